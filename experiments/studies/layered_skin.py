"""A skin of several magnetic layers, as a correction to the bonded layer."""

from functools import lru_cache
from typing import TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from experiments.studies.press_laws import LinearSkin
from i2t.skin.contact import Grid
from i2t.skin.dipoles import DIPOLE_SHEETS, sheets
from i2t.skin.elasticity import evaluate, load
from i2t.skin.layered import Sheet, stack_motion
from i2t.types import Pad

Layers: TypeAlias = tuple[
    tuple[float, float], ...
]  # fraction of the thickness and factor of Young's modulus, from the surface down


class LayeredSkin(LinearSkin):
    """Press law of a skin of several layers.

    Args:
        thickness: Thickness of the skin (m).
        poisson: Poisson's ratio of all layers.
        layers: Fraction of the thickness and factor of Young's modulus of each layer, from the surface down.
    """

    def __init__(self, thickness: float, poisson: float, layers: Layers) -> None:
        self.sheets = [Sheet(part * thickness, factor, poisson) for part, factor in layers]  # Young's modulus is 1
        self.bonded = [Sheet(thickness, 1.0, poisson)]
        roots, weights = np.polynomial.legendre.leggauss(DIPOLE_SHEETS)
        tops = thickness * np.cumsum([0.0, *(part for part, _ in layers)])
        # The slope of the motion jumps between layers, so each has its own sheets of magnets.
        self.depths = np.concatenate([
            top + sheet.thickness * (0.5 + 0.5 * roots) for top, sheet in zip(tops, self.sheets, strict=False)
        ])  # fmt: skip
        self.shares = np.concatenate([part * weights / 2 for part, _ in layers])  # fractions of the moments

    def magnets(self, pad: Pad, grid: Grid) -> tuple[Float[Array, " d"], Float[Array, "d 3 n n"]]:
        """Sheets of dipoles in each layer, as in `LinearSkin.magnets`."""
        _, moments = sheets(pad, grid, nodes=1)
        shares = jnp.asarray(self.shares, jnp.float32)[:, None, None, None]
        return jnp.asarray(self.depths, jnp.float32), shares * moments

    def compliance(self, pad: Pad, grid: Grid) -> Float[Array, "k k"]:
        """Compliance of the stack's surface, as in `LinearSkin.compliance`."""
        (down,) = stack_motion(self.sheets, _wavenumbers(grid), np.zeros(1)).down
        return jnp.asarray(-down, jnp.float32) / pad.young

    def extra_motion(self, pad: Pad, pressure: Float[Array, "n n"], grid: Grid) -> Float[Array, "d 6 n n"]:
        """Motion of the stack minus that of the bonded layer, as in `LinearSkin.extra_motion`."""
        own, bonded = (stack_motion(of, _wavenumbers(grid), self.depths) for of in (self.sheets, self.bonded))
        along, down, turn = (jnp.asarray(a - b, jnp.float32) / pad.young for a, b in zip(own, bonded, strict=True))
        waves = load(pad, pressure, None, grid)
        slope_x, slope_y, pressed = (part[None] for part in (*waves.slopes, waves.pressure))
        motion = [along * slope_x, along * slope_y, down * pressed, turn * slope_y, -turn * slope_x]
        return evaluate(jnp.stack([*motion, jnp.zeros_like(turn)], axis=1), grid)


def press_law(pad: Pad, layers: Layers) -> LayeredSkin:
    """Press law of a layered pad; the same object for the same pad, so that it compiles once."""
    return _law(float(pad.thickness), float(pad.poisson), layers)


_law = lru_cache(maxsize=4)(LayeredSkin)


def _wavenumbers(grid: Grid) -> np.ndarray:
    return np.hypot(grid.wavenumbers[:, None], grid.wavenumbers[None, :])
