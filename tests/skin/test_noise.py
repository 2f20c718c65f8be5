"""The sensor's noise: its sizes within the sampling error of a variance, and its structure exactly."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from i2t.skin import noise
from i2t.skin.boards import reskin_board
from i2t.skin.noise import Noise

BOARD = reskin_board()
N = 4000


def _within(variance: np.ndarray, expected: np.ndarray, count: int) -> None:
    """Check that sample variances are within the chi-square bounds of 15 normal numbers with p = 1e-6."""
    low, high = stats.chi2.ppf([1e-6 / 30, 1 - 1e-6 / 30], count - 1) / (count - 1)
    assert np.all(variance > low * expected)
    assert np.all(variance < high * expected)


def _bursts(samples: int, kind: Noise) -> np.ndarray:
    keys = jax.random.split(jax.random.key(0), N)
    return np.asarray(jax.jit(jax.vmap(lambda key: noise.sample_burst(key, jnp.zeros(15), BOARD, kind, samples)))(keys))


def test_a_sample_at_rest_has_the_measured_size_and_partly_a_field_common_to_all_chips():
    samples, kind = _bursts(1, Noise())[:, 0], Noise()
    # Rounding to steps q adds q^2 / 12, a uniform error (Sheppard), since the noise spans many steps.
    variance = kind.sigma(5) ** 2 + kind.steps(5) ** 2 / 12
    _within(samples.var(axis=0, ddof=1), variance, N)
    chips = np.asarray(BOARD.to_tool(samples))  # (N, 5, 3) in common axes
    for axis, sigma in enumerate((3.1, 3.1, 4.6)):
        correlation = np.corrcoef(chips[:, :, axis].T)[np.triu_indices(5, 1)]
        # The error of a correlation of N samples is (1 - r^2) / sqrt(N); ten of them stay within 5 such errors.
        np.testing.assert_allclose(correlation, kind.common * sigma**2 / variance[axis], atol=5 / np.sqrt(N))
        assert 0.20 < correlation.mean() < 0.33  # of real boards
    tool = np.asarray(BOARD.to_tool(noise.ambient(jax.random.key(3), BOARD, kind)))
    np.testing.assert_allclose(tool, np.broadcast_to(tool[0], (5, 3)), rtol=1e-6)  # one vector for every chip
    assert np.all(np.abs(tool[0]) > 0)


@pytest.mark.full
def test_averaging_removes_only_white_noise():
    kind = Noise(contact_samples=40)
    keys = jax.random.split(jax.random.key(1), N)
    seen = np.asarray(jax.jit(jax.vmap(lambda key: noise.add_sensor_noise(key, jnp.zeros(15), BOARD, kind)))(keys))
    white = (1 - kind.common) * kind.sigma(5) ** 2 + kind.steps(5) ** 2 / 12
    _within(seen.var(axis=0, ddof=1), 2 * kind.common * kind.sigma(5) ** 2 + white * (1 / 40 + 1 / 10), N)
    np.testing.assert_allclose(seen.mean(axis=0), 0, atol=5 * seen.std() / np.sqrt(N))


def test_samples_are_whole_steps_and_an_ideal_sensor_reports_the_field():
    for shape in ((15,), (4, 15)):
        values = np.random.default_rng(0).normal(size=shape) * 50
        rounded = noise.quantise(jnp.asarray(values, jnp.float32), Noise())
        steps = np.asarray(rounded) / Noise().steps(5)
        np.testing.assert_allclose(steps, np.round(steps), atol=1e-3)  # float32 of a few hundred steps
        assert np.all(np.abs(rounded - values) <= Noise().steps(5) / 2 * (1 + 1e-3))
    ideal = noise.add_sensor_noise(jax.random.key(0), jnp.asarray(values[0], jnp.float32), BOARD, Noise.none())
    np.testing.assert_allclose(ideal, values[0], rtol=1e-6)
