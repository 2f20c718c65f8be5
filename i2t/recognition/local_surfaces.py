"""Parts of large meshes that the skin can meet at a site.

A touch of a site meets an object within the skin's square only, wherever the object may stand. Of a scanned mesh that
is a small part, so each site gets a surface of the clusters of faces (`i2t.rendering.bvh`) whose boxes reach into that
square in at least one of the object's possible poses. What is left out can be neither met nor pressed: predictions stay
what they are on the whole mesh. NumPy on the host; metres.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float

from i2t.geometry import from_twist, inverse
from i2t.rendering.bvh import CLUSTERS_PER_GROUP, MAX_FINE_FACES, layout_clusters
from i2t.types import Array, Surface
from i2t.windows import PAD_WINDOW, STANDOFF

PRESSED_DEPTH_M = 10e-3  # behind first contact, five times the thickness of a skin: nothing deeper is pressed
LEAST_GROUPS = 16  # 2560 faces of a scan: most sites reach fewer
SLACK_M = 20e-6  # far above the rounding of float32


class ReachedBoxes(NamedTuple):
    """Boxes of the clusters of some surfaces, large enough for all poses in which an object may stand."""

    centre: Float[np.ndarray, "objects clusters 3"]
    extent: Float[np.ndarray, "objects clusters 3"]  # half edges; -inf for clusters without a face


def is_large(surfaces: Sequence[Surface]) -> bool:
    """Test for surfaces of one size class with so many faces that cutting them down saves time.

    Args:
        surfaces: Prepared together.

    Returns:
        Whether they have.
    """
    return len(surfaces[0].triangles) > MAX_FINE_FACES and surfaces[0].boxes is not None


def reached_boxes(surfaces: Sequence[Surface], twist: Float[Array | np.ndarray, "k 6"]) -> ReachedBoxes:
    """Boxes around each cluster of faces in every pose.

    Args:
        surfaces: Of the objects, of one size class.
        twist: Of the pose particles (m).

    Returns:
        The boxes.
    """
    T = np.asarray(jax.vmap(from_twist)(twist), np.float64)
    found = []
    for surface in surfaces:
        boxes = np.asarray(surface.boxes, np.float64).swapaxes(1, 2).reshape(-1, 6)
        low, high = np.full((2, len(boxes), 3), [[[np.inf]], [[-np.inf]]])
        for pose in T:
            centre = boxes[:, :3] @ pose[:3, :3].T + pose[:3, 3]
            extent = boxes[:, 3:] @ np.abs(pose[:3, :3]).T
            low, high = np.minimum(low, centre - extent), np.maximum(high, centre + extent)
        full = boxes[:, 3:].min(1, keepdims=True) >= 0
        found.append(((low + high) / 2, np.where(full, (high - low) / 2 + SLACK_M, -np.inf)))
    return ReachedBoxes(*(np.stack(part) for part in zip(*found, strict=True)))


def reached_clusters(
    boxes: ReachedBoxes, T_w_site: Float[np.ndarray, "sites 4 4"], overtravel: float
) -> Bool[np.ndarray, "objects sites clusters"]:
    """Clusters that a touch of each site may meet or press.

    Args:
        boxes: Of the objects.
        T_w_site: Sites.
        overtravel: Distance (m) beyond a site after which a press gives up.

    Returns:
        Whether they may be met.
    """
    T = inverse(np.asarray(T_w_site, np.float64))
    nearest, deepest, half = -2 * STANDOFF, overtravel + PRESSED_DEPTH_M, PAD_WINDOW / 2
    result = np.empty((len(boxes.centre), len(T), boxes.centre.shape[1]), bool)
    for i, (at, size) in enumerate(zip(boxes.centre, boxes.extent, strict=True)):
        full = np.isfinite(size[:, 0])
        size = np.where(full[:, None], size, 0.0)
        for j, pose in enumerate(T):
            x, y, z = (at @ pose[:3, :3].T + pose[:3, 3]).T
            dx, dy, dz = (size @ np.abs(pose[:3, :3]).T).T
            beside = (np.abs(x) - dx <= half) & (np.abs(y) - dy <= half)
            result[i, j] = full & beside & (z - dz <= deepest) & (z + dz >= nearest)
    return result


def size_class(reached: Bool[np.ndarray, "*sites clusters"]) -> int:
    """Groups of clusters, a power of four, that hold what is reached at any site: each class is compiled once, and few
    sites are much smaller than theirs.

    Args:
        reached: Which clusters, by site.

    Returns:
        The number of groups.
    """
    most, groups = int(reached.sum(-1).max()), LEAST_GROUPS
    while groups * CLUSTERS_PER_GROUP < most:
        groups *= 4
    return groups


def cut_surfaces(surface: Surface, reached: Bool[np.ndarray, "sites clusters"], groups: int) -> Surface:
    """The part of a surface that each of some sites reaches, stacked.

    Args:
        surface: Of the whole object.
        reached: Which clusters, by site.
        groups: Size class of the parts.

    Returns:
        Surfaces whose arrays have the sites as axis 0.
    """
    triangles = np.asarray(surface.triangles)
    clusters = triangles.reshape(reached.shape[1], -1, 3, 3)
    nothing = np.broadcast_to(triangles[0, 0], (1, 3, 3))  # a face without area, where a site reaches none
    parts = [
        layout_clusters(clusters[row].reshape(-1, 3, 3) if row.any() else nothing, clusters.shape[1], groups)
        for row in reached
    ]
    return Surface(*(np.stack(part) for part in zip(*parts, strict=True)))
