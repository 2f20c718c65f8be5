"""Lateral offset of the camera from its pose in a rig, by two looks between which the tool turns about its own axis.

An object that is displaced by o in the world appears displaced by o in both looks. A camera that is displaced by e in
the tool turns with it: the first look sees everything shifted by o - e, the second by o - R e in the axes of the first,
where R is the turn. The difference of both is (R - 1) e for any o. Errors of T_tool_camera and of T_flange_tool
have the same effect.

A look does not determine one shift, but a set of shifts that explain it about as well as the best: all those along an
edge, and all those in a plane. The spread of this set along a direction is the uncertainty of the camera's position
along it.

Frames: W world, C camera, tool axes of the first look; metres.
"""

import numpy as np
from jaxtyping import Bool, Float
from numpy.lib.stride_tricks import sliding_window_view
from scipy.ndimage import maximum_filter

from i2t.types import Array


def matching_shifts(
    depth: Float[Array, "h w"],
    expected: Float[Array, "h w"],
    on_object: Bool[Array, "h w"],
    pixel: tuple[float, float],
    tolerance: float,
    *,
    max_steps: int = 16,
    fit_margin: float = 0.1e-3,
) -> Float[np.ndarray, "n 3"]:
    """Find the shifts of an expected depth image that explain a measured one about as well as the best shift.

    Args:
        depth: Measured depth (m) along the camera's axis; NaN where nothing was measured.
        expected: Depth (m) of object and table at their poses in the rig.
        on_object: Mask of the pixels that show the object. The pixels around them count too.
        pixel: Width and height (m) of a pixel at the object's distance.
        tolerance: Bound (m) to which differences of depth are clipped, since a distant background is no more
            informative than a near one. Shifts up to twice this distance are tried.
        max_steps: Maximum number of steps in which shifts are tried in either direction.
        fit_margin: Mean difference (m) over a view's pixels by which the true shift may fit worse than the best. The
            default is a third of the noise of a pixel's depth. The mean over thousands of pixels has little noise, but
            errors of lens and pose distort views as well.

    Returns:
        `(n, 3)` shifts (m) of the expected view in the camera's axes, the best first. The z of each is the depth shift
        that fits best with its x and y. All tried shifts are returned if nothing was measured.
    """
    reach = max(1, round(2 * tolerance / min(pixel)))
    counted = maximum_filter(on_object, 2 * reach + 1)
    step = -(-reach // max_steps)
    depth, expected, counted = (image[::step, ::step] for image in (depth, expected, counted))
    reach = -(-reach // step)
    inner = (slice(reach, -reach), slice(reach, -reach))
    steps = np.arange(reach, -reach - 1, -1)
    v, u = (grid.ravel() for grid in np.meshgrid(steps, steps, indexing="ij"))
    shifts = np.column_stack([step * pixel[0] * u, step * pixel[1] * v, np.zeros(u.size)])
    measured, costs = (counted & np.isfinite(depth))[inner], np.zeros(u.size)
    if measured.any():
        windows = sliding_window_view(np.nan_to_num(expected), measured.shape)
        for i, (row, column) in enumerate(zip(reach - v, reach - u, strict=True)):
            difference = depth[inner][measured] - windows[row, column][measured]
            shifts[i, 2] = np.clip(np.median(difference), -tolerance, tolerance)
            costs[i] = np.minimum(np.abs(difference - shifts[i, 2]), tolerance).mean()
    order = np.argsort(costs, kind="stable")
    return shifts[order[~(costs[order] > costs[order[0]] + fit_margin)]]


def lateral_offset(
    first: Float[Array, "n 3"],
    second: Float[Array, "m 3"],
    rotations: tuple[Float[Array, "3 3"], Float[Array, "3 3"]],
    *,
    directions: int = 36,
) -> tuple[Float[np.ndarray, "d 2"], Float[np.ndarray, " d"], Float[np.ndarray, " d"]]:
    """Estimate how far the camera is from its pose in the rig, across the tool's z axis, from two looks at one site.

    Args:
        first: Shifts (m, in the world frame W) that explain the first look, from `matching_shifts`.
        second: Shifts (m, in W) that explain the second look, with the tool turned about its z axis.
        rotations: Rotations of the tool in W at the two looks, which differ by a turn about its z.
        directions: Number of directions within half a turn along which the offset is estimated.

    Returns:
        `(d, 2)` unit vectors in the tool's x and y, the offset (m) along each of the d directions, and its uncertainty
        (m): the largest deviation of any pair of shifts from the offset.
    """
    turn = (rotations[0].T @ rotations[1])[:2, :2]
    across = rotations[0][:, :2] @ np.linalg.inv(turn - np.eye(2)).T
    angles = np.pi / directions * np.arange(directions)
    along = np.column_stack([np.cos(angles), np.sin(angles)])
    by_first, by_second = (shifts @ across @ along.T for shifts in (first, second))
    offset = by_first.mean(0) - by_second.mean(0)
    uncertainty = np.maximum(by_first.max(0) - by_second.min(0) - offset, offset - by_first.min(0) + by_second.max(0))
    return along, offset, uncertainty
