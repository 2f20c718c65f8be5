"""One object explored under one condition, touch after touch, and how near its surface comes to the true one."""

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
from i2t.reconstruction.surface import (
    SurfaceEstimate,
    SurfaceState,
)

START = -1  # before the first touch, and before a view
REPORTED = (0, 1, 5, 10, 20)  # touches after which surfaces are judged
F_SCORE_SHARE = 0.01  # of the diagonal, within which a point counts as found
ASKED_STRIDE = 8  # of samples of a surface whose distance to the other one is asked
ERROR_STRIDE = 10  # of the points of which errors are kept
OUTER_M = 1.5e-3  # from the true surface, within which a point of a mesh is not inside another body of it
SCORES = ("chamfer_mm", "iou", "f_score", "coverage", "band_mm", "hidden_mm")


class TrueShape(NamedTuple):
    """The true shape, to compare reconstructions with."""

    points: np.ndarray  # (n, 3) m, of the surface
    tree: cKDTree  # of more of them
    inside: np.ndarray  # (g,) of the grid
    diagonal: float  # m
    hidden: np.ndarray  # (n,) which points a camera on one side does not see
    floor_mm: float  # Chamfer distance of the true signed distance, put on the grid and taken off it again


class SurfaceErrors(NamedTuple):
    """Absolute signed distances at points of the true surface, where they should be zero."""

    distance: np.ndarray  # m, without its sign
    std: np.ndarray  # m, as estimated


@dataclass
class Episode:
    """One object, touched until the touches are used up or no site is safe."""

    state: SurfaceState
    scores: dict[int, dict[str, float]] = field(default_factory=dict)  # after so many touches
    errors: dict[int, SurfaceErrors] = field(default_factory=dict)  # at points of the true surface
    estimates: dict[int, SurfaceEstimate] = field(default_factory=dict)
    stopped: bool = False  # because no site was safe

    def judge(self, done: int, estimate: SurfaceEstimate, truth: TrueShape) -> None:
        """Note what is known after so many touches, and how near that is."""
        errors = surface_errors(estimate, truth)
        self.estimates[done], self.scores[done] = estimate, judge(estimate, truth, errors)
        self.errors[done] = SurfaceErrors(*(part[::ERROR_STRIDE] for part in errors))


def true_shape(session: Session, grid: VoxelGrid, samples: int) -> TrueShape:
    """The true shape where it stands, and how near the grid itself allows a reconstruction to come."""
    mesh = session.mesh
    distance = signed_distance_grid(mesh, grid)
    drawn, _ = sample_surface(mesh, samples)
    outer = drawn[np.abs(interpolate(grid, distance, drawn)) < OUTER_M]  # not where bodies overlap
    outer = outer if len(outer) else drawn
    points = outer[::ASKED_STRIDE]
    diagonal = float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
    hidden = hidden_points(points, mesh)
    shape = TrueShape(points, cKDTree(outer), distance < 0, diagonal, hidden, 0.0)
    return shape._replace(floor_mm=chamfer_mm(extract_mesh(grid, distance), shape))


def chamfer_mm(mesh: Mesh, truth: TrueShape, samples: int | None = None) -> float:
    """Chamfer distance of an estimated surface, by so many samples of it, or as many as of the true one."""
    there, back = distances(mesh, truth, samples)
    return MM_PER_M * 0.5 * float(there.mean() + back.mean())


def judge(estimate: SurfaceEstimate, truth: TrueShape, errors: SurfaceErrors) -> dict[str, float]:
    """All scores of one reconstruction."""
    there, back = distances(estimate.mesh, truth)
    within = F_SCORE_SHARE * truth.diagonal
    precision, recall = (there < within).mean(), (back < within).mean()
    found = estimate.distance < 0
    return {
        "chamfer_mm": MM_PER_M * 0.5 * float(there.mean() + back.mean()),
        "iou": float((found & truth.inside).sum() / max((found | truth.inside).sum(), 1)),
        "f_score": float(2 * precision * recall / max(precision + recall, 1e-9)),
        "coverage": float((errors.distance / errors.std < STDS_WITHIN_90).mean()),
        "band_mm": MM_PER_M * STDS_WITHIN_90 * float(errors.std.mean()),
        "hidden_mm": MM_PER_M * float(back[truth.hidden].mean()),
    }


def surface_errors(estimate: SurfaceEstimate, truth: TrueShape) -> SurfaceErrors:
    """Errors of an estimate at points of the true surface."""
    distance, std = (interpolate(estimate.grid, part, truth.points) for part in (estimate.distance, estimate.std))
    return SurfaceErrors(np.abs(distance), std)


def distances(mesh: Mesh, truth: TrueShape, samples: int | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Distances from the estimated surface to the true one, and back from its points, by so many samples of it, or as
    many as of the true one; where nothing was estimated, the object's diagonal.
    """
    if not len(mesh.faces):
        return np.full(1, truth.diagonal), np.full(len(truth.points), truth.diagonal)
    # Sampled densely, so that the nearest sample is nearly the nearest point.
    points, _ = sample_surface(mesh, samples or truth.tree.n)
    return truth.tree.query(points[::ASKED_STRIDE])[0], cKDTree(points).query(truth.points)[0]
