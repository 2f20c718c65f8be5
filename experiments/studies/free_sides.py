"""Effect of free side faces on a pad, as a finite-element correction to the bonded layer.

The layer of `i2t.skin.elasticity` extends beyond the pad. Here two blocks are loaded cell by cell: one of the pad's
width with four free sides, and one that extends four thicknesses further on every side; both are bonded at the base.
The difference between them is the effect of free sides. It is smooth and small except near the sides, and is added to
the layer's response: to the indentation of the surface in the contact problem, and to the displacement and rotation of
the magnets. Both blocks have the same elements on the pad, so most of the discretisation error cancels.

By symmetry a quarter of each block suffices: loads and motions are sums of parts that are even or odd along x and y.
Elements are bricks with quadratic displacement, which hardly lock at nu = 0.48. They have no pressure unknowns, which
guarantees that the block with free sides is the softer one under every load, as in reality. scikit-fem is required.
Metres, pascals, newtons; row i along tool y, column j along tool x.
"""

from functools import lru_cache
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.sparse.linalg import splu

from experiments.studies.press_laws import LinearSkin
from i2t.errors import require_extra
from i2t.patches.dimensions import PAD_WINDOW
from i2t.skin.contact import GRID, Grid
from i2t.skin.dipoles import DIPOLE_SHEETS
from i2t.types import Pad

PARITIES = ((1, 1), (1, -1), (-1, 1), (-1, -1))  # along x and y: even 1, odd -1
# Signs of displacement (x, y, z) and rotation (x, y, z) after reflection at x = 0 and at y = 0.
MIRRORED_X = np.array([-1, 1, 1, 1, -1, -1])
MIRRORED_Y = np.array([1, -1, 1, -1, 1, -1])


class SideTable(NamedTuple):
    """Effect of free sides by parity (`PARITIES`) on the q cells of the quarter x, y > 0, row by row.

    Values are per newton on a cell and its mirror images, for a Young's modulus of 1 Pa.
    """

    sinking: Float[np.ndarray, "4 q q"]  # mean indentation of the first cell under a load on the second
    motion: Float[np.ndarray, "4 d 6 q q"]  # displacement and rotation at the depths of the magnets


# --- finite elements ---


def tabulate(thickness: float, poisson: float, *, cells: int = 20, layers: int = 3) -> SideTable:
    """Tabulate the effect of free sides on a layer.

    Args:
        thickness: Thickness of the layer (m).
        poisson: Poisson's ratio of the layer.
        cells: Number of table cells along each edge of the pad, even; 20 are 1 mm each.
        layers: Number of elements across the thickness.

    Returns:
        Table of indentation and motion by parity.

    Raises:
        MissingExtraError: scikit-fem is missing.
    """
    half = np.linspace(0, PAD_WINDOW / 2, cells // 2 + 1)
    far = np.linspace(half[-1], half[-1] + 4 * thickness, 6)
    deep = np.linspace(-thickness, 0, layers + 1)
    free, wide = _Block(half, deep, poisson), _Block(np.concatenate([half, far[1:]]), deep, poisson)
    roots, _ = np.polynomial.legendre.leggauss(DIPOLE_SHEETS)
    depths = thickness * (0.5 + 0.5 * roots)
    changes = []
    for parity in PARITIES:
        indentation, moved = free.respond(parity, cells // 2, -depths, sides_free=True)
        wide_indentation, moved_wide = wide.respond(parity, cells // 2, -depths, sides_free=False)
        changes.append((indentation - wide_indentation, moved - moved_wide))
    return SideTable(*(np.stack(part) for part in zip(*changes, strict=True)))


class _Block:
    """A quarter of a block, with element edges `across` (m, from the centre) along x and y, and `deep` along z."""

    def __init__(self, across: np.ndarray, deep: np.ndarray, poisson: float) -> None:
        require_extra("skfem", "a pad with free sides")
        import skfem
        from skfem.helpers import ddot, div, sym_grad

        self.across, self.deep, self.skfem = across, deep, skfem
        self.mesh = skfem.MeshHex.init_tensor(across, across, deep)
        self.basis = skfem.Basis(self.mesh, skfem.ElementVector(skfem.ElementHex2()), intorder=4)
        shear = 1 / (2 * (1 + poisson))
        lame = 2 * shear * poisson / (1 - 2 * poisson)

        def work(u: Any, v: Any, _: Any) -> Any:
            return 2 * shear * ddot(sym_grad(u), sym_grad(v)) + lame * div(u) * div(v)

        self.matrix = skfem.BilinearForm(work).assemble(self.basis).tocsc()
        entities = [getattr(self.basis, f"{name}_dofs") for name in ("nodal", "edge", "facet", "interior")]
        self.parts = [np.concatenate([np.asarray(dofs)[i] for dofs in entities]) for i in range(3)]
        self.places = self.basis.doflocs[:, self.parts[0]]

    def respond(
        self, parity: tuple[int, int], cells: int, heights: np.ndarray, *, sides_free: bool
    ) -> tuple[Float[np.ndarray, "q q"], Float[np.ndarray, "d 6 q q"]]:
        """Mean indentation of the cells next to the centre, and motions `heights` (m) below their centres, under one
        newton on each cell in turn.
        """
        held = [dofs[np.isclose(self.places[2], self.deep[0])] for dofs in self.parts]
        for axis, sign in enumerate(parity):
            middle = np.isclose(self.places[axis], 0)
            held += [self.parts[i][middle] for i in range(3) if (i == axis) == (sign > 0)]
            if not sides_free:
                held.append(self.parts[axis][np.isclose(self.places[axis], self.across[-1])])
        loads = self._loads(cells)
        free = np.setdiff1d(np.arange(self.matrix.shape[0]), np.concatenate(held))
        solution = np.zeros_like(loads)
        solution[free] = _factor(self.matrix[free][:, free]).solve(loads[free])
        order = np.lexsort(np.round(self.places, 9))
        shape = (2 * len(self.deep) - 1, 2 * len(self.across) - 1, 2 * len(self.across) - 1, -1)
        moved = np.stack([solution[dofs[order]].reshape(shape) for dofs in self.parts])  # (3, z, y, x, loads)
        near = moved[:, :, : 2 * cells + 1, : 2 * cells + 1]
        return loads.T @ solution, self._motions(near, heights, cells)

    def _loads(self, cells: int) -> np.ndarray:
        """Load vectors `(n, q)` of one newton spread evenly over each cell."""
        area = self.across[1] ** 2
        element = self.skfem.ElementVector(self.skfem.ElementHex2())
        down = self.skfem.LinearForm(lambda v, _: -v[2] / area)
        middles = self.mesh.p[:, self.mesh.facets].mean(axis=1)
        columns = []
        for y in range(cells):
            for x in range(cells):
                place = np.array([(x + 0.5) * self.across[1], (y + 0.5) * self.across[1], 0.0])
                facet = np.argmin(np.linalg.norm(middles - place[:, None], axis=0))
                columns.append(down.assemble(self.skfem.FacetBasis(self.mesh, element, facets=np.array([facet]))))
        return np.stack(columns, axis=1)

    def _motions(self, moved: np.ndarray, heights: np.ndarray, cells: int) -> np.ndarray:
        """Displacement and half its curl at the centres of the cells, where elements have their middle nodes."""
        value, slope = quadratic(self.deep, heights)
        size, ends = self.across[1], slice(0, None, 2)
        at, steep = (np.einsum("dz,czyxl->dcyxl", weights, moved) for weights in (value, slope))
        middle, along_z = at[:, :, 1::2, 1::2], steep[:, :, 1::2, 1::2]
        along_x = np.diff(at[:, :, 1::2, ends], axis=3) / size
        along_y = np.diff(at[:, :, ends, 1::2], axis=2) / size
        turned = np.stack([
            along_y[:, 2] - along_z[:, 1], along_z[:, 0] - along_x[:, 2], along_x[:, 1] - along_y[:, 0]
        ], axis=1) / 2  # fmt: skip
        return np.concatenate([middle, turned], axis=1).reshape(len(heights), 6, cells * cells, cells * cells)


def _factor(matrix: Any) -> Any:
    """Factorise a symmetric positive matrix, with a symmetric ordering that causes far less fill than the default."""
    return splu(matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})


def quadratic(edges: np.ndarray, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Interpolation weights of quadratic elements.

    Args:
        edges: Coordinates of the element edges, ascending.
        places: Coordinates at which to interpolate.

    Returns:
        Weights (places, nodes) of the values at the elements' ends and middles, and the weights of the slope.
    """
    element = np.clip(np.searchsorted(edges, places) - 1, 0, len(edges) - 2)
    width = edges[element + 1] - edges[element]
    t, rows = (places - edges[element]) / width, np.arange(len(places))
    values, slopes = np.zeros((2, len(places), 2 * len(edges) - 1))
    for i, (shape, rise) in enumerate((
        ((1 - t) * (1 - 2 * t), 4 * t - 3), (4 * t * (1 - t), 4 - 8 * t), (t * (2 * t - 1), 4 * t - 1)
    )):  # fmt: skip
        values[rows, 2 * element + i], slopes[rows, 2 * element + i] = shape, rise / width
    return values, slopes


# --- presses ---


class FreeSides(LinearSkin):
    """Press law of a pad with free sides, from its table."""

    def __init__(self, table: SideTable) -> None:
        self.cells = 2 * round(np.sqrt(table.sinking.shape[-1]))
        self.largest = float(np.linalg.eigvalsh(table.sinking).max())
        self.sinking = jnp.asarray(table.sinking, jnp.float32)
        self.motion = jnp.asarray(table.motion, jnp.float32)

    def extra_indentation(self, force: Float[Array, "n n"], grid: Grid = GRID) -> Float[Array, "n n"]:
        """Indentation due to free sides, as in `LinearSkin.extra_indentation`."""
        weights = _weights(grid, self.cells)
        moved = jnp.einsum("sij,sj->si", self.sinking, self._parities(weights.T @ force @ weights))
        return weights @ self._whole(moved[:, None], np.ones(1), np.ones(1))[0] @ weights.T

    def extra_bound(self, grid: Grid) -> float:
        """Bound from the largest eigenvalue of the table, as in `LinearSkin.extra_bound`."""
        return (1.5 * grid.cells / self.cells) ** 2 * self.largest  # the square is at least the cells' largest weight

    def extra_motion(self, pad: Pad, pressure: Float[Array, "n n"], grid: Grid) -> Float[Array, "d 6 n n"]:
        """Motion due to free sides, as in `LinearSkin.extra_motion`."""
        weights = _weights(grid, self.cells)
        parities = self._parities(weights.T @ (pressure * grid.spacing**2) @ weights)
        moved = jnp.einsum("sdcij,sj->sdci", self.motion, parities)
        return jnp.einsum("ni,dcij,mj->dcnm", weights, self._whole(moved, MIRRORED_X, MIRRORED_Y), weights) / pad.young

    def _parities(self, values: Array) -> Array:
        """Even and odd parts `(4, q)` of values on the table's cells, on the quarter x, y > 0."""
        half = self.cells // 2
        quarters = {(a, b): _quarter(values, half, a, b) for a in (0, 1) for b in (0, 1)}
        parts = [sum(sx**a * sy**b * part for (a, b), part in quarters.items()) / 4 for sx, sy in PARITIES]
        return jnp.stack([jnp.asarray(part).reshape(-1) for part in parts])

    def _whole(self, moved: Array, mirrored_x: np.ndarray, mirrored_y: np.ndarray) -> Array:
        """Expand parities (4, ..., components, q) on a quarter to values (..., components, cells, cells)."""
        half = self.cells // 2
        quarter = moved.reshape(*moved.shape[:-1], half, half)
        rows = []
        for b in (1, 0):
            row = []
            for a in (1, 0):
                signs = (mirrored_x**a * mirrored_y**b).reshape(*[1] * (quarter.ndim - 4), -1, 1, 1)
                part = sum(sx**a * sy**b * quarter[i] for i, (sx, sy) in enumerate(PARITIES)) * signs
                row.append(part[..., :: 1 - 2 * b, :: 1 - 2 * a])
            rows.append(jnp.concatenate(row, axis=-1))
        return jnp.concatenate(rows, axis=-2)


def _quarter(values: Array, half: int, a: int, b: int) -> Array:
    """Quarter of an array reflected to x, y > 0: the quarter at x < 0 if `a`, at y < 0 if `b`."""
    rows = values[:half][::-1] if b else values[half:]
    return rows[:, :half][:, ::-1] if a else rows[:, half:]


def _weights(grid: Grid, cells: int) -> np.ndarray:
    """Weights `(n, cells)` of linear inter- and extrapolation from the table's cell centres to those of a grid.

    The rows sum to 1, so the transpose distributes a load over the table's cells.
    """
    place = (grid.centres / PAD_WINDOW + 0.5) * cells - 0.5
    first = np.clip(np.floor(place).astype(int), 0, cells - 2)
    weights = np.zeros((grid.cells, cells), np.float32)
    rows, part = np.arange(grid.cells), place - first
    weights[rows, first], weights[rows, first + 1] = 1 - part, part
    return weights


def press_law(pad: Pad) -> FreeSides:
    """Press law of a pad, computed once for its thickness and Poisson's ratio (about a minute)."""
    return _law(float(pad.thickness), float(pad.poisson))


@lru_cache(maxsize=1)
def _law(thickness: float, poisson: float) -> FreeSides:
    return FreeSides(tabulate(thickness, poisson))
