"""Plausibility checks of a rig: each implausible value gives one sentence that names the field and the remedy.

`i2t.hardware.rig` refuses impossible values. This module doubts values that are possible but nearly always a mistake: a
tool that looks back into its flange, metres for millimetres where both are in range, a camera in front of the skin, the
lens of another image, an object below the table, a box that does not hold the object. Mistakes that only a motion
reveals (a TCP 20 mm off) are left to the first slow touches (`i2t.collect.first_touch`).

Frames: W world (z up, the table at z = 0), B robot base, F flange, T tool, C camera, O object.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from jaxtyping import Float

from i2t.depth.camera import Camera
from i2t.geometry import inverse
from i2t.hardware.limits import SAFETY
from i2t.hardware.motion_limits import format_position
from i2t.hardware.poses import pose_difference
from i2t.hardware.rig import Rig
from i2t.patches.dimensions import PAD_WINDOW, TWIST_LEVER_M
from i2t.types import Array


@dataclass(frozen=True)
class PlausibleRig:
    """Ranges of values that a correct rig nearly always has: metres, kilograms, degrees, and ratios of the lens."""

    tool_distance: tuple[float, float] = (10e-3, 0.35)  # m, range of the distance from the flange to the skin
    min_forward_cosine: float = 0.3  # smallest cosine between the direction from flange to skin and the skin's axis
    mass: tuple[float, float] = (0.05, 4.0)  # kg, range of the mass of skin, camera and mount
    max_mass_overhang: float = 0.1  # m, largest distance of the centre of mass beyond the skin, seen from the flange
    camera_distance: tuple[float, float] = (10e-3, 0.35)  # m, range of the distance from skin to camera
    max_camera_overhang: float = 5e-3  # m, largest distance of the camera in front of the skin's face
    min_looking_gap: float = 10e-3  # m, smallest gap between the skin and a surface at the looking distance
    focal_share: tuple[float, float] = (0.4, 4.0)  # range of fx over the image's width (103 to 14 degrees)
    max_pixel_aspect: float = 1.1  # largest ratio of fx and fy
    centre_share: tuple[float, float] = (0.3, 0.7)  # range of the principal point over width and height
    min_skin_pixels: float = 10  # smallest number of pixels along the skin's edge at the looking distance
    focal_tolerance: float = 0.1  # largest relative difference to the camera's own focal length
    centre_tolerance: float = 0.05  # largest difference to the camera's own principal point, over the image's width
    # tilts of a base on a table, a wall, a ceiling or a torso
    base_tilts: tuple[float, ...] = (0.0, 45.0, 90.0, 135.0, 180.0)
    base_tilt_tolerance: float = 4.0
    max_box_edge: float = 1.5
    max_box_below_table: float = 20e-3
    object_size: tuple[float, float] = (8e-3, 0.6)  # range of the largest edge of the object's box
    max_object_below_table: float = 5e-3
    max_object_above_table: float = 30e-3
    min_box_above_object: float = 40e-3
    # m, largest standard deviation of the object's position; above it the position counts as unknown
    max_position_std: float = 30e-3
    max_rotation_std: float = 30.0
    max_skin_overhang: float = 0.02  # m, largest distance of a further skin in front of the pressing skin
    min_skin_spacing: float = 0.01  # m, smallest distance between two skins that face the same way


Doubts: TypeAlias = Iterator[tuple[bool | np.bool_, str]]  # whether a value is implausible, and the sentence about it


def implausible_values(
    rig: Rig, vertices: Float[Array, "v 3"] | None = None, *, plausible: PlausibleRig = PlausibleRig()
) -> list[str]:
    """List the values of a rig that are nearly always mistakes.

    Args:
        rig: Calibration of a lab.
        vertices: (v, 3) vertices of the object in its own frame, m; None skips the checks that need them.
        plausible: Ranges of plausible values.

    Returns:
        Sentences, those about likely causes of others first; empty for a plausible rig.
    """
    checks = [_tool(rig, plausible), _carried(rig, plausible), _camera(rig, plausible)]
    checks += [_lens(rig.camera, rig.looking_distance, plausible), _world(rig, plausible)]
    checks.append(_origin(rig) if vertices is None else _object(rig, np.asarray(vertices, float), plausible))
    return [sentence for check in checks for wrong, sentence in check if wrong]


def require_plausible(rig: Rig, vertices: Float[Array, "v 3"] | None = None) -> None:
    """Refuse a rig with a value that is nearly always a mistake.

    Args:
        rig: Calibration of a lab.
        vertices: (v, 3) vertices of the object in its own frame, m.

    Raises:
        ValueError: A value of the rig is implausible; the message names it.
    """
    doubts = implausible_values(rig, vertices)
    if doubts:
        more = f" (and {len(doubts) - 1} more doubts)" if len(doubts) > 1 else ""
        raise ValueError(f"{doubts[0]}{more}; --accept-unusual-rig accepts a rig that is merely unusual")


def compare_lens(rig: Camera, own: Camera, *, plausible: PlausibleRig = PlausibleRig()) -> str:
    """Compare a rig's lens with the lens that the camera reports.

    Args:
        rig: Lens in the rig.
        own: Lens that the camera reports.
        plausible: Tolerances of the comparison.

    Returns:
        A sentence about the first difference beyond its tolerance; empty if there is none.
    """
    sizes = f"{rig.width} x {rig.height}", f"{own.width} x {own.height}"
    if sizes[0] != sizes[1]:
        return f"camera.width and height are {sizes[0]} but the camera sends {sizes[1]}; copy the lens of that image"
    pixels, share = plausible.centre_tolerance * own.width, plausible.focal_tolerance
    for name, tolerance in {"fx": share * own.fx, "fy": share * own.fy, "cx": pixels, "cy": pixels}.items():
        in_rig, reported = getattr(rig, name), getattr(own, name)
        if abs(in_rig - reported) > tolerance:
            return f"camera.{name} is {in_rig:g} but the camera reports {reported:.1f}; copy that, or recalibrate"
    return ""


def compare_tool(T_flange_tool: Float[Array, "4 4"], T_pendant: Float[Array, "4 4"]) -> str:
    """Compare the TCP (tool pose) that is set on a robot's controller with the rig's.

    Args:
        T_flange_tool: (4, 4) tool in the flange as the rig has it, m.
        T_pendant: (4, 4) tool in the flange as the controller has it, m; the identity means that none was set.

    Returns:
        A sentence about the difference; empty if it is within the limits in `SAFETY`, or if none was set.
    """
    if np.allclose(T_pendant, np.eye(4), atol=1e-6):
        return ""
    shift, angle = pose_difference(np.asarray(T_flange_tool, float), np.asarray(T_pendant, float))
    degrees = math.degrees(angle)
    if shift <= SAFETY.max_tcp_shift_m and degrees <= SAFETY.max_tcp_rotation_deg:
        return ""
    return (
        f"the TCP on the pendant is {1e3 * shift:.0f} mm and {degrees:.0f} degrees from the rig's T_flange_tool; "
        "correct the one that is wrong, or set the pendant's to zero"
    )


def _tool(rig: Rig, plausible: PlausibleRig) -> Doubts:
    key, place, axis = "tool.T_flange_tool", rig.T_flange_tool[:3, 3], rig.T_flange_tool[:3, 2]
    distance, (low, high) = float(np.linalg.norm(place)), plausible.tool_distance
    too_far = not low <= distance <= high
    yield too_far, f"{key} puts the skin {1e3 * distance:.0f} mm from the flange; give metres, from 10 to 350 mm"
    behind = not too_far and place[2] < -low
    yield behind, f"{key} puts the skin {-1e3 * place[2]:.0f} mm behind the flange; it may be the inverse"
    backwards = not (too_far or behind) and place @ axis < plausible.min_forward_cosine * distance
    yield backwards, f"{key} turns the skin back towards its flange; its third column must point out of the skin"
    lightest, heaviest = plausible.mass
    wrong_mass = not lightest <= rig.mass <= heaviest
    yield wrong_mass, f"tool.mass is {rig.mass:g} kg; skin, camera and mount weigh {lightest:g} to {heaviest:g} kg"
    centre = np.array(rig.centre)
    back, length = centre[2] < -low, float(np.linalg.norm(centre))
    yield back, f"tool.centre lies {-1e3 * centre[2]:.0f} mm behind the flange; its z points out of the flange"
    beyond = not back and length > distance + plausible.max_mass_overhang
    yield beyond, f"tool.centre lies {1e3 * length:.0f} mm from the flange, and the skin {1e3 * distance:.0f} mm"


def _carried(rig: Rig, plausible: PlausibleRig) -> Doubts:
    """Check for further skins that would touch everything first, or that coincide with another skin."""
    placed: dict[str, Array] = {"at the tool": np.eye(4)}
    for skin in rig.skins:
        key, T, overhang = f"skins.{skin.name}.T_tool_skin", skin.T_tool_skin, float(skin.T_tool_skin[2, 3])
        first = overhang > plausible.max_skin_overhang
        yield first, f"{key} puts it {1e3 * overhang:.0f} mm in front of the skin that presses: it would touch first"
        for name, other in placed.items():
            distance = float(np.linalg.norm(T[:3, 3] - other[:3, 3]))
            same = distance < plausible.min_skin_spacing and T[:3, 2] @ other[:3, 2] > 0
            yield same, f"{key} puts it {1e3 * distance:.0f} mm from the skin {name}, in its place; measure it again"
        placed[skin.name] = T


def _camera(rig: Rig, plausible: PlausibleRig) -> Doubts:
    key, T_t_c = "camera.T_tool_camera", rig.T_tool_camera
    distance, overhang = float(np.linalg.norm(T_t_c[:3, 3])), float(T_t_c[2, 3])
    low, high = plausible.camera_distance
    too_far = not low <= distance <= high
    yield too_far, f"{key} puts the camera {1e3 * distance:.0f} mm from the skin; give metres, from 10 to 350 mm"
    in_front = not too_far and overhang > plausible.max_camera_overhang
    yield in_front, f"{key} puts the camera {1e3 * overhang:.0f} mm in front of the skin; it may be the inverse"
    gap = rig.looking_distance - float(inverse(T_t_c)[2, 3])
    room = f"leaves {1e3 * gap:.0f} mm between skin and surface; raise it, or correct {key}"
    yield gap < plausible.min_looking_gap, f"camera.looking_distance {room}"


def _lens(camera: Camera, distance: float, plausible: PlausibleRig) -> Doubts:
    (low, high), (left, right) = plausible.focal_share, plausible.centre_share
    wrong_focal = not low <= camera.fx / camera.width <= high
    yield wrong_focal, f"camera.fx is {camera.fx:g} for {camera.width} pixels; give {low:g} to {high:g} times as many"
    aspect = plausible.max_pixel_aspect
    stretched = not wrong_focal and not 1 / aspect <= camera.fx / camera.fy <= aspect
    yield stretched, f"camera.fx is {camera.fx:g} and fy {camera.fy:g}; pixels are square, so copy both from one lens"
    edge = camera.fx * PAD_WINDOW / distance
    small = not (wrong_focal or stretched) and edge < plausible.min_skin_pixels
    yield small, f"from camera.looking_distance {distance:g} m the skin's edge is {edge:.1f} pixels; look from nearer"
    for name, at, size in (("cx", camera.cx, camera.width), ("cy", camera.cy, camera.height)):
        off_centre = not left <= at / size <= right
        yield off_centre, f"camera.{name} is {at:g} of {size} pixels; a lens is centred near the middle: copy its value"


def _world(rig: Rig, plausible: PlausibleRig) -> Doubts:
    tilt = math.degrees(math.acos(float(np.clip(rig.T_world_base[2, 2], -1, 1))))
    leans = min(abs(tilt - usual) for usual in plausible.base_tilts) > plausible.base_tilt_tolerance
    yield leans, f"world.T_world_base tilts the base by {tilt:.0f} degrees; a base stands, hangs, or is on a wall"
    box = rig.limits.box
    longest = float((box[1] - box[0]).max())
    yield (
        longest > plausible.max_box_edge,
        f"limits span {longest:.1f} m; give the box around the object",
    )
    corners = np.array([[x, y, z] for x in box[:, 0] for y in box[:, 1] for z in box[:, 2]])
    lowest = float((corners @ rig.T_world_base[2, :3]).min() + rig.T_world_base[2, 3])
    deep = lowest < -plausible.max_box_below_table
    yield deep, f"limits.lower lets the skin {-1e3 * lowest:.0f} mm below the table; raise it, or correct T_world_base"
    sigma = np.sqrt(np.diagonal(rig.object_covariance))
    shift, turn = float(sigma[:3].max()), math.degrees(float(sigma[3:].max()) / TWIST_LEVER_M)
    vague = shift > plausible.max_position_std or turn > plausible.max_rotation_std
    yield vague, f"world.object_covariance means {1e3 * shift:.0f} mm and {turn:.0f} degrees; give variances in m^2"


def _origin(rig: Rig) -> Doubts:
    reachable = rig.limits.contains((rig.T_base_world @ rig.T_world_object)[:3, 3], 0.05)
    yield not reachable, "limits.lower and upper do not hold world.T_world_object: nothing on it may be reachable"


def _object(rig: Rig, vertices: Array, plausible: PlausibleRig) -> Doubts:
    largest, (low, high) = float(np.ptp(vertices, axis=0).max()), plausible.object_size
    if not low <= largest <= high:
        yield True, f"the object is {1e3 * largest:.3g} mm large; check --unit, and that the mesh is the object alone"
        return
    key, placed = "world.T_world_object", vertices @ rig.T_world_object[:3, :3].T + rig.T_world_object[:3, 3]
    bottom, top = float(placed[:, 2].min()), float(placed[:, 2].max())
    position_std = float(np.sqrt(np.diagonal(rig.object_covariance)[:3].max()))
    sunk = bottom < -plausible.max_object_below_table - 3 * position_std
    yield sunk, f"{key} puts the object {-1e3 * bottom:.0f} mm below the table: is it upside down, or its height wrong?"
    floats = bottom > plausible.max_object_above_table
    yield floats, f"{key} puts the object {1e3 * bottom:.0f} mm above the table; put the world's origin where it stands"
    middle = (placed.min(0) + placed.max(0)) / 2
    at = rig.T_base_world @ np.array([*middle[:2], top + plausible.min_box_above_object, 1.0])
    above = f"{format_position(at[:3])} m, above the object's middle"
    yield not rig.limits.contains(at[:3]), f"limits.lower and upper do not hold {above}: the box is in the base"
