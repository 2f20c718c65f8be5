"""Plausibility of a rig: each value that no lab has is one sentence that names the field and the remedy.

`i2t.hardware.rig` refuses what cannot be. Here is refused what can be but is nearly always a mistake: a tool that looks
back into its flange, metres for millimetres where both are in range, a camera in front of the skin, a lens of another
image, an object below the table, a box that does not hold it. What only a motion tells (a TCP 20 mm off) is left to the
first slow touches (`i2t.collect.first_touch`).

Frames: W world (z up, the table at its z = 0), B robot base, F flange, T tool, C camera, O object.
"""

import math
from collections.abc import Iterator
from typing import TypeAlias

import numpy as np
from jaxtyping import Float

from i2t.depth.camera import Camera
from i2t.geometry import inverse
from i2t.hardware.motion_limits import format_position
from i2t.hardware.poses import pose_difference
from i2t.hardware.rig import Rig
from i2t.patches.dimensions import PAD_WINDOW, TWIST_LEVER_M
from i2t.types import Array

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
TCP_TOLERANCE_M, TCP_TOLERANCE_DEG = 5e-3, 3.0  # by which a pendant's TCP may differ from the rig's

Doubts: TypeAlias = Iterator[tuple[bool | np.bool_, str]]  # whether something is a mistake, and the sentence on it


def implausible(rig: Rig, vertices: Float[Array, "v 3"] | None = None) -> list[str]:
    """Find values of a rig that are nearly always mistakes.

    Args:
        rig: A lab's calibration.
        vertices: m, of the object in its own frame; None leaves out what needs them.

    Returns:
        Sentences, the likeliest cause of others first; none for a plausible rig.
    """
    checks = [_tool(rig), _carried(rig), _camera(rig), _lens(rig.camera, rig.looking_distance), _world(rig)]
    checks.append(_origin(rig) if vertices is None else _object(rig, np.asarray(vertices, float)))
    return [sentence for check in checks for wrong, sentence in check if wrong]


def require_plausible(rig: Rig, vertices: Float[Array, "v 3"] | None = None) -> None:
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
    sizes = f"{rig.width} x {rig.height}", f"{own.width} x {own.height}"
    if sizes[0] != sizes[1]:
        return f"camera.width and height are {sizes[0]} and the camera gives {sizes[1]}; copy the lens of that image"
    pixels = LENS_PIXELS * own.width
    for name, allowed in {"fx": LENS_SHARE * own.fx, "fy": LENS_SHARE * own.fy, "cx": pixels, "cy": pixels}.items():
        stated, told = getattr(rig, name), getattr(own, name)
        if abs(stated - told) > allowed:
            return f"camera.{name} is {stated:g} and the camera's own {told:.1f}; copy that, or calibrate it again"
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
    shift, angle = pose_difference(np.asarray(T_flange_tool, float), np.asarray(T_pendant, float))
    turn = math.degrees(angle)
    if shift <= TCP_TOLERANCE_M and turn <= TCP_TOLERANCE_DEG:
        return ""
    return (
        f"the TCP on the pendant is {1e3 * shift:.0f} mm and {turn:.0f} degrees from the rig's T_flange_tool; correct "
        "the one that is wrong, or set the pendant's to zero"
    )


def _tool(rig: Rig) -> Doubts:
    key, place, axis = "tool.T_flange_tool", rig.T_flange_tool[:3, 3], rig.T_flange_tool[:3, 2]
    far = float(np.linalg.norm(place))
    too_far = not LEAST_TOOL_M <= far <= MOST_TOOL_M
    yield too_far, f"{key} puts the skin {1e3 * far:.0f} mm from the flange; give metres, from 10 to 350 mm"
    behind = not too_far and place[2] < -LEAST_TOOL_M
    yield behind, f"{key} puts the skin {-1e3 * place[2]:.0f} mm behind the flange; it may be the inverse"
    turned = not (too_far or behind) and place @ axis < LEAST_FORWARD_COSINE * far
    yield turned, f"{key} turns the skin back towards its flange; its third column must point out of the skin"
    least, most = MASS_RANGE_KG
    light = not least <= rig.mass <= most
    yield light, f"tool.mass is {rig.mass:g} kg; skin, camera and mount weigh {least:g} to {most:g} kg"
    centre = np.array(rig.centre)
    back, long = centre[2] < -LEAST_TOOL_M, float(np.linalg.norm(centre))
    yield back, f"tool.centre lies {-1e3 * centre[2]:.0f} mm behind the flange; its z points out of the flange"
    beyond = not back and long > far + MOST_BEYOND_M
    yield beyond, f"tool.centre lies {1e3 * long:.0f} mm from the flange, and the skin {1e3 * far:.0f} mm"


def _carried(rig: Rig) -> Doubts:
    """Find further skins that would meet everything first, or lie where another one is."""
    placed: dict[str, Array] = {"at the tool": np.eye(4)}
    for skin in rig.skins:
        key, T, out_by = f"skins.{skin.name}.T_tool_skin", skin.T_tool_skin, float(skin.T_tool_skin[2, 3])
        first = out_by > MOST_BEFORE_TOOL_M
        yield first, f"{key} puts it {1e3 * out_by:.0f} mm before the skin that presses: it would meet everything first"
        for name, other in placed.items():
            apart = float(np.linalg.norm(T[:3, 3] - other[:3, 3]))
            same = apart < LEAST_APART_M and T[:3, 2] @ other[:3, 2] > 0
            yield same, f"{key} puts it {1e3 * apart:.0f} mm from the skin {name}, where that one is; measure it again"
        placed[skin.name] = T


def _camera(rig: Rig) -> Doubts:
    key, T_t_c = "camera.T_tool_camera", rig.T_tool_camera
    far, before = float(np.linalg.norm(T_t_c[:3, 3])), float(T_t_c[2, 3])
    too_far = not LEAST_CAMERA_M <= far <= MOST_CAMERA_M
    yield too_far, f"{key} puts the camera {1e3 * far:.0f} mm from the skin; give metres, from 10 to 350 mm"
    pressed = not too_far and before > MOST_BEFORE_SKIN_M
    yield pressed, f"{key} puts the camera {1e3 * before:.0f} mm before the skin, to be pressed; it may be the inverse"
    gap = rig.looking_distance - float(inverse(T_t_c)[2, 3])
    room = f"leaves {1e3 * gap:.0f} mm between skin and surface; raise it, or correct {key}"
    yield gap < LEAST_LOOK_GAP_M, f"camera.looking_distance {room}"


def _lens(camera: Camera, distance: float) -> Doubts:
    (least, most), (left, right) = FOCAL_RANGE, CENTRE_RANGE
    odd = not least <= camera.fx / camera.width <= most
    yield odd, f"camera.fx is {camera.fx:g} for {camera.width} pixels; give pixels, {least:g} to {most:g} times as many"
    stretched = not odd and not 1 / MOST_ASPECT <= camera.fx / camera.fy <= MOST_ASPECT
    yield stretched, f"camera.fx is {camera.fx:g} and fy {camera.fy:g}; pixels are square, so copy both from one lens"
    edge = camera.fx * PAD_WINDOW / distance
    small = not (odd or stretched) and edge < LEAST_WINDOW_PIXELS
    yield small, f"from camera.looking_distance {distance:g} m the skin's edge is {edge:.1f} pixels; look from nearer"
    for name, at, size in (("cx", camera.cx, camera.width), ("cy", camera.cy, camera.height)):
        aside = not left <= at / size <= right
        yield aside, f"camera.{name} is {at:g} of {size} pixels; a lens has its middle near the image's: copy that one"


def _world(rig: Rig) -> Doubts:
    tilt = math.degrees(math.acos(float(np.clip(rig.T_world_base[2, 2], -1, 1))))
    leans = min(abs(tilt - each) for each in BASE_TILTS_DEG) > BASE_TILT_TOLERANCE_DEG
    yield leans, f"world.T_world_base tilts the base by {tilt:.0f} degrees; a base stands, hangs, or is on a wall"
    box = rig.limits.box
    longest = float((box[1] - box[0]).max())
    yield longest > LONGEST_BOX_M, f"limits.lower and upper are {longest:.1f} m apart; give the box around the object"
    corners = np.array([[x, y, z] for x in box[:, 0] for y in box[:, 1] for z in box[:, 2]])
    lowest = float((corners @ rig.T_world_base[2, :3]).min() + rig.T_world_base[2, 3])
    deep = lowest < -BOX_BELOW_TABLE_M
    yield deep, f"limits.lower lets the skin {-1e3 * lowest:.0f} mm below the table; raise it, or correct T_world_base"
    sigma = np.sqrt(np.diagonal(rig.object_covariance))
    shift, turn = float(sigma[:3].max()), math.degrees(float(sigma[3:].max()) / TWIST_LEVER_M)
    vague = shift > MOST_STD_M or turn > MOST_STD_DEG
    yield vague, f"world.object_covariance says {1e3 * shift:.0f} mm and {turn:.0f} degrees; give variances in m^2"


def _origin(rig: Rig) -> Doubts:
    held = rig.limits.contains((rig.T_base_world @ rig.T_world_object)[:3, 3], 0.05)
    yield not held, "limits.lower and upper do not hold world.T_world_object: nothing on it may be reachable"


def _object(rig: Rig, vertices: Array) -> Doubts:
    largest, (least, most) = float(np.ptp(vertices, axis=0).max()), OBJECT_RANGE_M
    if not least <= largest <= most:
        yield True, f"the object is {1e3 * largest:.3g} mm large; check --unit, and that the mesh is the object alone"
        return
    key, placed = "world.T_world_object", vertices @ rig.T_world_object[:3, :3].T + rig.T_world_object[:3, 3]
    low, high = float(placed[:, 2].min()), float(placed[:, 2].max())
    sunk = low < -BELOW_TABLE_M - 3 * float(np.sqrt(np.diagonal(rig.object_covariance)[:3].max()))
    yield sunk, f"{key} puts the object {-1e3 * low:.0f} mm below the table: is it upside down, or its height wrong?"
    floats = low > ABOVE_TABLE_M
    yield floats, f"{key} puts the object {1e3 * low:.0f} mm above the table; put the world's origin where it stands"
    middle = (placed.min(0) + placed.max(0)) / 2
    at = rig.T_base_world @ np.array([*middle[:2], high + LEAST_ABOVE_OBJECT_M, 1.0])
    above = f"{format_position(at[:3])} m, above the object's middle"
    yield not rig.limits.contains(at[:3]), f"limits.lower and upper do not hold {above}: the box is in the base"
