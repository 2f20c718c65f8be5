"""A library of shapes: their signed distances on one grid, standing on any side, turned and mirrored about z.

Each shape is stored once for each side on which it may stand, with its box centred on the z axis and its lowest point
at z = 0, or with its box about the origin for objects that are held. The eight turns and mirrors of the square about z
are not stored: for such a turn R, the turned shape is f(R x), so the points are turned instead of the shapes, and the
values of all shapes at one point lie next to each other.
"""

from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, Int8

from i2t.objects.solids import Mesh, centre_box
from i2t.reconstruction.signed_distances import VoxelGrid, grid_around, signed_distance_grid

STEP_M = 0.25e-3  # m, unit of the signed distances that a shape library stores as 8-bit integers, clipped to 127 units

# Rotation and reflection matrices: the 4 turns of a square about z and their mirror images.
TURNS = np.stack(
    [np.diag((*signs, 1))[[*order, 2]] for order in ((0, 1), (1, 0)) for signs in product((1, -1), repeat=2)]
)
# Matrices, some of them reflections, that bring one of the 6 axis directions of a shape to the top. Their products with
# `TURNS` are the 48 rotations and reflections of a cube.
STANCES = np.stack(
    [np.roll(np.eye(3, dtype=int), axis, axis=1) * (1, 1, sign) for axis in range(3) for sign in (1, -1)]
)


class ShapeLibrary(NamedTuple):
    """Signed distances (inside < 0) of k shapes on a grid of g points, in units of `STEP_M`, clipped to 127 units
    (32 mm). The 8 turns and mirrors about z (`TURNS`) are not stored; with them there are 8 k shapes, numbered
    turn * k + shape.
    """

    grid: VoxelGrid
    steps: Int8[np.ndarray, "g k"]  # signed distances in units of `STEP_M`, clipped to 127

    @property
    def size(self) -> int:
        """Number of shapes, turns included."""
        return len(TURNS) * self.steps.shape[1]

    def near(self, points: Float[np.ndarray, "n 3"], turn: int) -> Float[np.ndarray, "n k"]:
        """Look up the signed distances of all shapes in one turn.

        Args:
            points: Points (m); those outside the grid are moved to its nearest face.
            turn: Index of the turn in `TURNS`.

        Returns:
            `(n, k)` signed distances (m) of the k shapes at the nearest grid points, negative inside.
        """
        last = np.array(self.grid.shape) - 1
        index = np.clip(np.rint((points @ TURNS[turn].T - self.grid.low) / self.grid.spacing), 0, last).astype(int)
        return self.steps[np.ravel_multi_index(tuple(index.T), self.grid.shape)] * np.float32(STEP_M)

    def fields(self, shapes: Int[np.ndarray, " m"]) -> Float[np.ndarray, "g m"]:
        """Look up the signed distances of some shapes at all points of the grid.

        Args:
            shapes: Indices of the shapes, turns included: turn * k + shape, for the library's k shapes.

        Returns:
            `(g, m)` signed distances (m) of the m shapes at the g points, negative inside.
        """
        turns, columns = np.divmod(shapes, max(self.steps.shape[1], 1))
        distances = np.empty((len(self.steps), len(shapes)), np.float32)
        for i, (turn, steps) in enumerate(zip(turns, self.steps.T[columns], strict=True)):
            distances[:, i] = _turned(steps.reshape(self.grid.shape), TURNS[turn]).ravel()
        distances *= np.float32(STEP_M)
        return distances


def shape_library(
    meshes: Sequence[Mesh],
    *,
    across: int,
    margin: float,
    low: np.ndarray,
    high: np.ndarray,
    on_table: bool = True,
) -> ShapeLibrary:
    """Compute the signed distances of shapes on a grid that holds them in every stance.

    Args:
        meshes: Closed meshes in metres, whose bodies may overlap.
        across: Number of grid points along x, and along y.
        margin: Margin (m) of the grid around the shapes.
        low: (3,) lowest corner (m) of a box that the grid must hold as well.
        high: (3,) highest corner (m) of that box.
        on_table: Whether shapes stand on z = 0 with their box about the z axis. Otherwise the box is about the origin.

    Returns:
        Library of all shapes in six stances.
    """
    sizes = np.array([np.ptp(mesh.vertices, axis=0) for mesh in meshes]).reshape(-1, 3)
    stood = np.abs(STANCES).transpose(0, 2, 1) @ sizes.T  # (stances, 3, meshes) m, size of the box of each
    half = stood.max((0, 2)) / 2 if len(meshes) else np.zeros(3)
    up = np.array([0, 0, half[2] if on_table else 0.0])
    grid = grid_around(np.minimum(low, up - half), np.maximum(high, up + half), across=across, margin=margin)
    steps = np.empty((int(np.prod(grid.shape)), len(meshes), len(STANCES)), np.int8)
    # This grid is about the origin, so that turns map it to itself.
    cube = VoxelGrid((grid.low[0],) * 3, grid.spacing, (across,) * 3)
    levels = grid.low[2] + grid.spacing * np.arange(grid.shape[2])
    for i, mesh in enumerate(meshes):
        field = signed_distance_grid(centre_box(mesh), cube).reshape(cube.shape)
        for j, stance in enumerate(STANCES):
            lift = stood[j, 2, i] / 2 if on_table else 0.0
            stands = _at_heights(_turned(field, stance), (levels - lift - cube.low[2]) / grid.spacing, grid.spacing)
            steps[:, i, j] = np.clip(np.rint(stands.ravel() / STEP_M), -127, 127)  # the range of int8
    return ShapeLibrary(grid, steps.reshape(len(steps), -1))


def _turned(field: np.ndarray, turn: Int[np.ndarray, "3 3"]) -> np.ndarray:
    """Turn a field f on a grid that R maps to itself, to the field f(R x)."""
    # The row of R that picks an axis gives the source of that axis of the field, and its direction.
    flipped = np.flip(field, tuple(axis for axis in range(3) if turn[axis].sum() < 0))
    return flipped.transpose(np.argsort(np.abs(turn).argmax(1)))


def _at_heights(field: np.ndarray, places: np.ndarray, spacing: float) -> np.ndarray:
    """Interpolate a field along z at grid coordinates. Beyond its ends it grows by the distance from there."""
    inner = np.clip(places, 0, field.shape[2] - 1)
    base = np.minimum(inner.astype(int), field.shape[2] - 2)
    part = inner - base
    return (1 - part) * field[:, :, base] + part * field[:, :, base + 1] + spacing * np.abs(places - inner)
