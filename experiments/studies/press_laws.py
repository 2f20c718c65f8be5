"""Press laws of linear skins other than the bonded layer of `i2t.skin.elasticity`.

A linear skin adds a correction to the layer's motion: to the indentation of the surface in the contact problem, and to
the displacement and rotation of the magnets. Metres, pascals, newtons; row i along tool y, column j along tool x.
"""

from abc import ABC, abstractmethod

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from i2t.skin.contact import CONTACT_SOLVER, GRID, MAX_HEIGHT_M, Grid, descend
from i2t.skin.dipoles import MICROTESLA, dipole_field, sheets, turn
from i2t.skin.elasticity import clamped_shape, compliance, convolve, interior, load
from i2t.skin.pad import Press
from i2t.types import Pad


class LinearSkin(ABC):
    """Press law (`i2t.contact.press.PressLaw`) of a skin whose motion is linear in the pressure."""

    @abstractmethod
    def extra_motion(self, pad: Pad, pressure: Float[Array, "n n"], grid: Grid) -> Float[Array, "d 6 n n"]:
        """Extra motion of the magnets over the bonded layer's.

        Args:
            pad: The skin.
            pressure: Pressure (Pa) on the cells of `grid`.
            grid: Cells of the pad, with a magnet below each.

        Returns:
            Displacement (m) and rotation (rad) at the magnets' depths.
        """

    def magnets(self, pad: Pad, grid: Grid) -> tuple[Float[Array, " d"], Float[Array, "d 3 n n"]]:
        """Dipoles at rest, as in `i2t.skin.dipoles.sheets`.

        Args:
            pad: The skin.
            grid: Cells of the pad, with a magnet below each.

        Returns:
            Depths (m) and moments (A m2) of the dipoles.
        """
        return sheets(pad, grid)

    def compliance(self, pad: Pad, grid: Grid) -> Float[Array, "k k"]:
        """Compliance of the surface for each wave of pressure, without `extra_indentation`; here the bonded layer's.

        Args:
            pad: The skin.
            grid: Grid of the Fourier series.

        Returns:
            Indentation per pressure (m/Pa) for each pair of wavenumbers.
        """
        return compliance(pad, grid)

    def extra_indentation(self, force: Float[Array, "n n"], grid: Grid = GRID) -> Float[Array, "n n"]:
        """Indentation of the surface in addition to that of `compliance`; here zero.

        Args:
            force: Force (N) on each cell of `grid`.
            grid: Cells of the pad.

        Returns:
            Indentation (m) times Young's modulus (Pa).
        """
        return jnp.zeros_like(force)

    def extra_bound(self, grid: Grid) -> float:
        """Bound on the eigenvalues of `extra_indentation`.

        Args:
            grid: Cells of the pad.

        Returns:
            Upper bound (1/m), zero if there is no extra indentation.
        """
        return 0.0

    def __call__(
        self,
        pad: Pad,
        height: Float[Array, "n n"],
        indentation: Float[Array, ""] | float,
        grid: Grid = GRID,
        start: Float[Array, "n n"] | None = None,
    ) -> Press:
        """Press to an indentation, as in `i2t.skin.pad.press`."""
        pressure, converged = self._contact(pad, height, indentation, grid, start)
        force = jnp.sum(pressure) * grid.spacing**2
        return Press(self._reading(pad, pressure, grid), force, jnp.asarray(indentation), pressure, converged)

    def _contact(
        self, pad: Pad, height: Array, indentation: Array | float, grid: Grid, start: Array | None
    ) -> tuple[Array, Array]:
        """Solve for the pressure (Pa), as in `i2t.skin.contact.solve` with this skin's indentation."""
        gap = (jnp.minimum(height, MAX_HEIGHT_M) - indentation) / pad.thickness
        scale = jnp.maximum(jnp.max(-gap), CONTACT_SOLVER.min_strain)
        unit, area = pad.young / pad.thickness, grid.spacing**2
        kernel, mount = self.compliance(pad, grid) * unit, pad.mount_compliance * area * unit
        shape = clamped_shape(grid, gap.dtype)

        def deflect(p: Array) -> Array:
            sinking = convolve(kernel, p, grid) + mount * jnp.sum(shape * p) * shape
            return sinking + self.extra_indentation(p, grid) * area / pad.thickness

        largest = jnp.max(kernel) + mount * jnp.sum(shape**2) + self.extra_bound(grid) * area / pad.thickness
        bounds = jnp.min(kernel), largest
        start = -gap / scale / largest if start is None else start / (pad.young * scale)
        state = descend(
            lambda p: deflect(p[..., 0])[..., None], gap[..., None] / scale, lambda p: jnp.maximum(p, 0),
            level=lambda p, gap: jnp.zeros_like(scale), start=start[..., None], bounds=bounds,
            tolerance=CONTACT_SOLVER.tolerance, max_steps=CONTACT_SOLVER.max_steps,
        )  # fmt: skip
        return state.point[..., 0] * scale * pad.young, state.residual.squeeze() <= CONTACT_SOLVER.tolerance

    def _reading(self, pad: Pad, pressure: Array, grid: Grid) -> Array:
        """Compute the reading (uT), as in `i2t.skin.dipoles.response` with this skin's motion."""
        loaded = load(pad, pressure, None, grid)
        y, x = np.meshgrid(grid.centres, grid.centres, indexing="ij")

        def field(position: Array, moments: Array) -> Array:
            return dipole_field(jnp.asarray(pad.board.chips), position.reshape(3, -1).T, moments.reshape(3, -1).T)

        def change(magnets: tuple[Array, Array, Array]) -> Array:
            depth, moments, more = magnets
            displacement, rotation = interior(pad, loaded, depth, grid)
            rest = jnp.stack([jnp.asarray(x), jnp.asarray(y), jnp.broadcast_to(-depth, x.shape)])
            return field(rest + displacement + more[:3], turn(rotation + more[3:], moments)) - field(rest, moments)

        magnets = (*self.magnets(pad, grid), self.extra_motion(pad, pressure, grid))
        return pad.gains * pad.board.to_board(MICROTESLA * jnp.sum(jax.lax.map(change, magnets), axis=0))
