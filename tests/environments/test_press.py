"""The quick press of an environment against the whole physics, and tables against it."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2t.environments.core import EnvironmentConfig, TouchAction, is_safe_everywhere, pose_of_numbers, touch_outcome
from i2t.environments.press import meet, press
from i2t.environments.tables import make_environment, tabulate
from i2t.environments.tasks import WhereIsIt
from i2t.geometry import inverse
from i2t.rendering.ops import element
from i2t.rendering.render import render_heights
from i2t.simulation.press import PressLimits, press_to_stop
from i2t.simulation.touches import SimulationErrors
from i2t.skin.contact import GRID
from i2t.types import PAD_WINDOW

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
def test_a_row_of_the_table_is_the_touch_pressed_and_poses_are_no_rows(made):
    environment, params = made
    table = tabulate(jax.random.key(1), environment, params, 2).table
    touch = jax.jit(partial(touch_outcome, config=QUIET))
    for pad, which, site in ((0, 0, 2), (1, 1, 5)):
        here = touch(
            jax.random.key(0), element(params.surfaces, which), table.T_w_o[1], params.T_w_site[site],
            pad=element(params.pads, pad), response=params.response[pad],
        )  # fmt: skip
        np.testing.assert_allclose(table.outcome.reading[pad, which, 1, site], here.reading, atol=0.05)
        np.testing.assert_allclose(table.outcome.advance[pad, which, 1, site], here.advance, atol=1e-6)
    with pytest.raises(ValueError, match="tabulated"):
        tabulate(jax.random.key(0), replace(environment, config=replace(QUIET, actions="pose")), params)
    with pytest.raises(ValueError, match="give one of each"):
        make_environment(())


@pytest.mark.full
def test_a_pose_is_touched_where_it_is_safe_and_refused_where_not(made):
    environment, params = made
    environment = replace(environment, config=replace(QUIET, actions="pose"))
    step = jax.jit(environment.step_env)
    _, state = environment.reset(jax.random.key(0), params)
    middle = TouchAction(jnp.array([0.0, 0, 30 / 45 * 2 - 1, 0, 0, 0]), jnp.zeros(2))  # on the top of either
    obs, after, _, _, info = step(jax.random.key(1), state, middle, params)
    assert not info["refused"]
    assert obs.contact
    assert abs(float(obs.advance)) < 1e-3
    for numbers in ((0, 0, -1.0, 0, 0, 0), (0, 0, 0, 0.95, 0.95, 0), (2.0, 0, 0, 0, 0, 0), (np.nan, 0, 0, 0, 0, 0)):
        action = TouchAction(jnp.asarray(numbers, jnp.float32), jnp.zeros(2))
        obs, unmoved, _, _, info = step(jax.random.key(1), after, action, params)
        assert info["refused"], numbers
        np.testing.assert_array_equal(unmoved.T_w_t, after.T_w_t)
        assert not np.any(obs.reading)
    T = pose_of_numbers(middle.touch, environment.config.workspace)
    assert is_safe_everywhere(T, params, environment.config)


@pytest.mark.full
def test_sites_of_where_it_is_are_safe_wherever_it_may_be():
    _, params = make_environment(("cylinder",), task=WhereIsIt(), config=QUIET, sites=4, pads=1)
    assert params.hypotheses.shape[0] == 27
    bare = replace(QUIET, limits=replace(QUIET.limits, overtravel=0.0))
    assert jax.jit(jax.vmap(lambda T: is_safe_everywhere(T, params, bare)))(params.T_w_site).all()
