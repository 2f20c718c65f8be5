"""Pose of the skin in the tool, found by touching a flat with each corner of the skin.

    i2t touch-off --host 192.168.0.2 --rig lab.toml --height 0.012 --at 0.4 0.1 --write

WARNING: The command moves the arm. Set the speed slider to a fifth and keep a hand on the emergency stop.

The flat is a rigid, level surface at a known height in the robot's base: the table, or a gauge block on it. The tool is
tilted so that one corner of the skin is lowest, and lowered until the arm feels the flat. From the tool's pose
T_b_t at that moment, the height in the tool of the corner (x, y) of the skin is

    z = (height - o_z - R_zx x - R_zy y) / R_zz,        T_b_t = (R, o),

and four corners determine a plane, z = z0 + sx x + sy y by least squares: the face of the skin. The tool's frame is
moved along its z axis and tilted onto this plane. A flat reveals nothing about lateral offsets or rotations about z.
Three corners determine a plane; the distance by which the four miss it, |z1 - z2 + z3 - z4| / 4 in their order around
the skin, is reported.

A press begins before its force can be measured. A corner that sinks into an elastic layer by d touches over an area of
d^2 at a mean strain proportional to d, so its force grows as d^3. With a spring of stiffness k in series, the travel
since first contact is a F^(1/3) + F / k. First contact, a and k are fitted to the measured forces by least squares. On
the skin of the simulated world the result is 0.03 mm early at this tilt; a straight line through the forces would be
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
from i2t.hardware.limits import SAFETY
from i2t.hardware.motion_limits import MotionLimits
from i2t.hardware.plugins import DeviceSetup, check_device, load_device
from i2t.hardware.poses import translated_along_z
from i2t.hardware.protocols import ArmState, GuardedArm
from i2t.hardware.rig import Rig
from i2t.patches.dimensions import ARM_STIFFNESS_N_PER_M, PAD_WINDOW
from i2t.types import Array

# Signs of x and y of the corners of the skin, in their order around the skin.
CORNER_SIGNS = ((1, 1), (-1, 1), (-1, -1), (1, -1))


@dataclass(frozen=True)
class TouchOffConfig:
    """Motions of a touch-off (touching a flat with each corner of the skin), and settings of its fit to the force.

    The motions have a tilt (rad), a clearance (m), speeds (m/s) and an acceleration (m/s^2).
    """

    tilt: float = math.radians(6)  # rad, tilt of the tool while it touches
    clearance: float = 6e-3  # m, height of the lowest corner above the flat before it is lowered slowly
    transfer_speed: float = 0.05  # m/s, speed between the corners
    lowering_speed: float = 0.02  # m/s, speed down to the clearance
    approach_speed: float = 2e-3  # m/s, speed from the clearance onto the flat
    approach_acceleration: float = 0.1  # m/s^2, acceleration onto the flat
    softness_guess: float = 0.8e-3  # m/N^(1/3), first guess of a corner's softness `a`
    contact_force_share: float = 0.2  # share of the largest force from which a sample counts as in contact
    min_contact_samples: int = 5  # smallest number of samples in contact


class FittedPlane(NamedTuple):
    """Pose of the skin's face in the rig's tool frame (m), and distance (m) of each corner from the fitted plane."""

    T_tool_skin: Array  # (4, 4) pose of the skin in the rig's tool frame: a shift along z and a tilt, m
    flatness_error: float  # m, distance of each corner from the fitted plane


def corner_rotation(side: tuple[int, int], tilt: float = TouchOffConfig.tilt) -> Float[Array, "3 3"]:
    """Calculate the rotation that brings one corner of the skin forward along tool z, ahead of the others.

    Args:
        side: Signs (1 or -1) of the corner's x and y in the tool.
        tilt: Angle of the rotation in rad.

    Returns:
        (3, 3) rotation in the tool's axes.
    """
    axis = np.array([side[1], -side[0], 0.0]) / math.sqrt(2)  # axis x corner points along +z
    return Rotation.from_rotvec(tilt * axis).as_matrix()


def contact_onset(
    distance: Float[Array, " n"], force: Float[Array, " n"], *, config: TouchOffConfig = TouchOffConfig()
) -> float:
    """Estimate from the force at which distance a pressed corner of the skin first touched the flat.

    Args:
        distance: (n,) distance of the tool from the start at each sample, m.
        force: (n,) force of each sample, N.
        config: Thresholds of the force.

    Returns:
        The distance in m at which contact began.

    Raises:
        ValueError: The force did not rise, or a sample is not finite.
    """
    distance, force = np.asarray(distance, float), np.asarray(force, float)
    if lost := int(np.sum(~np.isfinite(distance + force))):
        raise ValueError(f"{lost} of {len(force)} samples have no finite distance and force; touch again")
    felt = force > config.contact_force_share * max(force.max(), 0.0)
    if felt.sum() < config.min_contact_samples or np.ptp(distance[felt]) <= 0:
        raise ValueError(
            f"the force did not rise in at least {config.min_contact_samples} samples; lower the skin more slowly"
        )
    if np.polyfit(distance[felt], force[felt], 1)[0] <= 0:
        raise ValueError("the force did not rise with the travel; zero it in the air and touch again")
    low, high = distance[0], distance[felt][0]
    deep = max(distance[-1] - low, 1e-6)
    guess = [high - 0.3 * np.ptp(distance[felt]), math.log(config.softness_guess), math.log(ARM_STIFFNESS_N_PER_M)]
    bounds = [low - deep, math.log(1e-6), math.log(1e2)], [high, math.log(1e-2), math.log(1e6)]

    def residuals(x: Array) -> Array:
        return corner_force(distance - x[0], *np.exp(x[1:])) - force

    return float(least_squares(residuals, guess, bounds=bounds, x_scale=[1e-4, 1.0, 1.0]).x[0])


def corner_force(travel: Float[Array, " n"], soft: float, stiffness: float) -> Float[Array, " n"]:
    """Calculate the force F of a pressed corner of the skin from travel = soft F^(1/3) + F / stiffness.

    Args:
        travel: (n,) travel past first contact in m; below zero there is no force.
        soft: Softness of the elastic corner in m/N^(1/3).
        stiffness: Stiffness of arm and mount in N/m.

    Returns:
        (n,) force in N.
    """
    half = stiffness * np.maximum(travel, 0) / 2
    root = np.sqrt(half**2 + (soft * stiffness / 3) ** 3)
    return (np.cbrt(half + root) + np.cbrt(half - root)) ** 3


def fit_plane(touches: Sequence[Array], height: float) -> FittedPlane:
    """Fit the plane of the skin's face to the tool poses at which its corners first touched a flat.

    Args:
        touches: Four poses T_b_t (4, 4), in the order of `CORNER_SIGNS`.
        height: Height of the flat in the base, m.

    Returns:
        The pose of the skin's face in the tool, and the distance of the corners from its plane.

    Raises:
        ValueError: The face is so far from the tool's frame that something else was touched.
    """
    corners = PAD_WINDOW / 2 * np.array(CORNER_SIGNS, float)
    z = np.array([(height - T[2, 3] - T[2, :2] @ corner) / T[2, 2] for T, corner in zip(touches, corners, strict=True)])
    design = np.column_stack([np.ones(4), corners])
    z0, sx, sy = np.linalg.lstsq(design, z, rcond=None)[0]
    normal = np.array([-sx, -sy, 1.0]) / math.sqrt(1 + sx**2 + sy**2)
    tilt = math.acos(normal[2])
    if not (abs(z0) <= SAFETY.touch_off_max_shift_m and tilt <= SAFETY.touch_off_max_tilt_rad):
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
    *,
    config: TouchOffConfig = TouchOffConfig(),
) -> FittedPlane:
    """Touch a horizontal flat with each corner of the skin, and fit the plane of its face.

    Args:
        arm: Connected arm.
        limits: Limits of the arm.
        at: Position (x, y) of the flat in the base, m.
        height: Height of the flat in the base, m.
        report: Function that receives a line on each corner.
        config: Motions of the touch-off.

    Returns:
        The pose of the skin's face in the tool, and the distance of the corners from its plane.

    Raises:
        ValueError: The tool would leave the box, before anything has moved; or the fitted face is too far from the
            tool's frame.
        DeviceError: The arm fails, does not meet the flat, or meets something on its way.
    """
    starts = [_start(side, at, height, config) for side in CORNER_SIGNS]
    reach = config.clearance + SAFETY.touch_off_overtravel_m
    for start in starts:
        for goal in (start, translated_along_z(start, reach)):
            limits.check(goal, config.approach_speed, config.approach_acceleration)
    top = max(start[2, 3] for start in starts) + config.clearance
    across, down = (min(speed, limits.free_speed) for speed in (config.transfer_speed, config.lowering_speed))
    touches = []
    for side, start in zip(CORNER_SIGNS, starts, strict=True):
        above = start.copy()
        above[2, 3] = top
        arm.go(above, across)
        arm.go(start, down)
        onset = _touch_corner(arm, side, start, config)
        touches.append(translated_along_z(start, onset))
        report(f"corner {side}: touched after {1e3 * onset:.2f} mm")
        arm.go(start, down)
        arm.go(above, across)
    return fit_plane(touches, height)


def _start(side: tuple[int, int], at: tuple[float, float], height: float, config: TouchOffConfig) -> Array:
    """Pose T_b_t (4, 4) from which a corner is lowered onto the flat."""
    rotation = np.diag([1.0, -1.0, -1.0]) @ corner_rotation(side, config.tilt)
    lowest = -float(rotation[2, :2] @ (PAD_WINDOW / 2 * np.array(side)))  # m from the tool's origin down to that corner
    return transform(rotation, np.array([*at, height + lowest + config.clearance]))


def _touch_corner(arm: GuardedArm, side: tuple[int, int], start: Array, config: TouchOffConfig) -> float:
    """Lower a corner from T_b_t (4, 4), where the arm stands, and return the distance (m) to first contact."""
    arm.zero_wrench()
    samples: list[tuple[float, float]] = []

    def record(state: ArmState) -> None:
        samples.append((float((state.T_b_t[:3, 3] - start[:3, 3]) @ start[:3, 2]), float(-state.wrench[2])))

    reach = config.clearance + SAFETY.touch_off_overtravel_m
    speed, acceleration = config.approach_speed, config.approach_acceleration
    result = arm.approach(reach, speed, record, force=SAFETY.touch_off_force_n, acceleration=acceleration)
    if result.reason != "force":
        raise DeviceError(f"corner {side} met no flat within {1e3 * reach:g} mm: check its height")
    record(result.trigger)
    try:
        return contact_onset(*np.array(samples).T, config=config)
    except ValueError as error:
        raise DeviceError(f"corner {side}: {error}") from error


@dataclass(frozen=True)
class TouchOffArgs:
    """Find the pose of the skin in the tool by touching a flat with each corner of the skin."""

    rig: Path  # the lab's calibration file
    height: float  # height (m) of the flat in the robot's base frame
    at: Annotated[tuple[float, float], tyro.conf.arg(metavar="X Y")]  # position (m) of the flat in the base frame
    arm: str = "ur"  # ur, or an arm of another package by its registered name or as package.module:Class
    host: str | None = None  # address of the arm's controller; required for a UR arm
    write: bool = False  # write the result to the calibration file


def _touch_off(args: TouchOffArgs) -> None:
    rig = Rig.read(args.rig)
    check_device("arm", args.arm, {"address": args.host})
    setup = DeviceSetup(rig, args.host)  # its stack closes what was started for the arm
    with setup.stack, load_device("arm", args.arm, setup) as arm:
        plane = touch_off(arm, rig.limits, args.at, args.height)
    T = rig.T_flange_tool @ plane.T_tool_skin
    tilt = math.degrees(math.acos(min(1.0, plane.T_tool_skin[2, 2])))
    print(
        f"the skin is {1e3 * plane.T_tool_skin[2, 3]:+.2f} mm along z and {tilt:.2f} degrees from where the rig has "
        f"it; the corners miss a plane by {1e3 * plane.flatness_error:.2f} mm"
    )
    if args.write:
        # The camera keeps its place on the flange.
        camera = inverse(plane.T_tool_skin) @ rig.T_tool_camera
        replace(rig, T_flange_tool=T, T_tool_camera=camera).write(args.rig)
        print(f"{args.rig}: written")


main = command(
    TouchOffArgs,
    _touch_off,
    program="python -m i2t.hardware.touch_off",
    description=__doc__,
    interrupted="stopped; the rig is unchanged",
)


if __name__ == "__main__":
    sys.exit(main())
