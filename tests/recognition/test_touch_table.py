"""The quick press of an environment against the whole physics, and tables against single touches."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.environments import OBJECTS, PADS, SITES, random_environment

from i2t.contact.press import PressLimits
from i2t.recognition import touch_table
from i2t.recognition.environment import EnvironmentConfig, TabulatedTouches, TouchEnvironment, advance_along_approach
from i2t.recognition.touch_table import make_environment, tabulate
from i2t.simulation.touches import SimulationErrors
from i2t.skin.pad import press as press_pad

QUIET = EnvironmentConfig(
    errors=SimulationErrors.error_free(), limits=replace(PressLimits(), overshoot=0.0), touches=3, law=None
)


@pytest.fixture(scope="module")
def world():
    """Two prisms, two pads, six sites, without errors of the arm."""
    return make_environment(("star", "hexagon"), config=QUIET, sites=6, pads=2)


@pytest.mark.full
def test_a_linear_press_equals_the_full_physics_within_the_noise(world):
    """Without friction, force is within 8 %, travel within 20 um, and reading within 3 uT of those of cells of 0.5 mm
    and displaced dipoles.
    """
    _, params = world
    params = params._replace(pads=params.pads._replace(friction=jnp.zeros_like(params.pads.friction)))
    whole_world = TouchEnvironment(replace(QUIET, law=press_pad))

    @jax.jit
    @partial(jax.vmap, in_axes=(0, None))
    def both(site, number):
        which = params.owner[site]
        worn = params._replace(pads=jax.tree.map(lambda x: x[number][None], params.pads), table=None)
        ends = []
        for environment in (TouchEnvironment(QUIET), whole_world):
            config = environment.config
            here = worn._replace(response=touch_table._responses(worn.pads, config))
            state = environment.begin(jax.random.key(0), jax.random.key(1), which, 0, here)
            ends.append(environment.touch(jax.random.key(2), state, site, here))
        return tuple(ends)

    for number in range(2):
        ours, whole = both(jnp.arange(6), number)
        assert ours.contact.all()
        np.testing.assert_allclose(ours.force, whole.force, rtol=0.08)
        advance = [advance_along_approach(params.T_w_site, ends.T_w_t) for ends in (ours, whole)]
        np.testing.assert_allclose(*advance, atol=20e-6)
        assert np.linalg.norm(ours.reading - whole.reading, axis=1).max() < 3
        assert np.abs(np.linalg.norm(ours.reading, axis=1) / QUIET.limits.skin_change - 1).max() < 0.01


@pytest.mark.full
def test_a_row_of_the_table_equals_the_simulated_touch(world):
    environment, params = world
    table = tabulate(jax.random.key(1), environment, params, 2).table
    for pad, which, site in ((0, 0, 2), (1, 1, 5)):
        state = environment.begin(jax.random.key(0), jax.random.key(1), which, pad, params)
        state = state._replace(session=state.session._replace(T_o_placed=table.T_w_o[1]))
        here = environment.touch(jax.random.key(2), state, jnp.int32(site), params)
        row = jax.tree.map(lambda x, row=(pad, which, 1, site): x[row], table.touches)
        np.testing.assert_allclose(row.reading, here.reading, atol=0.05)
        np.testing.assert_allclose(row.advance, advance_along_approach(params.T_w_site[site], here.T_w_t), atol=1e-6)


def test_a_table_has_the_touches_of_each_object_next_to_each_other(monkeypatch):
    environment, params = random_environment(QUIET)
    corners = jnp.arange(float(OBJECTS))[:, None, None, None] * jnp.ones((OBJECTS, 1, 3, 3))
    params = params._replace(surfaces=params.surfaces._replace(triangles=corners))

    def touched(keys, surface, T_w_o, params, config):
        shape = (PADS, len(T_w_o), SITES)
        assert len(keys) == len(T_w_o) * SITES
        return TabulatedTouches(*(jnp.full(shape, surface.triangles[0, 0, 0]) for _ in TabulatedTouches._fields))

    monkeypatch.setattr(touch_table, "_touch_all", touched)
    table = tabulate(jax.random.key(0), environment, params, 2).table
    np.testing.assert_array_equal(table.touches.force[1, :, 1, 4], np.arange(OBJECTS))
    assert table.touches.force.shape == (PADS, OBJECTS, 2, SITES)
    with pytest.raises(ValueError, match="give at least one of each"):
        make_environment(())
