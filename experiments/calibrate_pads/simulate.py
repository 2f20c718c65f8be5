"""Random simulated pads, pressed with a spherical tip to known forces."""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from i2t.batching import map_batches
from i2t.calibration import Presses
from i2t.calibration.physics import RoundTip
from i2t.skin import boards, faults
from i2t.skin.pad import press_force, sample_pad
from i2t.types import Board, Pad

BALL_TIP = RoundTip("sphere", 4e-3)
HALF_EDGE_M = 8e-3  # of the square of positions
BALL_FORCES_N = (0.2, 1.0)
FORCE_ERROR_N, POSITION_ERROR_M, PRESS_NOISE_UT = 0.02, 0.05e-3, 1.5
PAD_PRESS_BATCH = 8


def board() -> Board:
    """The board of all pads."""
    return boards.reskin_board()


@partial(jax.jit, static_argnums=(1, 2))
def press_pads(key: Key[Array, ""], count: int, n: int) -> tuple[Pad, Presses, Float[Array, "count n c"]]:
    """Random pads, n presses of each as a lab believes them, and their readings (uT) with noise."""
    names = ("pads", "position", "force", "position error", "force error", "noise")
    keys = dict(zip(names, jax.random.split(key, len(names)), strict=True))
    position = jax.random.uniform(keys["position"], (count, n, 2), minval=-HALF_EDGE_M, maxval=HALF_EDGE_M)
    force = jax.random.uniform(keys["force"], (count, n), minval=BALL_FORCES_N[0], maxval=BALL_FORCES_N[1])
    true_position = position + POSITION_ERROR_M * jax.random.normal(keys["position error"], position.shape)
    true_force = force + FORCE_ERROR_N * jax.random.normal(keys["force error"], force.shape)

    def skin(at: tuple[Array, Array, Array]) -> tuple[Pad, Array]:
        pad = sample_pad(at[0])
        return pad, map_batches(
            lambda press: press_force(pad, BALL_TIP.height(press[0]), press[1]).reading,
            at[1:],
            batch_size=PAD_PRESS_BATCH,
        )

    pads, readings = jax.lax.map(skin, (jax.random.split(keys["pads"], count), true_position, true_force))
    return pads, Presses(position, force), readings + PRESS_NOISE_UT * jax.random.normal(keys["noise"], readings.shape)


@jax.jit
def add_faults(key: Key[Array, ""], readings: Float[Array, "pads n c"]) -> Float[Array, "pads n c"]:
    """Readings with what goes wrong with boards in order from press to press (`Faults.typical`)."""
    poses = jnp.broadcast_to(jnp.eye(4), (readings.shape[1], 4, 4))

    def session(key: Array, y: Array) -> Array:
        key_session, key_board = jax.random.split(key)
        return faults.apply(key_session, y, poses, board(), faults.Faults.typical(), key_board=key_board)

    return jax.vmap(session)(jax.random.split(key, len(readings)), readings)
