"""A board of four chips from the physics to what is fitted to it: readings of twelve values everywhere, and no five."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import i2t
from experiments.train import __main__ as train
from i2t.skin.boards import grid_board, same_board
from i2t.skin.elasticity import GRID

PRESSES, HELD_OUT = 60, 30
TIP_RADIUS_M = 4e-3


def tip_presses(pad: i2t.Pad, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions (m), forces (N) and readings (uT) of presses of a ball, with 1 uT of noise."""
    rng = np.random.default_rng(0)
    positions, depths = rng.uniform(-6e-3, 6e-3, (count, 2)), rng.uniform(0.1e-3, 0.5e-3, count)

    def press(at: jax.Array) -> tuple[jax.Array, jax.Array]:
        squared = (GRID.centres[None, :] - at[0]) ** 2 + (GRID.centres[:, None] - at[1]) ** 2
        pressed = i2t.press(pad, (squared - squared.min()) / (2 * TIP_RADIUS_M), at[2])
        return pressed.force, pressed.reading

    forces, readings = map(np.asarray, jax.lax.map(press, jnp.column_stack([positions, depths])))
    return positions, forces, readings + rng.normal(size=readings.shape)


@pytest.mark.full
def test_four_chips_are_simulated_kept_trained_with_and_calibrated(tmp_path):
    board = grid_board(2, 2)
    pad = i2t.sample_pad(jax.random.key(0), board=board)
    i2t.save_pad(tmp_path / "pad.npz", pad)

    positions, forces, readings = tip_presses(pad, PRESSES + HELD_OUT)
    known, others = slice(None, PRESSES), slice(PRESSES, None)
    calibration = i2t.calibrate(positions[known], forces[known], readings[known], load_kind="force", board=board)
    mean, std = calibration.predict(positions[others], forces[others])
    assert mean.shape == std.shape == (HELD_OUT, 12)
    missed = np.sum((readings[others] - mean) ** 2) / np.sum((readings[others] - readings[others].mean(0)) ** 2)
    assert missed < 0.5

    out = tmp_path / "run"
    arguments = ["--preset", "debug", "--epochs", "2", "--pad", str(tmp_path / "pad.npz"), "--out", str(out)]
    assert train.main(arguments) == 0
    made = i2t.load_dataset(out / "data.h5")
    assert made.touches.reading.shape == (60, 12)
    assert same_board(made.board, board)
    reading = i2t.load_predictor(out).predict(made.touches.patch[:2], force=made.touches.force[:2])
    assert reading.mean.shape == reading.std.shape == (2, 12)
    assert np.isfinite(reading.mean).all()
    assert (reading.std > 0).all()
