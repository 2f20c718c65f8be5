"""Beliefs about a surface whose library are balls, and poses of a pad that looks straight down."""

import numpy as np

from i2t.reconstruction.shape_library import STEP_M, ShapeLibrary
from i2t.reconstruction.signed_distances import VoxelGrid
from i2t.reconstruction.surface import SurfaceConfig, SurfaceModel


def ball_model(grid: VoxelGrid, radii: np.ndarray, centre: np.ndarray, **changes) -> SurfaceModel:
    """A model whose library is balls of given radii (m) around a point."""
    points = grid.points()
    distance = np.linalg.norm(points - centre, axis=-1)[:, None] - radii
    steps = np.clip(np.rint(distance / STEP_M), -127, 127).astype(np.int8)
    return SurfaceModel(ShapeLibrary(grid, steps), points, SurfaceConfig(**changes))


def from_above(z: float, x: float = 0.0, y: float = 0.0) -> np.ndarray:
    """Pose of a pad that looks straight down, its plane at a height."""
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[:3, 3] = [x, y, z]
    return T
