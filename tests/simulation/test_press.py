"""Where a press ends, against a sweep over all indentations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2t.simulation.press import PressLimits, press_to_stop
from i2t.skin.contact import GRID
from i2t.skin.pad import press, sample_pad
from i2t.types import Pad, ReturnCode

LIMITS = PressLimits()
WITHIN = 1e-3  # what PressLimits.refine promises
X, Y = np.meshgrid(GRID.centres, GRID.centres)


@pytest.fixture(scope="module")
def pad() -> Pad:
    return sample_pad(jax.random.key(3))


@pytest.fixture(scope="module")
def stop():
    return jax.jit(lambda pad, height, overshoot: press_to_stop(pad, height, LIMITS, overshoot))


@pytest.fixture(scope="module")
def sweep():
    """Skin change (uT) and force (N) at 120 indentations (m), and these."""

    def run(pad: Pad, height: jax.Array):
        depths = LIMITS.indentation * pad.thickness * jnp.geomspace(0.003, 1, 120)
        pressed = jax.lax.map(lambda depth: press(pad, height, depth), depths)
        return jnp.linalg.norm(pressed.reading, axis=1), pressed.force, depths

    return jax.jit(run)


def shapes() -> dict[str, np.ndarray]:
    bumps = np.random.default_rng(0).normal(size=(6, 6))
    waves = sum(
        bumps[i, j] * np.cos(np.pi * i * X / 20e-3 + i) * np.cos(np.pi * j * Y / 20e-3 - j)
        for i in range(6)
        for j in range(6)
    )
    return {
        "ball": (X**2 + Y**2) / 20e-3,
        "waves": 0.2e-3 * (waves - waves.min()),
        "edge": 0.5 * np.abs(X - 3e-3),
        "tilted face": 0.01 * (X + 10e-3),
        "flat face": 0 * X,
        "two tips": np.minimum(np.hypot(X - 6e-3, Y), np.hypot(X + 6e-3, Y) + 0.3e-3),
    }


@pytest.mark.full
@pytest.mark.parametrize("name", shapes())
def test_it_ends_at_the_first_crossing(name, pad, stop, sweep):
    height = jnp.float32(shapes()[name])
    end = stop(pad, height, 0.0)
    skin, force, depths = (np.asarray(values) for values in sweep(pad, height))
    excess = np.maximum(skin / LIMITS.skin_change, force / LIMITS.force)
    first = np.argmax(excess >= 1)
    assert first > 0
    assert excess[first] >= 1
    # Between the last indentation below the limit and the first above it, or as near to one as the promise allows.
    assert excess[first - 1] < 1
    reached = max(np.linalg.norm(end.reading) / LIMITS.skin_change, end.force / LIMITS.force)
    assert abs(reached - 1) < WITHIN
    assert depths[first - 1] * (1 - WITHIN) < end.indentation < depths[first] * (1 + WITHIN)
    assert end.code == ReturnCode.SKIN


@pytest.mark.parametrize("name", [name for name in shapes() if name != "two tips"])  # which never reach 8 N
def test_a_dull_skin_ends_by_force(name, pad, stop):
    # Bonded, so that it does not sink away: 8 N long before the deepest.
    dull = pad._replace(magnetization=1e-3 * pad.magnetization, young=6 * pad.young, mount_compliance=jnp.zeros(()))
    end = stop(dull, jnp.float32(shapes()[name]), 0.0)
    assert end.code == ReturnCode.WRENCH
    assert abs(end.force / LIMITS.force - 1) < WITHIN


def test_a_skin_that_feels_nothing_ends_at_the_deepest(pad, stop):
    soft = pad._replace(magnetization=0 * pad.magnetization, young=jnp.float32(1.0))
    end = stop(soft, jnp.float32(shapes()["ball"]), 0.0)
    assert end.code == ReturnCode.UNDEFINED
    # A logarithm and its exponential lose a few roundings.
    np.testing.assert_allclose(end.indentation, LIMITS.indentation * pad.thickness, rtol=1e-5)


def test_an_overshoot_raises_the_limit(pad, stop):
    end = stop(pad, jnp.float32(shapes()["ball"]), 0.2)
    assert abs(np.linalg.norm(end.reading) / (1.2 * LIMITS.skin_change) - 1) < WITHIN
