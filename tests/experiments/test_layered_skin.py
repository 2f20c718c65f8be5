"""The press of a skin of several layers against that of the bonded layer."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.studies.layered_skin import press_law
from i2t.skin.contact import FINE_GRID, GRID, Grid
from i2t.skin.pad import nominal_pad, press
from i2t.types import Pad

PAD = nominal_pad("poles")._replace(mount_compliance=jnp.float32(0.2e-3))


def pressed(law, grid: Grid = GRID, pad: Pad = PAD):
    across, along = np.meshgrid(grid.centres, grid.centres)
    height = jnp.asarray(((across - 3e-3) ** 2 + (along - 1e-3) ** 2) / (2 * 4e-3), jnp.float32)
    return jax.jit(lambda h: law(pad, h, 0.3e-3, grid=grid))(height)


@pytest.mark.parametrize("grid", [GRID, FINE_GRID])
def test_equal_layers_are_pressed_as_one(grid):
    ours, bonded = pressed(press_law(PAD, ((0.3, 1.0), (0.7, 1.0))), grid), pressed(press, grid)
    assert bool(ours.converged)
    np.testing.assert_allclose(ours.force, bonded.force, rtol=1e-3)
    change = np.abs(np.asarray(ours.reading) - np.asarray(bonded.reading)).max()
    assert change < 2e-3 * np.abs(np.asarray(bonded.reading)).max()


def test_layers_twice_as_stiff_take_twice_the_force_and_read_the_same():
    """The skin is bonded, because a mount would not stiffen with the layers."""
    twice = press_law(PAD, ((0.5, 2.0), (0.5, 2.0)))
    ours, bonded = (pressed(law, pad=PAD._replace(mount_compliance=jnp.float32(0))) for law in (twice, press))
    np.testing.assert_allclose(ours.force, 2 * bonded.force, rtol=1e-3)
    np.testing.assert_allclose(ours.reading, bonded.reading, atol=2e-3 * np.abs(np.asarray(bonded.reading)).max())


def test_on_a_rigid_lower_half_the_skin_is_one_of_half_the_thickness():
    """Its magnets are as far from the chips; those of the lower half contribute a constant, which cancels."""
    bonded = PAD._replace(mount_compliance=jnp.float32(0))
    ours = pressed(press_law(PAD, ((0.5, 1.0), (0.5, 1e6))), pad=bonded)
    thin = pressed(press, pad=bonded._replace(thickness=bonded.thickness / 2))
    np.testing.assert_allclose(ours.force, thin.force, rtol=2e-3)
    np.testing.assert_allclose(ours.reading, thin.reading, atol=0.05 * np.abs(np.asarray(thin.reading)).max())
