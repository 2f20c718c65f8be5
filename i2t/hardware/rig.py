"""A lab's calibration: where everything is and what may never be exceeded, in one TOML file that people can read.

    python -m i2t.hardware.rig lab.toml --example    # write one to start from
    python -m i2t.hardware.rig lab.toml              # check it and say what it means

Frames: W world (z up, its origin on the table), B robot base, F flange, T tool (the skin: origin at its centre, z out
of it), C camera (z forward), O object; `T_a_b` maps points in b to a. Metres, kilograms, newtons. A file holds every
pose as the four rows of its matrix; what is missing, unknown, not rigid or out of range is refused in one sentence.
Further skins that the tool carries are tables `[skins.NAME]` (`i2t.hardware.carried_skins`).
"""

import difflib
import math
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from i2t.cli import exit_code_of
from i2t.depth.camera import Camera
from i2t.files import read_toml, replacing
from i2t.geometry import inverse, nearest_rigid
from i2t.hardware.carried_skins import (
    TEXT_KEYS,
    TOOL_SKIN,
    CarriedSkin,
    carried_keys,
    require_distinct,
    require_skin_name,
)
from i2t.hardware.kinematics import arms
from i2t.hardware.limits import MotionLimits, format_position
from i2t.hardware.rig_checks import implausible
from i2t.options import read_options
from i2t.types import ORTHOGONALITY_TOLERANCE, TWIST_LEVER_M, Array

OBJECT_SOURCES = ("given", "registration")  # how an object's pose is known
MAX_PAYLOAD_KG = 20.0  # kg, that a UR arm carries
MAX_TOOL_M, MAX_LAB_M = 0.5, 10.0  # the largest sensible tool and lab
MIN_LOOKING_M, MAX_LOOKING_M = 0.02, 2.0  # from which a camera may look
MAX_CAMERA_TILT_RAD = math.radians(
    60
)  # between the camera's axis and the tool's, beyond which it cannot see what is touched
DEFAULT_OBJECT_STD_M = np.repeat(
    [1e-3, math.radians(1) * TWIST_LEVER_M], 3
)  # standard deviations unless a rig says others

COMMENTS = {
    "tool": "the skin (T: origin at its centre, z out of it) on the flange, and what the flange carries (kg, m)",
    "camera": "the camera in the tool, how far from a surface it looks (m), and its depth image's lens (pixels)",
    "world": "the robot's base and the object in the world (m); object_from: given or registration; how far the object "
    "may be off along and about its own axes: object_covariance (m^2, turns in radians times 8.5 mm)",
    "limits": "box for the tool's origin in the base (m), m/s, m/s^2, N, Nm, the longest approach (m), and the "
    "stiffness of skin, arm and mount in series (N/m), with which collisions are reckoned",
    "skins": "a further skin: its frame in the tool (m), its device, board and pad, and its port or serial number",
}

RENAMED_RIG_KEYS = {"limits": {"travel": "approach_distance"}}  # earlier name to name: files of both are read


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
    arm: str = ""  # a name of `i2t.hardware.kinematics.arms`, whose reach is then planned with; empty: it is not known
    skin: str = TOOL_SKIN  # name of the skin in the tool's frame, which presses
    skins: tuple[CarriedSkin, ...] = ()  # further ones, which are read in each touch

    def __post_init__(self) -> None:
        require_skin_name("tool.skin", self.skin)
        require_distinct(self.skin, self.skins)
        for name, far in (
            ("T_flange_tool", MAX_TOOL_M),
            ("T_tool_camera", MAX_TOOL_M),
            ("T_world_base", MAX_LAB_M),
            ("T_world_object", MAX_LAB_M),
        ):
            object.__setattr__(self, name, _rigid(_key(name), getattr(self, name), far))
        centre = _numbers("tool.centre", self.centre, (3,))
        if np.abs(centre).max() > MAX_TOOL_M:
            raise ValueError(
                f"tool.centre is {self.centre}; give x, y, z in m from the flange, each within {MAX_TOOL_M} m"
            )
        object.__setattr__(self, "centre", tuple(float(x) for x in centre))
        for name, least, most, unit in (
            ("mass", 0.0, MAX_PAYLOAD_KG, "kg"),
            ("looking_distance", MIN_LOOKING_M, MAX_LOOKING_M, "m"),
        ):
            value = float(_numbers(_key(name), getattr(self, name), ()))
            if not least <= value <= most:
                raise ValueError(f"{_key(name)} is {value:g}; give {unit}, from {least:g} to {most:g}")
            object.__setattr__(self, name, value)
        object.__setattr__(self, "object_covariance", _covariance("world.object_covariance", self.object_covariance))
        if self.arm and self.arm not in arms():
            raise ValueError(f"tool.arm is {self.arm!r}; give one of {', '.join(arms())}, or leave it out")
        if self.object_from not in OBJECT_SOURCES:
            raise ValueError(f"world.object_from is {self.object_from!r}; give one of {', '.join(OBJECT_SOURCES)}")
        if self.T_tool_camera[2, 2] < math.cos(MAX_CAMERA_TILT_RAD):
            raise ValueError(
                "camera.T_tool_camera turns the camera's axis more than 60 degrees away from the tool's, so it cannot "
                "see what is touched; its columns are the camera's axes in the tool, and it may be the inverse"
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
        path = Path(path)
        try:
            tables = read_toml(path)
        except FileNotFoundError:
            raise FileNotFoundError(
                f"{path}: there is no such file; write one to start from with python -m i2t.hardware.rig {path} "
                "--example"
            ) from None
        except OSError as error:
            raise ValueError(
                f"{path}: cannot be read ({error.strerror}); check the path and its permissions"
            ) from error
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
        for table, keys in _tables().items():
            lines += ["", f"# {COMMENTS[table]}", f"[{table}]"]
            values = self._values(table)
            left_out = {key for key, default in (("arm", ""), ("skin", TOOL_SKIN)) if getattr(self, key) == default}
            lines += [f"{key} = {_toml(values[key])}" for key in keys if key not in left_out]
        for skin in self.skins:
            lines += ["", f"# {COMMENTS['skins']}", *skin.text(_toml(skin.T_tool_skin))]
        return "\n".join(lines) + "\n"

    def _values(self, table: str) -> dict[str, Any]:
        if table == "limits":
            return asdict(self.limits)
        own = {each.name: getattr(self, each.name) for each in fields(self)}
        return {**asdict(self.camera), **own} if table == "camera" else own


def _tables() -> dict[str, list[str]]:
    """The keys of each table of a file, in order."""
    return {
        "tool": ["T_flange_tool", "mass", "centre", "arm", "skin"],
        "camera": ["T_tool_camera", "looking_distance", *(each.name for each in fields(Camera))],
        "world": ["T_world_base", "T_world_object", "object_from", "object_covariance"],
        "limits": [each.name for each in fields(MotionLimits)],
    }


def _key(name: str) -> str:
    return next(f"{table}.{name}" for table, keys in _tables().items() if name in keys)


def _parsed(tables: dict[str, Any]) -> Rig:
    known = _tables()
    skins = _carried(tables.pop("skins", {})) if isinstance(tables, dict) else ()
    _known("table", tables, [*known, "skins"])
    tables = {table: _with_present_names(table, values) for table, values in tables.items()}
    for table, keys in known.items():
        if not isinstance(tables.get(table), dict):
            raise ValueError(f"[{table}] is missing; add that table, with {COMMENTS[table]}")
        _known(f"key of [{table}]", tables[table], keys)
        own = {"arm", "skin", "model", "coefficients", "object_from", "object_covariance"}
        optional = {each.name for each in fields(MotionLimits)[2:]} | own
        missing = [key for key in keys if key not in tables[table] and key not in optional]
        if missing:
            raise ValueError(f"{table}.{missing[0]} is missing; add it to [{table}]: {COMMENTS[table]}")
    values = {table: {key: _value(f"{table}.{key}", tables[table][key]) for key in tables[table]} for table in known}
    camera = {key: values["camera"].pop(key) for key in known["camera"][2:] if key in values["camera"]}
    try:
        limits = MotionLimits(**values["limits"])
    except ValueError as error:
        raise ValueError(f"limits.{error}") from error
    places = {**values["tool"], **values["camera"], **values["world"]}
    return Rig(**places, camera=Camera(**camera), limits=limits, skins=skins)


def _carried(tables: Any) -> tuple[CarriedSkin, ...]:
    """The skins of the tables `[skins.NAME]`."""
    if not isinstance(tables, dict) or not all(isinstance(table, dict) for table in tables.values()):
        raise ValueError("skins is no table of tables; write [skins.NAME] for each further skin")
    found = []
    for name, table in tables.items():
        _known(f"key of [skins.{name}]", table, carried_keys())
        if "T_tool_skin" not in table:
            raise ValueError(f"skins.{name}.T_tool_skin is missing; add where the skin is in the tool")
        for key in TEXT_KEYS:
            if not isinstance(table.get(key, ""), str):
                raise ValueError(f"skins.{name}.{key} is {table[key]!r}; give a word in quotes")
        pose = _rigid(f"skins.{name}.T_tool_skin", table["T_tool_skin"], MAX_TOOL_M)
        found.append(CarriedSkin(**{**table, "name": name, "T_tool_skin": pose}))
    return tuple(found)


def _value(key: str, value: Any) -> Any:
    """Value of a key of a file, as the type that it must be."""
    name = key.split(".")[1]
    if name in ("arm", "skin", "model", "object_from"):
        if not isinstance(value, str):
            raise ValueError(f"{key} is {value!r}; give a word in quotes")
        return value
    if name == "coefficients":
        return tuple(_numbers(key, value, (len(value) if isinstance(value, list) else 1,)).tolist())
    if name in ("width", "height"):
        whole = float(_numbers(key, value, ()))
        if not whole.is_integer():
            raise ValueError(f"{key} is {value}; give whole pixels")
        return int(whole)
    square = {"object_covariance": (6, 6)}.get(name, (4, 4) if name.startswith("T_") else None)
    shape = square or ((3,) if name in ("centre", "lower", "upper") else ())
    array = _numbers(key, value, shape)
    return array if square else tuple(array.tolist()) if shape else float(array)


def _with_present_names(table: str, values: Any) -> Any:
    """A table of a file, which may be of an earlier version, with the keys' names of this one."""
    for earlier, name in RENAMED_RIG_KEYS.get(table, {}).items():
        if isinstance(values, dict) and earlier in values:
            if name in values:
                raise ValueError(f"[{table}] has {name} and {earlier}, its earlier name; keep {name}")
            values = {name if key == earlier else key: value for key, value in values.items()}
    return values


def _known(what: str, given: dict[str, Any], known: list[str]) -> None:
    for key in given:
        if key not in known:
            close = difflib.get_close_matches(key, known, 1, 0.5)
            remedy = f"is it {close[0]}?" if close else f"known are {', '.join(known)}"
            raise ValueError(f"{key!r} is no {what}; {remedy}")


def _numbers(key: str, value: Any, shape: tuple[int, ...]) -> Array:
    """An array of numbers of a shape, or a sentence that says what is wrong with it."""
    wanted = " x ".join(str(n) for n in shape) + " numbers" if shape else "one number"
    try:
        array = np.array(value)
    except ValueError:
        array = np.array(None)
    if array.dtype.kind not in "iuf" or array.shape != shape:
        shown = " x ".join(str(n) for n in array.shape) if array.dtype.kind in "iuf" and array.shape else repr(value)
        raise ValueError(f"{key} is {shown}; give {wanted}")
    if not np.isfinite(array).all():
        raise ValueError(f"{key} holds NaN or infinity; measure it again, or take an older file's value")
    return array.astype(float)


def _rigid(key: str, value: Any, far: float) -> Array:
    T = _numbers(key, value, (4, 4))
    if not np.array_equal(T[3], [0, 0, 0, 1]):
        hint = "it is transposed" if np.array_equal(T[:, 3], [0, 0, 0, 1]) else "write [0, 0, 0, 1]"
        raise ValueError(f"{key} has the last row {T[3].tolist()}; {hint}")
    if np.abs(T[:3, :3].T @ T[:3, :3] - np.eye(3)).max() > ORTHOGONALITY_TOLERANCE:
        raise ValueError(f"{key} holds no rotation: its columns are not orthonormal; copy it with six digits or more")
    if np.linalg.det(T[:3, :3]) < 0:
        raise ValueError(f"{key} holds a reflection: an axis has the wrong sign; make z the cross product of x and y")
    if np.abs(T[:3, 3]).max() > far:
        raise ValueError(f"{key} lies {np.abs(T[:3, 3]).max():g} m away; give metres, each within {far:g} m")
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
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, int | np.integer):
        return str(int(value))
    if np.ndim(value) == 2:
        return "[\n" + "".join(f"  {_toml(row)},\n" for row in value) + "]"
    if np.ndim(value) == 1:
        return "[" + ", ".join(_toml(each) for each in value) + "]"
    return repr(float(value))


@dataclass(frozen=True)
class RigArgs:
    """Check a lab's calibration and say what it means."""

    file: tyro.conf.Positional[Path]  # the lab's calibration
    example: bool = False  # write that of the emulators, to start from


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        arguments: Without the program's name; by default those of this process.

    Returns:
        The exit code.
    """
    asked = read_options(RigArgs, arguments, program="python -m i2t.hardware.rig", description=__doc__)

    def show() -> int:
        if asked.example and asked.file.exists():
            raise FileExistsError(f"{asked.file}: exists already; give another name")
        if asked.example:
            Rig().write(asked.file)
        rig = Rig.read(asked.file)
        print(summary(rig))
        doubts = implausible(rig)
        for doubt in doubts:
            print(f"DOUBT     {doubt}")
        return int(bool(doubts))

    return exit_code_of(show)


def summary(rig: Rig) -> str:
    """Summary of a rig, for a person to compare with what stands on the table.

    Args:
        rig: The lab's calibration.

    Returns:
        Five lines, and one for each further skin.
    """
    at, limits = (1e3 * rig.T_tool_camera[:3, 3]), rig.limits
    apart = math.degrees(math.acos(min(1.0, rig.T_tool_camera[2, 2])))
    sigma = np.sqrt(np.diagonal(rig.object_covariance))
    in_box = limits.contains((rig.T_base_world @ rig.T_world_object)[:3, 3], 0.05)
    return "\n".join(
        [
            f"skin      {1e3 * np.linalg.norm(rig.T_flange_tool[:3, 3]):.1f} mm from the flange; payload {rig.mass:g} "
            f"kg at {np.round(1e3 * np.array(rig.centre), 1).tolist()} mm",
            f"camera    {at.round(1).tolist()} mm from the skin in its axes, {apart:.1f} degrees askew; looks from "
            f"{1e3 * rig.looking_distance:.0f} mm; {rig.camera.width} x {rig.camera.height} pixels",
            f"object    at {format_position(rig.T_world_object[:3, 3])} m in the world ({rig.object_from}), within "
            f"{1e3 * sigma[:3].max():.1f} mm and {math.degrees(sigma[3:].max() / TWIST_LEVER_M):.1f} degrees"
            + ("" if in_box else "; OUTSIDE the box: nothing on it may be reachable"),
            f"box       {format_position(limits.lower)} to {format_position(limits.upper)} m in the base",
            f"limits    {limits.speed:g} m/s, {limits.acceleration:g} m/s^2, {limits.force:g} N, {limits.torque:g} Nm, "
            f"approaches of {1e3 * limits.approach_distance:g} mm; free motion at {1e3 * limits.free_speed:.0f} mm/s "
            f"at the most, which a collision at {limits.stiffness / 1e3:g} N/mm allows",
            *(_carried_line(skin) for skin in rig.skins),
        ]
    )


def _carried_line(skin: CarriedSkin) -> str:
    at = np.round(1e3 * skin.T_tool_skin[:3, 3], 1).tolist()
    apart = math.degrees(math.acos(float(np.clip(skin.T_tool_skin[2, 2], -1.0, 1.0))))
    where = f" {skin.serial_number or skin.address}" if skin.serial_number or skin.address else ""
    return (
        f"skin      {skin.name}: {skin.device}{where}, board {skin.board}, at {at} mm in the tool, facing "
        f"{apart:.0f} degrees off its z"
    )


if __name__ == "__main__":
    sys.exit(main())
