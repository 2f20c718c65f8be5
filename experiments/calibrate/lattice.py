"""Random skins like eFlesh, with four cylindrical magnets in a soft lattice above the chips.

No mechanics is solved. A press moves every magnet down and away from the tip and turns it towards the tip, by smooth
functions of position and travel. Amounts, length scales, growth with travel and the magnets differ between skins. The
fields are those of `i2t.skin.magnets`. All ranges are assumptions, wide enough for a skin of 30 mm with magnets of a
few millimetres. Metres, microtesla.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from i2t.runtime.batching import map_batches
from i2t.skin import boards, magnets
from i2t.skin.magnets import Magnets
from i2t.skin.pad import smooth_random


class _Lattice(NamedTuple):
    """Layout and motion of a skin's magnets."""

    rest: Array  # (4, 2) m
    above: Array  # () m, height of the magnets above the chips
    signs: Array  # (4,)
    strengths: Array  # (4,)
    length: Array  # () m, length scale of a press's effect
    down: Array  # () downward motion of a magnet relative to the travel
    away: Array  # () lateral motion relative to the travel
    tilt: Array  # () rad, rotation per travel relative to the length scale
    power: Array  # () exponent of the travel
    offset: Array  # () m, added to the travel
    softness: Array  # (cells, cells) relative variation over the skin


def sample_skin(
    key: Key[Array, ""],
    position: Float[Array, "n 2"],
    travel: Float[Array, " n"],
    *,
    half_edge: float,
) -> Float[Array, "n c"]:
    """Compute the readings of one random skin at n presses.

    Args:
        key: Random key.
        position: Positions of the tip, m, in a square about the skin's centre.
        travel: Travels of the presses, m.
        half_edge: Half of the square's edge, m.

    Returns:
        Readings relative to their root mean square, `(n, c)`.
    """
    lattice = _sample_lattice(key)
    chips = jnp.asarray(boards.eflesh_board(depth=0.0).chips)
    still = Magnets(
        positions=jnp.concatenate([lattice.rest, jnp.full((4, 1), lattice.above)], axis=1),
        rotations=jnp.broadcast_to(jnp.eye(3), (4, 3, 3)),
        radii=jnp.full(4, 3e-3),
        heights=jnp.full(4, 2e-3),
        magnetizations=1e6 * lattice.signs * lattice.strengths,
    )

    def press(at: Array, d: Array) -> Array:
        translation, rotation = _magnet_motion(lattice, at, d, half_edge)
        moved = magnets.move(still, translation, rotation)
        return (magnets.field(chips, moved, 24) - magnets.field(chips, still, 24)).ravel()

    readings = map_batches(lambda at_travel: press(*at_travel), (position, travel), batch_size=25)
    return readings / jnp.sqrt(jnp.mean(readings**2))


def _sample_lattice(key: Key[Array, ""]) -> _Lattice:
    keys = iter(jax.random.split(key, 16))

    def between(low: float, high: float, shape: tuple[int, ...] = ()) -> Array:
        return jax.random.uniform(next(keys), shape, minval=low, maxval=high)

    corners = np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]])
    rest = between(4e-3, 10e-3) * corners + 0.5e-3 * jax.random.normal(next(keys), (4, 2))
    above = between(4e-3, 9e-3)
    signs, strengths = jnp.sign(jax.random.normal(next(keys), (4,))), between(0.9, 1.1, (4,))
    length, down, away, tilt = between(7e-3, 14e-3), between(0.3, 0.8), between(0.0, 0.5), between(0.0, 60.0)
    power, offset = between(1.0, 2.0), between(0.0, 3e-3)
    # The map covers 20 mm and is stretched to the skin.
    softness = 0.2 * smooth_random(next(keys), between(2e-3, 6e-3), 8)[..., 0]
    return _Lattice(
        rest=rest, above=above, signs=signs, strengths=strengths, length=length, down=down, away=away, tilt=tilt,
        power=power, offset=offset, softness=softness,
    )  # fmt: skip


def _magnet_motion(lattice: _Lattice, at: Array, travel: Array, half_edge: float) -> tuple[Array, Array]:
    """Compute translation (4, 3) m and rotation (4, 3) rad of the magnets under a press."""
    deep = 2e-3  # m, travel at which a magnet right under the tip moves by about as much
    grown = deep * ((travel + lattice.offset) / (deep + lattice.offset)) ** lattice.power
    cell = (at / half_edge + 1) / 2 * (len(lattice.softness) - 1)
    grown = grown * (
        1 + jax.scipy.ndimage.map_coordinates(lattice.softness, [cell[1], cell[0]], order=1, mode="nearest")
    )
    offset = lattice.rest - at[None]
    near = grown * jnp.exp(-jnp.sum(offset**2, axis=1) / (2 * lattice.length**2))
    lateral = lattice.away * near[:, None] * offset / lattice.length
    sinking = -lattice.above * jnp.tanh(lattice.down * near / lattice.above)
    axis = jnp.stack([offset[:, 1], -offset[:, 0], jnp.zeros(4)], axis=1)
    rotation = lattice.tilt * near[:, None] / lattice.length * axis
    return jnp.concatenate([lateral, sinking[:, None]], axis=1), rotation
