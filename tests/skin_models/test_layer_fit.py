"""The fit of a layer by evidence, on features that are cheap to make."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from scipy import stats

from i2t.skin_models import layer_fit
from i2t.skin_models.layer_fit import UnitFeatures, _LinearModel, fit_layer
from i2t.skin_models.magnetic_layer import SHAPE_PARAMETERS, layer_prior, parameters_at

PRESSES, CHANNELS, WEIGHTS = 30, 6, 12
PRIOR = layer_prior(CHANNELS)
START, UNRAVEL = ravel_pytree(jax.tree.map(jnp.zeros_like, PRIOR.median))
INDEX = jax.tree.map(lambda at: np.asarray(at, int), UNRAVEL(jnp.arange(len(START), dtype=jnp.float32)))
SHAPE = np.concatenate([getattr(INDEX, name).ravel() for name in SHAPE_PARAMETERS])
STRENGTH = float(PRIOR.median.patch_strength[0])


class World:
    """Presses whose unit features are a quadratic function of the coordinates, and the layer that was pressed."""

    def __init__(self, seed, *, bend=0.05, gap=None):
        rng = np.random.default_rng(seed)
        self.value = 10 / STRENGTH * rng.normal(size=(PRESSES, CHANNELS, WEIGHTS))
        self.slope = 0.2 * 10 / STRENGTH * rng.normal(size=(len(SHAPE), PRESSES, CHANNELS, WEIGHTS))
        self.bend = bend
        self.true = rng.normal(size=len(START))
        if gap is not None:
            self.true[INDEX.gap] = gap
        layer = parameters_at(UNRAVEL(jnp.float32(self.true)), PRIOR)
        strength = np.append(np.repeat(layer.patch_strength, (WEIGHTS - 3) // 3), np.full(3, layer.uniform_strength))
        phi = self.features(self.true[SHAPE]) * np.asarray(layer.gains)[:, None] * strength
        self.readings = phi @ rng.normal(size=WEIGHTS) + float(layer.noise_std) * rng.normal(size=(PRESSES, CHANNELS))

    def features(self, x):
        return self.value + np.tensordot(x + self.bend * x**2, self.slope, 1)

    def linearized(self, coordinates):
        x = np.asarray(ravel_pytree(coordinates)[0])[SHAPE]
        slope = (1 + 2 * self.bend * x)[:, None, None, None] * self.slope
        return jnp.asarray(self.features(x)), jnp.asarray(slope)

    def fit(self):
        return fit_layer(lambda at: self.linearized(at)[0], self.readings, PRIOR)


def model_at(world, x):
    features = UnitFeatures(*(np.float64(part) for part in world.linearized(UNRAVEL(jnp.float32(x)))))
    return _LinearModel(x, features, world.readings, PRIOR)


def test_the_objective_is_evidence_times_prior_and_its_gradient_is_exact():
    world, rng = World(0), np.random.default_rng(1)
    model, x = model_at(world, np.zeros(len(START))), 0.3 * rng.normal(size=len(START))
    layer = parameters_at(UNRAVEL(jnp.float32(x)), PRIOR)
    strength = np.append(np.repeat(layer.patch_strength, (WEIGHTS - 3) // 3), np.full(3, layer.uniform_strength))
    unit = world.value + np.tensordot(x[SHAPE], world.slope, 1)
    phi = (unit * np.asarray(layer.gains)[:, None] * strength).reshape(-1, WEIGHTS)
    covariance = phi @ phi.T + float(layer.noise_std) ** 2 * np.eye(len(phi))
    wanted = -stats.multivariate_normal(np.zeros(len(phi)), covariance).logpdf(world.readings.ravel()) + 0.5 * x @ x
    value, gradient = model.value_and_gradient(x)
    np.testing.assert_allclose(value + 0.5 * world.readings.size * np.log(2 * np.pi), wanted, rtol=1e-5)
    step = 1e-5
    for number, way in enumerate(step * np.eye(len(x))):
        change = model.value_and_gradient(x + way)[0] - model.value_and_gradient(x - way)[0]
        np.testing.assert_allclose(gradient[number], change / (2 * step), rtol=1e-4, atol=1e-3)


def test_a_layer_is_recovered_and_its_ranges_have_the_stated_coverage():
    inside = []
    for seed in range(12):
        world = World(seed)
        posterior = world.fit()
        assert posterior.converged
        truth = parameters_at(UNRAVEL(jnp.float32(world.true)), PRIOR)
        low, high, value = (np.asarray(ravel_pytree(part)[0]) for part in (posterior.low, posterior.high, truth))
        inside.append((low <= value) & (value <= high))
    assert 0.9 < np.mean(inside) < 0.99


def test_implausible_parameters_and_an_unfinished_search_are_reported(monkeypatch):
    with pytest.warns(UserWarning, match="the fitted .*gap.* standard deviations from the prior's median"):
        World(3, gap=6.0).fit()
    monkeypatch.setattr(layer_fit, "_LAYER_SEARCH", layer_fit.LayerSearch(max_steps=1))
    with pytest.warns(UserWarning, match="did not converge"):
        assert not World(4).fit().converged


def test_a_search_whose_steps_all_fail_has_not_converged():
    world = World(4)

    def broken(at):
        """Return finite features at the start and where its slopes are computed, and nowhere else."""
        x = np.abs(np.asarray(ravel_pytree(at)[0]))
        alone = np.isclose(x, layer_fit._LAYER_SEARCH.slope_step).sum() == 1 and np.count_nonzero(x) == 1
        return (1.0 if alone or not x.any() else np.nan) * world.linearized(at)[0]

    with pytest.warns(UserWarning, match="did not converge"):
        assert not fit_layer(broken, world.readings, PRIOR).converged


def test_presses_that_are_not_finite_are_left_out_with_a_warning():
    world = World(5)
    whole = world.fit()
    world.slope[4, 7] = np.nan
    with pytest.warns(UserWarning, match=r"1 of 30 presses are left out .* row 7"):
        without = world.fit()
    std = (whole.high.thickness - whole.low.thickness) / 3.92
    assert abs(without.layer.thickness - whole.layer.thickness) < 2 * std
    world.value[:] = np.nan
    with pytest.raises(ValueError, match="no pad explains these presses"):
        world.fit()


@pytest.mark.filterwarnings("ignore:.*encountered:RuntimeWarning")
def test_impossible_readings_are_refused():
    world = World(6)
    world.readings = 1e200 * world.readings
    with pytest.raises(ValueError, match="no pad explains these presses"):
        world.fit()


def test_the_range_of_a_compliance_that_may_be_zero_begins_at_zero():
    coordinates = jax.tree.map(jnp.zeros_like, PRIOR.median)
    at = partial(parameters_at, prior=PRIOR)
    root = -1 / PRIOR.std.mount_compliance
    assert at(coordinates._replace(mount_compliance=root)).mount_compliance == pytest.approx(0, abs=1e-12)
    ends = [float(at(coordinates._replace(mount_compliance=jnp.asarray(x))).mount_compliance) for x in (-0.5, 0.5, 2.0)]
    assert ends == sorted(ends)
