"""Mistakes that people make in a lab's calibration file: each turns a right rig into a wrong one.

The list was written before any of them was tried. Some are refused by the file's own checks, some by
`i2t.hardware.rig_checks`, some only by camera, arm and skin in the first looks and the first slow touch
(`i2t.collect.first_touch`).
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from i2t.depth.camera import Camera
from i2t.geometry import inverse, transform
from i2t.hardware.limits import MotionLimits
from i2t.hardware.rig import Rig
from i2t.types import Array


class RigMistake(NamedTuple):
    """A mistake."""

    name: str
    make: Callable[[Rig], Rig]  # of a right rig; raises ValueError where a rig refuses it by itself


def right_rig() -> Rig:
    """A rig in which every frame is turned, so that what is transposed or inverted is another.

    Returns:
        The rig; it is plausible, and its lens is that of its camera.
    """
    return Rig(
        T_flange_tool=_pose((0.010, -0.005, 0.080), (0.0, 0.0, 30.0)),
        mass=0.6,
        centre=(0.005, 0.0, 0.035),
        T_tool_camera=_pose((0.055, 0.010, -0.060), (0.0, -15.0, 90.0)),
        looking_distance=0.120,
        camera=Camera(320, 180, 161.2, 161.05, 158.0, 92.0),
        T_world_base=_pose((-0.10, -0.45, 0.02), (0.0, 0.0, 90.0)),
        T_world_object=_pose((0.03, -0.02, 0.0), (0.0, 0.0, 40.0)),
        limits=MotionLimits((0.26, -0.30, -0.012), (0.60, 0.04, 0.42)),
    )


def _pose(place: tuple[float, float, float], degrees: tuple[float, float, float]) -> Array:
    return transform(Rotation.from_euler("xyz", degrees, degrees=True).as_matrix(), np.array(place))


def _tool(name: str, change: Callable[[Array], Array]) -> RigMistake:
    """A wrong calibration of the skin in the flange; camera and skin were calibrated apart, so the camera stays."""
    return RigMistake(name, lambda rig: replace(rig, T_flange_tool=change(np.array(rig.T_flange_tool))))


def _camera(name: str, change: Callable[[Array], Array]) -> RigMistake:
    return RigMistake(name, lambda rig: replace(rig, T_tool_camera=change(np.array(rig.T_tool_camera))))


def _base(name: str, change: Callable[[Array], Array]) -> RigMistake:
    return RigMistake(name, lambda rig: replace(rig, T_world_base=change(np.array(rig.T_world_base))))


def _object(name: str, change: Callable[[Array], Array]) -> RigMistake:
    return RigMistake(name, lambda rig: replace(rig, T_world_object=change(np.array(rig.T_world_object))))


def _lens(name: str, **changes: Any) -> RigMistake:
    return RigMistake(name, lambda rig: replace(rig, camera=replace(rig.camera, **changes)))


def _limits(name: str, **changes: Any) -> RigMistake:
    return RigMistake(name, lambda rig: replace(rig, limits=replace(rig.limits, **changes)))


def _shifted(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Callable[[Array], Array]:
    """Shift a transform by some millimetres, along the axes of the frame to which it maps."""

    def change(T: Array) -> Array:
        T[:3, 3] += 1e-3 * np.array([x, y, z])
        return T

    return change


def _turned(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Callable[[Array], Array]:
    """Turn a frame about its own axes by some degrees."""
    return lambda T: T @ _pose((0.0, 0.0, 0.0), (x, y, z))


def _scaled(factor: float) -> Callable[[Array], Array]:
    """Give lengths in another unit."""

    def change(T: Array) -> Array:
        T[:3, 3] *= factor
        return T

    return change


def _transposed(T: Array) -> Array:
    T[:3, :3] = T[:3, :3].T
    return T


def _degrees_as_radians(T: Array) -> Array:
    """A rotation vector in degrees that was taken for one in radians."""
    vector = np.degrees(Rotation.from_matrix(T[:3, :3]).as_rotvec())
    T[:3, :3] = Rotation.from_rotvec(vector).as_matrix()
    return T


def _radians_as_degrees(T: Array) -> Array:
    """A rotation vector in radians that was taken for one in degrees."""
    vector = np.radians(Rotation.from_matrix(T[:3, :3]).as_rotvec())
    T[:3, :3] = Rotation.from_rotvec(vector).as_matrix()
    return T


def _quaternion_order(T: Array) -> Array:
    """A quaternion (w, x, y, z) that was taken for (x, y, z, w)."""
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
    T[:3, :3] = Rotation.from_quat([w, x, y, z]).as_matrix()
    return T


def _identity(T: Array) -> Array:
    return np.eye(4)


def _half_turn_standing(rig: Rig) -> Rig:
    """The object stands on its head: turned over, and lifted so that it still stands on the table."""
    T = rig.T_world_object @ _pose((0.0, 0.0, 0.03), (180.0, 0.0, 0.0))
    return replace(rig, T_world_object=T)


def _box_in_world(rig: Rig) -> Rig:
    """The box was measured in the world, and the file holds it in the base."""
    corners = np.array([rig.limits.lower, rig.limits.upper]) @ rig.T_world_base[:3, :3].T + rig.T_world_base[:3, 3]
    return replace(rig, limits=replace(rig.limits, lower=tuple(corners.min(0)), upper=tuple(corners.max(0))))


def _flange_camera(rig: Rig) -> Rig:
    return replace(rig, T_tool_camera=rig.T_flange_tool @ rig.T_tool_camera)


def _object_in_base(rig: Rig) -> Rig:
    return replace(rig, T_world_object=rig.T_base_world @ rig.T_world_object)


MISTAKES: tuple[RigMistake, ...] = (
    _tool("TCP flipped: z into the flange", _turned(x=180.0)),
    _tool("TCP 50 mm too long", _shifted(z=50.0)),
    _tool("TCP 50 mm too short", _shifted(z=-50.0)),
    _tool("TCP 10 mm too long", _shifted(z=10.0)),
    _tool("TCP 10 mm too short", _shifted(z=-10.0)),
    _tool("TCP 50 mm aside", _shifted(x=50.0)),
    _tool("TCP 20 mm aside", _shifted(y=20.0)),
    _tool("TCP left at the flange", _identity),
    _tool("TCP in millimetres", _scaled(1e3)),
    _tool("TCP in centimetres", _scaled(1e2)),
    _tool("TCP transposed", _transposed),
    _tool("TCP inverted", inverse),
    _tool("TCP: degrees for radians", _degrees_as_radians),
    _tool("TCP: quaternion in another order", _quaternion_order),
    _tool("TCP turned by half a turn about z", _turned(z=180.0)),
    _tool("TCP tilted by 15 degrees", _turned(y=15.0)),
    RigMistake("payload in grams", lambda rig: replace(rig, mass=1e3 * rig.mass)),
    RigMistake("payload zero", lambda rig: replace(rig, mass=0.0)),
    RigMistake("payload ten times as much", lambda rig: replace(rig, mass=10 * rig.mass)),
    RigMistake("payload a kilogram too much", lambda rig: replace(rig, mass=rig.mass + 1.0)),
    RigMistake("centre of mass in millimetres", lambda rig: replace(rig, centre=(5.0, 0.0, 35.0))),
    RigMistake("centre of mass behind the flange", lambda rig: replace(rig, centre=(0.005, 0.0, -0.035))),
    _camera("hand-eye inverted", inverse),
    _camera("hand-eye transposed", _transposed),
    _camera("hand-eye in millimetres", _scaled(1e3)),
    _camera("hand-eye left at the tool", _identity),
    _camera("camera looks backwards", _turned(x=180.0)),
    _camera(
        "camera axes of ROS, x forwards",
        lambda T: T @ transform(np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]]), np.zeros(3)),
    ),
    _camera("camera turned by a quarter about its axis", _turned(z=90.0)),
    _camera("camera mounted the other way round", _turned(z=180.0)),
    _camera("hand-eye: quaternion in another order", _quaternion_order),
    _camera("hand-eye: degrees for radians", _degrees_as_radians),
    _camera("hand-eye: radians for degrees", _radians_as_degrees),
    _camera("camera 50 mm too far back", _shifted(z=-50.0)),
    _camera("camera 20 mm aside", _shifted(x=20.0)),
    RigMistake("camera in the flange instead of the tool", _flange_camera),
    RigMistake("looking distance in millimetres", lambda rig: replace(rig, looking_distance=120.0)),
    RigMistake("looking distance in centimetres", lambda rig: replace(rig, looking_distance=12.0)),
    RigMistake("looking distance of a tenth", lambda rig: replace(rig, looking_distance=0.012)),
    _lens("fx 1.93, the lens in millimetres", fx=1.93, fy=1.93),
    _lens("fx of 1.93 alone", fx=1.93),
    RigMistake(
        "fx and fy swapped", lambda rig: replace(rig, camera=replace(rig.camera, fx=rig.camera.fy, fy=rig.camera.fx))
    ),
    _lens("principal point at the corner", cx=0.0, cy=0.0),
    _lens("cx and cy swapped", cx=92.0, cy=158.0),
    _lens("principal point 40 pixels off", cx=198.0),
    _lens("lens of an image of twice the size", fx=322.4, fy=322.1, cx=316.0, cy=184.0),
    _lens("lens of an image of half the size", fx=80.6, fy=80.5, cx=79.0, cy=46.0),
    _lens("width and height swapped", width=180, height=320),
    _base("base inverted", inverse),
    _base("base transposed", _transposed),
    _base("base in millimetres", _scaled(1e3)),
    _base("base not turned", lambda T: transform(np.eye(3), T[:3, 3])),
    _base("base turned the other way", _turned(z=180.0)),
    _base("base: degrees for radians", _degrees_as_radians),
    _base("base: radians for degrees", _radians_as_degrees),
    _base("base 100 mm too high", _shifted(z=100.0)),
    _base("base 20 mm too low", _shifted(z=-20.0)),
    _base("base 100 mm aside", _shifted(x=100.0)),
    _object("object upside down", _turned(x=180.0)),
    RigMistake("object on its head", _half_turn_standing),
    _object("object on its side", _turned(x=90.0)),
    _object("object 100 mm off along x", _shifted(x=100.0)),
    _object("object 100 mm off along y", _shifted(y=-100.0)),
    _object("object 30 mm aside", _shifted(x=30.0)),
    _object("object 50 mm too high", _shifted(z=50.0)),
    _object("object 50 mm too low", _shifted(z=-50.0)),
    _object("object 10 mm too high", _shifted(z=10.0)),
    _object("object in millimetres", _scaled(1e3)),
    _object("object in centimetres", _scaled(1e2)),
    _object("object inverted", inverse),
    RigMistake("object in the base instead of the world", _object_in_base),
    RigMistake(
        "covariance in square millimetres", lambda rig: replace(rig, object_covariance=1e6 * rig.object_covariance)
    ),
    _limits("box not around the object", lower=(-0.60, -0.30, -0.012), upper=(-0.26, 0.04, 0.42)),
    _limits("box in millimetres", lower=(260.0, -300.0, -12.0), upper=(600.0, 40.0, 420.0)),
    _limits("corners of the box swapped", lower=(0.60, 0.04, 0.42), upper=(0.26, -0.30, -0.012)),
    RigMistake("box in the world instead of the base", _box_in_world),
    _limits("box reaches below the table", lower=(0.26, -0.30, -0.20)),
    _limits("box with a sign lost", lower=(0.26, 0.30, -0.012), upper=(0.60, 0.64, 0.42)),
    _limits("speed in mm/s", speed=250.0),
    _limits("force ten times as much", force=300.0),
    _limits("longest approach in millimetres", approach_distance=100.0),
)
