"""Parameters of an elastic magnetic layer, fitted by evidence.

Readings are linear in the weights of the magnetization map and nonlinear in the other parameters of the layer,
`LayerParameters`: y = Phi(theta) w + noise with w ~ N(0, I). Integrating the weights out leaves the evidence
(Bishop, "Pattern Recognition and Machine Learning", section 3.5)

    -log p(y | theta) = log |M| / 2 + N log s + (|y - Phi m|^2 / s^2 + |m|^2) / 2 + const,
    M = I + Phi' Phi / s^2,   m = M^-1 Phi' y / s^2,

whose derivative by Phi is (Phi M^-1 - (y - Phi m) m') / s^2. Together with the parameters' prior it is maximised as in
Gauss-Newton: Phi is taken as linear, with slopes by central differences, in a trust region. The region's size follows
the gain ratio, the gain of a step over the gain that the linear model promised (Nocedal and Wright, "Numerical
Optimization", algorithm 4.1). The curvature at the maximum gives the ranges of the parameters (Laplace).

The search runs in the coordinates of the prior: standard deviations from its median. Linear algebra is in double
precision. `n` is the number of presses, `c` of channels, `N = n c` of readings, `k` of weights and `d` of coordinates;
`e` coordinates change Phi by more than a scale.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int
from scipy import linalg, optimize

from i2t.skin_models.magnetic_layer import SHAPE_PARAMETERS, LayerParameters, LayerPrior, parameters_at
from i2t.types import in_one_line

# Error if a fit finds no plausible pad.
NO_PAD = "no pad explains these presses; check the tip, the unit of the loads and the board"


@dataclass(frozen=True)
class LayerSearch:
    """Options of the search for a layer's parameters; lengths are in standard deviations of the prior."""

    max_steps: int = 30  # largest number of steps of the trust region, including rejected ones
    inner_steps: int = 300  # number of L-BFGS steps within each step of the trust region
    # promised gain in log density that ends the search, under half a posterior standard deviation
    small_gain: float = 0.1
    min_gain_ratio: float = 0.1  # gain ratio above which a step is taken
    first_radius: float = 1.0
    max_radius: float = 3.0
    # Step of the slopes. Contacts on cells make features rough over a few hundredths, so derivatives at one place would
    # promise too much for tip and board, which move readings only at the skin's edges.
    slope_step: float = 0.25
    curvature_step: float = 1e-3  # step of the finite differences for second derivatives
    # distance from the prior's median, in standard deviations, above which a parameter is reported
    implausible_stds: float = 3.0


_LAYER_SEARCH = LayerSearch()  # trust-region search for the elastic layer of a pad


@in_one_line
class LayerPosterior(NamedTuple):
    """Most probable parameters of an elastic magnetic layer, and their 95 % ranges."""

    layer: LayerParameters  # the most probable parameters
    low: LayerParameters  # lower ends of the 95 % ranges
    high: LayerParameters
    converged: Bool[Array, ""] | bool


class UnitFeatures(NamedTuple):
    """Readings (uT) of n presses for each of k magnetization weights, at gains and strengths of 1, and derivatives.

    Derivatives are along the coordinates of the prior that change the readings by more than a scale.
    """

    value: Float[np.ndarray, "n c k"]  # uT, features at the parameters
    changes: Float[np.ndarray, "e n c k"]  # derivatives along the coordinates of SHAPE_PARAMETERS


def fit_layer(
    unit_features: Callable[[LayerParameters], Float[Array, "n c k"]],
    readings: Float[np.ndarray, "n c"],
    prior: LayerPrior,
) -> LayerPosterior:
    """Find the most probable parameters of an elastic magnetic layer, given presses, and their 95 % ranges.

    Args:
        unit_features: Function from coordinates of the prior to `(n, c, k)` readings (uT) of n presses for each of k
            weights, on a layer with gains and map strengths of 1. The weights are those of the map's patches, in three
            equal parts, then three of the uniform part.
        readings: `(n, c)` readings of the presses (uT).
        prior: Prior of the parameters.

    Returns:
        The layer and its ranges. Warnings report a search that did not converge, and parameters that are far from the
        medians of their prior.

    Raises:
        ValueError: The search cannot begin, because no press is finite at the prior's median.
    """
    start, unravel = ravel_pytree(jax.tree.map(jnp.zeros_like, prior.median))

    def coordinates(x: np.ndarray) -> LayerParameters:
        return unravel(jnp.asarray(x, jnp.float32))

    step = _LAYER_SEARCH.slope_step
    moves = step * np.eye(len(start))[shape_coordinates(prior)]

    def features(x: np.ndarray) -> np.ndarray:
        return np.asarray(unit_features(coordinates(x)), np.float64)

    def linear_model(x: np.ndarray, rows: np.ndarray) -> tuple[_LinearModel, np.ndarray]:
        value = features(x)
        changes = np.stack([features(x + move) - features(x - move) for move in moves]) / (2 * step)
        rows = _finite_rows(rows, np.isfinite(value).all((1, 2)) & np.isfinite(changes).all((0, 2, 3)))
        return _LinearModel(x, UnitFeatures(value[rows], changes[:, rows]), readings[rows], prior), rows

    def exact_value(x: np.ndarray, rows: np.ndarray) -> float:
        value = features(x)[rows]
        return _LinearModel(x, UnitFeatures(value, value[:0, None]), readings[rows], prior).value_and_gradient(x)[0]

    x, radius, converged = np.asarray(start, np.float64), _LAYER_SEARCH.first_radius, False
    model, rows = linear_model(x, np.arange(len(readings)))
    value = model.value_and_gradient(x)[0]
    if not np.isfinite(value):
        raise ValueError(NO_PAD)
    for _ in range(_LAYER_SEARCH.max_steps):
        proposal, promised = model.minimize(radius)
        length = model.shape_step(proposal)
        at_bound = length > 0.99 * radius
        if value - promised < _LAYER_SEARCH.small_gain:
            # A region that shrank promises little as well. If steps were taken before, the search has ended: contacts
            # on cells make the objective rough, by about 0.1, over a few hundredths of a prior standard deviation.
            converged = not at_bound or bool(x.any())
            x = proposal
            break
        reached = exact_value(proposal, rows)
        gain = (value - reached) / (value - promised)
        if gain < 0.25 or not np.isfinite(gain):
            radius = 0.25 * length
        elif gain > 0.75 and at_bound:
            radius = min(2 * radius, _LAYER_SEARCH.max_radius)
        if gain > _LAYER_SEARCH.min_gain_ratio:
            x = proposal
            model, rows = linear_model(x, rows)
            value = model.value_and_gradient(x)[0]
    if not converged:
        warnings.warn("the fit of the layer did not converge", stacklevel=3)
    _report_implausible(coordinates(x))
    std = _posterior_stds(model.curvature(x))
    return LayerPosterior(parameters_at(coordinates(x), prior), *ranges(x, std, prior), converged)


def shape_coordinates(prior: LayerPrior) -> Int[np.ndarray, " e"]:
    """List the coordinates of the layer's parameters that change the features by more than a factor.

    Args:
        prior: Prior of the parameters.

    Returns:
        `(e,)` numbers of the coordinates, in the order of SHAPE_PARAMETERS.
    """
    numbers = _numbers(prior)
    return np.concatenate([getattr(numbers, name).ravel() for name in SHAPE_PARAMETERS])


def _numbers(prior: LayerPrior) -> LayerParameters:
    """Number the coordinates of each parameter."""
    start, unravel = ravel_pytree(prior.median)
    return jax.tree.map(
        lambda number: np.asarray(np.rint(number), int), unravel(jnp.arange(len(start), dtype=jnp.float32))
    )


def ranges(
    x: Float[np.ndarray, " d"], std: Float[np.ndarray, " d"], prior: LayerPrior
) -> tuple[LayerParameters, LayerParameters]:
    """Compute the ends of the 95 % ranges of a layer's parameters.

    Args:
        x: `(d,)` means of the coordinates.
        std: `(d,)` standard deviations of the coordinates.
        prior: Prior of the parameters.

    Returns:
        The lower and the upper ends. If the root of the mount compliance may be zero, its range begins at zero.
    """
    unravel = ravel_pytree(prior.median)[1]
    below, above = (unravel(jnp.float32(x + step * std)) for step in (-1.96, 1.96))
    ends = parameters_at(below, prior), parameters_at(above, prior)
    low, high = (jax.tree.map(choose, *ends) for choose in (jnp.minimum, jnp.maximum))
    may_be_zero = 1 + prior.std.mount_compliance * below.mount_compliance < 0
    return low._replace(mount_compliance=jnp.where(may_be_zero, 0.0, low.mount_compliance)), high


@dataclass(frozen=True)
class _LinearModel:
    """Negative log posterior of a layer whose unit features are linear about given coordinates."""

    at: np.ndarray  # (d,)
    features: UnitFeatures
    readings: np.ndarray  # (n, c)
    prior: LayerPrior

    @cached_property
    def _index(self) -> LayerParameters:
        """Number the coordinates of each parameter."""
        return _numbers(self.prior)

    @cached_property
    def _shape(self) -> np.ndarray:
        """List the numbers (e,) of the coordinates that change features."""
        return shape_coordinates(self.prior)

    @cached_property
    def _host_prior(self) -> LayerPrior:
        """Convert the prior to double precision."""
        return jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), self.prior)

    def _scales(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """Compute gains (c, 1), strengths (k,) and noise at coordinates."""
        index, (median, std) = self._index, self._host_prior
        gains = median.gains + std.gains * x[index.gains]
        strength = median.patch_strength * np.exp(std.patch_strength * x[index.patch_strength])
        level = median.uniform_strength * np.exp(std.uniform_strength * x[index.uniform_strength])
        noise = median.noise_std * np.exp(std.noise_std * x[index.noise_std])
        strengths = np.append(np.repeat(strength, (self.features.value.shape[-1] - 3) // 3), np.full(3, level))
        return gains[:, None], strengths, float(noise)

    def value_and_gradient(self, x: np.ndarray) -> tuple[float, np.ndarray]:
        """Compute the negative log posterior density at coordinates, up to a constant, and its gradient. It is infinite
        if the regression cannot be solved.
        """
        gains, strength, noise = self._scales(x)
        scale = gains * strength
        moved = (x - self.at)[self._shape]
        unit = self.features.value
        if len(self.features.changes):
            unit = unit + np.tensordot(moved, self.features.changes, 1)
        phi, y = (unit * scale).reshape(-1, unit.shape[-1]), self.readings.ravel()
        factor = _cholesky(np.eye(phi.shape[1]) + phi.T @ phi / noise**2)
        if factor is None:
            return np.inf, np.zeros_like(x)
        mean = linalg.cho_solve((factor, True), phi.T @ y) / noise**2
        rest = y - phi @ mean
        value = (
            np.log(np.diag(factor)).sum()
            + len(y) * np.log(noise)
            + 0.5 * (rest @ rest / noise**2 + mean @ mean + x @ x)
        )
        covariance = linalg.cho_solve((factor, True), np.eye(len(factor)))
        by_phi = ((phi @ covariance - np.outer(rest, mean)) / noise**2).reshape(unit.shape)
        gradient, index, std = x.copy(), self._index, self.prior.std
        if len(self.features.changes):
            gradient[self._shape] += np.tensordot(self.features.changes, by_phi * scale, 3)
        by_scale = by_phi * unit * scale
        gradient[index.gains] += np.asarray(std.gains) * (by_scale.sum((0, 2)) / gains[:, 0])
        by_weight = by_scale.sum((0, 1))
        gradient[index.patch_strength] += np.asarray(std.patch_strength) * by_weight[:-3].reshape(3, -1).sum(1)
        gradient[index.uniform_strength] += float(std.uniform_strength) * by_weight[-3:].sum()
        trace = len(y) - len(factor) + np.trace(covariance)
        gradient[index.noise_std] += float(std.noise_std) * (trace - rest @ rest / noise**2)
        return float(value), gradient

    def minimize(self, radius: float) -> tuple[np.ndarray, float]:
        """Minimise within a radius of the expansion point; return the coordinates and the value there."""
        bounds = [(None, None)] * len(self.at)
        for number in self._shape:
            bounds[number] = (self.at[number] - radius, self.at[number] + radius)
        result = optimize.minimize(
            self.value_and_gradient,
            self.at,
            jac=True,
            method="L-BFGS-B",
            bounds=bounds,
            options={"maxiter": _LAYER_SEARCH.inner_steps},
        )
        return result.x, float(result.fun)

    def shape_step(self, x: np.ndarray) -> float:
        """Compute the largest move from the expansion point, in standard deviations of the prior."""
        return float(np.abs(x - self.at)[self._shape].max())

    def curvature(self, x: np.ndarray) -> np.ndarray:
        """Compute the second derivatives (d, d) at coordinates, by differences of the gradient."""
        moves = _LAYER_SEARCH.curvature_step * np.eye(len(x))
        change = [self.value_and_gradient(x + move)[1] - self.value_and_gradient(x - move)[1] for move in moves]
        curvature = np.stack(change) / (2 * _LAYER_SEARCH.curvature_step)
        return 0.5 * (curvature + curvature.T)


def _posterior_stds(curvature: np.ndarray) -> np.ndarray:
    """Compute the standard deviations (d,) of coordinates; none is larger than by the prior alone."""
    values, vectors = np.linalg.eigh(curvature)
    return np.sqrt((vectors**2 / np.maximum(values, 1.0)).sum(1))


def _cholesky(matrix: np.ndarray) -> np.ndarray | None:
    try:
        return linalg.cholesky(matrix, lower=True) if np.isfinite(matrix).all() else None
    except linalg.LinAlgError:
        return None


def _finite_rows(rows: np.ndarray, finite: np.ndarray) -> np.ndarray:
    """Select the presses whose features and derivatives are finite, and warn of the others."""
    lost = rows[~finite[rows]]
    if len(lost) == len(rows):
        raise ValueError(NO_PAD)
    if len(lost):
        warnings.warn(
            f"{len(lost)} of {len(rows)} presses are left out of the fit of the layer, because the derivatives of "
            f"their readings are not finite (the first is in row {lost[0]})",
            stacklevel=5,
        )
    return rows[finite[rows]]


def _report_implausible(coordinates: LayerParameters) -> None:
    """Warn of parameters far from the prior's median."""
    limit = _LAYER_SEARCH.implausible_stds
    far = [name for name, at in coordinates._asdict().items() if np.abs(at).max() > limit]
    if far:
        warnings.warn(
            f"the fitted {', '.join(far)} {'is' if len(far) == 1 else 'are'} more than {limit:g} standard "
            "deviations from the prior's median; check the tip, the unit of the loads and the board",
            stacklevel=4,
        )
