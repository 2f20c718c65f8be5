"""Layout of a triangle soup for rendering: a k-d tree orders the faces into small clusters, 32 clusters form a group,
and clusters and groups have bounding boxes.

Clusters have few faces, and the boxes let a renderer skip what a window cannot see: whole groups first, then clusters.
Surfaces are padded with faces that shrink to a point, whose boxes can never be met, so that the meshes of a size class
have arrays of the same shapes. NumPy on the host; metres.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from i2t.types import Surface

CLUSTERS_PER_GROUP = 32  # number of clusters of faces in a group, one for each bit of a word
EMPTY_HALF_EXTENT_M = -1e3  # m, half extent of an empty bounding box, which no ray or box meets


@dataclass(frozen=True)
class ClusterSizes:
    """Number of faces in a renderer's cluster, by the size of the mesh and of its faces."""

    fine: int = 2  # number of faces of a cluster in meshes of up to `max_fine_faces` faces
    coarse: int = 4  # number of faces of a cluster in larger meshes
    dense: int = 5  # number of faces of a cluster in larger meshes of small faces
    max_fine_faces: int = 4096
    small_face: float = 0.6e-6  # m^2, about five pixels of a patch: mean area of the face at a random point


# default number of faces in a cluster: least in meshes of few faces, most in large meshes of small faces
CLUSTER_SIZES = ClusterSizes()


def build_bvh(triangles: np.ndarray) -> Surface:
    """Order triangles into clusters and pad them to their size class.

    Args:
        triangles: `(f, 3, 3)` corners (m).

    Returns:
        The prepared surface.
    """
    if len(triangles) <= CLUSTER_SIZES.max_fine_faces:
        size = CLUSTER_SIZES.fine
    else:
        size = CLUSTER_SIZES.dense if _are_small(triangles) else CLUSTER_SIZES.coarse
    order = _tree_order(triangles.mean(1), size)
    clusters = -(-len(triangles) // size)
    return layout_clusters(triangles[order].astype(np.float32), size, _power_of_two(-(-clusters // CLUSTERS_PER_GROUP)))


def pad_to_same_size(surfaces: Sequence[Surface], faces: int = 1) -> list[Surface]:
    """Pad surfaces to the size class (number of faces) of the largest.

    Args:
        surfaces: Surfaces from `build_bvh`.
        faces: Number of faces for which the class must have room.

    Returns:
        Surfaces whose arrays have the same shapes.
    """
    sizes = [len(surface.triangles) // (len(np.asarray(surface.boxes)) * CLUSTERS_PER_GROUP) for surface in surfaces]
    capacity = max(faces, *(len(surface.triangles) for surface in surfaces))
    groups = -(-capacity // (max(sizes) * CLUSTERS_PER_GROUP))
    return [layout_clusters(np.asarray(surface.triangles), max(sizes), groups) for surface in surfaces]


def layout_clusters(triangles: np.ndarray, size: int, groups: int) -> Surface:
    """Cut ordered triangles into clusters, pad them and compute their boxes.

    Args:
        triangles: `(f, 3, 3)` corners (m), in the order of the tree's leaves.
        size: Number of faces in a cluster.
        groups: Number of groups, including the padding.

    Returns:
        The prepared surface.
    """
    missing = groups * CLUSTERS_PER_GROUP * size - len(triangles)
    triangles = np.concatenate([triangles, np.broadcast_to(triangles[-1, 0], (missing, 3, 3))])
    corners = triangles.reshape(groups * CLUSTERS_PER_GROUP, size * 3, 3)
    low, high = corners.min(1), corners.max(1)
    void = (corners == corners[:, :1]).all((1, 2))  # invisible clusters that shrink to a point, such as padding
    boxes = _boxes(low, high, void).reshape(groups, CLUSTERS_PER_GROUP, 6).swapaxes(1, 2)
    low = np.where(void[:, None], np.inf, low).reshape(groups, CLUSTERS_PER_GROUP, 3).min(1)
    high = np.where(void[:, None], -np.inf, high).reshape(groups, CLUSTERS_PER_GROUP, 3).max(1)
    empty = void.reshape(groups, CLUSTERS_PER_GROUP).all(1)
    low, high = np.where(empty[:, None], 0, low), np.where(empty[:, None], 0, high)
    group_boxes = np.full((6, -(-groups // 32) * 32), EMPTY_HALF_EXTENT_M, np.float32)
    group_boxes[:, :groups] = _boxes(low, high, empty).T
    return Surface(np.ascontiguousarray(triangles), np.ascontiguousarray(boxes), group_boxes)


def _are_small(triangles: np.ndarray) -> bool:
    """Test whether the faces of a mesh, weighted by their areas, are small on average."""
    a, b, c = np.moveaxis(triangles, 1, 0)
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    return bool((areas**2).sum() < CLUSTER_SIZES.small_face * areas.sum())


def _boxes(low: np.ndarray, high: np.ndarray, void: np.ndarray, slack: float = 1e-6) -> np.ndarray:
    """Compute the centres and half extents (n, 6) m of boxes between two corners, widened by a `slack` (m and relative)
    that exceeds the rounding errors of float32.
    """
    half = (high - low) / 2 * (1 + slack) + slack
    return np.concatenate([(low + high) / 2, np.where(void[:, None], EMPTY_HALF_EXTENT_M, half)], axis=1).astype(
        np.float32
    )


def _tree_order(points: np.ndarray, size: int) -> np.ndarray:
    """Order points (n, 3) by the leaves of a k-d tree, which all hold `size` points except the last."""
    leaves, stack = [], [(np.arange(len(points)), -(-len(points) // size))]
    while stack:
        indices, count = stack.pop()
        if count == 1:
            leaves.append(indices)
            continue
        axis = np.argmax(np.ptp(points[indices], axis=0))
        split = count // 2 * size
        halves = np.argpartition(points[indices, axis], split - 1)
        stack += [(indices[halves[split:]], count - count // 2), (indices[halves[:split]], count // 2)]
    return np.concatenate(leaves)


def _power_of_two(n: int) -> int:
    return 1 << (n - 1).bit_length()
