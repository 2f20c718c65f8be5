"""Exploration of one object under one condition, and the distance of the estimated surface from the true one."""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from experiments.reconstruct.world import MM_PER_M, Session, hidden_points
from i2t.leave_one_out import STDS_WITHIN_90
from i2t.objects.solids import Mesh
from i2t.reconstruction.signed_distances import (
    VoxelGrid,
    extract_mesh,
    interpolate,
    sample_surface,
    signed_distance_grid,
)
from i2t.reconstruction.surface import SurfaceEstimate, SurfaceState

START = -1  # before the first touch, and before a view
REPORTED_TOUCHES = (0, 1, 5, 10, 20)
QUERY_STRIDE = 8  # every eighth sample of a surface is a query point for distances to the other one
SCORES = ("chamfer_mm", "iou", "f_score", "coverage", "band_mm", "hidden_mm")


class TrueShape(NamedTuple):
    """The true shape, with which reconstructions are compared."""

    points: np.ndarray  # (n, 3) m, on the surface
    tree: cKDTree  # denser points on the surface
    inside: np.ndarray  # (g,) bool, grid points inside the object
    diagonal: float  # m, of the bounding box
    hidden: np.ndarray  # (n,) bool, points that the camera on one side does not see
    floor_mm: float  # mm, Chamfer distance of the surface extracted from the true signed distance on the grid


class SurfaceErrors(NamedTuple):
    """Absolute signed distances at points of the true surface, where they should be zero."""

    distance: np.ndarray  # m, absolute
    std: np.ndarray  # m, as estimated


@dataclass
class Episode:
    """Exploration of one object, which ends after the last touch or if no site is safe."""

    state: SurfaceState
    scores: dict[int, dict[str, float]] = field(default_factory=dict)  # by number of touches
    errors: dict[int, SurfaceErrors] = field(
        default_factory=dict
    )  # at points of the true surface, by number of touches
    estimates: dict[int, SurfaceEstimate] = field(default_factory=dict)
    stopped: bool = False  # early, because no site was safe

    def judge(self, done: int, estimate: SurfaceEstimate, truth: TrueShape) -> None:
        """Record the estimate after `done` touches, its scores and a tenth of its errors."""
        errors = surface_errors(estimate, truth)
        self.estimates[done], self.scores[done] = estimate, judge(estimate, truth, errors)
        self.errors[done] = SurfaceErrors(*(part[::10] for part in errors))


def true_shape(session: Session, grid: VoxelGrid, samples: int) -> TrueShape:
    """Prepare the true shape at its true pose, with the smallest Chamfer distance that the grid allows."""
    mesh = session.mesh
    distance = signed_distance_grid(mesh, grid)
    drawn, _ = sample_surface(mesh, samples)
    outer = drawn[np.abs(interpolate(grid, distance, drawn)) < 1.5e-3]  # m; drops faces inside another body of the mesh
    outer = outer if len(outer) else drawn
    points = outer[::QUERY_STRIDE]
    diagonal = float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
    hidden = hidden_points(points, mesh)
    shape = TrueShape(points, cKDTree(outer), distance < 0, diagonal, hidden, 0.0)
    return shape._replace(floor_mm=chamfer_mm(extract_mesh(grid, distance), shape))


def chamfer_mm(mesh: Mesh, truth: TrueShape, samples: int | None = None) -> float:
    """Measure how far an estimated surface is from the true one.

    Args:
        mesh: Estimated surface.
        truth: True shape.
        samples: Points sampled on the estimated surface; as many as on the true one if None.

    Returns:
        The Chamfer distance in millimetres, which is the mean of both directions.
    """
    forward, backward = distances(mesh, truth, samples)
    return MM_PER_M * 0.5 * float(forward.mean() + backward.mean())


def judge(estimate: SurfaceEstimate, truth: TrueShape, errors: SurfaceErrors) -> dict[str, float]:
    """Score one reconstruction; the F-score counts points within 1 % of the diagonal."""
    forward, backward = distances(estimate.mesh, truth)
    tolerance = 0.01 * truth.diagonal
    precision, recall = (forward < tolerance).mean(), (backward < tolerance).mean()
    occupied = estimate.distance < 0
    return {
        "chamfer_mm": MM_PER_M * 0.5 * float(forward.mean() + backward.mean()),
        "iou": float((occupied & truth.inside).sum() / max((occupied | truth.inside).sum(), 1)),
        "f_score": float(2 * precision * recall / max(precision + recall, 1e-9)),
        "coverage": float((errors.distance / errors.std < STDS_WITHIN_90).mean()),
        "band_mm": MM_PER_M * STDS_WITHIN_90 * float(errors.std.mean()),
        "hidden_mm": MM_PER_M * float(backward[truth.hidden].mean()),
    }


def surface_errors(estimate: SurfaceEstimate, truth: TrueShape) -> SurfaceErrors:
    """Absolute signed distance and standard deviation of an estimate at points of the true surface."""
    distance, std = (interpolate(estimate.grid, part, truth.points) for part in (estimate.distance, estimate.std))
    return SurfaceErrors(np.abs(distance), std)


def distances(mesh: Mesh, truth: TrueShape, samples: int | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Distances (m) from points of the estimated surface to the true one, and from the true points to the estimate.

    Both are the object's diagonal if the estimate is empty. `samples` is as in `chamfer_mm`.
    """
    if not len(mesh.faces):
        return np.full(1, truth.diagonal), np.full(len(truth.points), truth.diagonal)
    # Samples are dense, so the nearest sample is close to the nearest point.
    points, _ = sample_surface(mesh, samples or truth.tree.n)
    return truth.tree.query(points[::QUERY_STRIDE])[0], cKDTree(points).query(truth.points)[0]
