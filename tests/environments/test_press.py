"""The quick press of an environment against the whole physics, and tables against it."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.environments import OBJECTS, PADS, SITES, random_environment

from i2t.contact.press import PressLimits, press_to_stop
from i2t.environments import tables
from i2t.environments.core import EnvironmentConfig, TouchAction
from i2t.environments.press import TouchOutcome, meet, press, touch_outcome
from i2t.environments.tables import make_environment, tabulate
from i2t.geometry import inverse
from i2t.patches.dimensions import PAD_WINDOW
from i2t.rendering.ops import element
from i2t.rendering.render import render_heights
from i2t.simulation.touches import SimulationErrors
from i2t.skin.contact import GRID

QUIET = EnvironmentConfig(touches=3, errors=SimulationErrors.none(), limits=replace(PressLimits(), overshoot=0.0))


@pytest.fixture(scope="module")
def made():
    """Two prisms, two pads, six sites, without errors of the arm."""
    return make_environment(("star", "hexagon"), config=QUIET, sites=6, pads=2)


@pytest.mark.full
def test_a_press_is_that_of_the_whole_physics_within_the_noise(made):
    """Force within 8 %, travel within 20 um, reading within 3 uT of cells of 0.5 mm and displaced dipoles."""
    _, params = made

    @jax.jit
    @partial(jax.vmap, in_axes=(0, 0, None))
    def both(which, T_w_site, number):
        surface, pad = element(params.surfaces, which), element(params.pads, number)
        here = meet(jax.random.key(0), surface, jnp.eye(4), T_w_site, errors=QUIET.errors, limits=QUIET.limits)
        ours = press(pad, params.response[number], here, 0.0, QUIET.limits)
        heights = render_heights(surface, inverse(T_w_site), PAD_WINDOW, GRID.cells)
        whole = press_to_stop(pad, heights - jnp.min(heights), QUIET.limits)
        return ours, whole, here.nearest

    for number in range(2):
        ours, whole, nearest = both(params.owner, params.T_w_site, number)
        assert ours.contact.all()
        np.testing.assert_allclose(ours.force, whole.force, rtol=0.08)
        travel = whole.indentation + whole.force / QUIET.limits.stiffness
        np.testing.assert_allclose(ours.advance - nearest, travel, atol=20e-6)
        assert np.linalg.norm(ours.reading - whole.reading, axis=1).max() < 3
        assert np.abs(np.linalg.norm(ours.reading, axis=1) / QUIET.limits.skin_change - 1).max() < 0.01


@pytest.mark.full
def test_a_row_of_the_table_is_the_touch_pressed(made):
    environment, params = made
    table = tabulate(jax.random.key(1), environment, params, 2).table
    touch = jax.jit(partial(touch_outcome, errors=QUIET.errors, limits=QUIET.limits))
    for pad, which, site in ((0, 0, 2), (1, 1, 5)):
        here = touch(
            jax.random.key(0), element(params.surfaces, which), table.T_w_o[1], params.T_w_site[site],
            pads=params.pads, response=params.response,
        )  # fmt: skip
        np.testing.assert_allclose(table.outcome.reading[pad, which, 1, site], here.reading[pad], atol=0.05)
        np.testing.assert_allclose(table.outcome.advance[pad, which, 1, site], here.advance[pad], atol=1e-6)
    _, state = environment.reset(jax.random.key(2), params)
    _, exact, _, _, info = jax.jit(environment.step_env)(
        jax.random.key(3), state, TouchAction(jnp.int32(2), jnp.zeros(2)), params
    )
    assert not info["refused"]
    assert exact.touches == 1


def test_a_table_has_the_touches_of_each_object_next_to_each_other(monkeypatch):
    environment, params = random_environment(QUIET)
    corners = jnp.arange(float(OBJECTS))[:, None, None, None] * jnp.ones((OBJECTS, 1, 3, 3))
    params = params._replace(surfaces=params.surfaces._replace(triangles=corners))

    def touched(keys, surface, T_w_o, params, config):
        shape = (PADS, len(T_w_o), SITES)
        assert len(keys) == len(T_w_o) * SITES
        return TouchOutcome(*(jnp.full(shape, surface.triangles[0, 0, 0]) for _ in TouchOutcome._fields))

    monkeypatch.setattr(tables, "_touch_all", touched)
    table = tabulate(jax.random.key(0), environment, params, 2).table
    np.testing.assert_array_equal(table.outcome.force[1, :, 1, 4], np.arange(OBJECTS))
    assert table.outcome.force.shape == (PADS, OBJECTS, 2, SITES)
    with pytest.raises(ValueError, match="give one of each"):
        make_environment(())
