"""Where the camera is aside of what a rig has, told by two looks between which the tool was turned about its own axis.

An object that stands aside is seen aside by both looks alike, by o in the world. A camera that is aside in the tool, by
e, is turned with it: the first look sees everything shifted by o - e, the second by o - R e in the first's axes, with R
the turn. So the difference of both is (R - 1) e, whatever o is. It tells alike of T_tool_camera and T_flange_tool.

A look does not tell one shift but several that explain it about as well as the best: of an edge all those along it, of
a plane all. By how far they disagree along a direction, the camera's place is not known along it.

Frames: W world, C camera, tool axes of the first look; metres.
"""

import numpy as np
from jaxtyping import Bool, Float
from numpy.lib.stride_tricks import sliding_window_view
from scipy.ndimage import maximum_filter

from i2t.types import Array

SHIFT_STEPS = 16  # at the most, either way, in which shifts are tried: 0.75 mm where 12 mm are
# Mean over a view's pixels, by which the true shift may fit worse than the best: a third of a depth pixel's noise, of
# which thousands of pixels have little left, but lens and placement bend views too.
FIT_MARGIN_M = 0.1e-3
DIRECTIONS = 36  # of half a turn, in which shifts are compared


def matching_shifts(
    depth: Float[Array, "h w"],
    expected: Float[Array, "h w"],
    on_object: Bool[Array, "h w"],
    pixel: tuple[float, float],
    tolerance: float,
) -> Float[np.ndarray, "n 3"]:
    """Shifts of an expected view that explain a measured one about as well as the best of them.

    Args:
        depth: m, as measured; NaN where nothing was.
        expected: m, of object and table where the rig has them.
        on_object: Which pixels show the object; those around them count too.
        pixel: m, its width and height at the object.
        tolerance: m, to which errors of depth are cut, as what is elsewhere is no better if it is near; shifts are
            tried up to twice as far.

    Returns:
        m in the camera's axes, the best first; along z as fits best. All that are tried where nothing was measured.
    """
    reach = max(1, round(2 * tolerance / min(pixel)))
    counted = maximum_filter(on_object, 2 * reach + 1)
    step = -(-reach // SHIFT_STEPS)
    depth, expected, counted = (each[::step, ::step] for each in (depth, expected, counted))
    reach = -(-reach // step)
    inner = (slice(reach, -reach), slice(reach, -reach))
    tried = np.arange(reach, -reach - 1, -1)
    v, u = (each.ravel() for each in np.meshgrid(tried, tried, indexing="ij"))
    shifts = np.column_stack([step * pixel[0] * u, step * pixel[1] * v, np.zeros(u.size)])
    measured, costs = (counted & np.isfinite(depth))[inner], np.zeros(u.size)
    if measured.any():
        windows = sliding_window_view(np.nan_to_num(expected), measured.shape)
        for i, (row, column) in enumerate(zip(reach - v, reach - u, strict=True)):
            off = depth[inner][measured] - windows[row, column][measured]
            shifts[i, 2] = np.clip(np.median(off), -tolerance, tolerance)
            costs[i] = np.minimum(np.abs(off - shifts[i, 2]), tolerance).mean()
    order = np.argsort(costs, kind="stable")
    return shifts[order[~(costs[order] > costs[order[0]] + FIT_MARGIN_M)]]


def camera_aside(
    first: Float[Array, "n 3"], second: Float[Array, "m 3"], turned: tuple[Float[Array, "3 3"], Float[Array, "3 3"]]
) -> tuple[Float[np.ndarray, "d 2"], Float[np.ndarray, " d"], Float[np.ndarray, " d"]]:
    """Where the camera is across the tool's axis, seen from where the rig has it.

    Args:
        first: m in W, shifts that explain the first look.
        second: m in W, of the second.
        turned: Rotation of the tool in W at each; it was turned about its z in between.

    Returns:
        Directions in the tool's x and y, m along each, and m by which some pair of shifts disagrees with that.
    """
    turn = (turned[0].T @ turned[1])[:2, :2]
    across = turned[0][:, :2] @ np.linalg.inv(turn - np.eye(2)).T
    angles = np.pi / DIRECTIONS * np.arange(DIRECTIONS)
    along = np.column_stack([np.cos(angles), np.sin(angles)])
    by_first, by_second = (shifts @ across @ along.T for shifts in (first, second))
    aside = by_first.mean(0) - by_second.mean(0)
    unsure = np.maximum(by_first.max(0) - by_second.min(0) - aside, aside - by_first.min(0) + by_second.max(0))
    return along, aside, unsure
