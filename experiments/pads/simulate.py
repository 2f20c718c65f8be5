"""Simulated skins on a few boards, and a session of presses of each."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from i2t.batching import map_batches
from i2t.calibration import Presses
from i2t.calibration.physics import RoundTip
from i2t.skin import faults
from i2t.skin.faults import Faults
from i2t.skin.noise import Noise, add_sensor_noise
from i2t.skin.pad import press_force, sample_pad
from i2t.types import Pad

PROBE_TIP = RoundTip("sphere", 2.3e-3)
REACH_M = 7e-3  # of the positions along x and y
PROBE_FORCES_N = (0.6, 1.0)
PROBE_PRESS_BATCH = 16


class SkinSession(NamedTuple):
    """Presses of one skin."""

    position: Float[Array, "n 2"]  # m
    force: Float[Array, " n"]  # N
    reading: Float[Array, "n c"]  # uT

    @property
    def presses(self) -> Presses:
        """Presses without their readings."""
        return Presses(self.position, self.force)

    def rows(self, part: slice) -> "SkinSession":
        """Some of the presses."""
        return SkinSession(*(values[part] for values in self))


def sample_skins(key: Key[Array, ""], skins: int, boards: int) -> list[Pad]:
    """Skins, of which those on one board share its chips' gains and what lies between chips and layer.

    Skin i sits on board i % boards.
    """
    key_skins, key_boards = jax.random.split(key)
    sample = jax.jit(jax.vmap(sample_pad))
    skin, board = sample(jax.random.split(key_skins, skins)), sample(jax.random.split(key_boards, boards))
    pads = []
    for i in range(skins):
        one, under = (jax.tree.map(lambda leaf, k=k: leaf[k], part) for part, k in ((skin, i), (board, i % boards)))
        gap = -under.board.chips[:, 2] - under.thickness
        chips = under.board.chips.at[:, 2].set(-(one.thickness + gap))
        pads.append(one._replace(gains=under.gains, board=under.board._replace(chips=chips)))
    return pads


@partial(jax.jit, static_argnums=2)
def press_skin(key: Key[Array, ""], pad: Pad, n: int) -> SkinSession:
    """n presses, as a board in order records them."""
    key_position, key_force, key_faults, key_noise = jax.random.split(key, 4)
    position = jax.random.uniform(key_position, (n, 2), minval=-REACH_M, maxval=REACH_M)
    force = jax.random.uniform(key_force, (n,), minval=PROBE_FORCES_N[0], maxval=PROBE_FORCES_N[1])
    ideal = map_batches(
        lambda at: press_force(pad, PROBE_TIP.height(at[0]), at[1]).reading,
        (position, force),
        batch_size=PROBE_PRESS_BATCH,
    )
    upright = jnp.broadcast_to(jnp.eye(4), (n, 4, 4))
    key_board = faults.board_key(pad.gains)
    felt = faults.apply(key_faults, ideal, upright, pad.board, Faults.typical(), key_board=key_board)
    keys = jax.random.split(key_noise, n)
    noisy = jax.vmap(lambda key, one: add_sensor_noise(key, one, pad.board, Noise()))(keys, felt)
    return SkinSession(position, force, noisy)
