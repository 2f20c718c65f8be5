"""Your skin from a few presses: positions, forces and readings of one tip become a model of all other presses.

python examples/06_calibrate_a_skin.py
"""

import jax
import jax.numpy as jnp
import numpy as np

import i2t


def main(presses: int = 60, tip_radius: float = 4e-3) -> float:
    """Calibrate a simulated skin from some presses; return R2 over 60 others."""
    pad = i2t.sample_pad(jax.random.key(2))  # here the "real" skin; bring your own presses instead
    random, grid = np.random.default_rng(0), i2t.Grid()
    positions = random.uniform(-6e-3, 6e-3, (presses + 60, 2))  # m, of the tip in the tool frame
    depths = random.uniform(0.1e-3, 0.5e-3, presses + 60)  # m past first contact

    def press(at: jax.Array) -> tuple[jax.Array, jax.Array]:
        squared = (grid.centres[None, :] - at[0]) ** 2 + (grid.centres[:, None] - at[1]) ** 2
        pressed = i2t.press(pad, (squared - squared.min()) / (2 * tip_radius), at[2])
        return pressed.reading, pressed.force

    readings, forces = map(np.asarray, jax.lax.map(press, jnp.column_stack([positions, depths])))
    readings = readings + random.normal(0, 1.0, readings.shape)  # uT of noise

    known, others, board = slice(None, presses), slice(presses, None), i2t.Board(*map(np.asarray, pad.board))
    calibration = i2t.calibrate(positions[known], forces[known], readings[known], load_kind="force", board=board)
    mean, std = calibration.predict(positions[others], forces[others])
    error, spread = readings[others] - mean, readings[others] - readings[others].mean(0)
    r2, inside = float(1 - (error**2).sum() / (spread**2).sum()), (np.abs(error) < 1.645 * std).mean()
    print(f"{presses} presses predict 60 others with R2 {r2:.2f}; 90 % ranges hold {inside:.0%} (simulated)")
    return r2


if __name__ == "__main__":
    i2t.use_compile_cache()
    main()
