import numpy as np
import pytest

from i2t.recordings.diagnose.smooth import leave_one_out, smooth_r2


def drawn() -> tuple[np.ndarray, np.ndarray]:
    """Labels in their standard deviations, and values of mean zero."""
    rng = np.random.default_rng(0)
    labels, values = rng.normal(size=(12, 2)), rng.normal(size=(12, 3))
    return labels / labels.std(0), values + np.sin(labels[:, :1]) - (values + np.sin(labels[:, :1])).mean(0)


def covariance(labels: np.ndarray, length: float, noise: float) -> np.ndarray:
    square = ((labels[:, None] - labels) ** 2).sum(-1)
    return np.exp(-square / (2 * length**2)) + noise * np.eye(len(labels))


def refitted(K: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Errors of each row, predicted by a fit to all others."""
    errors = []
    for i in range(len(K)):
        rest = np.delete(np.arange(len(K)), i)
        errors.append(values[i] - K[i, rest] @ np.linalg.solve(K[np.ix_(rest, rest)], values[rest]))
    return np.array(errors)


def test_leave_one_out_errors_match_refits():
    labels, values = drawn()
    K = covariance(labels, 0.7, 0.03)
    np.testing.assert_allclose(leave_one_out(K, values).error, refitted(K, values), rtol=1e-8, atol=1e-10)


def test_r2_is_that_of_the_best_refit():
    labels, values = drawn()
    lengths, noises = (0.5, 2.0), (0.01, 0.3)
    missed = [
        np.sum(refitted(covariance(labels, length, noise), values) ** 2) for length in lengths for noise in noises
    ]
    assert smooth_r2(labels, values, lengths=lengths, noises=noises) == pytest.approx(
        1 - min(missed) / np.sum(values**2), abs=1e-9
    )
