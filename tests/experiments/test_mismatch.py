"""Worlds of other physics against closed forms, and stops that are wrong too often."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.studies import mismatch, placement
from i2t.simulation.touches import SimulationErrors
from i2t.skin.contact import FINE_GRID, GRID
from i2t.skin.pad import nominal_pad, numbered_pad


@pytest.mark.parametrize("grid", [GRID, FINE_GRID])
def test_a_ball_that_rolls_inside_rounds_edges_by_its_radius_and_leaves_flats(grid):
    radius = mismatch.EDGE_RADIUS_M
    x = grid.centres
    straight = np.broadcast_to(np.where(np.abs(x) < 5e-3, 0.0, np.inf), (grid.cells, grid.cells))
    opened = np.asarray(mismatch.opened_by_ball(jnp.asarray(straight), radius, grid.spacing))
    assert (opened >= straight).all()
    inside = np.abs(x) < 5e-3 - radius
    np.testing.assert_array_equal(opened[:, inside], 0)
    assert np.isinf(opened[:, np.abs(x) > 5e-3]).all()
    # The last cell's centre lies half a cell inside the edge; the quarter circle is met from the cells of the grid.
    last = opened[grid.cells // 2, np.flatnonzero(np.abs(x) < 5e-3)[-1]]
    depth = grid.spacing / 2
    exact = radius - np.sqrt(radius**2 - (radius - depth) ** 2)
    assert exact - 1e-9 <= last <= radius + 1e-9
    cone = jnp.asarray(
        np.hypot(*np.meshgrid(x, x)), jnp.float32
    )  # of 45 degrees: its tip recedes by (sqrt 2 - 1) radii
    tip = float(jnp.min(mismatch.opened_by_ball(cone, radius, grid.spacing))) - float(jnp.min(cone))
    assert tip == pytest.approx((np.sqrt(2) - 1) * radius, abs=grid.spacing * 0.75)


def test_columns_of_a_winkler_foundation():
    """A flat face: springs' force, and the field of an evenly shortened layer, the same on either grid."""
    pad = nominal_pad("uniform")
    press = jax.jit(mismatch.winkler_press, static_argnums=3)
    depth = 0.1e-3
    for grid in (GRID, FINE_GRID):
        found = press(pad, jnp.zeros((grid.cells, grid.cells)), depth, grid)
        assert float(found.force) == pytest.approx(float(pad.young / pad.thickness) * depth * (20e-3) ** 2, rel=1e-4)
    # Half of the face: half of the force, and no effect on what is not met.
    half = jnp.asarray(np.where(GRID.centres[None] < 0, 0.0, np.inf) * np.ones((GRID.cells, 1)), jnp.float32)
    found = press(pad, half, depth, GRID)
    assert float(found.force) == pytest.approx(float(pad.young / pad.thickness) * depth * (20e-3) ** 2 / 2, rel=1e-4)
    assert (np.asarray(found.pressure)[:, GRID.centres > 0] == 0).all()
    nothing = press(pad, half, -1e-4, GRID)
    np.testing.assert_allclose(nothing.reading, 0, atol=1e-2)  # uT, differences of a field at rest in float32
    assert float(nothing.force) == 0
    twice = press(pad, half, 2 * depth, GRID)
    ratio = np.linalg.norm(twice.reading) / np.linalg.norm(found.reading)
    assert 1.9 < ratio < 2.2  # nearly linear: magnets come a little nearer


@pytest.mark.full
def test_another_chip_remembers_and_nothing_else_that_can_be_read_differs():
    some, pad = mismatch.worlds(), numbered_pad(0)
    other = some["another chip remembers"].pad(pad)
    assert mismatch.remembering_chip(other) != mismatch.remembering_chip(pad)
    np.testing.assert_allclose(other.gains, pad.gains, rtol=1e-4)
    errors = some["chip remembers twice as much"].errors(SimulationErrors())
    assert errors.faults.hysteresis == pytest.approx(2 * SimulationErrors().faults.hysteresis)


def test_stops_that_are_wrong_too_often_are_named(capsys):
    """Half of the sure decisions are wrong."""
    p = np.tile([0.995, 0.005], (40, 2, 1))
    truth = np.arange(40) % 2
    entry = placement.report_condition("1 mm, stated 1", p, truth, np.full(40, 1.5), [])
    assert entry["stopping"][0]["stopped_error"]["mean"] == 0.5
    assert entry["scale_percentiles_25_50_75"] == [1.5, 1.5, 1.5]
    assert capsys.readouterr().out.count("TOO OFTEN") == 3
    right = placement.report_condition("1 mm, stated 1", p, np.zeros(40, int), np.full(40, 1.5), [])
    assert right["stopping"][0]["stopped_error"]["mean"] == 0
    assert "TOO OFTEN" not in capsys.readouterr().out
