"""Signed distance of a mesh on a grid, and the mesh of a signed distance.

A signed distance (m) is negative inside a solid and positive outside. Its sign is the winding number along a line
through each column of the grid, so bodies may overlap. Its size is the exact distance to the nearest of a few triangles
near the surface, and the distance to a dense sample of the surface farther away. Marching cubes (Lewiner et al.,
Journal of Graphics Tools 8, 2003) turn a signed distance back to a mesh. They come from scikit-image, the optional
extra `reconstruct`.
"""

from typing import NamedTuple

import numpy as np
import trimesh
from jaxtyping import Float
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from i2t.errors import require_extra
from i2t.objects.solids import Mesh


class VoxelGrid(NamedTuple):
    """Regular grid of points in the object's frame: point (i, j, k) is `low + spacing * (i, j, k)` (m)."""

    low: tuple[float, float, float]  # m, lowest corner of the grid
    spacing: float  # m, distance between the grid's points
    shape: tuple[int, int, int]

    def points(self) -> Float[np.ndarray, "g 3"]:
        """List all points of the grid.

        Returns:
            `(g, 3)` coordinates (m) of the g points, z fastest.
        """
        axes = [self.low[i] + self.spacing * np.arange(self.shape[i]) for i in range(3)]
        return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3).astype(np.float32)


def grid_around(low: NDArray, high: NDArray, *, across: int, margin: float) -> VoxelGrid:
    """Lay a grid over a box, square from above and centred on the z axis, so that quarter turns map it to itself.

    Args:
        low: (3,) lowest corner (m) of the box.
        high: (3,) highest corner (m) of the box.
        across: Number of points along x, and along y.
        margin: Margin (m) added on all sides.

    Returns:
        Grid that covers the box with its margin.
    """
    half = float(np.abs(np.stack([low[:2], high[:2]])).max()) + margin
    spacing = 2 * half / (across - 1)
    levels = int(np.ceil((high[2] - low[2] + 2 * margin) / spacing)) + 1
    return VoxelGrid((-half, -half, float(low[2]) - margin), spacing, (across, across, levels))


def corners_of(grid: VoxelGrid, points: Float[np.ndarray, "n 3"]) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Find the eight grid points around each point, and their weights in trilinear interpolation.

    Args:
        grid: Grid on which to interpolate.
        points: Points (m); those outside are moved to the grid's nearest face.

    Returns:
        `(n, 8)` indices into the flat grid, and `(n, 8)` weights that sum to 1.
    """
    last = np.array(grid.shape) - 1
    place = np.clip((np.asarray(points) - grid.low) / grid.spacing, 0, last)
    base = np.minimum(place.astype(np.int64), last - 1)
    part = place - base
    step = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    index = np.ravel_multi_index(tuple(np.moveaxis(base[:, None] + step, -1, 0)), grid.shape)
    weight = np.where(step, part[:, None], 1 - part[:, None]).prod(-1)
    return index, weight.astype(np.float32)


def interpolate(grid: VoxelGrid, values: Float[np.ndarray, " g"], points: Float[np.ndarray, "n 3"]) -> NDArray:
    """Interpolate values of a grid at any points trilinearly.

    Args:
        grid: Grid of the values.
        values: One value for each point of the grid.
        points: Points (m); those outside take the value of the nearest face.

    Returns:
        `(n,)` values at the points.
    """
    index, weight = corners_of(grid, points)
    return (values[index] * weight).sum(-1)


def signed_distance_grid(
    mesh: Mesh,
    grid: VoxelGrid,
    *,
    min_samples: int = 6000,
    samples_per_face: int = 2,
    neighbours: int = 6,
    exact_within: float = 8e-3,
) -> Float[np.ndarray, " g"]:
    """Compute the signed distance of a closed mesh at the points of a grid.

    Args:
        mesh: Closed mesh with faces turned outward; bodies may overlap.
        grid: Grid of the signed distance.
        min_samples: Minimum number of samples of the surface.
        samples_per_face: Minimum mean number of samples of a face.
        neighbours: Number of nearest samples whose triangles give the exact distance.
        exact_within: Distance (m) from the surface up to which distances are exact. Farther away they are distances to
            the samples.

    Returns:
        `(g,)` signed distances (m) at the grid's g points, negative inside.
    """
    triangles = np.asarray(mesh.vertices, np.float64)[mesh.faces]
    points = grid.points().astype(np.float64)
    samples, faces = sample_surface(mesh, max(min_samples, samples_per_face * len(mesh.faces)))
    distance, nearest = cKDTree(samples).query(points, k=neighbours, workers=-1)
    near = np.flatnonzero(distance[:, 0] < exact_within)
    candidates = faces[nearest[near]].reshape(-1)
    near_points = np.repeat(points[near], neighbours, axis=0)
    closest = trimesh.triangles.closest_point(triangles[candidates], near_points)
    exact = np.linalg.norm(closest - near_points, axis=-1).reshape(-1, neighbours).min(-1)
    size = distance[:, 0]
    size[near] = exact
    return np.where(_inside(triangles, grid), -size, size).astype(np.float32)


def sample_surface(mesh: Mesh, count: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Draw points evenly over a surface, the same points at each call.

    Args:
        mesh: Mesh with a surface area above 0.
        count: Number of points.

    Returns:
        `(count, 3)` points (m), and the `(count,)` indices of their faces.
    """
    rng = np.random.default_rng(0)
    a, b, c = np.moveaxis(np.asarray(mesh.vertices, np.float64)[mesh.faces], 1, 0)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=-1)
    places = (np.arange(count) + rng.random(count)) / count  # stratified, for smaller gaps than independent draws leave
    face = np.searchsorted(np.cumsum(area) / area.sum(), places).clip(max=len(area) - 1)
    root, v = np.sqrt(rng.random((count, 1))), rng.random((count, 1))
    return (1 - root) * a[face] + root * (1 - v) * b[face] + root * v * c[face], face


def extract_mesh(grid: VoxelGrid, distance: Float[np.ndarray, " g"]) -> Mesh:
    """Extract the surface on which a signed distance is zero, closed where it leaves the grid.

    Args:
        grid: Grid of the signed distance.
        distance: `(g,)` signed distances (m) at the grid's g points, negative inside.

    Returns:
        Mesh of the surface in metres, faces turned outward; without faces if no point is inside.

    Raises:
        MissingExtraError: scikit-image is not installed.
    """
    require_extra("skimage", "a mesh of signed distances")
    from skimage.measure import marching_cubes

    field = np.pad(distance.reshape(grid.shape), 1, constant_values=grid.spacing)
    if field.min() >= 0 or field.max() <= 0:
        return Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32))
    vertices, faces, _, _ = marching_cubes(field, level=0.0, spacing=(grid.spacing,) * 3, gradient_direction="descent")
    return Mesh(vertices.astype(np.float64) - grid.spacing + grid.low, faces.astype(np.int32))


def _inside(triangles: NDArray, grid: VoxelGrid) -> NDArray[np.bool_]:
    """Test which grid points are inside a mesh, by the winding number along their column of the grid."""
    columns_xy = grid.points().reshape(*grid.shape, 3)[:, :, 0, :2].reshape(-1, 2).astype(np.float64)
    xy = columns_xy + np.array([1.7e-7, 1.1e-7])  # m, so that columns miss vertices and edges that lie on the grid
    levels = grid.low[2] + grid.spacing * np.arange(grid.shape[2])
    winding = np.zeros((len(xy), grid.shape[2]), np.int32)
    low, high = triangles[..., :2].min(1), triangles[..., :2].max(1)
    for corner, lowest, highest in zip(triangles, low, high, strict=True):
        a, b, c = corner[:, :2]
        area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        columns = np.flatnonzero(((xy >= lowest) & (xy <= highest)).all(-1)) if area else np.zeros(0, int)
        if not len(columns):
            continue
        p = xy[columns] - a
        v = (p[:, 0] * (c[1] - a[1]) - p[:, 1] * (c[0] - a[0])) / area
        w = ((b[0] - a[0]) * p[:, 1] - (b[1] - a[1]) * p[:, 0]) / area
        inside = (v >= 0) & (w >= 0) & (v + w <= 1)
        z = corner[0, 2] + v * (corner[1, 2] - corner[0, 2]) + w * (corner[2, 2] - corner[0, 2])
        above = z[inside][:, None] > levels
        winding[columns[inside]] += np.where(above, np.sign(area).astype(np.int32), 0)
    return (winding > 0).reshape(-1)
