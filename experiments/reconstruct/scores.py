"""Distance of a reconstructed surface to the true one, and coverage of its bands."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from i2t.objects.solids import Mesh
from i2t.reconstruction.signed_distances import (
    VoxelGrid,
    extract_mesh,
    interpolate,
    sample_surface,
    signed_distance_grid,
)
from i2t.reconstruction.surface import Z_90, SurfaceEstimate

F_SCORE_SHARE = 0.01  # of the diagonal, within which a point counts as found
SEEN_WITHIN_M = 3e-3  # of a point of the view, the surface is not hidden
MM_PER_M = 1e3
SCORES = ("chamfer_mm", "iou", "f_score", "coverage", "band_mm", "hidden_mm")


class TrueShape(NamedTuple):
    """The true shape, to compare reconstructions with."""

    points: np.ndarray  # (n, 3) m, of the surface
    tree: cKDTree
    inside: np.ndarray  # (g,) of the grid
    diagonal: float  # m
    floor_mm: float  # Chamfer distance of the true signed distance, put on the grid and taken off it again


def true_shape(mesh: Mesh, grid: VoxelGrid, samples: int) -> TrueShape:
    """The true shape, and how near the grid itself allows a reconstruction to come."""
    points, _ = sample_surface(mesh, samples)
    distance = signed_distance_grid(mesh, grid)
    diagonal = float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
    shape = TrueShape(points, cKDTree(points), distance < 0, diagonal, 0.0)
    there, back = _distances(extract_mesh(grid, distance), shape)
    return shape._replace(floor_mm=MM_PER_M * 0.5 * (there.mean() + back.mean()))


def judge(estimate: SurfaceEstimate, truth: TrueShape, hidden: np.ndarray | None = None) -> dict[str, float]:
    """All scores of one reconstruction; `hidden` are points of the surface that no view showed."""
    there, back = _distances(estimate.mesh, truth)
    within = F_SCORE_SHARE * truth.diagonal
    precision, recall = (there < within).mean(), (back < within).mean()
    found = estimate.distance < 0
    std = interpolate(estimate.grid, estimate.std, truth.points)
    return {
        "chamfer_mm": MM_PER_M * 0.5 * float(there.mean() + back.mean()),
        "iou": float((found & truth.inside).sum() / max((found | truth.inside).sum(), 1)),
        "f_score": float(2 * precision * recall / max(precision + recall, 1e-9)),
        "coverage": float((surface_errors(estimate, truth).standard < Z_90).mean()),
        "band_mm": MM_PER_M * Z_90 * float(std.mean()),
        "hidden_mm": float("nan") if hidden is None else MM_PER_M * _one_way(estimate.mesh, hidden),
    }


class SurfaceErrors(NamedTuple):
    """Absolute signed distances at points of the true surface, where they should be zero."""

    distance: np.ndarray  # m, without its sign
    std: np.ndarray  # m, as estimated

    @property
    def standard(self) -> np.ndarray:
        """The errors in standard deviations."""
        return self.distance / self.std


def joined_errors(parts: Sequence[SurfaceErrors]) -> SurfaceErrors:
    """Errors of several estimates as one."""
    return SurfaceErrors(*map(np.concatenate, zip(*parts, strict=True)))


def surface_errors(estimate: SurfaceEstimate, truth: TrueShape) -> SurfaceErrors:
    """Errors of an estimate at points of the true surface."""
    distance, std = (interpolate(estimate.grid, part, truth.points) for part in (estimate.distance, estimate.std))
    return SurfaceErrors(np.abs(distance), std)


def hidden_points(truth: TrueShape, seen: np.ndarray) -> np.ndarray:
    """Points of the true surface that a view did not show."""
    return truth.points[cKDTree(seen).query(truth.points)[0] > SEEN_WITHIN_M]


def _distances(mesh: Mesh, truth: TrueShape) -> tuple[np.ndarray, np.ndarray]:
    """Distances from the estimated surface to the true one, and back; where nothing was estimated, the object's
    diagonal.
    """
    if not len(mesh.faces):
        return np.full(1, truth.diagonal), np.full(1, truth.diagonal)
    points, _ = sample_surface(mesh, len(truth.points))
    return truth.tree.query(points[::4])[0], cKDTree(points).query(truth.points[::4])[0]


def _one_way(mesh: Mesh, points: np.ndarray) -> float:
    if not len(mesh.faces) or not len(points):
        return float("nan")
    return float(cKDTree(sample_surface(mesh, 20000)[0]).query(points)[0].mean())
