"""Simulated skins of many kinds under random presses, on which the prior over kernels is fitted and tested.

  bonded     pads of `sample_pad` that are bonded to their board
  loose      the same pads clamped at their edge, so that a press anywhere bends the whole skin
  uniform    nearly the same direction of magnetization everywhere
  weak       bonded pads with three tenths of the magnetization, so that the signal is a few times the noise
  lattice    four moving magnets in a soft lattice (`experiments.calibrate.lattice`), with local and periodic heights
  displaced  effects observed on real boards: the force at one travel jumps threefold within a session, one chip keeps a
             part of the previous press and slips by up to 35 uT, the skin stays displaced (a field that does not depend
             on the load), and a fifth of the signal is unexplained

Travel and force of every press have measurement errors.
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

SKIN_KINDS = ("bonded", "loose", "uniform", "weak", "lattice", "displaced")


class PressedSkinOfKind(NamedTuple):
    """One skin with its measured presses in chronological order."""

    kind: str
    position: np.ndarray  # (n, 2) m
    travel: np.ndarray  # (n,) m
    force: np.ndarray  # (n,) N
    readings: np.ndarray  # (n, c) uT
    chip_positions: np.ndarray  # (chips, 2) m
    zero: float = 0.0  # m, error of the height of first contact, which is unknown for a real skin


def simulate_skins(kind: str, seed: int, skins: int, presses: int) -> list[PressedSkinOfKind]:
    """Simulate skins of one kind.

    Args:
        kind: One of `SKIN_KINDS`.
        seed: Seed of all random choices.
        skins: Number of skins.
        presses: Number of presses of each skin.

    Returns:
        The skins with their presses.
    """
    key = jax.random.fold_in(jax.random.key(seed), SKIN_KINDS.index(kind))
    rng = np.random.default_rng((seed, SKIN_KINDS.index(kind)))
    make = _lattices if kind == "lattice" else partial(_layers, kind)
    return make(key, rng, skins, presses)


def _layers(kind: str, key: Key[Array, ""], rng: np.random.Generator, skins: int, n: int) -> list[PressedSkinOfKind]:
    """Simulate pads with an elastic layer, pressed with a ball by random travels."""
    board = boards.reskin_board()
    key_pads, key_kind = jax.random.split(key)
    pads = _of_kind(kind, _sample_pads(key_pads, skins), key_kind)
    position = rng.uniform(-8e-3, 8e-3, (skins, n, 2))
    travel = rng.uniform(0.15e-3, 1.1e-3, (skins, n))
    shifted = jnp.float32(position + 0.05e-3 * rng.normal(size=position.shape))
    readings, force = (np.asarray(part, np.float64) for part in _press_pads(pads, shifted, jnp.float32(travel)))
    finish = _displaced if kind == "displaced" else _measured
    chips = np.asarray(board.chips[:, :2], np.float64)
    pressed = zip(position, travel, force, readings, strict=True)
    return [finish(rng, PressedSkinOfKind(kind, *presses, chips)) for presses in pressed]


@partial(jax.jit, static_argnums=1)
def _sample_pads(key: Key[Array, ""], skins: int) -> Pad:
    return jax.vmap(sample_pad)(jax.random.split(key, skins))


def _of_kind(kind: str, pads: Pad, key: Key[Array, ""]) -> Pad:
    """Change random pads to be of a kind."""
    skins = len(pads.thickness)
    if kind in ("bonded", "weak", "uniform"):
        pads = pads._replace(mount_compliance=jnp.zeros(skins))
    if kind == "loose":
        compliance = 0.25e-3 * jnp.exp(0.6 * jax.random.normal(key, (skins,)))
        pads = pads._replace(mount_compliance=compliance)
    if kind == "weak":
        pads = pads._replace(magnetization=0.3 * pads.magnetization)
    if kind == "uniform":
        strength = jnp.sqrt(jnp.mean(pads.magnetization**2, axis=(1, 2, 3), keepdims=True))
        direction = jax.random.normal(key, (skins, 1, 1, 3))
        direction = direction / jnp.sqrt(jnp.mean(direction**2, axis=3, keepdims=True))
        pads = pads._replace(magnetization=strength * direction + 0.15 * pads.magnetization)
    return pads


@jax.jit
def _press_pads(
    pads: Pad, position: Float[Array, "s n 2"], travel: Float[Array, "s n"]
) -> tuple[Float[Array, "s n c"], Float[Array, "s n"]]:
    """Simulate readings (uT) and forces (N) of presses with a ball."""
    ball = RoundTip("sphere", 4e-3)

    def press_skin(skin: tuple[Pad, Array, Array]) -> tuple[Array, Array]:
        def press_once(at: tuple[Array, Array]) -> tuple[Array, Array]:
            pressed = press(skin[0], ball.height(at[0]), at[1])
            return pressed.reading, pressed.force

        return map_batches(press_once, skin[1:], batch_size=8)

    return jax.lax.map(press_skin, (pads, position, travel))


def _measured(rng: np.random.Generator, skin: PressedSkinOfKind) -> PressedSkinOfKind:
    """Add the measurement errors of a lab to exact presses."""
    zero = 0.1 * skin.travel.max() * rng.normal()
    travel = np.maximum(skin.travel + zero + 0.02e-3 * rng.normal(size=skin.travel.shape), 0)
    force = np.maximum(skin.force + 0.02 * rng.normal(size=skin.force.shape), 0)
    readings = skin.readings + 1.5 * rng.normal(size=skin.readings.shape)
    return skin._replace(travel=travel, force=force, readings=readings, zero=zero)


def _displaced(rng: np.random.Generator, skin: PressedSkinOfKind) -> PressedSkinOfKind:
    """Add measurement errors and the effects that were observed on two real boards."""
    n, c = skin.readings.shape
    rms = np.sqrt(np.mean(skin.readings**2))
    measured = _measured(rng, skin)
    # Friction, or a skin that lifts off, makes the force at one travel jump within the session. The reading follows the
    # force.
    state = np.cumsum(rng.random(n) < 0.05) % 2
    travel = measured.travel * np.where(state, 3.0 ** (-2 / 3), 1.0)
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
    """Simulate skins with four moving magnets."""
    half = 15e-3
    chips = np.asarray(boards.eflesh_board(depth=0.0).chips[:, :2], np.float64)
    position = rng.uniform(-half, half, (skins, n, 2))
    travel = rng.uniform(0.3e-3, 4e-3, (skins, n))
    pressed = []
    for key_skin, at, d in zip(jax.random.split(key, skins), position, travel, strict=True):
        pitch, rough = rng.uniform(6e-3, 10e-3), rng.uniform(0.0, 0.25e-3)
        phase = np.cos(2 * np.pi * at / pitch + rng.uniform(0, 2 * np.pi, 2)).sum(1)
        height = rough * (phase + _smooth_field(rng, at, 2.5e-3, 1)[:, 0])
        true = np.maximum(d + height, 0)
        felt = np.asarray(_sample_lattice(key_skin, jnp.float32(at), jnp.float32(true), half_edge=half), np.float64)
        stiffness = 1.5e3 * np.exp(0.3 * rng.normal())
        force = stiffness * true * (true / 2e-3) ** rng.uniform(0.0, 0.6)
        readings = rng.uniform(60.0, 300.0) * felt * (1 + 0.03 * rng.normal(size=felt.shape))
        pressed.append(_measured(rng, PressedSkinOfKind("lattice", at, d, force, readings, chips)))
    return pressed


_sample_lattice = jax.jit(lattice.sample_skin, static_argnames="half_edge")


def _smooth_field(rng: np.random.Generator, position: np.ndarray, length: float, channels: int) -> np.ndarray:
    """Sample a random field (n, channels) of variance 1 (random Fourier features of a squared exponential)."""
    waves, phase = rng.normal(size=(80, 2)) / length, rng.uniform(0, 2 * np.pi, 80)
    return np.sqrt(2 / 80) * np.cos(position @ waves.T + phase) @ rng.normal(size=(80, channels))
