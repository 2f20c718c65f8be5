"""A pad from presses: first the layer, then the map and the chips' gains for that layer.

Metres, newtons, pascals, microtesla; `c` channels, `k` weights of the map.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from i2t.calibration.physics.design import (
    MODES,
    cosine_basis,
    cosine_prior_factor,
    design_matrices,
    weight_features,
)
from i2t.calibration.physics.layer import LayerParameters, LayerPrior, Tip, layer_prior, make_pad
from i2t.calibration.physics.layer_fit import LayerPresses, fit_layer
from i2t.calibration.physics.regression import LinearRegression, bayesian_linear_regression
from i2t.calibration.structured_gp import Presses
from i2t.skin.elasticity import GRID, Grid
from i2t.types import Board, Pad

MAX_LAYER_PRESSES = 48  # that the layer's parameters are fitted to; they need no more, and the map takes all
LINEARIZATIONS = 3  # of the design matrices
GAIN_STD = 0.05  # of the chips' gains, as in `sample_pad`
GAIN_ROUNDS = 3


class PadFit(NamedTuple):
    """A fitted pad, and its uncertainty."""

    pad: Pad
    layer: LayerParameters
    layer_std: LayerParameters
    weights: Float[Array, " k"]  # posterior mean
    precision_cholesky: Float[Array, "k k"]  # of the weights' posterior
    leave_one_out: Float[Array, "n c"]  # uT, each press as predicted from all others
    log_density: Float[Array, ""]  # mean, of a value of a press as predicted from all others


def fit_pad(
    presses: Presses,
    readings: Float[Array, "n c"],
    *,
    tip: Tip,
    board: Board,
    by_force: bool,
    prior: LayerPrior | None = None,
    grid: Grid = GRID,
    max_layer_presses: int = MAX_LAYER_PRESSES,
    linearizations: int = LINEARIZATIONS,
) -> PadFit:
    """Fit a pad to presses with a known tip.

    Args:
        presses: Positions (m) and loads (m or N), in random order.
        readings: Their readings (uT).
        tip: What pressed; hashable.
        board: The sensor board, any number of chips.
        by_force: Whether the loads are forces.
        prior: Of the layer's parameters; by default `layer_prior()`.
        grid: Cells of the pad.
        max_layer_presses: The layer's parameters are fitted to at most so many presses, the first.
        linearizations: Of the design matrices; with 0 the layer stays at the median of its prior.

    Returns:
        The pad, the layer's parameters with their standard deviations, and the posterior of the map.
    """
    prior = layer_prior() if prior is None else prior
    first = min(max_layer_presses, len(presses.load))
    some, known = jax.tree.map(lambda part: part[:first], presses), readings[:first]
    pressed = LayerPresses(some, known, tip=tip, board=board, by_force=by_force, grid=grid)
    layer, layer_std = fit_layer(pressed, prior, linearizations)
    return solve_map(layer, layer_std, presses, readings, tip=tip, board=board, by_force=by_force, grid=grid)


def solve_map(
    layer: LayerParameters,
    layer_std: LayerParameters,
    presses: Presses,
    readings: Float[Array, "n c"],
    *,
    tip: Tip,
    board: Board,
    by_force: bool,
    grid: Grid = GRID,
) -> PadFit:
    """Fit the magnetization and the chips' gains for a known layer.

    Args:
        layer: Parameters of the layer.
        layer_std: Their standard deviations, which are passed on.
        presses: Positions (m) and loads (m or N).
        readings: Their readings (uT).
        tip: What pressed; hashable.
        board: The sensor board.
        by_force: Whether the loads are forces.
        grid: Cells of the pad.

    Returns:
        The fitted pad.
    """
    designs = design_matrices(layer, board, tip, presses, by_force=by_force, grid=grid)
    features = weight_features(layer, designs, grid.window)
    gains, solved, pad = _map_and_gains(layer, features, readings, board, grid.window)
    return PadFit(
        pad=pad._replace(gains=gains),
        layer=layer,
        layer_std=layer_std,
        weights=solved.weights,
        precision_cholesky=solved.precision_cholesky,
        leave_one_out=solved.leave_one_out,
        log_density=jnp.mean(solved.log_density) / readings.shape[1],
    )


def predict_pad(
    fitted: PadFit, presses: Presses, *, tip: Tip, by_force: bool, grid: Grid = GRID
) -> tuple[Float[Array, "n c"], Float[Array, "n c"]]:
    """Predict the readings of other presses; the layer is taken as known.

    Args:
        fitted: The fitted pad.
        presses: Positions (m) and loads (m or N).
        tip: What presses; hashable.
        by_force: Whether the loads are forces.
        grid: Cells of the pad, as in the fit.

    Returns:
        Mean and standard deviation (uT).
    """
    designs = design_matrices(fitted.layer, fitted.pad.board, tip, presses, by_force=by_force, grid=grid)
    return _predict(fitted, weight_features(fitted.layer, designs, grid.window))


@partial(jax.jit, static_argnames=("window",))
def _map_and_gains(
    layer: LayerParameters, features: Array, readings: Array, board: Board, window: float
) -> tuple[Array, LinearRegression, Pad]:
    gains = jnp.ones(readings.shape[1])
    solved = bayesian_linear_regression(features, readings, layer.noise_std)
    for _ in range(GAIN_ROUNDS):
        # The presses measure a gain only as far as each is predicted from all others.
        own = jnp.sum(solved.leave_one_out**2, axis=0) / layer.noise_std**2
        seen = jnp.sum(solved.leave_one_out / gains[None] * readings, axis=0) / layer.noise_std**2
        own = own / gains**2
        gains = (1 / GAIN_STD**2 + seen) / (1 / GAIN_STD**2 + own)
        solved = bayesian_linear_regression(features * gains[None, :, None], readings, layer.noise_std)
    weights, level = solved.weights[:-3].reshape(3, MODES, MODES), solved.weights[-3:]
    r, waves = cosine_prior_factor(layer.patch_length, window), jnp.asarray(cosine_basis())
    edge = jnp.matmul(waves, r, precision="highest")
    patches = jnp.einsum("ia,jb,cab,c->ijc", edge, edge, weights, layer.patch_strength, precision="highest")
    return gains, solved, make_pad(layer, board, patches + layer.uniform_strength * level[None, None])


@jax.jit
def _predict(fitted: PadFit, features: Array) -> tuple[Array, Array]:
    features = features * fitted.pad.gains[None, :, None]
    mean = jnp.einsum("nok,k->no", features, fitted.weights, precision="highest")
    rows = features.reshape(-1, features.shape[-1])
    half = jax.scipy.linalg.solve_triangular(fitted.precision_cholesky, rows.T, lower=True)
    return mean, jnp.sqrt(jnp.sum(half**2, axis=0).reshape(mean.shape) + fitted.layer.noise_std**2)
