"""Mistakes that people make in a lab's calibration file: each turns a right rig into a wrong one.

The lists were written before any of them was tried. Some are refused by the file's own checks, some by
`i2t.hardware.rig_checks`, some only by camera, arm and skin in the first looks and the first slow touch
(`i2t.collect.first_touch`).
"""

from collections.abc import Callable
from dataclasses import replace
from itertools import cycle
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from i2t.depth.camera import Camera
from i2t.geometry import inverse, transform
from i2t.hardware.motion_limits import MotionLimits
from i2t.hardware.rig import Rig
from i2t.types import Array
from tests.faults.rig_objects import RIG_OBJECTS


class RigMistake(NamedTuple):
    """A mistake in one field of a rig."""

    name: str
    field: str
    change: Any  # the wrong value, fields of the value by name, or a function that makes the wrong value of the right

    def make(self, rig: Rig) -> Rig:
        """The wrong rig.

        Args:
            rig: The right one.

        Returns:
            The wrong one.

        Raises:
            ValueError: A rig refuses it by itself.
        """
        value = getattr(rig, self.field)
        if callable(self.change):
            wrong = self.change(value)
        elif isinstance(self.change, dict):
            wrong = replace(value, **self.change)
        else:
            wrong = self.change
        return replace(rig, **{self.field: wrong})


def _pose(place: tuple[float, float, float], degrees: tuple[float, float, float]) -> Array:
    return transform(Rotation.from_euler("xyz", degrees, degrees=True).as_matrix(), np.array(place))


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


RIGHT = right_rig()


def _shifted(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Callable[[Array], Array]:
    """Shift a transform by some millimetres, along the axes of the frame to which it maps."""
    return lambda T: transform(T[:3, :3], T[:3, 3] + 1e-3 * np.array([x, y, z]))


def _turned(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Callable[[Array], Array]:
    """Turn a frame about its own axes by some degrees."""
    return lambda T: T @ _pose((0.0, 0.0, 0.0), (x, y, z))


def _scaled(factor: float) -> Callable[[Array], Array]:
    """Give lengths in another unit."""
    return lambda T: transform(T[:3, :3], factor * T[:3, 3])


def _transposed(T: Array) -> Array:
    return transform(T[:3, :3].T, T[:3, 3])


def _vector_scaled(factor: float) -> Callable[[Array], Array]:
    """Take a rotation vector in one unit for one in another."""

    def change(T: Array) -> Array:
        vector = factor * Rotation.from_matrix(T[:3, :3]).as_rotvec()
        return transform(Rotation.from_rotvec(vector).as_matrix(), T[:3, 3])

    return change


def _quaternion_order(T: Array) -> Array:
    """A quaternion (w, x, y, z) that was taken for (x, y, z, w)."""
    return transform(Rotation.from_quat(np.roll(Rotation.from_matrix(T[:3, :3]).as_quat(), 1)).as_matrix(), T[:3, 3])


def _identity(T: Array) -> Array:
    return np.eye(4)


def _ros_axes(T: Array) -> Array:
    return T @ transform(np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]]), np.zeros(3))


def _box_in_world(limits: MotionLimits) -> MotionLimits:
    """The box was measured in the world, and the file holds it in the base."""
    corners = np.array([limits.lower, limits.upper]) @ RIGHT.T_world_base[:3, :3].T + RIGHT.T_world_base[:3, 3]
    return replace(limits, lower=tuple(corners.min(0)), upper=tuple(corners.max(0)))


DEGREES_AS_RADIANS, RADIANS_AS_DEGREES = _vector_scaled(180 / np.pi), _vector_scaled(np.pi / 180)
TOOL, CAMERA, BASE, OBJECT = "T_flange_tool", "T_tool_camera", "T_world_base", "T_world_object"
MISTAKES: tuple[RigMistake, ...] = (
    RigMistake("TCP flipped: z into the flange", TOOL, _turned(x=180.0)),
    RigMistake("TCP 50 mm too long", TOOL, _shifted(z=50.0)),
    RigMistake("TCP 50 mm too short", TOOL, _shifted(z=-50.0)),
    RigMistake("TCP 10 mm too long", TOOL, _shifted(z=10.0)),
    RigMistake("TCP 10 mm too short", TOOL, _shifted(z=-10.0)),
    RigMistake("TCP 50 mm aside", TOOL, _shifted(x=50.0)),
    RigMistake("TCP 20 mm aside", TOOL, _shifted(y=20.0)),
    RigMistake("TCP left at the flange", TOOL, _identity),
    RigMistake("TCP in millimetres", TOOL, _scaled(1e3)),
    RigMistake("TCP in centimetres", TOOL, _scaled(1e2)),
    RigMistake("TCP transposed", TOOL, _transposed),
    RigMistake("TCP inverted", TOOL, inverse),
    RigMistake("TCP: degrees for radians", TOOL, DEGREES_AS_RADIANS),
    RigMistake("TCP: quaternion in another order", TOOL, _quaternion_order),
    RigMistake("TCP turned by half a turn about z", TOOL, _turned(z=180.0)),
    RigMistake("TCP tilted by 15 degrees", TOOL, _turned(y=15.0)),
    RigMistake("payload in grams", "mass", 600.0),
    RigMistake("payload zero", "mass", 0.0),
    RigMistake("payload ten times as much", "mass", 6.0),
    RigMistake("payload a kilogram too much", "mass", 1.6),
    RigMistake("centre of mass in millimetres", "centre", (5.0, 0.0, 35.0)),
    RigMistake("centre of mass behind the flange", "centre", (0.005, 0.0, -0.035)),
    RigMistake("hand-eye inverted", CAMERA, inverse),
    RigMistake("hand-eye transposed", CAMERA, _transposed),
    RigMistake("hand-eye in millimetres", CAMERA, _scaled(1e3)),
    RigMistake("hand-eye left at the tool", CAMERA, _identity),
    RigMistake("camera looks backwards", CAMERA, _turned(x=180.0)),
    RigMistake("camera axes of ROS, x forwards", CAMERA, _ros_axes),
    RigMistake("camera turned by a quarter about its axis", CAMERA, _turned(z=90.0)),
    RigMistake("camera mounted the other way round", CAMERA, _turned(z=180.0)),
    RigMistake("hand-eye: quaternion in another order", CAMERA, _quaternion_order),
    RigMistake("hand-eye: degrees for radians", CAMERA, DEGREES_AS_RADIANS),
    RigMistake("hand-eye: radians for degrees", CAMERA, RADIANS_AS_DEGREES),
    RigMistake("camera 50 mm too far back", CAMERA, _shifted(z=-50.0)),
    RigMistake("camera 20 mm aside", CAMERA, _shifted(x=20.0)),
    RigMistake("camera in the flange instead of the tool", CAMERA, lambda T: RIGHT.T_flange_tool @ T),
    RigMistake("looking distance in millimetres", "looking_distance", 120.0),
    RigMistake("looking distance in centimetres", "looking_distance", 12.0),
    RigMistake("looking distance of a tenth", "looking_distance", 0.012),
    RigMistake("fx 1.93, the lens in millimetres", "camera", {"fx": 1.93, "fy": 1.93}),
    RigMistake("fx of 1.93 alone", "camera", {"fx": 1.93}),
    RigMistake("fx and fy swapped", "camera", {"fx": 161.05, "fy": 161.2}),
    RigMistake("principal point at the corner", "camera", {"cx": 0.0, "cy": 0.0}),
    RigMistake("cx and cy swapped", "camera", {"cx": 92.0, "cy": 158.0}),
    RigMistake("principal point 40 pixels off", "camera", {"cx": 198.0}),
    RigMistake("lens of twice the image", "camera", {"fx": 322.4, "fy": 322.1, "cx": 316.0, "cy": 184.0}),
    RigMistake("lens of half the image", "camera", {"fx": 80.6, "fy": 80.5, "cx": 79.0, "cy": 46.0}),
    RigMistake("width and height swapped", "camera", {"width": 180, "height": 320}),
    RigMistake("base inverted", BASE, inverse),
    RigMistake("base transposed", BASE, _transposed),
    RigMistake("base in millimetres", BASE, _scaled(1e3)),
    RigMistake("base not turned", BASE, lambda T: transform(np.eye(3), T[:3, 3])),
    RigMistake("base turned the other way", BASE, _turned(z=180.0)),
    RigMistake("base: degrees for radians", BASE, DEGREES_AS_RADIANS),
    RigMistake("base: radians for degrees", BASE, RADIANS_AS_DEGREES),
    RigMistake("base 100 mm too high", BASE, _shifted(z=100.0)),
    RigMistake("base 20 mm too low", BASE, _shifted(z=-20.0)),
    RigMistake("base 100 mm aside", BASE, _shifted(x=100.0)),
    RigMistake("object upside down", OBJECT, _turned(x=180.0)),
    RigMistake("object on its head", OBJECT, lambda T: T @ _pose((0.0, 0.0, 0.03), (180.0, 0.0, 0.0))),
    RigMistake("object on its side", OBJECT, _turned(x=90.0)),
    RigMistake("object 100 mm off along x", OBJECT, _shifted(x=100.0)),
    RigMistake("object 100 mm off along y", OBJECT, _shifted(y=-100.0)),
    RigMistake("object 30 mm aside", OBJECT, _shifted(x=30.0)),
    RigMistake("object 50 mm too high", OBJECT, _shifted(z=50.0)),
    RigMistake("object 50 mm too low", OBJECT, _shifted(z=-50.0)),
    RigMistake("object 10 mm too high", OBJECT, _shifted(z=10.0)),
    RigMistake("object in millimetres", OBJECT, _scaled(1e3)),
    RigMistake("object in centimetres", OBJECT, _scaled(1e2)),
    RigMistake("object inverted", OBJECT, inverse),
    RigMistake("object in the base instead of the world", OBJECT, lambda T: RIGHT.T_base_world @ T),
    RigMistake("covariance in square millimetres", "object_covariance", lambda covariance: 1e6 * covariance),
    RigMistake("box not around the object", "limits",
               {"lower": (-0.60, -0.30, -0.012), "upper": (-0.26, 0.04, 0.42)}),
    RigMistake("box in millimetres", "limits", {"lower": (260.0, -300.0, -12.0), "upper": (600.0, 40.0, 420.0)}),
    RigMistake("corners of the box swapped", "limits",
               {"lower": (0.60, 0.04, 0.42), "upper": (0.26, -0.30, -0.012)}),
    RigMistake("box in the world instead of the base", "limits", _box_in_world),
    RigMistake("box reaches below the table", "limits", {"lower": (0.26, -0.30, -0.20)}),
    RigMistake("box with a sign lost", "limits", {"lower": (0.26, 0.30, -0.012), "upper": (0.60, 0.64, 0.42)}),
    RigMistake("speed in mm/s", "limits", {"speed": 250.0}),
    RigMistake("force ten times as much", "limits", {"force": 300.0}),
    RigMistake("longest approach in millimetres", "limits", {"approach_distance": 100.0}),
)  # fmt: skip
SMALL_MISTAKES = (  # each with the object over which it is tried; none is one of the object's symmetries
    (RigMistake("payload 0.4 kg too much", "mass", 1.0), "star"),
    (RigMistake("payload 0.4 kg too little", "mass", 0.2), "wall"),
    (RigMistake("TCP 7 mm aside along x", TOOL, _shifted(x=7.0)), "hexagon"),
    (RigMistake("TCP 7 mm aside along y", TOOL, _shifted(y=7.0)), "cone"),
    (RigMistake("TCP 7 mm aside along x", TOOL, _shifted(x=7.0)), "wall"),
    (RigMistake("TCP 7 mm aside along y", TOOL, _shifted(y=-7.0)), "cube"),
    (RigMistake("TCP 7 mm aside along x", TOOL, _shifted(x=-7.0)), "hammer"),
    (RigMistake("TCP 7 mm too long", TOOL, _shifted(z=7.0)), "ball"),
    (RigMistake("TCP 7 mm too short", TOOL, _shifted(z=-7.0)), "screwdriver"),
    (RigMistake("object 7 mm aside along x", OBJECT, _shifted(x=7.0)), "star"),
    (RigMistake("object 7 mm aside along y", OBJECT, _shifted(y=7.0)), "dome"),
    (RigMistake("object 7 mm aside along y", OBJECT, _shifted(y=-7.0)), "rod"),
    (RigMistake("object 7 mm aside along x", OBJECT, _shifted(x=-7.0)), "mug"),
    (RigMistake("object 7 mm too high", OBJECT, _shifted(z=7.0)), "plate"),
    (RigMistake("object 7 mm too low", OBJECT, _shifted(z=-7.0)), "hexagon"),
    (RigMistake("object turned by 20 degrees about z", OBJECT, _turned(z=20.0)), "star"),
    (RigMistake("object turned by 20 degrees about z", OBJECT, _turned(z=20.0)), "wall"),
    (RigMistake("object turned by 20 degrees about z", OBJECT, _turned(z=-20.0)), "screwdriver"),
    (RigMistake("camera 15 mm aside along x", CAMERA, _shifted(x=15.0)), "hexagon"),
    (RigMistake("camera 15 mm aside along y", CAMERA, _shifted(y=15.0)), "rod"),
    (RigMistake("camera 15 mm aside along x", CAMERA, _shifted(x=-15.0)), "cone"),
    (RigMistake("camera tilted by 8 degrees", CAMERA, _turned(x=8.0)), "dome"),
    (RigMistake("base 10 mm aside", BASE, _shifted(x=10.0)), "star"),
)
WRONG_RIGS = (  # first the fifty by which the checks are judged
    *zip(MISTAKES[1::3], cycle(RIG_OBJECTS), strict=False),
    *SMALL_MISTAKES,
    *zip(MISTAKES[::3] + MISTAKES[2::3], cycle(RIG_OBJECTS), strict=False),
)
