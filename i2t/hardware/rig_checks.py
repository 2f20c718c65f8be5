"""Plausibility of a rig: each value that no lab has is one sentence that names the field and the remedy.

`i2t.hardware.rig` refuses what cannot be. Here is refused what can be but is nearly always a mistake: a tool that looks
back into its flange, metres for millimetres where both are in range, a camera in front of the skin, a lens of another
image, an object below the table, a box that does not hold it. What only a motion tells (a TCP 20 mm off) is left to the
first slow touch (`i2t.collect.first_touch`).

Frames: W world (z up, the table at its z = 0), B robot base, F flange, T tool, C camera, O object. NumPy only.
"""

import math
from collections.abc import Iterator
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from i2t.depth.camera import Camera
from i2t.geometry import inverse
from i2t.hardware.carried_skins import CarriedSkin
from i2t.hardware.limits import MotionLimits, format_position
from i2t.types import PAD_WINDOW, TWIST_LEVER_M, Array

MOST_BEFORE_TOOL_M, LEAST_APART_M = 0.02, 0.01  # of a further skin: out of the skin that presses; from another one
LEAST_TOOL_M, MOST_TOOL_M = 10e-3, 0.35  # from the flange to a skin
LEAST_FORWARD_COSINE = 0.3  # between where the skin is from the flange, and where it looks
MASS_RANGE_KG, MOST_BEYOND_M = (0.05, 4.0), 0.1  # of skin, camera and mount; of their centre past the skin
LEAST_CAMERA_M, MOST_CAMERA_M = 10e-3, 0.35  # from skin to camera
MOST_BEFORE_SKIN_M, LEAST_LOOK_GAP_M = 5e-3, 10e-3  # camera before the skin's face; skin from a surface looked at
FOCAL_RANGE, MOST_ASPECT = (0.4, 4.0), 1.1  # fx over the image's width (103 to 14 degrees), fx over fy
CENTRE_RANGE = (0.3, 0.7)  # of the principal point, as shares of width and height
LEAST_WINDOW_PIXELS = 10  # in which a camera must see the skin's edge from the looking distance
BASE_TILTS_DEG, BASE_TILT_TOLERANCE_DEG = (0.0, 45.0, 90.0, 135.0, 180.0), 4.0  # of a table, a wall, a ceiling, a torso
BELOW_TABLE_M, ABOVE_TABLE_M = 5e-3, 30e-3  # of an object's lowest point
BOX_BELOW_TABLE_M, LONGEST_BOX_M = 20e-3, 1.5
OBJECT_RANGE_M = (8e-3, 0.6)  # largest edge of an object's box
MOST_STD_M, MOST_STD_DEG = 30e-3, 30.0  # of an object's pose, above which nothing is known of it
LENS_SHARE, LENS_PIXELS = 0.1, 0.05  # by which a rig's lens may differ from the camera's own: of fx; of the width
LEAST_ABOVE_OBJECT_M = 40e-3  # that the box must leave above an object


@runtime_checkable
class StatedRig(Protocol):
    """Values that a rig states (`i2t.hardware.rig.Rig`)."""

    @property
    def T_flange_tool(self) -> Array:
        """(4, 4), the robot's TCP."""

    @property
    def mass(self) -> float:
        """kg, of all that the flange carries."""

    @property
    def centre(self) -> tuple[float, float, float]:
        """m, its centre of mass in the flange."""

    @property
    def skins(self) -> tuple[CarriedSkin, ...]:
        """Further skins on the tool."""

    @property
    def T_tool_camera(self) -> Array:
        """(4, 4), m."""

    @property
    def looking_distance(self) -> float:
        """m from the camera to the surface it looks at."""

    @property
    def camera(self) -> Camera:
        """Size and lens."""

    @property
    def T_world_base(self) -> Array:
        """(4, 4), m."""

    @property
    def T_world_object(self) -> Array:
        """(4, 4), m."""

    @property
    def limits(self) -> MotionLimits:
        """Limits that no motion exceeds."""

    @property
    def object_covariance(self) -> Array:
        """(6, 6) m^2."""

    @property
    def T_base_world(self) -> Array:
        """(4, 4) world in base."""


def implausible(rig: StatedRig, vertices: Float[Array, "v 3"] | None = None) -> list[str]:
    """Find values of a rig that are nearly always mistakes.

    Args:
        rig: A lab's calibration.
        vertices: m, of the object in its own frame; None leaves out what needs them.

    Returns:
        Sentences, the likeliest cause of others first; none for a plausible rig.
    """
    found = [
        *_tool(rig),
        *_carried(rig),
        *_payload(rig),
        *_camera(rig),
        *_lens(rig.camera, rig.looking_distance),
        *_world(rig),
    ]
    return [*found, *_object(rig, vertices)] if vertices is not None else [*found, *_origin(rig)]


def require_plausible(rig: StatedRig, vertices: Float[Array, "v 3"] | None = None) -> None:
    """Refuse a rig that is nearly always a mistake.

    Args:
        rig: A lab's calibration.
        vertices: m, of the object in its own frame.

    Raises:
        ValueError: What is wrong, in one sentence.
    """
    found = implausible(rig, vertices)
    if found:
        more = f" (and {len(found) - 1} more doubts)" if len(found) > 1 else ""
        raise ValueError(f"{found[0]}{more}; --trust-rig goes on with a rig that is only unusual")


def other_lens(rig: Camera, own: Camera) -> str:
    """Compare a rig's lens with the camera's own.

    Args:
        rig: As the rig has it.
        own: As the camera says.

    Returns:
        A sentence, or "".
    """
    if (rig.width, rig.height) != (own.width, own.height):
        return (
            f"camera.width and height are {rig.width} x {rig.height} and the camera gives {own.width} x {own.height}; "
            "copy the lens of that image"
        )
    for name, allowed in (
        ("fx", LENS_SHARE * own.fx),
        ("fy", LENS_SHARE * own.fy),
        ("cx", LENS_PIXELS * own.width),
        ("cy", LENS_PIXELS * own.width),
    ):
        if abs(getattr(rig, name) - getattr(own, name)) > allowed:
            return (
                f"camera.{name} is {getattr(rig, name):g} and the camera's own {getattr(own, name):.1f}; copy that, "
                "or calibrate it again"
            )
    return ""


def other_tool(T_flange_tool: Float[Array, "4 4"], T_pendant: Float[Array, "4 4"]) -> str:
    """Compare the TCP that a controller was told with the rig's.

    Args:
        T_flange_tool: As the rig has it.
        T_pendant: As the controller has it; one at the flange means that it was told none.

    Returns:
        A sentence, or "".
    """
    if np.allclose(T_pendant, np.eye(4), atol=1e-6):
        return ""
    apart = inverse(np.asarray(T_flange_tool, float)) @ np.asarray(T_pendant, float)
    shift = 1e3 * float(np.linalg.norm(apart[:3, 3]))
    turn = math.degrees(math.acos(float(np.clip((np.trace(apart[:3, :3]) - 1) / 2, -1, 1))))
    if shift <= 5.0 and turn <= 3.0:
        return ""
    return (
        f"the TCP on the pendant is {shift:.0f} mm and {turn:.0f} degrees from the rig's T_flange_tool; correct the "
        "one that is wrong, or set the pendant's to zero"
    )


def _carried(rig: StatedRig) -> Iterator[str]:
    """Find further skins that would meet everything first, or lie where another one is."""
    placed: dict[str, Array] = {"at the tool": np.eye(4)}
    for skin in rig.skins:
        out_by = float(skin.T_tool_skin[2, 3])
        if out_by > MOST_BEFORE_TOOL_M:
            yield (
                f"skins.{skin.name}.T_tool_skin puts it {1e3 * out_by:.0f} mm before the skin that presses, so that it "
                "would meet everything first; give metres, or put the tool's frame there"
            )
        for name, other in placed.items():
            apart = float(np.linalg.norm(skin.T_tool_skin[:3, 3] - other[:3, 3]))
            if apart < LEAST_APART_M and skin.T_tool_skin[:3, 2] @ other[:3, 2] > 0:
                yield (
                    f"skins.{skin.name}.T_tool_skin puts it {1e3 * apart:.0f} mm from the skin {name}, where that one "
                    "is; measure it from the tool's frame"
                )
        placed[skin.name] = skin.T_tool_skin


def _tool(rig: StatedRig) -> Iterator[str]:
    place, axis = rig.T_flange_tool[:3, 3], rig.T_flange_tool[:3, 2]
    far = float(np.linalg.norm(place))
    if not LEAST_TOOL_M <= far <= MOST_TOOL_M:
        yield (
            f"tool.T_flange_tool puts the skin {1e3 * far:.0f} mm from the flange; give metres, from "
            f"{1e3 * LEAST_TOOL_M:g} to {1e3 * MOST_TOOL_M:g} mm"
        )
    elif place[2] < -LEAST_TOOL_M:
        yield f"tool.T_flange_tool puts the skin {-1e3 * place[2]:.0f} mm behind the flange; it may be the inverse"
    elif place @ axis < LEAST_FORWARD_COSINE * far:
        yield (
            "tool.T_flange_tool turns the skin back towards its flange; its third column must point out of the skin, "
            "away from the mount"
        )


def _payload(rig: StatedRig) -> Iterator[str]:
    least, most = MASS_RANGE_KG
    if not least <= rig.mass <= most:
        yield f"tool.mass is {rig.mass:g} kg; skin, camera and mount weigh {least:g} to {most:g} kg"
    centre, far = np.array(rig.centre), float(np.linalg.norm(rig.T_flange_tool[:3, 3]))
    if centre[2] < -LEAST_TOOL_M:
        yield f"tool.centre lies {-1e3 * centre[2]:.0f} mm behind the flange; its z points out of the flange"
    elif np.linalg.norm(centre) > far + MOST_BEYOND_M:
        yield f"tool.centre lies {1e3 * np.linalg.norm(centre):.0f} mm from the flange, and the skin {1e3 * far:.0f} mm"


def _camera(rig: StatedRig) -> Iterator[str]:
    T_t_c = rig.T_tool_camera
    far = float(np.linalg.norm(T_t_c[:3, 3]))
    if not LEAST_CAMERA_M <= far <= MOST_CAMERA_M:
        yield (
            f"camera.T_tool_camera puts the camera {1e3 * far:.0f} mm from the skin; give metres, from "
            f"{1e3 * LEAST_CAMERA_M:g} to {1e3 * MOST_CAMERA_M:g} mm"
        )
    elif T_t_c[2, 3] > MOST_BEFORE_SKIN_M:
        yield (
            f"camera.T_tool_camera puts the camera {1e3 * T_t_c[2, 3]:.0f} mm before the skin, where it would be "
            "pressed; it may be the inverse"
        )
    gap = rig.looking_distance - float(inverse(T_t_c)[2, 3])
    if gap < LEAST_LOOK_GAP_M:
        yield (
            f"camera.looking_distance is {1e3 * rig.looking_distance:.0f} mm, which leaves {1e3 * gap:.0f} mm between "
            "the skin and the surface that is looked at; raise it, or correct T_tool_camera"
        )


def _lens(camera: Camera, distance: float) -> Iterator[str]:
    (least, most), (left, right) = FOCAL_RANGE, CENTRE_RANGE
    if not least <= camera.fx / camera.width <= most:
        yield (
            f"camera.fx is {camera.fx:g} for {camera.width} pixels; give pixels, from {least * camera.width:.0f} to "
            f"{most * camera.width:.0f}"
        )
    elif not 1 / MOST_ASPECT <= camera.fx / camera.fy <= MOST_ASPECT:
        yield f"camera.fx is {camera.fx:g} and fy {camera.fy:g}; pixels are square, so copy both from one calibration"
    elif camera.fx * PAD_WINDOW / distance < LEAST_WINDOW_PIXELS:
        yield (
            f"from camera.looking_distance {distance:g} m the skin's edge is {camera.fx * PAD_WINDOW / distance:.1f} "
            "pixels; look from nearer, or with a larger image"
        )
    for name, at, size in (("cx", camera.cx, camera.width), ("cy", camera.cy, camera.height)):
        if not left <= at / size <= right:
            yield (
                f"camera.{name} is {at:g} of {size} pixels; a lens has its middle near the image's, so copy it from "
                "the calibration of this image size"
            )


def _world(rig: StatedRig) -> Iterator[str]:
    tilt = math.degrees(math.acos(float(np.clip(rig.T_world_base[2, 2], -1, 1))))
    if min(abs(tilt - each) for each in BASE_TILTS_DEG) > BASE_TILT_TOLERANCE_DEG:
        yield f"world.T_world_base tilts the base by {tilt:.0f} degrees; a base stands, hangs, or is on a wall"
    box = rig.limits.box
    edges = box[1] - box[0]
    if edges.max() > LONGEST_BOX_M:
        yield f"limits.lower and upper are {edges.max():.1f} m apart; give the box around the object, in m"
    corners = np.array([[x, y, z] for x in box[:, 0] for y in box[:, 1] for z in box[:, 2]])
    lowest = float((corners @ rig.T_world_base[2, :3]).min() + rig.T_world_base[2, 3])
    if lowest < -BOX_BELOW_TABLE_M:
        yield f"limits.lower lets the skin {-1e3 * lowest:.0f} mm below the table; raise it, or correct T_world_base"
    sigma = np.sqrt(np.diagonal(rig.object_covariance))
    if sigma[:3].max() > MOST_STD_M or math.degrees(sigma[3:].max() / TWIST_LEVER_M) > MOST_STD_DEG:
        yield (
            f"world.object_covariance says {1e3 * sigma[:3].max():.0f} mm and "
            f"{math.degrees(sigma[3:].max() / TWIST_LEVER_M):.0f} degrees; give variances in m^2"
        )


def _origin(rig: StatedRig) -> Iterator[str]:
    if not rig.limits.contains((rig.T_base_world @ rig.T_world_object)[:3, 3], 0.05):
        yield "limits.lower and upper do not hold world.T_world_object: nothing on the object may be reachable"


def _object(rig: StatedRig, vertices: Array) -> Iterator[str]:
    vertices = np.asarray(vertices, float)
    largest = float(np.ptp(vertices, axis=0).max())
    least, most = OBJECT_RANGE_M
    if not least <= largest <= most:
        yield f"the object is {1e3 * largest:.3g} mm large; check --unit, and that the mesh is the object alone"
        return
    placed = vertices @ rig.T_world_object[:3, :3].T + rig.T_world_object[:3, 3]
    lowest, highest = float(placed[:, 2].min()), float(placed[:, 2].max())
    allowed = BELOW_TABLE_M + 3 * float(np.sqrt(np.diagonal(rig.object_covariance)[:3].max()))
    if lowest < -allowed:
        yield (
            f"world.T_world_object puts the object {-1e3 * lowest:.0f} mm below the table: is it upside down, or its "
            "height wrong?"
        )
    elif lowest > ABOVE_TABLE_M:
        yield (
            f"world.T_world_object puts the object {1e3 * lowest:.0f} mm above the table, on nothing; put the world's "
            "origin where it stands"
        )
    middle = (placed.min(0) + placed.max(0)) / 2
    above = np.array([*middle[:2], highest + LEAST_ABOVE_OBJECT_M])
    at = rig.T_base_world[:3, :3] @ above + rig.T_base_world[:3, 3]
    if not rig.limits.contains(at):
        yield (
            f"limits.lower and upper do not hold {format_position(at)} m, {1e3 * LEAST_ABOVE_OBJECT_M:.0f} mm above "
            "the object's middle; the box is in the base, and must be around the object"
        )
