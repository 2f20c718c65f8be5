"""A skin of other physics against closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.studies.winkler import winkler_press
from i2t.skin.contact import FINE_GRID, GRID
from i2t.skin.pad import nominal_pad


def test_columns_of_a_winkler_foundation():
    """A flat face: springs' force, and the field of an evenly shortened layer, the same on either grid."""
    pad = nominal_pad("uniform")
    press = jax.jit(winkler_press, static_argnums=3)
    indentation = 0.1e-3
    for grid in (GRID, FINE_GRID):
        found = press(pad, jnp.zeros((grid.cells, grid.cells)), indentation, grid)
        assert float(found.force) == pytest.approx(
            float(pad.young / pad.thickness) * indentation * (20e-3) ** 2, rel=1e-4
        )
    # Half of the face: half of the force, and no effect on what is not met.
    half = jnp.asarray(np.where(GRID.centres[None] < 0, 0.0, np.inf) * np.ones((GRID.cells, 1)), jnp.float32)
    found = press(pad, half, indentation, GRID)
    assert float(found.force) == pytest.approx(
        float(pad.young / pad.thickness) * indentation * (20e-3) ** 2 / 2, rel=1e-4
    )
    assert (np.asarray(found.pressure)[:, GRID.centres > 0] == 0).all()
    nothing = press(pad, half, -1e-4, GRID)
    np.testing.assert_allclose(nothing.reading, 0, atol=1e-2)  # uT, differences of a field at rest in float32
    assert float(nothing.force) == 0
    twice = press(pad, half, 2 * indentation, GRID)
    ratio = np.linalg.norm(twice.reading) / np.linalg.norm(found.reading)
    assert 1.9 < ratio < 2.2  # nearly linear: magnets come a little nearer
