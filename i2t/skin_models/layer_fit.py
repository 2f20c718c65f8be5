"""Parameters of an elastic magnetic layer, fitted by evidence.

Readings are linear in the weights of the magnetization map and nonlinear in the other parameters of the layer,
`LayerParameters`: y = Phi(theta) w + noise with w ~ N(0, I). Integrating the weights out leaves the evidence
(Bishop, "Pattern Recognition and Machine Learning", section 3.5)

    -log p(y | theta) = log |M| / 2 + N log s + (|y - Phi m|^2 / s^2 + |m|^2) / 2 + const,
    M = I + Phi' Phi / s^2,   m = M^-1 Phi' y / s^2,

of which the derivative by Phi is (Phi M^-1 - (y - Phi m) m') / s^2. Together with the parameters' prior it is maximised
as Gauss-Newton does, by taking Phi as linear, with slopes by central differences, in a trust region whose size follows
the gain ratio: what the step gains over what the linear model promised (Nocedal and Wright, "Numerical Optimization",
algorithm 4.1). The curvature at the maximum gives the ranges of the parameters (Laplace).

The search runs in the coordinates of the prior: standard deviations from its median. Linear algebra is in double
precision. `n` is the number of presses, `c` of channels, `N = n c` of readings, `k` of weights, `d` of coordinates, of
which `e` change Phi by more than a scale.
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

NO_PAD = "no pad explains these presses; check the tip, the unit of the loads and the board"
MAX_STEPS = 30  # of the trust region, rejected ones included
INNER_STEPS = 300  # of L-BFGS in each
SMALL_GAIN = 0.1  # in log density: a step that promises less, under half a posterior standard deviation, is the last
MIN_GAIN_RATIO = 0.1  # of a step that is taken
FIRST_RADIUS, MAX_RADIUS = 1.0, 3.0  # of the trust region, in standard deviations of the prior
STDS_WITHIN_95 = 1.96
# Prior standard deviations, of slopes. Contacts on cells make features rough over some hundredths, so that derivatives
# at one place would promise too much of tip and board, which move readings at the skin's edges only.
SLOPE_STEP = 0.25
DIFFERENCE_STEP = 1e-3  # prior standard deviations, of second derivatives
IMPLAUSIBLE_STDS = 3.0  # prior standard deviations from the median beyond which a parameter is reported


@in_one_line
class LayerPosterior(NamedTuple):
    """Fitted layer and how well it is known."""

    layer: LayerParameters  # the most likely one
    low: LayerParameters  # ends of each parameter's 95 % range
    high: LayerParameters
    converged: Bool[Array, ""] | bool


class UnitFeatures(NamedTuple):
    """Readings of weights on a layer whose gains and map strengths are 1, and their derivatives."""

    value: Float[np.ndarray, "n c k"]  # uT
    changes: Float[np.ndarray, "e n c k"]  # along each coordinate of SHAPE_PARAMETERS


def fit_layer(
    unit_features: Callable[[LayerParameters], Float[Array, "n c k"]],
    readings: Float[np.ndarray, "n c"],
    prior: LayerPrior,
) -> LayerPosterior:
    """Find the most likely layer and the ranges of its parameters.

    Args:
        unit_features: Readings (uT) of weights at coordinates of the prior, on a layer whose gains and map strengths
            are 1; first those of the map's patches, in three equal parts, then three of the uniform part.
        readings: Of the n presses (uT).
        prior: Of the parameters.

    Returns:
        The layer and its ranges. A warning says that the search did not converge, and which parameters are far from
        the medians of their prior.

    Raises:
        ValueError: The search cannot begin, because no press is finite at the prior's median.
    """
    start, unravel = ravel_pytree(jax.tree.map(jnp.zeros_like, prior.median))

    def coordinates(x: np.ndarray) -> LayerParameters:
        return unravel(jnp.asarray(x, jnp.float32))

    moves = SLOPE_STEP * np.eye(len(start))[shape_coordinates(prior)]

    def features(x: np.ndarray) -> np.ndarray:
        return np.asarray(unit_features(coordinates(x)), np.float64)

    def linear_model(x: np.ndarray, rows: np.ndarray) -> tuple[_LinearModel, np.ndarray]:
        value = features(x)
        changes = np.stack([features(x + move) - features(x - move) for move in moves]) / (2 * SLOPE_STEP)
        rows = _finite_rows(rows, np.isfinite(value).all((1, 2)) & np.isfinite(changes).all((0, 2, 3)))
        return _LinearModel(x, UnitFeatures(value[rows], changes[:, rows]), readings[rows], prior), rows

    def exact_value(x: np.ndarray, rows: np.ndarray) -> float:
        value = features(x)[rows]
        return _LinearModel(x, UnitFeatures(value, value[:0, None]), readings[rows], prior).value_and_gradient(x)[0]

    x, radius, converged = np.asarray(start, np.float64), FIRST_RADIUS, False
    model, rows = linear_model(x, np.arange(len(readings)))
    value = model.value_and_gradient(x)[0]
    if not np.isfinite(value):
        raise ValueError(NO_PAD)
    for _ in range(MAX_STEPS):
        proposal, promised = model.minimize(radius)
        length = model.shape_step(proposal)
        at_bound = length > 0.99 * radius
        if value - promised < SMALL_GAIN:
            # A region that shrank promises little, too. Where steps were taken before, that is the end: contacts on
            # cells make the objective rough, by about 0.1, over a few hundredths of the prior's standard deviations.
            converged = not at_bound or bool(x.any())
            x = proposal
            break
        reached = exact_value(proposal, rows)
        gain = (value - reached) / (value - promised)
        if gain < 0.25 or not np.isfinite(gain):
            radius = 0.25 * length
        elif gain > 0.75 and at_bound:
            radius = min(2 * radius, MAX_RADIUS)
        if gain > MIN_GAIN_RATIO:
            x = proposal
            model, rows = linear_model(x, rows)
            value = model.value_and_gradient(x)[0]
    if not converged:
        warnings.warn("the fit of the layer did not converge", stacklevel=3)
    _report_implausible(coordinates(x))
    std = _posterior_stds(model.curvature(x))
    return LayerPosterior(parameters_at(coordinates(x), prior), *ranges(x, std, prior), converged)


def shape_coordinates(prior: LayerPrior) -> Int[np.ndarray, " e"]:
    """Find the coordinates that features change with by more than a scale.

    Args:
        prior: Of the parameters.

    Returns:
        Their numbers, in the order of SHAPE_PARAMETERS.
    """
    numbers = _numbers(prior)
    return np.concatenate([getattr(numbers, name).ravel() for name in SHAPE_PARAMETERS])


def _numbers(prior: LayerPrior) -> LayerParameters:
    """Numbers of the coordinates of each parameter."""
    start, unravel = ravel_pytree(prior.median)
    return jax.tree.map(
        lambda number: np.asarray(np.rint(number), int), unravel(jnp.arange(len(start), dtype=jnp.float32))
    )


def ranges(
    x: Float[np.ndarray, " d"], std: Float[np.ndarray, " d"], prior: LayerPrior
) -> tuple[LayerParameters, LayerParameters]:
    """Ends of the 95 % ranges of parameters.

    Args:
        x: Mean of the coordinates.
        std: Their standard deviations.
        prior: Of the parameters.

    Returns:
        The lower and the upper ends; a mount compliance whose root may be zero has a range from zero on.
    """
    unravel = ravel_pytree(prior.median)[1]
    below, above = (unravel(jnp.float32(x + step * std)) for step in (-STDS_WITHIN_95, STDS_WITHIN_95))
    ends = parameters_at(below, prior), parameters_at(above, prior)
    low, high = (jax.tree.map(choose, *ends) for choose in (jnp.minimum, jnp.maximum))
    may_be_zero = 1 + prior.std.mount_compliance * below.mount_compliance < 0
    return low._replace(mount_compliance=jnp.where(may_be_zero, 0.0, low.mount_compliance)), high


@dataclass(frozen=True)
class _LinearModel:
    """Negative log posterior of a layer whose unit features are linear about some coordinates."""

    at: np.ndarray  # (d,)
    features: UnitFeatures
    readings: np.ndarray  # (n, c)
    prior: LayerPrior

    @cached_property
    def _index(self) -> LayerParameters:
        """Numbers of the coordinates of each parameter."""
        return _numbers(self.prior)

    @cached_property
    def _shape(self) -> np.ndarray:
        """(e,) numbers of the coordinates that features change with."""
        return shape_coordinates(self.prior)

    @cached_property
    def _host_prior(self) -> LayerPrior:
        """The prior in double precision."""
        return jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), self.prior)

    def _scales(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """Gains (c, 1), strengths (k,) and noise at coordinates."""
        index, (median, std) = self._index, self._host_prior
        gains = median.gains + std.gains * x[index.gains]
        strength = median.patch_strength * np.exp(std.patch_strength * x[index.patch_strength])
        level = median.uniform_strength * np.exp(std.uniform_strength * x[index.uniform_strength])
        noise = median.noise_std * np.exp(std.noise_std * x[index.noise_std])
        strengths = np.append(np.repeat(strength, (self.features.value.shape[-1] - 3) // 3), np.full(3, level))
        return gains[:, None], strengths, float(noise)

    def value_and_gradient(self, x: np.ndarray) -> tuple[float, np.ndarray]:
        """Negative log posterior density at coordinates, up to a constant, and its gradient; infinite where the
        regression cannot be solved.
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
        """Coordinates of the least value within a radius of where features are linear, and that value."""
        bounds = [(None, None)] * len(self.at)
        for number in self._shape:
            bounds[number] = (self.at[number] - radius, self.at[number] + radius)
        found = optimize.minimize(
            self.value_and_gradient,
            self.at,
            jac=True,
            method="L-BFGS-B",
            bounds=bounds,
            options={"maxiter": INNER_STEPS},
        )
        return found.x, float(found.fun)

    def shape_step(self, x: np.ndarray) -> float:
        """Largest move from where features are linear, in standard deviations of the prior."""
        return float(np.abs(x - self.at)[self._shape].max())

    def curvature(self, x: np.ndarray) -> np.ndarray:
        """Second derivatives (d, d) at coordinates, by differences of the gradient."""
        ways = DIFFERENCE_STEP * np.eye(len(x))
        change = [self.value_and_gradient(x + way)[1] - self.value_and_gradient(x - way)[1] for way in ways]
        curvature = np.stack(change) / (2 * DIFFERENCE_STEP)
        return 0.5 * (curvature + curvature.T)


def _posterior_stds(curvature: np.ndarray) -> np.ndarray:
    """Standard deviations (d,) of coordinates; no direction is less certain than by the prior alone."""
    values, vectors = np.linalg.eigh(curvature)
    return np.sqrt((vectors**2 / np.maximum(values, 1.0)).sum(1))


def _cholesky(matrix: np.ndarray) -> np.ndarray | None:
    try:
        return linalg.cholesky(matrix, lower=True) if np.isfinite(matrix).all() else None
    except linalg.LinAlgError:
        return None


def _finite_rows(rows: np.ndarray, finite: np.ndarray) -> np.ndarray:
    """Rows of the presses whose features and derivatives are finite; a warning counts those that are lost."""
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
    """Warn of parameters that ended where the prior hardly allows them."""
    far = [name for name, at in coordinates._asdict().items() if np.abs(at).max() > IMPLAUSIBLE_STDS]
    if far:
        warnings.warn(
            f"the fitted {', '.join(far)} {'is' if len(far) == 1 else 'are'} more than {IMPLAUSIBLE_STDS:g} standard "
            "deviations from the prior's median; check the tip, the unit of the loads and the board",
            stacklevel=4,
        )
