"""Simulated skins of many kinds, pressed at random: what the prior over kernels is made of and tried on.

  bonded     pads of `sample_pad` that are bonded to their board
  loose      the same, clamped at their edge: a press anywhere bends the whole skin
  uniform    one direction of magnetization nearly everywhere
  weak       bonded pads three tenths as strong: the signal is a few times the noise
  lattice    four moving magnets in a soft lattice (`experiments.calibrate.lattice`), with local heights and a period
  displaced  what facts about real boards add: force at the same travel jumps threefold within a session, one chip keeps
             a part of the press before and slips by up to 35 uT, skins stay displaced (a field that does not depend on
             the load) and a fifth of the signal is not explained by anything known

Every skin has travel and force of each press with errors of a lab.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from experiments.calibrate import lattice
from i2t.runtime.batching import map_batches
from i2t.skin import boards
from i2t.skin.pad import press, sample_pad
from i2t.skin_models.magnetic_layer import RoundTip
from i2t.types import Pad

BALL_TIP = RoundTip("sphere", 4e-3)
FORCE_ERROR_N, POSITION_ERROR_M, PRESS_NOISE_UT = 0.02, 0.05e-3, 1.5
SKIN_KINDS = ("bonded", "loose", "uniform", "weak", "lattice", "displaced")
LAYER_HALF_EDGE_M, LATTICE_HALF_EDGE_M = 8e-3, 15e-3
LAYER_TRAVELS_M, LATTICE_TRAVELS_M = (0.15e-3, 1.1e-3), (0.3e-3, 4e-3)
TRAVEL_ERROR_M = 0.02e-3
HEIGHT_ZERO_ERROR = 0.1  # of the largest travel, standard deviation of the believed first contact of a skin
WEAK = 0.3
PATCHES_OF_UNIFORM = 0.15
LATTICE_RMS_UT = (60.0, 300.0)
LATTICE_NEWTON_PER_M = 1.5e3
PRESS_BATCH = 8
JUMP = 3.0  # of the force at the same travel


class PressedSkinOfKind(NamedTuple):
    """One skin and its presses in the order of time, as a lab measures them."""

    kind: str
    position: np.ndarray  # (n, 2) m
    travel: np.ndarray  # (n,) m
    force: np.ndarray  # (n,) N
    readings: np.ndarray  # (n, c) uT
    chip_positions: np.ndarray  # (chips, 2) m
    zero: float = 0.0  # m, by which the travels are believed too large: what nobody knows of a real skin


def simulate_skins(kind: str, seed: int, skins: int, presses: int) -> list[PressedSkinOfKind]:
    """Skins of one kind; those of another seed are others.

    Args:
        kind: One of `SKIN_KINDS`.
        seed: Of all that is random.
        skins: How many.
        presses: Of each.

    Returns:
        The skins.
    """
    key = jax.random.fold_in(jax.random.key(seed), SKIN_KINDS.index(kind))
    rng = np.random.default_rng((seed, SKIN_KINDS.index(kind)))
    make = _lattices if kind == "lattice" else partial(_layers, kind)
    return make(key, rng, skins, presses)


def _layers(kind: str, key: Key[Array, ""], rng: np.random.Generator, skins: int, n: int) -> list[PressedSkinOfKind]:
    """Pads of an elastic layer, pressed by random travels."""
    board = boards.reskin_board()
    key_pads, key_kind = jax.random.split(key)
    pads = _of_kind(kind, _sample_pads(key_pads, skins), key_kind)
    position = rng.uniform(-LAYER_HALF_EDGE_M, LAYER_HALF_EDGE_M, (skins, n, 2))
    travel = rng.uniform(*LAYER_TRAVELS_M, (skins, n))
    shifted = jnp.float32(position + POSITION_ERROR_M * rng.normal(size=position.shape))
    found = _press_pads(pads, shifted, jnp.float32(travel))
    readings, force = (np.asarray(part, np.float64) for part in found)
    finish = _displaced if kind == "displaced" else _measured
    chips = np.asarray(board.chips[:, :2], np.float64)
    pressed = zip(position, travel, force, readings, strict=True)
    return [finish(rng, PressedSkinOfKind(kind, *one, chips)) for one in pressed]


@partial(jax.jit, static_argnums=1)
def _sample_pads(key: Key[Array, ""], skins: int) -> Pad:
    return jax.vmap(sample_pad)(jax.random.split(key, skins))


def _of_kind(kind: str, pads: Pad, key: Key[Array, ""]) -> Pad:
    """Random pads made to be of a kind."""
    skins = len(pads.thickness)
    if kind in ("bonded", "weak", "uniform"):
        pads = pads._replace(mount_compliance=jnp.zeros(skins))
    if kind == "loose":
        compliance = 0.25e-3 * jnp.exp(0.6 * jax.random.normal(key, (skins,)))
        pads = pads._replace(mount_compliance=compliance)
    if kind == "weak":
        pads = pads._replace(magnetization=WEAK * pads.magnetization)
    if kind == "uniform":
        strength = jnp.sqrt(jnp.mean(pads.magnetization**2, axis=(1, 2, 3), keepdims=True))
        direction = jax.random.normal(key, (skins, 1, 1, 3))
        direction = direction / jnp.sqrt(jnp.mean(direction**2, axis=3, keepdims=True))
        pads = pads._replace(magnetization=strength * direction + PATCHES_OF_UNIFORM * pads.magnetization)
    return pads


@jax.jit
def _press_pads(
    pads: Pad, position: Float[Array, "s n 2"], travel: Float[Array, "s n"]
) -> tuple[Float[Array, "s n c"], Float[Array, "s n"]]:
    """Readings (uT) and forces (N) of presses with a ball."""

    def skin(one: tuple[Pad, Array, Array]) -> tuple[Array, Array]:
        def single(at: tuple[Array, Array]) -> tuple[Array, Array]:
            pressed = press(one[0], BALL_TIP.height(at[0]), at[1])
            return pressed.reading, pressed.force

        return map_batches(single, one[1:], batch_size=PRESS_BATCH)

    return jax.lax.map(skin, (pads, position, travel))


def _measured(rng: np.random.Generator, skin: PressedSkinOfKind) -> PressedSkinOfKind:
    """Exact presses with a lab's errors."""
    zero = HEIGHT_ZERO_ERROR * skin.travel.max() * rng.normal()
    travel = np.maximum(skin.travel + zero + TRAVEL_ERROR_M * rng.normal(size=skin.travel.shape), 0)
    force = np.maximum(skin.force + FORCE_ERROR_N * rng.normal(size=skin.force.shape), 0)
    readings = skin.readings + PRESS_NOISE_UT * rng.normal(size=skin.readings.shape)
    return skin._replace(travel=travel, force=force, readings=readings, zero=zero)


def _displaced(rng: np.random.Generator, skin: PressedSkinOfKind) -> PressedSkinOfKind:
    """Presses with the errors and effects seen on two real boards."""
    n, c = skin.readings.shape
    rms = np.sqrt(np.mean(skin.readings**2))
    measured = _measured(rng, skin)
    # Friction and a skin that lifts: what is pressed at the same travel jumps within the session, and the reading
    # follows the force.
    state = np.cumsum(rng.random(n) < 0.05) % 2
    travel = measured.travel * np.where(state, JUMP ** (-2 / 3), 1.0)
    amount, length = rng.uniform(0.2, 0.7) * rms, rng.uniform(2.5e-3, 7e-3)
    still = amount * _smooth_field(rng, skin.position, length, c)
    constant = rng.uniform(0.05, 0.4) * rms * rng.normal(size=c)
    unexplained = 1 + 0.2 * rng.normal(size=(n, 1)) + 0.1 * rng.normal(size=(n, c))
    felt = unexplained * (measured.readings + still) + constant
    chip = rng.integers(c // 3)
    own = slice(3 * chip, 3 * chip + 3)
    slipped = 35 * np.clip(rng.standard_t(3, size=(n, 3)) / 2, -1, 1) * (rng.random((n, 1)) < 0.5)
    for i in range(1, n):
        felt[i, own] += rng.uniform(0.2, 0.4) * felt[i - 1, own]
    felt[:, own] += slipped
    return measured._replace(travel=travel, readings=felt)


def _lattices(key: Key[Array, ""], rng: np.random.Generator, skins: int, n: int) -> list[PressedSkinOfKind]:
    """Skins of four moving magnets."""
    half = LATTICE_HALF_EDGE_M
    chips = np.asarray(boards.eflesh_board(depth=0.0).chips[:, :2], np.float64)
    position = rng.uniform(-half, half, (skins, n, 2))
    travel = rng.uniform(*LATTICE_TRAVELS_M, (skins, n))
    found = []
    for one, at, d in zip(jax.random.split(key, skins), position, travel, strict=True):
        pitch, rough = rng.uniform(6e-3, 10e-3), rng.uniform(0.0, 0.25e-3)
        phase = np.cos(2 * np.pi * at / pitch + rng.uniform(0, 2 * np.pi, 2)).sum(1)
        height = rough * (phase + _smooth_field(rng, at, 2.5e-3, 1)[:, 0])
        true = np.maximum(d + height, 0)
        felt = np.asarray(_sample_lattice(one, jnp.float32(at), jnp.float32(true)), np.float64)
        stiffness = LATTICE_NEWTON_PER_M * np.exp(0.3 * rng.normal())
        force = stiffness * true * (true / 2e-3) ** rng.uniform(0.0, 0.6)
        readings = rng.uniform(*LATTICE_RMS_UT) * felt * (1 + 0.03 * rng.normal(size=felt.shape))
        found.append(_measured(rng, PressedSkinOfKind("lattice", at, d, force, readings, chips)))
    return found


_sample_lattice = jax.jit(partial(lattice.sample_skin, half_edge=LATTICE_HALF_EDGE_M))


def _smooth_field(rng: np.random.Generator, position: np.ndarray, length: float, channels: int) -> np.ndarray:
    """(n, channels) of a random field of variance 1 (random Fourier features of a squared exponential)."""
    waves, phase = rng.normal(size=(80, 2)) / length, rng.uniform(0, 2 * np.pi, 80)
    return np.sqrt(2 / 80) * np.cos(position @ waves.T + phase) @ rng.normal(size=(80, channels))
