"""Bounds of the contact operator's spectrum, within whose inverse the solver's steps are kept."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2t.skin import contact
from i2t.skin.elasticity import Grid
from i2t.skin.pad import nominal_pad

GRID = Grid(10, 16)


@pytest.mark.parametrize("mount_compliance", [0.0, 0.25e-3, 5e-3])
def test_the_spectrum_lies_within_its_bounds_also_of_an_edge_clamped_skin(mount_compliance):
    pad = nominal_pad()._replace(mount_compliance=jnp.asarray(mount_compliance))
    softness = contact._softness(pad, GRID)
    low, high = (float(bound) for bound in contact._bounds(softness, GRID))
    one = jax.vmap(lambda pressure: contact._deflect(softness, pressure, GRID).ravel())
    operator = np.asarray(one(jnp.eye(GRID.cells**2).reshape(-1, GRID.cells, GRID.cells)), np.float64)
    values = np.linalg.eigvalsh((operator + operator.T) / 2)
    assert values[0] > (1 - 1e-4) * low
    assert values[-1] < (1 + 1e-4) * high
    # The mount's part is a single direction: where it is the largest by far, the bound is sharp.
    if mount_compliance > 1e-3:
        assert values[-1] > 0.8 * high
