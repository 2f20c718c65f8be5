"""What the experiment on simulated pads presses."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.calibrate_pads import population, simulate
from i2t.calibration import Presses
from i2t.calibration.structured_gp import fit, predict
from i2t.prediction.metrics import score
from i2t.skin import boards


@pytest.mark.full
def test_pads_are_pressed_as_stated():
    pads, presses, readings = simulate.press_pads(jax.random.key(0), 2, 6)
    assert readings.shape == (2, 6, 15)
    assert pads.magnetization.shape[0] == 2
    assert np.isfinite(readings).all()
    assert np.abs(presses.position).max() < simulate.HALF_EDGE_M
    assert (presses.load > 0.2).all()
    assert (presses.load < 1).all()


def test_the_search_climbs_to_the_top():
    top = dict.fromkeys(population.SEARCHED, 3.0) | {"far_amplitude": 1.0}

    def hill(hyper):
        return -sum(
            float(np.log(getattr(hyper, name) / getattr(population.GUESS, name) / top[name]) ** 2)
            for name in population.SEARCHED
        )

    found = population.search(hill, population.GUESS)
    for name in population.SEARCHED:
        # 3 lies between powers of the factors; what is found is off by less than half of the smallest factor.
        far = getattr(found, name) / getattr(population.GUESS, name) / top[name]
        assert abs(np.log(far)) <= np.log(population.STEP_FACTORS[-1]) / 2 + 1e-9


@pytest.mark.full
def test_scores_of_a_population_are_those_of_single_skins():
    position, load = jax.random.split(jax.random.key(1))
    presses = Presses(
        jax.random.uniform(position, (2, 30, 2), minval=-8e-3, maxval=8e-3), jax.random.uniform(load, (2, 30))
    )
    readings = 1e5 * presses.position[:, :, :1] * presses.load[..., None] * jnp.arange(1.0, 16)[None, None]
    found = population.structured_r2(population.GUESS, presses, readings, (5, 20), 10)
    assert found.shape == (2, 2)
    one = Presses(presses.position[1], presses.load[1])
    known, test = (jax.tree.map(lambda a, rows=rows: a[rows], one) for rows in (slice(20), slice(20, None)))
    chips = jnp.float32(boards.reskin_board().chips[:, :2])
    mean = predict(fit(population.GUESS, known, readings[1, :20], chips), test)[0]
    np.testing.assert_allclose(found[1, 1], score(np.asarray(readings[1, 20:]), np.asarray(mean)).r2, rtol=1e-3)


def test_a_run_adds_the_faults_of_a_board_in_order():
    readings = jnp.full((2, 30, 15), 50.0)
    found = np.asarray(simulate.add_faults(jax.random.key(2), readings)) / 50
    # Warming by up to 11.2 K weakens magnets by 0.12 % a kelvin; softening adds a tenth, one chip keeps 0.3, creep 1 %.
    assert found.min() >= 1 - 1.2e-3 * 11.2
    assert found.max() <= 1.1 * 1.3 / (1 - 0.2 * 0.05)
    remembers = (found[:, -1] > 1.25).reshape(2, 5, 3)
    np.testing.assert_array_equal(remembers.all(2).sum(1), [1, 1])
    np.testing.assert_array_equal(remembers.any(2).sum(1), [1, 1])
    assert not np.array_equal(found[0], found[1])
