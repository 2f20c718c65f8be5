"""Local heights of a skin against random draws."""

import numpy as np
import pytest

from i2t.skin_models.tip_gp.heights import Heights, SlopedErrors, height_inverses, heights_at, hypothesis_shares

CHANNELS = 15


def drawn() -> tuple[np.ndarray, np.ndarray, np.random.Generator]:
    """Draw the positions of 80 presses and a smooth height at each."""
    rng, x = np.random.default_rng(39), np.random.default_rng(40).uniform(-8e-3, 8e-3, (80, 2))
    square = ((x[:, None] - x) ** 2).sum(-1)
    return x, np.linalg.cholesky(0.06**2 * np.exp(-square / 2 / 4e-3**2) + 1e-8 * np.eye(80)) @ rng.normal(size=80), rng


@pytest.mark.parametrize("smooth", [True, False])
def test_heights_get_weight_if_those_of_neighbours_predict_a_held_out_height(smooth):
    x, height, rng = drawn()
    height = height if smooth else rng.permutation(height)
    slope = np.full((80, CHANNELS), 30.0)
    tried = Heights(np.array([0.06]), np.array([4e-3]), np.ones(1), height, np.full(80, 5e-3**2))
    error = slope * height[:, None] + rng.normal(size=(80, CHANNELS))
    share = hypothesis_shares(tried, x, SlopedErrors(error, np.ones_like(error), slope, np.zeros(80)))
    assert share[0] > 0.99 if smooth else share[0] < 0.01


def test_heights_elsewhere_are_interpolated_near_presses_and_unknown_far_away():
    x, height, _ = drawn()
    heights = Heights(np.array([0.06]), np.array([4e-3]), np.ones(1), height, np.full(80, 5e-3**2))
    inverses = height_inverses(heights, x)
    mean, variance = heights_at(heights, ((x[:, None] - x) ** 2).sum(-1), inverses)
    assert np.sqrt(np.mean((mean - height) ** 2)) < 6e-3
    assert (variance < 5e-3**2).all()
    far, far_variance = heights_at(heights, np.ones((1, 80)), inverses)
    np.testing.assert_allclose((far, far_variance), ([0], [0.06**2]), atol=1e-12)
