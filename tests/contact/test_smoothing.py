"""Local planes and continued edges, against planes, statistics of white noise and steps."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2t.contact.smoothing import fill, local_planes

N, RADIUS, SIGMA = 40, 5, 2.2
OFFSETS = np.arange(-RADIUS, RADIUS + 1)
ROW, COLUMN = np.meshgrid(np.arange(N), np.arange(N), indexing="ij")
smooth = jax.jit(local_planes)


def plane(down: float, right: float) -> np.ndarray:
    return (1e-3 + down * ROW + right * COLUMN).astype(np.float32)


def test_a_plane_stays_unchanged():
    seen = plane(-2e-4, 1.5e-4)
    inside = slice(RADIUS, N - RADIUS)
    # Weights are symmetric there, so the value is a mean: wrong by the rounding of sums of 121 heights below 17 mm.
    rounding = 121 * np.finfo(np.float32).eps * np.abs(seen).max()
    np.testing.assert_allclose(smooth(seen)[inside, inside], seen[inside, inside], atol=rounding)


@pytest.mark.full
def test_noise_is_averaged_over_the_effective_number_of_pixels():
    noise = 1e-5  # m, a fiftieth of the narrowest edge: agreement weights are 1 within 0.1 %
    images = noise * jax.random.normal(jax.random.key(0), (100, N, N))
    centres = np.arange(RADIUS, N - RADIUS, 2 * RADIUS + 1)  # windows that share no pixel
    values = np.asarray(jax.jit(jax.vmap(local_planes))(images))[:, centres[:, None], centres]
    weights = np.exp(-(OFFSETS**2) / (2 * SIGMA**2))
    effective = (weights.sum() ** 2 / (weights**2).sum()) ** 2
    assert effective > 50
    # The variance of m independent normal values scatters by sqrt(2 / m); 4.5 of that, and the 0.1 %.
    ratio = values.var() / (noise**2 / effective)
    assert abs(ratio - 1) < 4.5 * np.sqrt(2 / values.size) + 2e-3


def test_a_step_stays_a_step():
    seen = np.where(COLUMN < N // 2, 0.0, 3e-3).astype(np.float32)
    # Beside the step, 41 % of the Gaussian's weight is on the other side; agreement must keep out two thirds of that.
    weights = np.exp(-(OFFSETS**2) / (2 * SIGMA**2))
    across = weights[RADIUS + 1 :].sum() / weights.sum()
    assert np.abs(smooth(seen) - seen).max() < across / 3 * 3e-3
    noisy = seen + 0.3e-3 * np.random.default_rng(1).normal(size=seen.shape).astype(np.float32)
    assert (np.asarray(smooth(noisy)) > 1.5e-3).tolist() == (seen > 1.5e-3).tolist()


def test_unknown_pixels_have_no_weight_and_are_filled_with_the_edge():
    seen = np.random.default_rng(2).normal(scale=1e-4, size=(N, N)).astype(np.float32) + plane(1e-4, 5e-5)
    cropped = seen[8:-8, 8:-8]
    surrounded = np.pad(cropped, 8, constant_values=np.nan)
    result = np.asarray(smooth(surrounded))
    assert np.isnan(result[~np.isfinite(surrounded)]).all()
    # The same sums over the same pixels: equal but for the order in which a compiler adds 121 terms.
    np.testing.assert_allclose(result[8:-8, 8:-8], smooth(cropped), atol=121 * 2**-24 * np.abs(cropped).max())
    np.testing.assert_array_equal(jax.jit(fill)(jnp.asarray(surrounded)), np.pad(cropped, 8, mode="edge"))
