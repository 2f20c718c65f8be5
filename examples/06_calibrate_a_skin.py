"""Calibrate a skin from a few presses: a model of readings from positions and forces of one tip.

python examples/06_calibrate_a_skin.py
"""

import jax
import jax.numpy as jnp
import numpy as np

import i2t


def main(presses: int = 60, tip_radius: float = 4e-3) -> float:
    """Calibrate a simulated skin from some presses, and return R2 on 60 others."""
    pad = i2t.sample_pad(jax.random.key(2))  # plays the real skin; use your own presses instead
    random, grid = np.random.default_rng(0), i2t.Grid()
    positions = random.uniform(-6e-3, 6e-3, (presses + 60, 2))  # m, tip in the tool frame
    travels = random.uniform(0.1e-3, 0.5e-3, presses + 60)  # m past first contact

    def press(at: jax.Array) -> tuple[jax.Array, jax.Array]:
        squared = (grid.centres[None, :] - at[0]) ** 2 + (grid.centres[:, None] - at[1]) ** 2
        pressed = i2t.press(pad, (squared - squared.min()) / (2 * tip_radius), at[2])
        return pressed.reading, pressed.force

    readings, forces = map(np.asarray, jax.lax.map(press, jnp.column_stack([positions, travels])))
    readings = readings + random.normal(0, 1.0, readings.shape)  # uT of noise

    fitted, test, board = slice(None, presses), slice(presses, None), i2t.Board(*map(np.asarray, pad.board))
    calibration = i2t.calibrate(positions[fitted], forces[fitted], readings[fitted], load_kind="force", board=board)
    mean, std = calibration.predict(positions[test], forces[test])
    error, spread = readings[test] - mean, readings[test] - readings[test].mean(0)
    r2, inside = float(1 - (error**2).sum() / (spread**2).sum()), (np.abs(error) < 1.645 * std).mean()
    print(f"{presses} presses predict 60 others with R2 {r2:.2f}; coverage of 90 % intervals: {inside:.0%} (simulated)")
    return r2


if __name__ == "__main__":
    i2t.use_compile_cache()
    main()
