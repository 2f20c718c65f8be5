"""Positions from readings: on generated linear skins exactly as Bayes says, on simulated pads by the experiment."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from i2t.calibration import localize
from i2t.calibration.localize import PressLibrary, WeightPosterior

EDGE = np.linspace(-5e-3, 5e-3, 11)
POSITIONS = np.stack(np.meshgrid(EDGE, EDGE), axis=-1).reshape(-1, 2)
K = 20


def _library(channels: int = 15) -> PressLibrary:
    """A generated skin: every weight is a bump that some channels feel, more or less, as the tip comes near it."""
    random = np.random.default_rng(0)
    centres = random.uniform(-6e-3, 6e-3, (K, 2))
    near = np.exp(-0.5 * np.sum((POSITIONS[:, None] - centres[None]) ** 2, axis=-1) / 2.5e-3**2)
    phi = near[:, None, :] * random.normal(size=(1, channels, K)) * 20
    return PressLibrary(jnp.asarray(POSITIONS, jnp.float32), jnp.ones(len(POSITIONS)), jnp.asarray(phi, jnp.float32))


def _presses(library: PressLibrary, n: int, noise: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Which press, its reading, and the true weights."""
    random = np.random.default_rng(1)
    weights = random.normal(size=K)
    rows = random.integers(len(POSITIONS), size=n)
    clean = np.asarray(library.features)[rows] @ weights
    return rows, clean + noise * random.normal(size=clean.shape), weights


def test_likelihood_is_the_normal_density():
    channels = 48
    library = _library(channels=channels)
    _, readings, _ = _presses(library, 5, 2.0)
    random = np.random.default_rng(4)
    root = np.tril(random.normal(size=(K, K))) + 3 * np.eye(K)
    weights = WeightPosterior(
        jnp.asarray(random.normal(size=K), jnp.float32), jnp.asarray(root, jnp.float32), jnp.asarray(2.0)
    )
    found = localize.log_likelihood(library, weights, jnp.asarray(readings, jnp.float32))
    phi = np.asarray(library.features, float)
    for m in (0, 17, 120):  # of 121: the last batch is padded
        covariance = phi[m] @ np.linalg.inv(root @ root.T) @ phi[m].T + 4 * np.eye(channels)
        normal = stats.multivariate_normal(phi[m] @ np.asarray(weights.mean, float), covariance)
        expected = normal.logpdf(readings) + channels / 2 * np.log(2 * np.pi)
        np.testing.assert_allclose(found[:, m], expected, rtol=1e-3, atol=0.05)


def test_a_known_skin_tells_the_place_and_how_sure_it_is():
    library = _library()
    rows, readings, truth = _presses(library, 300, 4.0)
    weights = WeightPosterior(jnp.asarray(truth, jnp.float32), 1e4 * jnp.eye(K), jnp.asarray(4.0))
    positions, sure = localize.localize(library, weights, jnp.asarray(readings, jnp.float32), radius=1.01e-3)
    right = np.linalg.norm(np.asarray(positions) - POSITIONS[rows], axis=1) <= 1.01e-3
    assert right.mean() > 0.8
    # Where its probability is 1, it is right; on average it is right as often as it says.
    assert abs(right.mean() - np.mean(sure)) < 3 * np.sqrt(0.25 / 300)


@pytest.mark.full
def test_a_skin_is_fitted_to_readings_without_positions():
    """Better than nothing by far, and nearly as good as the skin itself."""
    library = _library()
    rows, readings, truth = _presses(library, 400, 2.0)
    seen = jnp.asarray(readings, jnp.float32)

    def right(weights: WeightPosterior) -> float:
        positions, _ = localize.localize(library, weights, seen[300:], radius=1.01e-3)
        return float(np.mean(np.linalg.norm(np.asarray(positions) - POSITIONS[rows[300:]], axis=1) <= 1.01e-3))

    none = right(localize.pad_prior_weights(library, 2.0))
    fitted = right(localize.fit_weights_without_positions(library, seen[:300], 2.0))
    known = right(WeightPosterior(jnp.asarray(truth, jnp.float32), 1e4 * jnp.eye(K), jnp.asarray(2.0)))
    assert fitted > none + 0.15
    assert fitted > known - 0.1
