"""A pad with free sides against finite elements of the whole, against the bonded layer, and against itself."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.studies import free_sides
from experiments.studies.free_sides import FreeSides, SideTable
from i2t.skin.contact import FINE_GRID, GRID, Grid
from i2t.skin.pad import nominal_pad, press

PAD = nominal_pad("uniform")
CELLS = 8


@pytest.fixture(scope="module")
def table() -> SideTable:
    return free_sides.tabulate(2e-3, 0.48, cells=CELLS, layers=2)


def ball(x: float, y: float, grid: Grid = GRID) -> jax.Array:
    """Heights of a ball of 4 mm above a point of the pad."""
    across, along = np.meshgrid(grid.centres, grid.centres)
    return jnp.asarray(((across - x) ** 2 + (along - y) ** 2) / (2 * 4e-3), jnp.float32)


def pressed(law, height: jax.Array, grid: Grid = GRID):
    return jax.jit(lambda h: law(PAD, h, 0.3e-3, grid=grid))(height)


@pytest.mark.full
def test_free_sides_only_soften_and_by_little_far_from_them(table):
    for part in table.sinking:
        np.testing.assert_allclose(part, part.T, atol=1e-6 * np.abs(part).max())
        values = np.linalg.eigvalsh(part)
        assert values.min() > -1e-6 * values.max()  # whatever is pressed, the work done grows
    own = sum(np.diagonal(part) for part in table.sinking).reshape(CELLS // 2, CELLS // 2)
    assert own[0, 0] < 0.02 * own[0, -1] < 0.02 * own[-1, -1]  # the middle, a side, a corner
    np.testing.assert_allclose(own, own.T, rtol=1e-5)


@pytest.mark.full
def test_without_a_change_the_press_is_that_of_the_bonded_layer(table):
    law = FreeSides(SideTable(0 * table.sinking, 0 * table.motion))
    for grid in (GRID, FINE_GRID):
        height = ball(7e-3, 2e-3, grid)
        ours, bonded = pressed(law, height, grid), pressed(press, height, grid)
        assert bool(ours.converged)
        np.testing.assert_allclose(ours.force, bonded.force, rtol=1e-3)
        change = np.abs(np.asarray(ours.reading) - np.asarray(bonded.reading)).max()
        assert change < 2e-3 * np.abs(np.asarray(bonded.reading)).max()


@pytest.mark.full
def test_a_press_near_a_side_is_softer_and_its_mirror_image_the_same(table):
    law = FreeSides(table)
    near, far = ball(8.5e-3, 1e-3), ball(0, 0)
    softer = float(pressed(law, near).force / pressed(press, near).force)
    assert 0.3 < softer < 0.95
    assert float(pressed(law, far).force / pressed(press, far).force) == pytest.approx(1, abs=0.01)
    first = pressed(law, near).pressure
    for mirrored, x, y in ((first[:, ::-1], -8.5e-3, 1e-3), (first[::-1], 8.5e-3, -1e-3), (first.T, 1e-3, 8.5e-3)):
        other = pressed(law, ball(x, y)).pressure
        np.testing.assert_allclose(other, mirrored, atol=2e-3 * float(jnp.max(first)))
