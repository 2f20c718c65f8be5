"""The magnetization's weights by Bayesian linear regression, with every press predicted from all others.

Bishop, "Pattern Recognition and Machine Learning", section 3.3; leaving one out is that of Rasmussen and Williams,
"Gaussian Processes for Machine Learning", section 5.4.2, with all channels of a press left out together.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


class LinearRegression(NamedTuple):
    """Posterior of the map's weights."""

    weights: Float[Array, " k"]  # mean
    precision_cholesky: Float[Array, "k k"]
    leave_one_out: Float[Array, "n c"]  # uT, each press as predicted from all others
    log_density: Float[Array, " n"]  # of each press as predicted from all others


def bayesian_linear_regression(
    features: Float[Array, "n c k"], readings: Float[Array, "n c"], noise_std: Float[Array, ""]
) -> LinearRegression:
    """Weights of prior variance 1, and predictions of left-out presses (all values), in closed form.

    Args:
        features: Readings of each weight.
        readings: Readings of the presses, in the features' unit.
        noise_std: Standard deviation of a reading's noise, in the same unit.

    Returns:
        The posterior, and each press as predicted from all others.
    """
    channels = features.shape[1]
    rows = features.reshape(-1, features.shape[-1]) / noise_std
    precision = jnp.matmul(rows.T, rows, precision="highest") + jnp.eye(features.shape[-1])
    cholesky = jnp.linalg.cholesky(precision)
    projected = jnp.matmul(rows.T, readings.reshape(-1) / noise_std, precision="highest")
    weights = jax.scipy.linalg.cho_solve((cholesky, True), projected)
    half = jax.scipy.linalg.solve_triangular(cholesky, rows.T, lower=True).T.reshape(features.shape)
    rest = jnp.eye(channels)[None] - jnp.einsum("nok,npk->nop", half, half, precision="highest")
    error = (readings - jnp.einsum("nok,k->no", features, weights, precision="highest")) / noise_std
    factor = jnp.linalg.cholesky(rest + 1e-5 * jnp.eye(channels)[None])
    # The error without the press is (I - H)^-1 e, its covariance (I - H)^-1.
    lone = jax.vmap(lambda L, e: jax.scipy.linalg.cho_solve((L, True), e))(factor, error)
    log_rest = 2 * jnp.sum(jnp.log(jnp.diagonal(factor, axis1=1, axis2=2)), axis=1)
    log_density = -0.5 * (jnp.sum(error * lone, axis=1) - log_rest) - channels * jnp.log(noise_std * np.sqrt(2 * np.pi))
    return LinearRegression(weights, cholesky, readings - noise_std * lone, log_density)
