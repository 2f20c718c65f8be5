"""Place of the skin in the tool, by touching a flat with each of its corners; the first lines of a rig that are true.

    python -m i2t.hardware.touch_off --host 192.168.0.2 --rig lab.toml --height 0.012 --at 0.4 0.1 --write

A rigid, level flat lies at a known height in the robot's base, say the table, or a gauge block on it. The tool is
tilted so that one corner of the skin is lowest, and lowered until it is felt; from the tool's pose T_b_t then, the
corner (x, y) of the skin has in the tool the height

    z = (height - o_z - R_zx x - R_zy y) / R_zz,        T_b_t = (R, o),

and four corners make a plane, z = z0 + sx x + sy y by least squares: the skin's face. The tool's frame is moved along
its z axis and tilted onto it; sideways and about z a flat shows nothing. The fourth corner is one more than a plane
needs: by how much the four miss it, |z1 - z2 + z3 - z4| / 4 in their order around, is reported.

A press begins before it is felt. A corner that sinks into an elastic layer by d meets it over an area of d^2 at a mean
strain in proportion to d, so its force grows as d^3; with a spring 1 / k in series the travel since first contact is
a F^(1/3) + F / k. First contact, a and k are those that fit the forces on the way best, by least squares. On the skin
of the simulated world that is 0.03 mm early at this tilt, where a straight line through the forces would be
0.5 mm late.
"""

import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import tyro
from jaxtyping import Float
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from i2t.cli.exit_codes import command
from i2t.errors import DeviceError
from i2t.geometry import inverse, transform
from i2t.hardware.motion_limits import MotionLimits
from i2t.hardware.plugins import DeviceSetup, check_device, load_device
from i2t.hardware.poses import shifted_along_z
from i2t.hardware.protocols import ArmState, GuardedArm
from i2t.hardware.rig import Rig
from i2t.patches.dimensions import ARM_STIFFNESS_N_PER_M, PAD_WINDOW
from i2t.types import Array

CORNER_SIGNS = ((1, 1), (-1, 1), (-1, -1), (1, -1))  # of the corners, in their order around
TILT_RAD = math.radians(6)  # of the tool while it touches
CLEARANCE_M = 6e-3  # above the flat, from where the lowest corner is lowered
MAX_OVERTRAVEL_M = 5e-3  # past where it should touch, after which there is no flat
TRANSFER_SPEED_M_S, LOWERING_SPEED_M_S = 0.05, 0.02
APPROACH_ACCELERATION_M_S2 = 0.1
SPEED_M_S, STOP_FORCE_N = 2e-3, 2.0  # a corner gives some newtons per millimetre
SOFT_M_PER_CUBE_ROOT_N = 0.8e-3  # m/N^(1/3), a guess of a corner
CONTACT_FORCE_SHARE, MIN_LOOKS = 0.2, 5  # of the last force, above which it counts as felt; looks that must feel it
MAX_SHIFT_M, MAX_TILT_RAD = 5e-3, math.radians(4)  # what is further from the rig was no touch of a flat


class FittedPlane(NamedTuple):
    """Plane of the skin as it was found."""

    T_tool_skin: Array  # (4, 4), from the tool's frame as it was: a shift along z and a tilt
    flatness_error: float  # m, by which each corner misses their plane


def corner_rotation(side: tuple[int, int]) -> Float[Array, "3 3"]:
    """The turn that brings one corner of the skin forward.

    Args:
        side: Signs of the corner's x and y.

    Returns:
        (3, 3) rotation in the tool's axes.
    """
    axis = np.array([side[1], -side[0], 0.0]) / math.sqrt(2)  # axis x corner is along +z
    return Rotation.from_rotvec(TILT_RAD * axis).as_matrix()


def contact_onset(distance: Float[Array, " n"], force: Float[Array, " n"]) -> float:
    """Distance to first contact in a press of a corner.

    Args:
        distance: m, of the looks on the way.
        force: N, felt then.

    Returns:
        m, where first contact was.

    Raises:
        ValueError: The force did not rise, or a look is not finite.
    """
    distance, force = np.asarray(distance, float), np.asarray(force, float)
    if lost := int(np.sum(~np.isfinite(distance + force))):
        raise ValueError(f"{lost} of {len(force)} looks have no finite distance and force; touch again")
    felt = force > CONTACT_FORCE_SHARE * max(force.max(), 0.0)
    if felt.sum() < MIN_LOOKS or np.ptp(distance[felt]) <= 0:
        raise ValueError(f"the force did not rise in at least {MIN_LOOKS} looks; lower the skin more slowly")
    if np.polyfit(distance[felt], force[felt], 1)[0] <= 0:
        raise ValueError("the force did not rise with the travel; zero it in the air and touch again")
    low, high = distance[0], distance[felt][0]
    deep = max(distance[-1] - low, 1e-6)
    guess = [high - 0.3 * np.ptp(distance[felt]), math.log(SOFT_M_PER_CUBE_ROOT_N), math.log(ARM_STIFFNESS_N_PER_M)]
    bounds = [low - deep, math.log(1e-6), math.log(1e2)], [high, math.log(1e-2), math.log(1e6)]

    def residuals(x: Array) -> Array:
        return corner_force(distance - x[0], *np.exp(x[1:])) - force

    return float(least_squares(residuals, guess, bounds=bounds, x_scale=[1e-4, 1.0, 1.0]).x[0])


def corner_force(indentation: Float[Array, " n"], soft: float, stiffness: float) -> Float[Array, " n"]:
    """Force of a corner that is pressed: indentation = soft F^(1/3) + F / stiffness, solved by Cardano's formula.

    Args:
        indentation: m since first contact; none below zero.
        soft: m/N^(1/3), of the elastic corner.
        stiffness: N/m, of arm and mount.

    Returns:
        N.
    """
    half = stiffness * np.maximum(indentation, 0) / 2
    root = np.sqrt(half**2 + (soft * stiffness / 3) ** 3)
    return (np.cbrt(half + root) + np.cbrt(half - root)) ** 3


def fit_plane(touches: Sequence[Array], height: float) -> FittedPlane:
    """The skin's face from the tool's poses where each of its corners began to touch.

    Args:
        touches: Four T_b_t (4, 4), in the order of `CORNER_SIGNS`.
        height: m, of the flat in the base.

    Returns:
        Where the face is in the tool.

    Raises:
        ValueError: It lies so far from the tool's frame that something else was touched.
    """
    corners = PAD_WINDOW / 2 * np.array(CORNER_SIGNS, float)
    z = np.array([(height - T[2, 3] - T[2, :2] @ corner) / T[2, 2] for T, corner in zip(touches, corners, strict=True)])
    design = np.column_stack([np.ones(4), corners])
    z0, sx, sy = np.linalg.lstsq(design, z, rcond=None)[0]
    normal = np.array([-sx, -sy, 1.0]) / math.sqrt(1 + sx**2 + sy**2)
    tilt = math.acos(normal[2])
    if abs(z0) > MAX_SHIFT_M or tilt > MAX_TILT_RAD:
        raise ValueError(
            f"the skin would be {1e3 * z0:.1f} mm and {math.degrees(tilt):.1f} degrees from where the rig has it; "
            "check the flat's height, and measure T_flange_tool with a ruler first"
        )
    axis = np.array([sy, -sx, 0.0]) / max(math.hypot(sx, sy), 1e-12)  # z x normal
    T = transform(Rotation.from_rotvec(tilt * axis).as_matrix(), np.array([0.0, 0.0, z0]))
    return FittedPlane(T, float(abs(z[0] - z[1] + z[2] - z[3]) / 4))


def touch_off(
    arm: GuardedArm,
    limits: MotionLimits,
    at: tuple[float, float],
    height: float,
    report: Callable[[str], None] = print,
) -> FittedPlane:
    """Touch a flat with all corners.

    Args:
        arm: Connected.
        limits: Of the arm.
        at: x and y (m) of the flat in the base.
        height: m, of the flat in the base.
        report: Hears how it goes.

    Returns:
        Where the skin's face is.

    Raises:
        ValueError: It would leave the box; nothing has moved.
        DeviceError: The arm fails, meets nothing, or something on its way.
    """
    starts = [_start(side, at, height) for side in CORNER_SIGNS]
    for start in starts:
        for goal in (start, shifted_along_z(start, CLEARANCE_M + MAX_OVERTRAVEL_M)):
            limits.check(goal, SPEED_M_S, APPROACH_ACCELERATION_M_S2)
    top = max(start[2, 3] for start in starts) + CLEARANCE_M
    across, down = (min(speed, limits.free_speed) for speed in (TRANSFER_SPEED_M_S, LOWERING_SPEED_M_S))
    touches = []
    for side, start in zip(CORNER_SIGNS, starts, strict=True):
        above = start.copy()
        above[2, 3] = top
        arm.go(above, across)
        arm.go(start, down)
        onset = _touch_corner(arm, side, start)
        touches.append(shifted_along_z(start, onset))
        report(f"corner {side}: touched after {1e3 * onset:.2f} mm")
        arm.go(start, down)
        arm.go(above, across)
    return fit_plane(touches, height)


def _start(side: tuple[int, int], at: tuple[float, float], height: float) -> Array:
    """T_b_t (4, 4) from where a corner is lowered onto the flat."""
    rotation = np.diag([1.0, -1.0, -1.0]) @ corner_rotation(side)
    lowest = -float(rotation[2, :2] @ (PAD_WINDOW / 2 * np.array(side)))  # m from the tool's origin down to that corner
    return transform(rotation, np.array([*at, height + lowest + CLEARANCE_M]))


def _touch_corner(arm: GuardedArm, side: tuple[int, int], start: Array) -> float:
    """Lower a corner from T_b_t (4, 4), where the arm stands; returns the distance (m) to first contact."""
    arm.zero_wrench()
    looks: list[tuple[float, float]] = []

    def look(state: ArmState) -> None:
        looks.append((float((state.T_b_t[:3, 3] - start[:3, 3]) @ start[:3, 2]), float(-state.wrench[2])))

    reach = CLEARANCE_M + MAX_OVERTRAVEL_M
    done = arm.approach(reach, SPEED_M_S, look, force=STOP_FORCE_N, acceleration=APPROACH_ACCELERATION_M_S2)
    if done.reason != "force":
        raise DeviceError(f"corner {side} met no flat within {1e3 * reach:g} mm: check its height")
    look(done.trigger)
    try:
        return contact_onset(*np.array(looks).T)
    except ValueError as error:
        raise DeviceError(f"corner {side}: {error}") from error


@dataclass(frozen=True)
class TouchOffArgs:
    """Find the skin in the tool by touching a flat with each of its corners."""

    rig: Path  # the lab's calibration
    height: float  # of the flat in the base, m
    at: Annotated[tuple[float, float], tyro.conf.arg(metavar="X Y")]  # the flat's position in the base, m
    arm: str = "ur"  # or another package's: the name that it registers, or package.module:Class
    host: str | None = None  # address of the arm's controller; a UR arm needs one
    write: bool = False  # put what is found into the rig


def _touch_off(asked: TouchOffArgs) -> None:
    rig = Rig.read(asked.rig)
    check_device("arm", asked.arm, {"address": asked.host})
    setup = DeviceSetup(rig, asked.host)  # whose stack holds what is started
    with setup.stack, load_device("arm", asked.arm, setup) as arm:
        found = touch_off(arm, rig.limits, asked.at, asked.height)
    T = rig.T_flange_tool @ found.T_tool_skin
    tilt = math.degrees(math.acos(min(1.0, found.T_tool_skin[2, 2])))
    print(
        f"the skin is {1e3 * found.T_tool_skin[2, 3]:+.2f} mm along z and {tilt:.2f} degrees from where the rig has "
        f"it; the corners miss a plane by {1e3 * found.flatness_error:.2f} mm"
    )
    if asked.write:
        # The camera stays where it is on the flange.
        camera = inverse(found.T_tool_skin) @ rig.T_tool_camera
        replace(rig, T_flange_tool=T, T_tool_camera=camera).write(asked.rig)
        print(f"{asked.rig}: written")


main = command(
    TouchOffArgs,
    _touch_off,
    program="python -m i2t.hardware.touch_off",
    description=__doc__,
    interrupted="stopped; the rig is as it was",
)


if __name__ == "__main__":
    sys.exit(main())
