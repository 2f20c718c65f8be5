"""Generated skins of the kind of eFlesh: four cylinder magnets in a soft lattice over the chips.

No mechanics is solved. A press moves every magnet by smooth functions of its position and travel, down and away from
the tip, and turns it towards the tip; how far, over which length, and how it grows with travel differs from skin to
skin, and so do the magnets. The fields are those of `i2t.skin.magnets`. All sizes are assumptions, wide enough to hold
a skin of 30 mm with magnets of a few mm. Metres, microtesla.
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

SOFTNESS_CELLS = 8  # along each edge of the map by which a skin's softness varies
DEEP_PRESS_M = 2e-3  # at which a magnet right under the tip moves by about as much
LATTICE_BATCH = 25
_CORNERS = np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]])


class _Lattice(NamedTuple):
    """Layout and motion of a skin's magnets."""

    rest: Array  # (4, 2) m
    above: Array  # () m, of the magnets over the chips
    signs: Array  # (4,)
    strengths: Array  # (4,)
    length: Array  # () m, over which a press is felt
    down: Array  # () share of the travel by which a magnet sinks
    away: Array  # () share by which it moves aside
    tilt: Array  # () rad per travel and length
    power: Array  # () of the travel
    offset: Array  # () m
    softness: Array  # (cells, cells)


def sample_skin(
    key: Key[Array, ""],
    position: Float[Array, "n 2"],
    travel: Float[Array, " n"],
    *,
    half_edge: float,
) -> Float[Array, "n c"]:
    """Readings of one random skin at n presses.

    Args:
        key: Random key.
        position: Positions of the tip (m), in a square about the skin's centre.
        travel: Travels of the presses (m).
        half_edge: Half of the square's edge (m).

    Returns:
        Readings in units of their root mean square.
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

    readings = map_batches(lambda one: press(*one), (position, travel), batch_size=LATTICE_BATCH)
    return readings / jnp.sqrt(jnp.mean(readings**2))


def _sample_lattice(key: Key[Array, ""]) -> _Lattice:
    keys = iter(jax.random.split(key, 16))

    def between(low: float, high: float, shape: tuple[int, ...] = ()) -> Array:
        return jax.random.uniform(next(keys), shape, minval=low, maxval=high)

    rest = between(4e-3, 10e-3) * _CORNERS + 0.5e-3 * jax.random.normal(next(keys), (4, 2))
    above = between(4e-3, 9e-3)
    signs, strengths = jnp.sign(jax.random.normal(next(keys), (4,))), between(0.9, 1.1, (4,))
    length, down, away, tilt = between(7e-3, 14e-3), between(0.3, 0.8), between(0.0, 0.5), between(0.0, 60.0)
    power, offset = between(1.0, 2.0), between(0.0, 3e-3)
    # A map over 20 mm, stretched to the skin.
    softness = 0.2 * smooth_random(next(keys), between(2e-3, 6e-3), SOFTNESS_CELLS)[..., 0]
    return _Lattice(
        rest=rest, above=above, signs=signs, strengths=strengths, length=length, down=down, away=away, tilt=tilt,
        power=power, offset=offset, softness=softness,
    )  # fmt: skip


def _magnet_motion(lattice: _Lattice, at: Array, travel: Array, half_edge: float) -> tuple[Array, Array]:
    """Translation (4, 3) m and rotation (4, 3) rad of the magnets under a press."""
    grown = DEEP_PRESS_M * ((travel + lattice.offset) / (DEEP_PRESS_M + lattice.offset)) ** lattice.power
    cell = (at / half_edge + 1) / 2 * (SOFTNESS_CELLS - 1)
    grown = grown * (
        1 + jax.scipy.ndimage.map_coordinates(lattice.softness, [cell[1], cell[0]], order=1, mode="nearest")
    )
    offset = lattice.rest - at[None]
    near = grown * jnp.exp(-jnp.sum(offset**2, axis=1) / (2 * lattice.length**2))
    aside = lattice.away * near[:, None] * offset / lattice.length
    sinking = -lattice.above * jnp.tanh(lattice.down * near / lattice.above)
    axis = jnp.stack([offset[:, 1], -offset[:, 0], jnp.zeros(4)], axis=1)
    rotation = lattice.tilt * near[:, None] / lattice.length * axis
    return jnp.concatenate([aside, sinking[:, None]], axis=1), rotation
