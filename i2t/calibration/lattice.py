"""Made-up skins of the kind of eFlesh: four cylinder magnets in a soft lattice over the chips, to learn features from.

No mechanics is solved. A press moves every magnet by smooth functions of its place and depth, down and away from the
tip, and turns it towards the tip; how far, over which length, and how it grows with depth differs from skin to skin,
and so do the magnets. The fields are those of `i2t.skin.magnets`. All sizes are assumptions, wide enough to hold a skin
of 30 mm with magnets of a few mm.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from i2t.calibration.structured_gp import Presses
from i2t.skin import boards, magnets
from i2t.skin.magnets import Magnets
from i2t.skin.pad import smooth_random

ROUGH = 8  # cells along each edge of the map by which a skin's softness varies


def skin(
    key: Key[Array, ""], place: Float[Array, "n 2"], depth: Float[Array, " n"], half: float = 16e-3
) -> Float[Array, "n 15"]:
    """Readings (uT) of one random skin, in units of their root mean square, at presses on a square of half edge `half`
    (m).
    """
    keys = iter(jax.random.split(key, 16))

    def between(low: float, high: float, shape: tuple[int, ...] = ()) -> Array:
        return jax.random.uniform(next(keys), shape, minval=low, maxval=high)

    corners = np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]])
    rest = between(4e-3, 10e-3) * corners + 0.5e-3 * jax.random.normal(next(keys), (4, 2))
    above = between(4e-3, 9e-3)
    still = Magnets(
        positions=jnp.concatenate([rest, jnp.full((4, 1), above)], axis=1),
        rotations=jnp.broadcast_to(jnp.eye(3), (4, 3, 3)),
        radii=jnp.full(4, 3e-3),
        heights=jnp.full(4, 2e-3),
        magnetisations=1e6 * jnp.sign(jax.random.normal(next(keys), (4,))) * between(0.9, 1.1, (4,)),
    )
    length, down, away, turn = between(7e-3, 14e-3), between(0.3, 0.8), between(0.0, 0.5), between(0.0, 60.0)
    power, offset = between(1.0, 2.0), between(0.0, 3e-3)
    soft = 0.2 * smooth_random(next(keys), between(2e-3, 6e-3), ROUGH)[..., 0]  # over 20 mm, stretched to the skin
    board = boards.anyskin_board(depth=0.0)
    chips = jnp.asarray(board.chips)

    def one(at: Array, d: Array) -> Array:
        grown = 2e-3 * ((d + offset) / (2e-3 + offset)) ** power
        cell = (at / half + 1) / 2 * (ROUGH - 1)
        grown = grown * (1 + jax.scipy.ndimage.map_coordinates(soft, [cell[1], cell[0]], order=1, mode="nearest"))
        apart = rest - at[None]
        near = grown * jnp.exp(-jnp.sum(apart**2, axis=1) / (2 * length**2))
        aside = away * near[:, None] * apart / length
        sunk = -above * jnp.tanh(down * near / above)
        moved = jnp.concatenate([aside, sunk[:, None]], axis=1)
        tilt = turn * near[:, None] / length * jnp.stack([apart[:, 1], -apart[:, 0], jnp.zeros(4)], axis=1)
        change = magnets.field(chips, magnets.moved(still, moved, tilt), 24) - magnets.field(chips, still, 24)
        return change.ravel()

    readings = jax.lax.map(lambda press: one(*press), (place, depth), batch_size=25)
    return readings / jnp.sqrt(jnp.mean(readings**2))


def skins(key: Key[Array, ""], count: int, n: int, half: float, deepest: float) -> tuple[Presses, Array]:
    """Many random skins, (count, n) random presses of each, and their readings (count, n, 15) with some noise."""
    a, b, c, d = jax.random.split(key, 4)
    place = jax.random.uniform(a, (count, n, 2), minval=-half, maxval=half)
    depth = jax.random.uniform(b, (count, n), maxval=deepest)
    each = (jax.random.split(c, count), place, depth)
    readings = jax.lax.map(lambda one: skin(one[0], one[1], one[2], half), each)
    return Presses(place, depth), 50 * (readings + 0.03 * jax.random.normal(d, readings.shape))
