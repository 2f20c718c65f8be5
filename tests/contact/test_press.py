"""Where a press ends: at the first of its limits, and no sooner."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2t.contact.press import PressLimits, pad_response, press_at_stop, press_to_stop, stop_load
from i2t.skin.contact import FINE_GRID, GRID
from i2t.skin.pad import Press, friction_response, press, press_force, sample_pad
from i2t.types import Pad, ReturnCode

LIMITS = PressLimits()
WITHIN = 1e-3
LOADS = np.array([0.3, 0.9, 2.7])  # N
X, Y = np.meshgrid(GRID.centres, GRID.centres)
WAVES = sum(
    bump * np.cos(np.pi * i * X / 20e-3 + i) * np.cos(np.pi * j * Y / 20e-3 - j)
    for (i, j), bump in np.ndenumerate(np.random.default_rng(0).normal(size=(6, 6)))
)
SHAPES = {
    "ball": (X**2 + Y**2) / 20e-3,
    "waves": 0.2e-3 * (WAVES - WAVES.min()),
    "edge": 0.5 * np.abs(X - 3e-3),
    "tilted face": 0.01 * (X + 10e-3),
    "two tips": np.minimum(np.hypot(X - 6e-3, Y), np.hypot(X + 6e-3, Y) + 0.3e-3),
}
stop = jax.jit(lambda pad, height, overshoot: press_to_stop(pad, height, LIMITS, overshoot))


@pytest.fixture(scope="module")
def pad() -> Pad:
    return sample_pad(jax.random.key(3))


@jax.jit
def excess(pad: Pad, height: jax.Array, indentations: jax.Array) -> jax.Array:
    """Skin change or force of presses to `indentations` (m), relative to its limit, whichever is larger."""
    pressed = jax.lax.map(lambda indentation: press(pad, height, indentation), indentations)
    return jnp.maximum(jnp.linalg.norm(pressed.reading, axis=1) / LIMITS.skin_change, pressed.force / LIMITS.force)


@pytest.mark.full
@pytest.mark.parametrize("name", SHAPES)
def test_a_press_ends_at_the_first_crossing_of_a_limit(name, pad):
    height = jnp.float32(SHAPES[name])
    end = stop(pad, height, 0.0)
    found = excess(pad, height, end.indentation * jnp.append(jnp.geomspace(0.02, 0.99, 14), 1.0))
    assert (found[:-1] < 1).all()
    assert abs(found[-1] - 1) < WITHIN
    assert end.code == ReturnCode.SKIN


def test_a_weak_skin_ends_by_force_a_dead_one_at_the_deepest_press_and_an_overshoot_raises_the_limit(pad):
    ball = jnp.float32(SHAPES["ball"])
    # Bonded, so that it does not sink away: 8 N long before the deepest.
    dull = pad._replace(magnetization=1e-3 * pad.magnetization, young=6 * pad.young, mount_compliance=jnp.zeros(()))
    for name in ("ball", "tilted face"):
        end = stop(dull, jnp.float32(SHAPES[name]), 0.0)
        assert end.code == ReturnCode.WRENCH
        assert abs(end.force / LIMITS.force - 1) < WITHIN
    end = stop(pad._replace(magnetization=0 * pad.magnetization, young=jnp.float32(1.0)), ball, 0.0)
    assert end.code == ReturnCode.UNDEFINED
    # A logarithm and its exponential lose a few roundings.
    np.testing.assert_allclose(end.indentation, LIMITS.indentation * pad.thickness, rtol=1e-5)
    end = stop(pad, ball, 0.2)
    assert abs(np.linalg.norm(end.reading) / (1.2 * LIMITS.skin_change) - 1) < WITHIN


@pytest.mark.full
@pytest.mark.parametrize("name", ["ball", "edge", "two tips"])
def test_the_final_press_is_that_of_all_its_dipoles(name, pad):
    """Deep sheets of fewer dipoles, corrected, move the reading by less than 0.05 uT or 0.3 %."""
    y, x = np.meshgrid(FINE_GRID.centres, FINE_GRID.centres, indexing="ij")
    fine = {
        "ball": (x**2 + y**2) / 20e-3,
        "edge": 0.5 * np.abs(x - 3e-3),
        "two tips": np.minimum(np.hypot(x - 6e-3, y), np.hypot(x + 6e-3, y) + 0.3e-3),
    }[name]
    end = stop(pad, jnp.float32(SHAPES[name]), 0.0)
    quick = jax.jit(lambda pad, height, end: press_at_stop(pad, height, end.indentation, end, final=FINE_GRID))
    final = quick(pad, jnp.float32(fine), end)
    whole = press(pad, jnp.float32(fine), end.indentation, grid=FINE_GRID)
    np.testing.assert_allclose(final.force, whole.force, rtol=1e-4)
    error = np.linalg.norm(final.reading - whole.reading)
    assert error < max(0.05, 3e-3 * np.linalg.norm(whole.reading))


def test_a_precomputed_response_gives_the_same_press(pad):
    ball, response = jnp.float32(SHAPES["ball"]), pad_response(pad)
    given = jax.jit(lambda pad, height, response: press_to_stop(pad, height, LIMITS, response=response))
    end, wanted = given(pad, ball, response), stop(pad, ball, 0.0)
    np.testing.assert_allclose(end.reading, wanted.reading, rtol=1e-4, atol=1e-3)
    np.testing.assert_allclose(end.pressure, press(pad, ball, end.indentation).pressure, atol=1e-3 * end.pressure.max())


def test_friction_of_a_known_press_is_that_of_the_press(pad):
    ball, slide = jnp.float32(SHAPES["ball"]), jnp.asarray([1e-5, -2e-5])
    pressed = press(pad, ball, 2e-4)
    assert isinstance(pressed, Press)
    known = friction_response(pad, ball, 2e-4, slide, pressed=pressed)
    np.testing.assert_allclose(known, friction_response(pad, ball, 2e-4, slide), atol=1e-3)


def test_a_power_law_between_loads_and_beyond_them_stops_where_it_crosses():
    rng = np.random.default_rng(6)
    n = 60
    power, goal = rng.uniform(0.3, 1.3, (2, n)), rng.uniform(0.05, 7, n)
    direction = rng.normal(size=(n, 15))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)

    def growth(load: np.ndarray) -> np.ndarray:
        """Logarithm of the size, with one power below the middle load and another above."""
        bend = np.log(load / LOADS[1])
        return power[0] * np.minimum(bend, 0) + power[1] * np.maximum(bend, 0)

    size = LIMITS.skin_change * np.exp(growth(LOADS[:, None]) - growth(goal))
    reading = direction[:, None] * size.T[..., None]
    ends = jax.jit(jax.vmap(partial(stop_load, skin_change=LIMITS.skin_change, force=6.0), (0, None)))
    found = ends(jnp.float32(reading), jnp.float32(LOADS))
    # Logarithms in float32, over a power of at least 0.3.
    np.testing.assert_allclose(found, np.clip(goal, LOADS[0] / 10, 6.0), rtol=1e-5)
    nothing = ends(jnp.zeros((n, 3, 15)), jnp.float32(LOADS))
    np.testing.assert_array_equal(nothing, 6)
    huge = ends(jnp.float32(1e6 * reading), jnp.float32(LOADS))
    np.testing.assert_allclose(huge, LOADS[0] / 10, rtol=1e-6)


def test_the_load_between_readings_at_three_loads_is_that_of_the_search_within_two_per_cent(pad):
    for name in ("ball", "waves", "edge", "tilted face"):
        height = jnp.float32(SHAPES[name])
        readings = jnp.stack([press_force(pad, height, load).reading for load in LOADS])
        load = stop_load(readings, jnp.float32(LOADS), skin_change=LIMITS.skin_change, force=LIMITS.force)
        np.testing.assert_allclose(load, stop(pad, height, 0.0).force, rtol=0.02)
