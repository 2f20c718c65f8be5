"""Where the skin is in the tool, by touching a flat with each of its corners; the first lines of a rig that are true.

    python -m i2t.hardware.touch_off --host 192.168.0.2 --rig lab.toml --height 0.012 --at 0.4 0.1 --write

A rigid, level flat lies at a known height in the robot's base, say the table, or a gauge block on it. The tool is
tilted so that one corner of the skin is lowest, and lowered until it is felt; from the tool's pose T_b_t then, the
corner (x, y) of the skin has in the tool the height

    z = (height - o_z - R_zx x - R_zy y) / R_zz,        T_b_t = (R, o),

and four corners make a plane, z = z0 + sx x + sy y by least squares: the skin's face. The tool's frame is moved along
its z axis and tilted onto it; sideways and about z a flat tells nothing. The fourth corner is one more than a plane
needs: by how much the four miss it, |z1 - z2 + z3 - z4| / 4 in their order around, is told.

A press begins before it is felt. A corner that sinks into an elastic layer by d meets it over an area of d^2 at a mean
strain in proportion to d, so its force grows as d^3; with a spring 1 / k in series the travel since first contact is
a F^(1/3) + F / k. First contact, a and k are those that fit the forces on the way best, by least squares. On the skin
of the simulated world that is 0.03 mm early at this tilt, where a straight line through the forces would be
0.5 mm late.
"""

import argparse
import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from i2t.cli import ended
from i2t.errors import DeviceError
from i2t.hardware.protocols import ArmState
from i2t.hardware.rig import Rig
from i2t.types import PAD_WINDOW, Array

SIDES = ((1, 1), (-1, 1), (-1, -1), (1, -1))  # of the corners, in their order around
TILT = math.radians(6)  # of the tool while it touches
CLEAR = 6e-3  # m above the flat, from where the lowest corner is lowered
BEYOND = 5e-3  # m past where it should touch, after which there is no flat
SPEED, FORCE = 2e-3, 2.0  # m/s, N: a corner gives some newtons per millimetre
SOFT, STIFF = 0.8e-3, 1e4  # m/N^(1/3), N/m: a guess of a corner, and of arm and mount
EARLY, FEWEST = 0.2, 5  # of the last force, above which it counts as felt; looks that must feel it
LARGEST = 5e-3, math.radians(4)  # m, rad: what is further from the rig was no touch of a flat


class Face(NamedTuple):
    """The skin as it was found."""

    T_tool_skin: Array  # (4, 4), from the tool's frame as it was: a shift along z and a tilt
    miss: float  # m, by which each corner misses their plane


def lowered(side: tuple[int, int], tilt: float = TILT) -> Array:
    """(3, 3) turn, in the tool's axes, that brings the corner on a side forward."""
    across = np.array([side[1], -side[0], 0.0]) / math.sqrt(2)  # across x corner is along +z
    return Rotation.from_rotvec(tilt * across).as_matrix()


def onset(travel: Array, force: Array) -> float:
    """Where (m) a press began, from travel (n,) m and force (n,) N on the way; raises ValueError where none rose."""
    travel, force = np.asarray(travel, float), np.asarray(force, float)
    most, felt = force.max(), force > EARLY * force.max()
    if felt.sum() < FEWEST or most <= 0 or np.ptp(travel[felt]) <= 0:
        raise ValueError(f"the force did not rise in at least {FEWEST} looks; lower the skin more slowly")
    if np.polyfit(travel[felt], force[felt], 1)[0] <= 0:
        raise ValueError("the force did not rise with the travel; zero it in the air and touch again")
    low, high = travel[0], travel[felt][0]
    deep = max(travel[-1] - low, 1e-6)

    def miss(x: Array) -> Array:
        return pressed(travel - x[0], *np.exp(x[1:])) - force

    found = least_squares(
        miss,
        [high - 0.3 * np.ptp(travel[felt]), math.log(SOFT), math.log(STIFF)],
        bounds=([low - deep, math.log(1e-6), math.log(1e2)], [high, math.log(1e-2), math.log(1e6)]),
        x_scale=[1e-4, 1.0, 1.0],
    )
    return float(found.x[0])


def pressed(travel: Array, soft: float, stiff: float) -> Array:
    """Force (N) at `travel` (m) since first contact, where travel = soft F^(1/3) + F / stiff (Cardano)."""
    half = stiff * np.maximum(travel, 0) / 2
    root = np.sqrt(half**2 + (soft * stiff / 3) ** 3)
    return (np.cbrt(half + root) + np.cbrt(half - root)) ** 3


def face(touches: Sequence[Array], height: float, half: float = PAD_WINDOW / 2) -> Face:
    """The skin's face from the tool's poses T_b_t (4, 4) where each of its corners began to touch, in the order of
    SIDES; `height` (m) is the flat's in the base, `half` (m) half the skin's edge. Raises ValueError where it lies so
    far from the tool's frame that it was something else.
    """
    corners = half * np.array(SIDES, float)
    z = np.array([(height - T[2, 3] - T[2, :2] @ corner) / T[2, 2] for T, corner in zip(touches, corners, strict=True)])
    design = np.column_stack([np.ones(4), corners])
    z0, sx, sy = np.linalg.lstsq(design, z, rcond=None)[0]
    normal = np.array([-sx, -sy, 1.0]) / math.sqrt(1 + sx**2 + sy**2)
    tilt = math.acos(normal[2])
    if abs(z0) > LARGEST[0] or tilt > LARGEST[1]:
        raise ValueError(
            f"the skin would be {1e3 * z0:.1f} mm and {math.degrees(tilt):.1f} degrees from where the rig has it; "
            "check the flat's height, and measure T_flange_tool with a ruler first"
        )
    axis = np.cross([0.0, 0.0, 1.0], normal)
    size = np.linalg.norm(axis)
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(axis / size * tilt if size > 0 else axis).as_matrix()
    T[2, 3] = z0
    return Face(T, float(abs(z[0] - z[1] + z[2] - z[3]) / 4))


def touch_off(arm: Any, at: tuple[float, float], height: float, tell: Callable[[str], None] = print) -> Face:
    """Touch a flat with all corners, with a connected arm that guards its approaches (`i2t.hardware.ur.driver.UrArm`).

    `at` and `height` (m) are in the base. Raises ValueError, before anything moves, where it would leave the box;
    DeviceError where the arm fails, meets nothing, or something on its way.
    """
    down = np.diag([1.0, -1.0, -1.0, 1.0])
    down[:2, 3] = at
    starts = []
    for side in SIDES:
        T = down.copy()
        T[:3, :3] = down[:3, :3] @ lowered(side)
        reach = -float(T[2, :2] @ (PAD_WINDOW / 2 * np.array(side)))  # from the tool's origin down to that corner
        T[2, 3] = height + reach + CLEAR
        end = T.copy()
        end[:3, 3] += (CLEAR + BEYOND) * T[:3, 2]
        for goal in (T, end):
            arm.limits.check(goal, SPEED, 0.1)
        starts.append(T)
    top = max(T[2, 3] for T in starts)
    touches = []
    for side, T in zip(SIDES, starts, strict=True):
        above = T.copy()
        above[2, 3] = top + CLEAR
        arm.go(above, min(0.05, arm.limits.speed))
        arm.go(T, min(0.02, arm.limits.speed))
        arm.zero_wrench()
        looks: list[tuple[float, float]] = []

        def look(state: ArmState, start: Array = T, looks: list[tuple[float, float]] = looks) -> None:
            looks.append((float((state.T_b_t[:3, 3] - start[:3, 3]) @ start[:3, 2]), float(-state.wrench[2])))

        done = arm.approach(CLEAR + BEYOND, SPEED, look, force=FORCE, acceleration=0.1)
        if done.reason != "force":
            raise DeviceError(f"corner {side} met no flat within {1e3 * (CLEAR + BEYOND):g} mm: check its height")
        look(done.trigger)
        try:
            began = onset(*np.array(looks).T)
        except ValueError as error:
            raise DeviceError(f"corner {side}: {error}") from error
        touch = T.copy()
        touch[:3, 3] += began * T[:3, 2]
        touches.append(touch)
        tell(f"corner {side}: touched after {1e3 * began:.2f} mm")
        arm.go(T, 0.02)
        arm.go(above, min(0.05, arm.limits.speed))
    return face(touches, height)


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = argparse.ArgumentParser(
        "python -m i2t.hardware.touch_off", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--host", required=True, help="address of the arm's controller")
    parser.add_argument("--rig", type=Path, required=True, help="the lab's calibration")
    parser.add_argument("--height", type=float, required=True, help="of the flat in the base, m")
    parser.add_argument("--at", type=float, nargs=2, required=True, metavar=("X", "Y"), help="its place in the base, m")
    parser.add_argument("--state-timeout", type=float, default=0.1, help="s without news after which the arm is taken for lost")
    parser.add_argument("--watchdog-rate", type=float, default=10.0, help="Hz, how often the controller must hear from us")
    parser.add_argument("--write", action="store_true", help="put what is found into the rig")
    asked = parser.parse_args(arguments)
    return ended(lambda: _touch_off(asked), "stopped; the rig is as it was")


def _touch_off(asked: argparse.Namespace) -> None:
    from i2t.hardware.ur.driver import UrArm

    rig = Rig.read(asked.rig)
    payload = rig.mass, rig.centre
    with UrArm(asked.host, rig.limits, rig.T_flange_tool, payload, state_timeout=asked.state_timeout, watchdog_rate=asked.watchdog_rate) as arm:
        found = touch_off(arm, tuple(asked.at), asked.height)
    T = rig.T_flange_tool @ found.T_tool_skin
    tilt = math.degrees(math.acos(min(1.0, found.T_tool_skin[2, 2])))
    print(
        f"the skin is {1e3 * found.T_tool_skin[2, 3]:+.2f} mm along z and {tilt:.2f} degrees from where the rig has "
        f"it; the corners miss a plane by {1e3 * found.miss:.2f} mm"
    )
    if asked.write:
        # The camera stays where it is on the flange.
        camera = np.linalg.inv(found.T_tool_skin) @ rig.T_tool_camera
        replace(rig, T_flange_tool=T, T_tool_camera=camera).write(asked.rig)
        print(f"{asked.rig}: written")


if __name__ == "__main__":
    sys.exit(main())
