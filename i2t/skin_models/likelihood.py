"""Likelihood of a measured touch given the predicted one, fitted to touches left out.

Errors of a reading are Student's t with their covariance; errors of where a press ends have heavy tails, a scale
mixture of normals (Andrews and Mallows, J. R. Stat. Soc. B 36, 1974). `i2t.recognition.belief` says what they are used
for. Metres, newtons, microtesla.
"""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple, TypeVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from i2t.contact.press import PressLimits
from i2t.types import in_one_line

Length = TypeVar("Length", float, Array)  # m

# Indentations on objects that were not trained on are so far from the nominal layer's, relative to these: the most
# probable value for the validation objects at their true places, among 0.1, 0.2, ... 0.5.
INDENTATION_ERROR = 0.2
OUTLIER_RATE = 0.01  # share of touches that may be anything
STRAY_RANGE_M = 20e-3  # added to twice the overtravel: the length over which an outlier's press may end
# Standard deviations of which a position's error is mixed: from the repeatability of an arm to a missed edge.
POSITION_STDS_M = (0.05e-3, 0.1e-3, 0.2e-3, 0.4e-3, 0.8e-3, 1.6e-3)
EM_STEPS = 300
PRIOR_TOUCHES = 0.5  # of each standard deviation, as if they had been seen: no tail is impossible


class ScaleMixture(NamedTuple):
    """A distribution with heavy tails: normal about 0, with one of several standard deviations."""

    std: Float[np.ndarray, " s"]  # m
    share: Float[np.ndarray, " s"]  # of each; they sum to 1


@in_one_line
class Likelihood(NamedTuple):
    """Likelihood of a touch given the predicted one; see `fit_likelihood`, the rest chosen on validation episodes."""

    whiten: Float[Array, "c c"]  # W, with W S W' = 1 and W diag(scale^2) W' = diag(growth), S the errors' covariance
    growth: Float[Array, " c"]  # of the whitened variance with the GP's own variance
    loads: Float[Array, " l"]  # N, of the predicted touches
    overtravel: Float[Array, ""]  # m beyond the site after which a press gives up
    dof: Float[Array, ""]  # degrees of freedom of Student's t
    inflation: Float[Array, ""]  # of the errors' standard deviation, on objects that were not trained on
    position_std: Float[Array, " s"]  # m, of the components of the error of where a press ends at a known pose
    position_share: Float[Array, " s"]  # of touches that have each of these standard deviations
    indentation_error: Float[Array, ""]  # standard deviation of an indentation, relative to the predicted one
    outlier_rate: Float[Array, ""]  # share of touches that may be anything
    tactile_weight: Float[Array, ""]  # of the reading's evidence; 0 leaves it out
    spatial_weight: Float[Array, ""]  # of the position's evidence; 0 leaves it out
    presence_weight: Float[Array, ""]  # of having met something, or nothing; 0 leaves it out
    stiffness: Float[Array, ""]  # N/m, of arm and mount
    drift_std: Float[Array, ""]  # uT by which the bias drifts from touch to touch; 0 where it is measured at each


def fit_likelihood(
    errors: Float[np.ndarray, "n c"],
    scale: Float[Array, " c"],
    loads: Float[Array, " l"],
    *,
    overtravel: float,
    position_std: float | ScaleMixture,
    stiffness: float = PressLimits.stiffness,
) -> Likelihood:
    """Fit a likelihood to a Gaussian process's errors on held-out touches, in double precision.

    Args:
        errors: Measured minus predicted readings (uT) of touches that the GP was not conditioned on.
        scale: Scale (uT) of each channel by which the GP's relative variance is multiplied.
        loads: Loads (N) at which touches are predicted.
        overtravel: Distance (m) beyond the site after which a press gives up.
        position_std: Standard deviation (m) of where a press ends at a known pose, or a mixture of several.
        stiffness: Of arm and mount in series (N/m).

    Returns:
        The likelihood, with defaults for what errors cannot tell.
    """
    # Shrunk towards its diagonal as by as many touches as there are channels.
    sample, n, channels = np.cov(np.asarray(errors, np.float64).T), *np.shape(errors)
    covariance = (n * sample + channels * np.diag(np.diag(sample))) / (n + channels) + 1e-3 * np.eye(channels)
    factor = np.linalg.inv(np.linalg.cholesky(covariance))
    growth, rotation = np.linalg.eigh(factor @ np.diag(np.asarray(scale, np.float64) ** 2) @ factor.T)
    number = partial(jnp.asarray, dtype=jnp.float32)
    if not isinstance(position_std, ScaleMixture):
        position_std = ScaleMixture(np.array([position_std]), np.ones(1))
    return Likelihood(
        whiten=number(rotation.T @ factor),
        growth=number(np.maximum(growth, 0)),
        loads=loads,
        overtravel=number(overtravel),
        dof=number(8.0),
        inflation=number(1.0),
        position_std=number(position_std.std),
        position_share=number(position_std.share),
        indentation_error=number(INDENTATION_ERROR),
        outlier_rate=number(OUTLIER_RATE),
        tactile_weight=number(1.0),
        spatial_weight=number(1.0),
        presence_weight=number(1.0),
        stiffness=number(stiffness),
        drift_std=number(0.0),
    )


def fit_position_errors(
    errors: Float[np.ndarray, " n"],
    variance: Float[np.ndarray, " n"],
    *,
    outlier_density: float = 0.0,
    stds: Sequence[float] = POSITION_STDS_M,
) -> ScaleMixture:
    """The distribution of errors, a scale mixture of normals with given standard deviations, whose shares are found by
    expectation maximisation (Laird, JASA 73, 1978).

    Args:
        errors: Of predictions (m).
        variance: The part of each error's variance (m^2) that is known and no part of the distribution.
        outlier_density: Share of outliers over the length (1/m) on which they may be.
        stds: Standard deviations (m) that are mixed.

    Returns:
        The mixture; standard deviations that no error asks for keep a small share.

    Raises:
        ValueError: An error or its variance is not finite.
    """
    if lost := int(np.sum(~np.isfinite(np.asarray(errors, float) + np.asarray(variance, float)))):
        raise ValueError(f"{lost} of {len(errors)} errors of position are not finite; leave these touches out")
    std = np.asarray(stds, float)
    total = std[None] ** 2 + np.asarray(variance, float)[:, None]
    density = np.exp(-0.5 * np.asarray(errors, float)[:, None] ** 2 / total) / np.sqrt(2 * np.pi * total)
    share = np.full(len(std), 1 / len(std))
    for _ in range(EM_STEPS):
        joint = share * density
        belonging = joint / (joint.sum(1, keepdims=True) + outlier_density + np.finfo(float).tiny)
        share = belonging.sum(0) + PRIOR_TOUCHES
        share = share / share.sum()
    return ScaleMixture(std, share)


def outlier_range(overtravel: Length) -> Length:
    """The length (m) over which an outlier's press may end.

    Args:
        overtravel: Distance (m) beyond the site after which a press gives up.

    Returns:
        The length (m).
    """
    return 2 * overtravel + STRAY_RANGE_M
