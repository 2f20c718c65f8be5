"""A lab's calibration: where everything is and what may never be exceeded, in one TOML file that people can read.

    python -m i2t.hardware.rig lab.toml --example    # write one to start from
    python -m i2t.hardware.rig lab.toml              # check it and say what it means

Frames: W world (z up, its origin on the table), B robot base, F flange, T tool (the skin: origin at its centre, z out
of it), C camera (z forward), O object; `T_a_b` maps points in b to a. Metres, kilograms, newtons. A file holds every
pose as the four rows of its matrix; what is missing, unknown, not rigid or out of range is refused in one sentence.
Further skins that the tool carries are tables `[skins.NAME]` (`i2t.hardware.carried_skins`).
"""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from i2t import validation
from i2t.depth.camera import Camera
from i2t.errors import closest
from i2t.files.reading import read_toml
from i2t.files.writing import replacing
from i2t.geometry import inverse, nearest_rigid
from i2t.hardware.carried_skins import TEXT_KEYS, TOOL_SKIN, CarriedSkin, require_distinct
from i2t.hardware.motion_limits import MotionLimits, format_position
from i2t.patches.dimensions import MAX_POSE_M, ORTHOGONALITY_TOLERANCE, TWIST_LEVER_M
from i2t.types import Array

OBJECT_SOURCES = ("given", "registration")  # how an object's pose is known
MAX_TOOL_M = 0.5  # the largest sensible tool
POSES = {
    "T_flange_tool": MAX_TOOL_M,
    "T_tool_camera": MAX_TOOL_M,
    "T_world_base": MAX_POSE_M,
    "T_world_object": MAX_POSE_M,
}
NUMBER_RANGES = {"mass": (0.0, 20.0, "kg"), "looking_distance": (0.02, 2.0, "m")}  # of a payload, of a camera
MAX_CAMERA_TILT_DEG = 60  # between the camera's axis and the tool's, beyond which it cannot see what is touched
DEFAULT_OBJECT_STD_M = np.repeat([1e-3, math.radians(1) * TWIST_LEVER_M], 3)  # unless a rig says others

TABLES = {  # of a file, with their keys in order
    "tool": ("T_flange_tool", "mass", "centre", "skin"),
    "camera": ("T_tool_camera", "looking_distance", *(each.name for each in fields(Camera))),
    "world": ("T_world_base", "T_world_object", "object_from", "object_covariance"),
    "limits": tuple(each.name for each in fields(MotionLimits)),
}
TEXTS = {"skin", "model", "object_from"}
OPTIONAL = {*TEXTS, "coefficients", "object_covariance", *TABLES["limits"][2:]}
COMMENTS = {
    "tool": "the skin (T: origin at its centre, z out of it) on the flange, and what the flange carries (kg, m)",
    "camera": "the camera in the tool, how far from a surface it looks (m), and its depth image's lens (pixels)",
    "world": "the robot's base and the object in the world (m); object_from: given or registration; how far the object "
    "may be off along and about its own axes: object_covariance (m^2, turns in radians times 8.5 mm)",
    "limits": "box for the tool's origin in the base (m), m/s, m/s^2, N, Nm, the longest approach (m), and the "
    "stiffness of skin, arm and mount in series (N/m), with which collisions are reckoned",
}


def _pose(x: float, y: float, z: float) -> Array:
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    return pose


@dataclass(frozen=True, eq=False)
class Rig:
    """Calibration of a lab: places and limits. The defaults describe the emulators and the simulation, no lab.

    Raises ValueError, with one sentence that names the field, for values that cannot be.
    """

    T_flange_tool: Array = field(default_factory=lambda: _pose(0.0, 0.0, 0.05))  # (4, 4), the robot's TCP
    mass: float = 0.5  # kg, of all that the flange carries
    centre: tuple[float, float, float] = (0.0, 0.0, 0.03)  # m, its centre of mass in the flange
    T_tool_camera: Array = field(default_factory=lambda: _pose(0.0, 0.0, -0.064))  # the paper's: 64 mm behind the skin
    looking_distance: float = 0.104  # m from the camera to the surface it looks at
    camera: Camera = field(default_factory=lambda: Camera(640, 360, fx=322.4, fy=322.1, cx=319.5, cy=179.5))
    T_world_base: Array = field(default_factory=lambda: _pose(-0.4, 0.0, 0.0))
    T_world_object: Array = field(default_factory=lambda: np.eye(4))
    object_from: str = "given"  # or registration: the pose is where registering its depth starts from
    limits: MotionLimits = field(default_factory=lambda: MotionLimits((0.25, -0.15, 0.005), (0.55, 0.15, 0.45)))
    object_covariance: Array = field(
        default_factory=lambda: np.diag(DEFAULT_OBJECT_STD_M) ** 2
    )  # (6, 6) m^2 (`i2t.registration.touch`)
    skin: str = TOOL_SKIN  # name of the skin in the tool's frame, which presses
    skins: tuple[CarriedSkin, ...] = ()  # further ones, which are read in each touch

    def __post_init__(self) -> None:
        require_distinct(self.skin, self.skins)
        for name, far in POSES.items():
            object.__setattr__(self, name, _rigid(_key(name), getattr(self, name), far))
        centre = _numbers("tool.centre", self.centre, (3,))
        if np.abs(centre).max() > MAX_TOOL_M:
            raise ValueError(f"tool.centre is {self.centre}; give m from the flange, each within {MAX_TOOL_M} m")
        object.__setattr__(self, "centre", tuple(centre.tolist()))
        for name, (least, most, unit) in NUMBER_RANGES.items():
            value = float(_numbers(_key(name), getattr(self, name), ()))
            if not least <= value <= most:
                raise ValueError(f"{_key(name)} is {value:g}; give {unit}, from {least:g} to {most:g}")
            object.__setattr__(self, name, value)
        object.__setattr__(self, "object_covariance", _covariance("world.object_covariance", self.object_covariance))
        if self.object_from not in OBJECT_SOURCES:
            raise ValueError(f"world.object_from is {self.object_from!r}; give one of {', '.join(OBJECT_SOURCES)}")
        if self.T_tool_camera[2, 2] < math.cos(math.radians(MAX_CAMERA_TILT_DEG)):
            raise ValueError(
                f"camera.T_tool_camera turns the camera's axis more than {MAX_CAMERA_TILT_DEG} degrees away from the "
                "tool's; its columns are the camera's axes in the tool, and it may be the inverse"
            )

    @property
    def T_base_world(self) -> Array:
        """(4, 4) world in base."""
        return inverse(self.T_world_base)

    @classmethod
    def read(cls, path: str | Path) -> "Rig":
        """The rig in a file.

        Args:
            path: Of the TOML file.

        Returns:
            The rig.

        Raises:
            ValueError: What is wrong with the file, in one sentence.
            FileNotFoundError: There is no such file.
        """
        start = f"write one to start from with python -m i2t.hardware.rig {path} --example"
        try:
            tables = read_toml(Path(path))
        except FileNotFoundError:
            raise FileNotFoundError(f"{path}: there is no such file; {start}") from None
        except OSError as error:
            raise ValueError(f"{path}: cannot be read ({error.strerror}); check its permissions") from error
        try:
            return _parsed(tables)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error

    def write(self, path: str | Path) -> None:
        """Write it to a file, whole or not at all.

        Args:
            path: Of the TOML file; one that is there is replaced.

        Raises:
            DataError: It cannot be written.
        """
        with replacing(Path(path)) as temporary:
            temporary.write_text(self.text(), encoding="utf-8")

    def text(self) -> str:
        """The rig as TOML."""
        lines = ["# A rig of i2t: T_a_b maps points in b to a, as the four rows of its matrix."]
        left_out = {"skin"} if self.skin == TOOL_SKIN else set()
        for table, keys in TABLES.items():
            lines += ["", f"# {COMMENTS[table]}", f"[{table}]"]
            values = {**vars(self.limits), **vars(self.camera), **vars(self)}
            lines += [f"{key} = {_toml(values[key])}" for key in keys if key not in left_out]
        for skin in self.skins:
            given = {key: getattr(skin, key) for key in TEXT_KEYS if getattr(skin, key)}
            lines += ["", f"[skins.{skin.name}]", f"T_tool_skin = {_toml(skin.T_tool_skin)}"]
            lines += [f"{key} = {_toml(value)}" for key, value in given.items()]
        return "\n".join(lines) + "\n"


def summary(rig: Rig) -> str:
    """Summary of a rig, for a person to compare with what stands on the table.

    Args:
        rig: The lab's calibration.

    Returns:
        Five lines, and one for each further skin.
    """
    limits, sigma = rig.limits, np.sqrt(np.diagonal(rig.object_covariance))
    in_box = limits.contains((rig.T_base_world @ rig.T_world_object)[:3, 3], 0.05)
    return "\n".join(
        [
            f"skin      {1e3 * np.linalg.norm(rig.T_flange_tool[:3, 3]):.1f} mm from the flange; payload {rig.mass:g} "
            f"kg at {_mm(rig.centre)}",
            f"camera    {_mm(rig.T_tool_camera[:3, 3])} from the skin in its axes, {_tilt(rig.T_tool_camera):.1f} "
            f"degrees askew; looks from {1e3 * rig.looking_distance:.0f} mm; {rig.camera.width} x {rig.camera.height} "
            "pixels",
            f"object    at {format_position(rig.T_world_object[:3, 3])} m in the world ({rig.object_from}), within "
            f"{1e3 * sigma[:3].max():.1f} mm and {math.degrees(sigma[3:].max() / TWIST_LEVER_M):.1f} degrees"
            + ("" if in_box else "; OUTSIDE the box: nothing on it may be reachable"),
            f"box       {format_position(limits.lower)} to {format_position(limits.upper)} m in the base",
            f"limits    {limits.speed:g} m/s, {limits.acceleration:g} m/s^2, {limits.force:g} N, {limits.torque:g} Nm, "
            f"approaches of {1e3 * limits.approach_distance:g} mm; free motion at {1e3 * limits.free_speed:.0f} mm/s "
            f"at the most, which a collision at {limits.stiffness / 1e3:g} N/mm allows",
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
    """Degrees between the z axes of two frames."""
    return math.degrees(math.acos(float(np.clip(pose[2, 2], -1, 1))))


def _key(name: str) -> str:
    return next(f"{table}.{name}" for table, keys in TABLES.items() if name in keys)


def _parsed(tables: dict[str, Any]) -> Rig:
    skins = _carried(tables.pop("skins", {}))
    _known("table", tables, TABLES)
    values: dict[str, Any] = {}
    for table, keys in TABLES.items():
        given = tables.get(table)
        if not isinstance(given, dict):
            raise ValueError(f"[{table}] is missing; add that table, with {COMMENTS[table]}")
        _known(f"key of [{table}]", given, keys)
        missing = [key for key in keys if key not in given and key not in OPTIONAL]
        if missing:
            raise ValueError(f"{table}.{missing[0]} is missing; add it to [{table}]: {COMMENTS[table]}")
        values |= {key: _value(f"{table}.{key}", value) for key, value in given.items()}
    lens = {key: values.pop(key) for key in TABLES["camera"][2:] if key in values}
    bounds = {key: values.pop(key) for key in TABLES["limits"] if key in values}
    try:
        limits = MotionLimits(**bounds)
    except ValueError as error:
        raise ValueError(f"limits.{error}") from error
    return Rig(**values, camera=Camera(**lens), limits=limits, skins=skins)


def _carried(tables: Any) -> tuple[CarriedSkin, ...]:
    """The skins of the tables `[skins.NAME]`."""
    if not isinstance(tables, dict) or not all(isinstance(table, dict) for table in tables.values()):
        raise ValueError("skins is no table of tables; write [skins.NAME] for each further skin")
    for name, table in tables.items():
        _known(f"key of [skins.{name}]", table, ("T_tool_skin", *TEXT_KEYS))
        if "T_tool_skin" not in table:
            raise ValueError(f"skins.{name}.T_tool_skin is missing; add where the skin is in the tool")
        table["T_tool_skin"] = _rigid(f"skins.{name}.T_tool_skin", table["T_tool_skin"], POSES["T_flange_tool"])
        table |= {key: _text(f"skins.{name}.{key}", table[key]) for key in TEXT_KEYS if key in table}
    return tuple(CarriedSkin(name=name, **table) for name, table in tables.items())


def _value(key: str, value: Any) -> Any:
    """Value of a key of a file, as the type that it must be."""
    name = key.split(".")[1]
    if name in TEXTS:
        return _text(key, value)
    anything = {"coefficients": (len(value) if isinstance(value, list) else 1,), "object_covariance": (6, 6)}
    shapes = {**anything, **dict.fromkeys(POSES, (4, 4)), **dict.fromkeys(("centre", "lower", "upper"), (3,))}
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


def _known(what: str, given: dict[str, Any], known: Sequence[str] | dict[str, Any]) -> None:
    for key in given:
        if key not in known:
            close = closest(key, known)
            remedy = f"is it {close}?" if close else f"known are {', '.join(known)}"
            raise ValueError(f"{key!r} is no {what}; {remedy}")


def _numbers(key: str, value: Any, shape: tuple[int, ...]) -> Array:
    """An array of numbers of a shape, or a sentence that says what is wrong with it."""
    wanted = " x ".join(str(n) for n in shape) + " numbers" if shape else "one number"
    try:
        array = np.array(value)
    except ValueError:
        array = np.array(None)
    if array.dtype.kind not in "iuf" or array.shape != shape:
        raise ValueError(f"{key} is {value!r}; give {wanted}")
    if not np.isfinite(array).all():
        raise ValueError(f"{key} holds NaN or infinity; measure it again, or take an older file's value")
    return array.astype(float)


def _rigid(key: str, value: Any, far: float) -> Array:
    T = validation.pose(key, _numbers(key, value, (4, 4)), farthest=far)
    T = nearest_rigid(T)  # rounded digits are no part of a rotation
    T.flags.writeable = False
    return T


def _covariance(key: str, value: Any) -> Array:
    matrix = _numbers(key, value, (6, 6))
    if np.abs(matrix - matrix.T).max() > ORTHOGONALITY_TOLERANCE * np.abs(matrix).max():
        raise ValueError(f"{key} is not symmetric; copy it whole")
    if np.linalg.eigvalsh(matrix).min() < -ORTHOGONALITY_TOLERANCE * np.abs(matrix).max():
        raise ValueError(f"{key} has a negative variance; copy it whole")
    if np.sqrt(np.diagonal(matrix).max()) > MAX_TOOL_M:
        raise ValueError(f"{key} says {np.sqrt(np.diagonal(matrix).max()):g} m; give variances in m^2")
    matrix.flags.writeable = False
    return matrix


def _toml(value: Any) -> str:
    if np.ndim(value) == 2:
        return "[\n" + "".join(f"  {_toml(row)},\n" for row in value) + "]"
    plain = value.tolist() if isinstance(value, np.ndarray) else list(value) if isinstance(value, tuple) else value
    return json.dumps(plain, ensure_ascii=False)
