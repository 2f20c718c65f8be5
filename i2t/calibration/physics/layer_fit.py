"""The layer under a map: its parameters and their spread, with the map solved for at every step.

Variable projection (Golub and Pereyra, SIAM J. Numer. Anal. 10, 1973): what is maximised is the log density of each
press as predicted from all others plus that of the parameters' priors. Gradients are exact: forward through the contact
and the design matrices, backwards through the regression. The curvature at the maximum gives the parameters' spread
(Laplace's approximation). The coordinates are a `LayerParameters` of standard deviations from the prior's median, which
the optimiser sees as one vector (`ravel_pytree`).
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array
from scipy import optimize

from i2t.calibration.physics.design import design_matrix, weight_features
from i2t.calibration.physics.layer import (
    DESIGN_PARAMETERS,
    NORMAL_PARAMETERS,
    LayerParameters,
    LayerPrior,
    Tip,
    parameters_at,
)
from i2t.calibration.physics.regression import bayesian_linear_regression
from i2t.calibration.structured_gp import Presses
from i2t.skin.elasticity import Grid
from i2t.types import Board

LBFGS_STEPS = 25  # in each linearization
MAX_MOVE_STDS = 0.7  # how far each coordinate goes in one of them, in standard deviations of the prior
CURVATURE_STEP_STDS = 0.05  # of the finite differences for the curvature
FAILED_OBJECTIVE = 1e9  # what is minimised, where it cannot be computed

_Unravel: TypeAlias = Callable[[Any], LayerParameters]
_Objective: TypeAlias = Callable[[np.ndarray], tuple[float, np.ndarray]]


class LayerPresses(NamedTuple):
    """Data of a layer fit."""

    presses: Presses
    readings: Array  # (n, c) uT
    tip: Tip
    board: Board
    by_force: bool
    grid: Grid


def fit_layer(pressed: LayerPresses, prior: LayerPrior, linearizations: int) -> tuple[LayerParameters, LayerParameters]:
    """Fit the parameters of a layer.

    Args:
        pressed: Presses and their readings.
        prior: Of the parameters.
        linearizations: Of the design matrices; with 0 the layer stays at the median of its prior.

    Returns:
        The parameters and their standard deviations.
    """
    flat, unravel = ravel_pytree(jax.tree.map(jnp.zeros_like, prior.median))
    at, curvature = np.zeros(len(flat)), np.eye(len(flat))
    for _ in range(linearizations):
        at, curvature = _maximise(_linearized(at, pressed, prior, unravel), at)
    values, vectors = np.linalg.eigh((curvature + curvature.T) / 2)
    # The prior alone curves by 1: less is rounding, or a maximum that was not reached.
    stds = np.sqrt(np.sum(vectors**2 / np.maximum(values, 1.0), axis=1))
    layer = parameters_at(unravel(jnp.asarray(at, jnp.float32)), prior)
    return layer, _parameter_stds(layer, unravel(jnp.asarray(stds, jnp.float32)), prior)


class _Linearization(NamedTuple):
    """Design matrices near some coordinates."""

    coordinates: LayerParameters
    value: Array  # (n, c, 3, m, m)
    changes: Array  # (d, n, c, 3, m, m), along each coordinate of DESIGN_PARAMETERS


def _maximise(objective: _Objective, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The minimum of a negative log posterior near `start`, and its curvature there."""
    bounds = [(at - MAX_MOVE_STDS, at + MAX_MOVE_STDS) for at in start]
    options = {"maxiter": LBFGS_STEPS}
    found = optimize.minimize(objective, start, jac=True, method="L-BFGS-B", bounds=bounds, options=options).x
    step = CURVATURE_STEP_STDS
    curvature = [
        (objective(found + step * e)[1] - objective(found - step * e)[1]) / (2 * step) for e in np.eye(len(found))
    ]
    return found, np.array(curvature)


def _linearized(at: np.ndarray, pressed: LayerPresses, prior: LayerPrior, unravel: _Unravel) -> _Objective:
    """Value and gradient of the negative log posterior, with design matrices that are linear about `at`."""
    coordinates = unravel(jnp.asarray(at, jnp.float32))
    presses, readings, tip, board, by_force, grid = pressed
    value, changes = _design_derivatives(
        coordinates, prior, board, tip=tip, presses=presses, by_force=by_force, grid=grid
    )
    linearization = _Linearization(coordinates, value, changes)

    def objective(x: np.ndarray) -> tuple[float, np.ndarray]:
        here = unravel(jnp.asarray(x, jnp.float32))
        value, gradient = _value_and_gradient(here, linearization, readings, prior, window=grid.window)
        gradient = np.asarray(ravel_pytree(gradient)[0], np.float64)
        if not np.isfinite(value) or not np.isfinite(gradient).all():  # beyond what single precision can factor
            return FAILED_OBJECTIVE, np.zeros(len(x))
        return float(value), gradient

    return objective


def _design_coordinates(coordinates: LayerParameters) -> tuple[Array, ...]:
    return tuple(getattr(coordinates, name) for name in DESIGN_PARAMETERS)


def _negative_log_posterior(
    coordinates: LayerParameters, linearization: _Linearization, readings: Array, prior: LayerPrior, window: float
) -> Array:
    layer = parameters_at(coordinates, prior)
    here, _ = ravel_pytree(_design_coordinates(coordinates))
    there, _ = ravel_pytree(_design_coordinates(linearization.coordinates))
    designs = linearization.value + jnp.tensordot(here - there, linearization.changes, 1, precision="highest")
    features = weight_features(layer, designs, window)
    solved = bayesian_linear_regression(features, readings, layer.noise_std)
    return 0.5 * jnp.sum(ravel_pytree(coordinates)[0] ** 2) - jnp.sum(solved.log_density)


_value_and_gradient = jax.jit(jax.value_and_grad(_negative_log_posterior), static_argnames=("window",))


@partial(jax.jit, static_argnames=("tip", "by_force", "grid"))
def _design_derivatives(
    coordinates: LayerParameters,
    prior: LayerPrior,
    board: Board,
    *,
    tip: Tip,
    presses: Presses,
    by_force: bool,
    grid: Grid,
) -> tuple[Array, Array]:
    """Design matrices of all presses, and their change along each coordinate of DESIGN_PARAMETERS."""
    start, unravel = ravel_pytree(_design_coordinates(coordinates))

    def one(press: Presses) -> tuple[Array, Array]:
        def at(vector: Array) -> Array:
            moved = coordinates._replace(**dict(zip(DESIGN_PARAMETERS, unravel(vector), strict=True)))
            layer = parameters_at(moved, prior)
            return design_matrix(layer, board, tip, press.position, press.load, by_force=by_force, grid=grid)

        def along(direction: Array) -> Array:
            return jax.jvp(at, (start,), (direction,))[1]

        return at(start), jax.lax.map(along, jnp.eye(len(start)))

    value, changes = jax.lax.map(one, presses)
    return value, jnp.swapaxes(changes, 0, 1)


def _parameter_stds(layer: LayerParameters, stds: LayerParameters, prior: LayerPrior) -> LayerParameters:
    """Standard deviations of the parameters from those of their coordinates, to first order."""

    def std(name: str) -> Array:
        moved = getattr(prior.std, name) * getattr(stds, name)
        return moved if name in NORMAL_PARAMETERS else getattr(layer, name) * moved

    return LayerParameters(**{name: std(name) for name in LayerParameters._fields})
