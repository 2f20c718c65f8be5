"""Calibration of a lab: the poses of its devices and the limits of its arm, in one readable TOML file.

    i2t rig lab.toml --example    # write an example to start from
    i2t rig lab.toml              # check the file and explain what it means

Frames: W world (z up, its origin on the table), B robot base, F flange, T tool (the skin: origin at its centre, z out
of it), C camera (z forward), O object; `T_a_b` maps points in b to a. Metres, kilograms, newtons. A file holds every
pose as the four rows of its matrix. Values that are missing, unknown, not rigid or out of range are refused. Further
skins on the tool are tables `[skins.NAME]` (`i2t.hardware.carried_skins`).
"""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from i2t import validation
from i2t.depth.camera import Camera
from i2t.errors import closest
from i2t.files.reading import read_toml
from i2t.files.writing import replacing
from i2t.geometry import inverse, nearest_rigid
from i2t.hardware.carried_skins import TEXT_KEYS, TOOL_SKIN, CarriedSkin, require_distinct
from i2t.hardware.limits import SAFETY, range_of
from i2t.hardware.motion_limits import MotionLimits, format_position
from i2t.patches.dimensions import MAX_POSE_M, ORTHOGONALITY_TOLERANCE, TWIST_LEVER_M
from i2t.types import Array

# Poses in a rig, with the largest accepted translation (m) along an axis.
POSES = {
    "T_flange_tool": SAFETY.max_tool_offset_m,
    "T_tool_camera": SAFETY.max_tool_offset_m,
    "T_world_base": MAX_POSE_M,
    "T_world_object": MAX_POSE_M,
}


class _Table(NamedTuple):
    """A table of a file, with its keys in order."""

    comment: str
    required: tuple[str, ...]
    optional: tuple[str, ...]

    @property
    def keys(self) -> tuple[str, ...]:
        return self.required + self.optional


# Tables of a rig file: comment, required keys and optional keys.
# CAUTION: The comments are part of a rig's hash; a changed comment keeps a collection from being resumed.
TABLES = {
    "tool": _Table(
        "the skin (T: origin at its centre, z out of it) on the flange, and what the flange carries (kg, m)",
        ("T_flange_tool", "mass", "centre"),
        ("skin",),
    ),
    "camera": _Table(
        "the camera in the tool, how far from a surface it looks (m), and its depth image's lens (pixels)",
        ("T_tool_camera", "looking_distance", "width", "height", "fx", "fy", "cx", "cy"),
        ("model", "coefficients"),
    ),
    "world": _Table(
        "the robot's base and the object in the world (m); object_from: given or registration; how far the "
        "object may be off along and about its own axes: object_covariance (m^2, turns in radians times 8.5 mm)",
        ("T_world_base", "T_world_object"),
        ("object_from", "object_covariance"),
    ),
    "limits": _Table(
        "box for the tool's origin in the base (m), m/s, m/s^2, N, Nm, the longest approach (m), and the stiffness of "
        "skin, arm and mount in series (N/m), with which collisions are reckoned",
        ("lower", "upper"),
        tuple(limit.name for limit in fields(MotionLimits))[2:],
    ),
}


def _pose(x: float, y: float, z: float) -> Array:
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    return pose


@dataclass(frozen=True, eq=False)
class Rig:
    """Calibration of a lab: poses (m) of tool, camera, base and object, payload (kg), lens, limits and further skins.

    The defaults describe the emulated and simulated lab. The pose of the object has a covariance (m^2).

    Raises ValueError, which names the field, for an invalid value.
    """

    # (4, 4) pose of the tool in the flange, the robot's TCP, m
    T_flange_tool: Array = field(default_factory=lambda: _pose(0.0, 0.0, 0.05))
    mass: float = 0.5  # kg, mass of everything on the flange
    # m, centre of mass of everything on the flange, in the flange
    centre: tuple[float, float, float] = (0.0, 0.0, 0.03)
    # (4, 4) pose of the camera in the tool, m; by default, as in the paper
    T_tool_camera: Array = field(default_factory=lambda: _pose(0.0, 0.0, -0.064))
    looking_distance: float = 0.104  # m, distance from the camera to the surface that it looks at
    camera: Camera = field(default_factory=lambda: Camera(640, 360, fx=322.4, fy=322.1, cx=319.5, cy=179.5))
    T_world_base: Array = field(default_factory=lambda: _pose(-0.4, 0.0, 0.0))
    T_world_object: Array = field(default_factory=lambda: np.eye(4))
    object_from: str = "given"  # origin of the object's pose: given, or registration, which starts from this pose
    limits: MotionLimits = field(default_factory=lambda: MotionLimits((0.25, -0.15, 0.005), (0.55, 0.15, 0.45)))
    # (6, 6) m^2 (`i2t.registration.touch`): by default, 1 mm and 1 degree along and about each axis
    object_covariance: Array = field(
        default_factory=lambda: np.diag(np.repeat([1e-3, math.radians(1) * TWIST_LEVER_M], 3)) ** 2
    )
    skin: str = TOOL_SKIN  # name of the skin in the tool's frame, which presses
    skins: tuple[CarriedSkin, ...] = ()  # further skins, which are read in each touch

    def __post_init__(self) -> None:
        require_distinct(self.skin, self.skins)
        for name, max_offset in POSES.items():
            object.__setattr__(self, name, _rigid(_key(name), getattr(self, name), max_offset))
        centre = _numbers("tool.centre", self.centre, (3,))
        reach = SAFETY.max_tool_offset_m
        if np.abs(centre).max() > reach:
            raise ValueError(f"tool.centre is {self.centre}; give m from the flange, each within {reach} m")
        object.__setattr__(self, "centre", tuple(centre.tolist()))
        for name in ("mass", "looking_distance"):
            value, (low, high, unit) = float(_numbers(_key(name), getattr(self, name), ())), range_of(name)
            if not low <= value <= high:
                raise ValueError(f"{_key(name)} is {value:g}; give {unit}, from {low:g} to {high:g}")
            object.__setattr__(self, name, value)
        object.__setattr__(self, "object_covariance", _covariance("world.object_covariance", self.object_covariance))
        if self.object_from not in ("given", "registration"):
            raise ValueError(f"world.object_from is {self.object_from!r}; give one of given, registration")
        tilt = SAFETY.max_camera_tilt_deg
        if self.T_tool_camera[2, 2] < math.cos(math.radians(tilt)):
            raise ValueError(
                f"camera.T_tool_camera turns the camera's axis more than {tilt} degrees away from the tool's; its "
                "columns are the camera's axes in the tool, and it may be the inverse"
            )

    @property
    def T_base_world(self) -> Array:
        """(4, 4) pose of the world in the robot's base, m; the inverse of `T_world_base`."""
        return inverse(self.T_world_base)

    @classmethod
    def read(cls, path: str | Path) -> "Rig":
        """Read a rig from a TOML file.

        Args:
            path: Path of the TOML file.

        Returns:
            The rig that the file describes.

        Raises:
            ValueError: The file cannot be read, or a value in it is invalid; the message names file and field.
            FileNotFoundError: The file does not exist.
        """
        remedy = f"write one to start from with i2t rig {path} --example"
        try:
            tables = read_toml(Path(path))
        except FileNotFoundError:
            raise FileNotFoundError(f"{path}: there is no such file; {remedy}") from None
        except OSError as error:
            raise ValueError(f"{path}: cannot be read ({error.strerror}); check its permissions") from error
        try:
            return _parsed(tables)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error

    def write(self, path: str | Path) -> None:
        """Write the rig to a TOML file, completely or not at all.

        Args:
            path: Path of the TOML file; an existing file is replaced.

        Raises:
            DataError: The file cannot be written.
        """
        with replacing(Path(path)) as temporary:
            temporary.write_text(self.text(), encoding="utf-8")

    def text(self) -> str:
        """Return the rig as TOML text, which `read` reads."""
        lines = ["# A rig of i2t: T_a_b maps points in b to a, as the four rows of its matrix."]
        left_out = {"skin"} if self.skin == TOOL_SKIN else set()
        for name, table in TABLES.items():
            lines += ["", f"# {table.comment}", f"[{name}]"]
            values = {**vars(self.limits), **vars(self.camera), **vars(self)}
            lines += [f"{key} = {_toml(values[key])}" for key in table.keys if key not in left_out]
        for skin in self.skins:
            given = {key: getattr(skin, key) for key in TEXT_KEYS if getattr(skin, key)}
            lines += ["", f"[skins.{skin.name}]", f"T_tool_skin = {_toml(skin.T_tool_skin)}"]
            lines += [f"{key} = {_toml(value)}" for key, value in given.items()]
        return "\n".join(lines) + "\n"


def summary(rig: Rig) -> str:
    """Summarise a rig in words and numbers, for comparison with the real devices.

    Args:
        rig: Calibration of the lab.

    Returns:
        Five lines of text, and one for each further skin.
    """
    limits, sigma = rig.limits, np.sqrt(np.diagonal(rig.object_covariance))
    in_box = limits.contains((rig.T_base_world @ rig.T_world_object)[:3, 3], 0.05)
    return "\n".join(
        [
            f"skin      {1e3 * np.linalg.norm(rig.T_flange_tool[:3, 3]):.1f} mm from the flange; payload {rig.mass:g} "
            f"kg at {_mm(rig.centre)}",
            f"camera    {_mm(rig.T_tool_camera[:3, 3])} from the skin in its axes, {_tilt(rig.T_tool_camera):.1f} "
            f"degrees tilted; looks from {1e3 * rig.looking_distance:.0f} mm; {rig.camera.width} x {rig.camera.height} "
            "pixels",
            f"object    at {format_position(rig.T_world_object[:3, 3])} m in the world ({rig.object_from}), within "
            f"{1e3 * sigma[:3].max():.1f} mm and {math.degrees(sigma[3:].max() / TWIST_LEVER_M):.1f} degrees"
            + ("" if in_box else "; OUTSIDE the box: nothing on it may be reachable"),
            f"box       {format_position(limits.lower)} to {format_position(limits.upper)} m in the base",
            f"limits    {limits.speed:g} m/s, {limits.acceleration:g} m/s^2, {limits.force:g} N, {limits.torque:g} Nm, "
            f"approaches of {1e3 * limits.approach_distance:g} mm; free motion at {1e3 * limits.free_speed:.0f} mm/s "
            f"at most, for a collision at {limits.stiffness / 1e3:g} N/mm",
            *(
                f"skin      {skin.name}: {skin.device} {skin.serial_number or skin.address}, board {skin.board}, at "
                f"{_mm(skin.T_tool_skin[:3, 3])} in the tool, facing {_tilt(skin.T_tool_skin):.0f} degrees off its z"
                for skin in rig.skins
            ),
        ]
    )


def _mm(position: Sequence[float] | Array) -> str:
    return f"{np.round(1e3 * np.asarray(position), 1).tolist()} mm"


def _tilt(pose: Array) -> float:
    """Angle in degrees between the z axes of two frames."""
    return math.degrees(math.acos(float(np.clip(pose[2, 2], -1, 1))))


def _key(name: str) -> str:
    return next(f"{table}.{name}" for table, content in TABLES.items() if name in content.keys)


def _parsed(tables: dict[str, Any]) -> Rig:
    skins = _carried(tables.pop("skins", {}))
    _require_known("table", tables, tuple(TABLES))
    values: dict[str, Any] = {}
    for name, table in TABLES.items():
        given = tables.get(name)
        if not isinstance(given, dict):
            raise ValueError(f"[{name}] is missing; add that table, with {table.comment}")
        _require_known(f"key of [{name}]", given, table.keys)
        missing = [key for key in table.required if key not in given]
        if missing:
            raise ValueError(f"{name}.{missing[0]} is missing; add it to [{name}]: {table.comment}")
        values |= {key: _value(f"{name}.{key}", value) for key, value in given.items()}
    lens = {key.name: values.pop(key.name) for key in fields(Camera) if key.name in values}
    bounds = {key: values.pop(key) for key in TABLES["limits"].keys if key in values}
    try:
        limits = MotionLimits(**bounds)
    except ValueError as error:
        raise ValueError(f"limits.{error}") from error
    return Rig(**values, camera=Camera(**lens), limits=limits, skins=skins)


def _carried(tables: Any) -> tuple[CarriedSkin, ...]:
    """Parse the tables `[skins.NAME]`."""
    if not isinstance(tables, dict) or not all(isinstance(table, dict) for table in tables.values()):
        raise ValueError("skins is not a table of tables; write [skins.NAME] for each further skin")
    for name, table in tables.items():
        _require_known(f"key of [skins.{name}]", table, ("T_tool_skin", *TEXT_KEYS))
        if "T_tool_skin" not in table:
            raise ValueError(f"skins.{name}.T_tool_skin is missing; add the skin's pose in the tool")
        table["T_tool_skin"] = _rigid(f"skins.{name}.T_tool_skin", table["T_tool_skin"], POSES["T_flange_tool"])
        table |= {key: _text(f"skins.{name}.{key}", table[key]) for key in TEXT_KEYS if key in table}
    return tuple(CarriedSkin(name=name, **table) for name, table in tables.items())


def _value(key: str, value: Any) -> Any:
    """Convert the value of a key to the type of its field."""
    name = key.split(".")[1]
    if name in ("skin", "model", "object_from"):
        return _text(key, value)
    lengths = {"coefficients": (len(value) if isinstance(value, list) else 1,), "object_covariance": (6, 6)}
    shapes = {**lengths, **dict.fromkeys(POSES, (4, 4)), **dict.fromkeys(("centre", "lower", "upper"), (3,))}
    array = _numbers(key, value, shapes.get(name, ()))
    if array.ndim:
        return array if array.ndim == 2 else tuple(array.tolist())
    if name not in ("width", "height"):
        return float(array)
    if array % 1:
        raise ValueError(f"{key} is {value}; give whole pixels")
    return int(array)


def _text(key: str, value: Any) -> str:
    if not isinstance(value, str):
        raise ValueError(f"{key} is {value!r}; give a word in quotes")
    return value


def _require_known(what: str, given: dict[str, Any], names: tuple[str, ...]) -> None:
    for key in given:
        if key not in names:
            close = closest(key, names)
            remedy = f"is it {close}?" if close else f"give one of {', '.join(names)}"
            raise ValueError(f"{key!r} is not a {what}; {remedy}")


def _numbers(key: str, value: Any, shape: tuple[int, ...]) -> Array:
    """Convert a value to an array of a shape; raise ValueError if it is not one."""
    wanted = " x ".join(str(n) for n in shape) + " numbers" if shape else "one number"
    try:
        array = np.array(value)
    except ValueError:
        array = np.array(None)
    if array.dtype.kind not in "iuf" or array.shape != shape:
        raise ValueError(f"{key} is {value!r}; give {wanted}")
    if not np.isfinite(array).all():
        raise ValueError(f"{key} holds NaN or infinity; measure it again, or take the value of an older file")
    return array.astype(float)


def _rigid(key: str, value: Any, max_offset: float) -> Array:
    T = validation.pose(key, _numbers(key, value, (4, 4)), farthest=max_offset)
    T = nearest_rigid(T)  # rounded digits make it slightly non-rigid
    T.flags.writeable = False
    return T


def _covariance(key: str, value: Any) -> Array:
    matrix = _numbers(key, value, (6, 6))
    if np.abs(matrix - matrix.T).max() > ORTHOGONALITY_TOLERANCE * np.abs(matrix).max():
        raise ValueError(f"{key} is not symmetric; copy it whole")
    if np.linalg.eigvalsh(matrix).min() < -ORTHOGONALITY_TOLERANCE * np.abs(matrix).max():
        raise ValueError(f"{key} has a negative variance; copy it whole")
    if np.sqrt(np.diagonal(matrix).max()) > SAFETY.max_tool_offset_m:
        raise ValueError(f"{key} means {np.sqrt(np.diagonal(matrix).max()):g} m; give variances in m^2")
    matrix.flags.writeable = False
    return matrix


def _toml(value: Any) -> str:
    if np.ndim(value) == 2:
        return "[\n" + "".join(f"  {_toml(row)},\n" for row in value) + "]"
    plain = value.tolist() if isinstance(value, np.ndarray) else list(value) if isinstance(value, tuple) else value
    return json.dumps(plain, ensure_ascii=False)
