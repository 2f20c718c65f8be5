"""Layout of a triangle soup for rendering: a k-d tree orders the faces into small clusters, 32 clusters make a group,
and both have boxes.

The clusters have few faces each and the boxes let a renderer skip what a window cannot see: first whole groups, then
clusters. Everything is padded with faces that shrink to a point (their boxes can never be met), so that meshes of one
size class have arrays of one shape. NumPy on the host; metres.
"""

from collections.abc import Sequence

import numpy as np

from i2t.types import Surface

CLUSTERS_PER_GROUP = 32  # clusters of a group: one machine word holds a bit for each
FINE_CLUSTER_FACES = 2  # faces of a cluster in meshes of up to MAX_FINE_FACES faces
COARSE_CLUSTER_FACES = 4  # in larger meshes
DENSE_CLUSTER_FACES = 5  # in larger meshes of small faces
MAX_FINE_FACES = 4096
SMALL_FACE_M2 = 0.6e-6  # about five pixels of a patch: on dense meshes the face at a random point is smaller
EMPTY_HALF_EXTENT_M = -1e3  # m, half extent of a box that nothing meets
BOX_SLACK = 1e-6  # m and relative: boxes are widened by more than float32 can lose


def build_bvh(triangles: np.ndarray) -> Surface:
    """Order triangles into clusters and pad them to their size class.

    Args:
        triangles: (f, 3, 3) corners (m).

    Returns:
        The surface.
    """
    size = (
        FINE_CLUSTER_FACES
        if len(triangles) <= MAX_FINE_FACES
        else DENSE_CLUSTER_FACES
        if _are_small(triangles)
        else COARSE_CLUSTER_FACES
    )
    order = _tree_order(triangles.mean(1), size)
    clusters = -(-len(triangles) // size)
    return layout_clusters(triangles[order].astype(np.float32), size, _power_of_two(-(-clusters // CLUSTERS_PER_GROUP)))


def pad_to_same_size(surfaces: Sequence[Surface], faces: int = 1) -> list[Surface]:
    """Bring surfaces to one size class, the largest among them.

    Args:
        surfaces: Of `build_bvh`.
        faces: For which the class has room at least.

    Returns:
        Surfaces whose arrays have the same shapes.
    """
    sizes = [len(surface.triangles) // (len(np.asarray(surface.boxes)) * CLUSTERS_PER_GROUP) for surface in surfaces]
    most = max(faces, *(len(surface.triangles) for surface in surfaces))
    groups = -(-most // (max(sizes) * CLUSTERS_PER_GROUP))
    return [layout_clusters(np.asarray(surface.triangles), max(sizes), groups) for surface in surfaces]


def layout_clusters(triangles: np.ndarray, size: int, groups: int) -> Surface:
    """Cut ordered triangles into clusters, pad them and box them.

    Args:
        triangles: (f, 3, 3) corners (m), in the order of the tree's leaves.
        size: Faces of a cluster.
        groups: Of clusters, with the padding.

    Returns:
        The surface.
    """
    missing = groups * CLUSTERS_PER_GROUP * size - len(triangles)
    triangles = np.concatenate([triangles, np.broadcast_to(triangles[-1, 0], (missing, 3, 3))])
    corners = triangles.reshape(groups * CLUSTERS_PER_GROUP, size * 3, 3)
    low, high = corners.min(1), corners.max(1)
    void = (corners == corners[:, :1]).all((1, 2))  # a cluster that shrinks to a point: padding, or nothing to see
    boxes = _boxes(low, high, void).reshape(groups, CLUSTERS_PER_GROUP, 6).swapaxes(1, 2)
    low = np.where(void[:, None], np.inf, low).reshape(groups, CLUSTERS_PER_GROUP, 3).min(1)
    high = np.where(void[:, None], -np.inf, high).reshape(groups, CLUSTERS_PER_GROUP, 3).max(1)
    empty = void.reshape(groups, CLUSTERS_PER_GROUP).all(1)
    low, high = np.where(empty[:, None], 0, low), np.where(empty[:, None], 0, high)
    whole = np.full((6, -(-groups // 32) * 32), EMPTY_HALF_EXTENT_M, np.float32)
    whole[:, :groups] = _boxes(low, high, empty).T
    return Surface(np.ascontiguousarray(triangles), np.ascontiguousarray(boxes), whole)


def _are_small(triangles: np.ndarray) -> bool:
    a, b, c = np.moveaxis(triangles, 1, 0)
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    return bool((areas**2).sum() < SMALL_FACE_M2 * areas.sum())


def _boxes(low: np.ndarray, high: np.ndarray, void: np.ndarray) -> np.ndarray:
    """Centres and half extents (n, 6) of boxes between two corners."""
    half = (high - low) / 2 * (1 + BOX_SLACK) + BOX_SLACK
    return np.concatenate([(low + high) / 2, np.where(void[:, None], EMPTY_HALF_EXTENT_M, half)], axis=1).astype(
        np.float32
    )


def _tree_order(points: np.ndarray, size: int) -> np.ndarray:
    """Order of points (n, 3) by the leaves of a k-d tree; all leaves but the last hold `size` points."""
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
