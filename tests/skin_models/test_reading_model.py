"""The reading model against the equivalent dense Gaussian process, and against presses of a pad."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2t.contact.pressure import ContactPressure
from i2t.skin.boards import reskin_board
from i2t.skin.dipoles import response
from i2t.skin.elasticity import CELL_GRID
from i2t.skin_models import magnetic_layer as physics
from i2t.skin_models import pressure_gp as gp
from i2t.skin_models import reading_model
from i2t.skin_models.layer import NOMINAL_LAYER, Layer
from i2t.skin_models.reading_model import PressedTouches

CELLS, CHANNELS, WEIGHTS = CELL_GRID.cells, 3, 4
AT = reading_model._Hyperparameters(a=0.7, r=0.4, v=0.2)
LOADS = (0.5, 2.0)
DISCREPANCY = reading_model.DISCREPANCY._replace(weights=jnp.float32([0.1, 0.3, 0.2, 0.3, 0.1]), bend=jnp.float32(0.7))


def spots(seed: int, load: np.ndarray) -> ContactPressure:
    """Make round contacts at random places."""
    rng, x = np.random.default_rng(seed), np.arange(CELLS)
    place = rng.uniform(2, CELLS - 3, (len(load), 2, 1))
    along = np.exp(-((x - place) ** 2) / (2 * rng.uniform(1, 2, (len(load), 1, 1)) ** 2))
    pressure = along[:, 0, :, None] * along[:, 1, None, :]
    pressure *= load[:, None, None] / pressure.sum((1, 2), keepdims=True)
    return ContactPressure(jnp.float32(pressure), jnp.float32(load))


@pytest.fixture
def touches() -> PressedTouches:
    """Touches with arbitrary readings."""
    rng = np.random.default_rng(1)
    reading = rng.normal(size=(9, CHANNELS)) * [5.0, 20.0, 10.0]
    return PressedTouches(spots(2, rng.uniform(0.4, 2.5, 9)), reading)


@pytest.fixture
def maps() -> np.ndarray:
    """Smooth maps of a few weights (uT/N)."""
    rng, x = np.random.default_rng(3), np.arange(CELLS)
    wave = np.cos(np.outer(x, np.arange(1, 4)) * np.pi / CELLS)
    return 20 * np.einsum("xi,yj,ijck->xyck", wave, wave, rng.normal(size=(3, 3, CHANNELS, WEIGHTS))).reshape(
        CELLS**2, CHANNELS, WEIGHTS
    )


def dense(touches: PressedTouches, maps: np.ndarray, scale: np.ndarray, at: ContactPressure) -> tuple:
    """Predict mean and variance (m, c) of other presses, in units of the scales, from one matrix of all presses."""
    n, m = len(touches.reading), len(at.load)
    both = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), touches.pressure, at)
    f = gp.features(both)
    linear = gp.inner_products(f, f)
    unit = jnp.mean(jnp.diagonal(linear[:, :n, :n], axis1=1, axis2=2), axis=1)
    k = np.asarray(gp.gram(DISCREPANCY, unit, linear, both.load, both.load), np.float64)
    phi = np.einsum("nx,xck->nck", np.asarray(both.pressure, np.float64).reshape(n + m, -1), maps) / scale[:, None]
    rows = phi.reshape(-1, maps.shape[-1])
    covariance = AT.a**2 * rows @ rows.T + AT.r * np.kron(k, np.eye(CHANNELS))
    fitted = np.arange(n * CHANNELS)
    new = np.arange(n * CHANNELS, len(covariance))
    precision = np.linalg.inv(covariance[np.ix_(fitted, fitted)] + AT.v * np.eye(len(fitted)))
    cross = covariance[np.ix_(new, fitted)]
    mean = cross @ precision @ (touches.reading / scale).reshape(-1)
    variance = np.diag(covariance)[new] - np.einsum("ij,jk,ik->i", cross, precision, cross)
    return mean.reshape(m, CHANNELS), variance.reshape(m, CHANNELS)


def test_maps_and_leave_one_out_errors_agree_with_the_dense_gaussian_process(touches, maps):
    system = reading_model._system(touches, maps, DISCREPANCY)
    weighted = reading_model._weigh(system, AT.r, AT.v)
    posterior = reading_model._posterior(weighted, AT.a)
    models = reading_model._Models(AT.r, weighted.precision, [posterior])
    mean, variance = reading_model._linear_maps(touches.pressure, system, maps, [models], np.ones(1), LOADS)
    root = reading_model._roots(variance)
    for i, load in enumerate(LOADS):
        new = spots(5, np.full(6, load))
        newtons = np.asarray(new.pressure, np.float64).reshape(6, -1)
        wanted, wanted_variance = dense(touches, maps, system.scale, new)
        np.testing.assert_allclose(newtons @ mean[i], wanted, atol=1e-4 * np.abs(wanted).max())
        got = np.sum((newtons @ root[i]) ** 2, axis=1)
        np.testing.assert_allclose(got, wanted_variance.mean(1), rtol=2e-3)
    # One touch is left out; scale and unit are those of all touches.
    errors, density = reading_model._leave_one_out(system, weighted, posterior)
    assert reading_model._densities(system, AT.r, AT.v, [3.0, AT.a])[1] == density  # amplitudes do not interact
    assert density > reading_model._densities(system, AT.r, 1e3, [AT.a])[0]  # a model of nearly all noise explains less
    full = np.linalg.inv(_covariance(touches, maps, system.scale))
    t = 4 * CHANNELS + np.arange(CHANNELS)
    wanted = np.linalg.solve(full[np.ix_(t, t)], (full @ (touches.reading / system.scale).reshape(-1))[t])
    np.testing.assert_allclose(errors[4], wanted, rtol=1e-4, atol=1e-4)


def _covariance(touches: PressedTouches, maps: np.ndarray, scale: np.ndarray) -> np.ndarray:
    f = gp.features(touches.pressure)
    linear = gp.inner_products(f, f)
    load = touches.pressure.load
    unit = jnp.mean(jnp.diagonal(linear, axis1=1, axis2=2), axis=1)
    k = np.asarray(gp.gram(DISCREPANCY, unit, linear, load, load), np.float64)
    newtons = np.asarray(touches.pressure.pressure, np.float64).reshape(len(load), -1)
    rows = (np.einsum("nx,xck->nck", newtons, maps) / scale[:, None]).reshape(-1, maps.shape[-1])
    noise = AT.v * np.eye(len(rows))
    return AT.a**2 * rows @ rows.T + AT.r * np.kron(k, np.eye(CHANNELS)) + noise


@pytest.mark.parametrize(("r", "together"), [(0.02, {AT.r: [AT.a], 0.02: [3.0]}), (AT.r, {AT.r: [AT.a, 3.0]})])
def test_the_mixtures_variance_includes_its_models_disagreement(touches, maps, r, together):
    system = reading_model._system(touches, maps, DISCREPANCY)

    def parts(models: dict[float, list[float]], shares: list[float]) -> tuple[np.ndarray, np.ndarray]:
        """Compute mean and variance of models, given as amplitudes by r."""
        groups = []
        for r, amplitudes in models.items():
            weighted = reading_model._weigh(system, r, AT.v)
            posteriors = [reading_model._posterior(weighted, a) for a in amplitudes]
            groups.append(reading_model._Models(r, weighted.precision, posteriors))
        mean, variance = reading_model._linear_maps(touches.pressure, system, maps, groups, np.array(shares), (1.0,))
        return mean[0], variance[0]

    (first, var_first), (other, var_other) = parts({AT.r: [AT.a]}, [1.0]), parts({r: [3.0]}, [1.0])
    both, var_both = parts(together, [0.25, 0.75])
    np.testing.assert_allclose(both, 0.25 * first + 0.75 * other, atol=1e-9 * np.abs(both).max())
    apart = 0.25 * 0.75 * np.einsum("xc,yc->xy", first - other, first - other) / CHANNELS
    wanted = 0.25 * var_first + 0.75 * var_other + apart
    np.testing.assert_allclose(var_both, wanted, atol=1e-9 * np.abs(wanted).max())


def test_magnetization_maps_agree_with_the_readings_of_such_a_pad():
    board = reskin_board()
    layer = physics.layer_prior(board.num_readings).median
    upright = jnp.zeros((physics.MAP_CELLS, physics.MAP_CELLS, 3)).at[..., 2].set(layer.uniform_strength)
    pad = physics.make_pad(layer._replace(mount_compliance=jnp.asarray(0.0)), board, upright)
    newtons = spots(7, np.array([0.03])).pressure[0]
    wanted = response(pad, newtons / CELL_GRID.spacing**2, CELL_GRID)
    reading = np.asarray(newtons).reshape(-1) @ reading_model.magnetization_maps(board, NOMINAL_LAYER)[..., -1]
    np.testing.assert_allclose(reading, wanted, atol=0.05 * np.abs(wanted).max())


def test_the_layer_whose_pressures_explain_the_readings_is_chosen(monkeypatch, maps):
    monkeypatch.setattr(reading_model, "magnetization_maps", lambda board, layer: maps)
    rng = np.random.default_rng(11)
    pressures = [spots(seed, rng.uniform(0.4, 2.5, 40)) for seed in (20, 21, 22)]
    for true in range(3):
        newtons = np.asarray(pressures[true].pressure, np.float64).reshape(40, -1)
        readings = np.einsum("nx,xck,k->nc", newtons, maps, [1.0, -0.5, 0.3, 0.8])
        pressed = [PressedTouches(pressure, readings) for pressure in pressures]
        assert reading_model.choose_layer(pressed, [Layer()] * 3, reskin_board()) == true
