"""The figures of `docs/physics.md`: `python tests/helpers/skin_figures.py` from the root of the checkout (some minutes
on two cores).
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from round_tips import round_tip

from i2t.skin import contact
from i2t.skin.dipoles import DIPOLE_SHEETS, response
from i2t.skin.elasticity import FINE_GRID, GRID, Grid
from i2t.skin.pad import nominal_pad, press_force, sample_pad

RANDOM = np.random.default_rng(1)
FINEST = Grid(160, 256)


def _edge(x, y, angle, offset, slope):
    s = x * np.cos(angle) + y * np.sin(angle) - offset
    return np.minimum(np.maximum(s * slope, -s / slope), 4e-3)


def _corner(x, y, x0, y0, turn, slope):
    faces = [np.cos(a) * (x - x0) + np.sin(a) * (y - y0) for a in turn + np.array([0, 2.1, 4.2])]
    return np.minimum(slope * np.max(faces, axis=0), 4e-3)


def _stamp(x, y, across, tilt):
    upright, bar = (abs(x) < 1e-3) & (abs(y) < 5e-3), (abs(x) < 5e-3) & (abs(y - across) < 1e-3)
    return np.where(upright | bar, 0, 3.5e-3) + tilt * (x + 10e-3)


def _drawn(shape, *ranges) -> list:
    """Eight shapes with numbers drawn from ranges."""
    draws = [[RANDOM.uniform(*each) for each in ranges] for _ in range(8)]
    return [lambda x, y, draw=draw: shape(x, y, *draw) for draw in draws]


def refinement() -> None:
    pads = [nominal_pad(), *(sample_pad(jax.random.key(i)) for i in range(4))]
    print("\nchange of the reading against 160 x 160 cells and 80 x 80 x 10 dipoles: pooled, median and worst press")
    levels = {
        "40, dipoles 40": (GRID, GRID, DIPOLE_SHEETS),
        "80, dipoles 40": (FINE_GRID, GRID, DIPOLE_SHEETS),
        "80, dipoles 80": (FINE_GRID, FINE_GRID, DIPOLE_SHEETS),
        "reference": (FINEST, FINE_GRID, 2 * DIPOLE_SHEETS),
    }
    middle = (-4e-3, 4e-3)
    for family, shapes, force in (
        ("tips", [partial(round_tip, at=RANDOM.uniform(-7e-3, 7e-3, 2)) for _ in range(8)], 0.8),
        ("stamps", [partial(_stamp, across=at, tilt=tilt) for at in (4e-3, 0) for tilt in (0, 0.02)], 1.0),
        ("edges", _drawn(_edge, (0, 2 * np.pi), (-5e-3, 5e-3), (0.2, 1.2)), 0.6),
        ("corners", _drawn(_corner, middle, middle, (0, 2), (0.4, 1)), 0.5),
    ):
        readings = {}
        for name, (grid, dipoles, nodes) in levels.items():
            y, x = np.meshgrid(grid.centres, grid.centres, indexing="ij")
            heights = jnp.asarray(np.stack([shape(x, y) for shape in shapes]), jnp.float32)

            def one(pad, height, grid=grid, dipoles=dipoles, nodes=nodes, force=force):
                found = contact.solve_force(pad, height - jnp.min(height), force, grid)
                return response(pad, found.pressure, grid, dipoles=dipoles, nodes=nodes)

            each = jax.jit(lambda pad, heights, one=one: jax.lax.map(lambda height: one(pad, height), heights))
            readings[name] = np.stack([each(pad, heights) for pad in pads])
        exact = readings.pop("reference")
        for name, found in readings.items():
            change, size = np.linalg.norm(found - exact, axis=-1), np.linalg.norm(exact, axis=-1)
            pooled, each = np.sqrt(np.sum(change**2) / np.sum(size**2)), change / size
            print(f"{family:8} at {force} N, {name}: {pooled:.2%}  {np.median(each):.2%}  {each.max():.2%}")


def magnitudes() -> None:
    y, x = np.meshgrid(GRID.centres, GRID.centres, indexing="ij")
    heights = jnp.asarray(np.stack([round_tip(x, y, p) for p in RANDOM.uniform(-7e-3, 7e-3, (32, 2))]), jnp.float32)
    forces = jnp.asarray(RANDOM.uniform(0.6, 1.0, 32), jnp.float32)
    pads = jax.jit(jax.vmap(sample_pad))(jax.random.split(jax.random.key(11), 200))
    each = jax.vmap(press_force, (None, 0, 0))
    reading = np.asarray(jax.jit(lambda pads: jax.lax.map(lambda pad: each(pad, heights, forces).reading, pads))(pads))
    norm, chips = np.linalg.norm(reading, axis=-1), reading.reshape(200, 32, 5, 3)
    strongest = np.linalg.norm(chips, axis=-1).argmax(axis=-1)
    values = np.abs(np.take_along_axis(chips, strongest[..., None, None], axis=2)[:, :, 0])
    print("\n200 simulated pads, a tip of 4.6 mm at 0.6-1.0 N: 10, 50 and 90 % of the pads")
    for name, of_pads in {
        "median norm (uT)": np.median(norm, axis=1),
        "95th percentile (uT)": np.quantile(norm, 0.95, axis=1),
        "sensitivity (uT/N)": np.median(norm / np.asarray(forces), axis=1),
        **{f"strongest chip's {axis} (uT)": np.median(values[..., i], axis=1) for i, axis in enumerate("xyz")},
    }.items():
        print(name, np.quantile(of_pads, [0.1, 0.5, 0.9]).round())


if __name__ == "__main__":
    refinement()
    magnitudes()
