"""Likelihood of a measured touch given the predicted one, fitted to leave-one-out errors.

Errors of a reading are Student's t with their covariance. Errors of where a press ends have heavy tails, modelled by a
scale mixture of normals (Andrews and Mallows, J. R. Stat. Soc. B 36, 1974). `i2t.recognition.belief` describes how both
are used. Metres, newtons, microtesla.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, TypeVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from i2t.contact.press import PressLimits
from i2t.types import in_one_line

Length = TypeVar("Length", float, Array)  # m


@dataclass(frozen=True)
class TouchErrors:
    """Assumptions about errors of the indentation and position at which a press ends.

    The indentation error is the most probable value, among 0.1, 0.2, ... 0.5, for the validation objects at their true
    places.
    """

    # standard deviation of an indentation on unknown objects, relative to the layer's indentation
    indentation_error: float = 0.2
    outlier_rate: float = 0.01  # share of touches that are outliers, which may end anywhere
    stray_range: float = 20e-3  # m, length over which an outlier's press may end, in addition to twice the overtravel
    # Standard deviations (m) in the mixture, from the repeatability of an arm to a missed edge.
    position_stds: tuple[float, ...] = (0.05e-3, 0.1e-3, 0.2e-3, 0.4e-3, 0.8e-3, 1.6e-3)


# default errors of the indentation and position of a press's end, as the likelihood assumes them
TOUCH_ERRORS = TouchErrors()


class ScaleMixture(NamedTuple):
    """Error distribution with heavy tails: normal about 0, with s standard deviations (m) and their shares."""

    std: Float[np.ndarray, " s"]  # m, standard deviations of the components
    share: Float[np.ndarray, " s"]  # share of each standard deviation; the shares sum to 1


@in_one_line
class Likelihood(NamedTuple):
    """Distribution of a measured touch (reading, position and contact) about the predicted one.

    What `fit_likelihood` does not fit was chosen on validation episodes.
    """

    whiten: Float[Array, "c c"]  # W, with W S W' = 1 and W diag(scale^2) W' = diag(growth), S the errors' covariance
    growth: Float[Array, " c"]  # growth of each whitened variance with the Gaussian process's own variance
    loads: Float[Array, " l"]  # N, loads of the predicted touches
    overtravel: Float[Array, ""]  # m, distance beyond the site after which a press gives up
    dof: Float[Array, ""]  # degrees of freedom of the Student's t distribution
    inflation: Float[Array, ""]  # factor on the errors' standard deviation, for objects that were not trained on
    # m, standard deviations of the components of the error of a press's end at a known pose
    position_std: Float[Array, " s"]
    position_share: Float[Array, " s"]  # share of touches that have each of the standard deviations in `position_std`
    indentation_error: Float[Array, ""]  # standard deviation of an indentation, relative to the predicted one
    outlier_rate: Float[Array, ""]  # share of touches that are outliers, which may end anywhere
    tactile_weight: Float[Array, ""]  # weight of the reading's evidence; 0 ignores it
    spatial_weight: Float[Array, ""]  # weight of the position's evidence; 0 ignores it
    presence_weight: Float[Array, ""]  # weight of the evidence of having met something or nothing; 0 ignores it
    stiffness: Float[Array, ""]  # N/m, stiffness of arm and mount
    drift_std: Float[Array, ""]  # uT, drift of the bias from touch to touch; 0 if it is measured at each touch


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
        errors: `(n, c)` measured minus predicted readings (uT) of touches that the GP was not conditioned on.
        scale: `(c,)` scales (uT) of the channels, by which the GP's relative variance is multiplied.
        loads: `(l,)` loads (N) at which touches are predicted.
        overtravel: Distance (m) beyond the site at which a press gives up.
        position_std: Standard deviation (m) of the position at which a press ends on an object at a known pose, or a
            mixture of several.
        stiffness: Stiffness (N/m) of arm and mount in series.

    Returns:
        The likelihood, with defaults for what the errors do not determine.
    """
    # The covariance is shrunk towards its diagonal, with the weight of as many touches as there are channels.
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
        indentation_error=number(TOUCH_ERRORS.indentation_error),
        outlier_rate=number(TOUCH_ERRORS.outlier_rate),
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
    stds: Sequence[float] = TOUCH_ERRORS.position_stds,
    steps: int = 300,
    prior_touches: float = 0.5,
) -> ScaleMixture:
    """Fit a mixture of normal distributions with given standard deviations to position errors of presses.

    The shares are found by expectation maximisation (Laird, JASA 73, 1978).

    Args:
        errors: `(n,)` errors of predictions (m).
        variance: `(n,)` part of each error's variance (m^2) that is known and does not belong to the distribution.
        outlier_density: Share of outliers divided by the length (1/m) over which they may be.
        stds: Standard deviations (m) in the mixture.
        steps: Steps of expectation maximisation.
        prior_touches: Prior touches for each standard deviation, so that no tail is impossible.

    Returns:
        The mixture; standard deviations without evidence keep a small share.

    Raises:
        ValueError: An error or its variance is not finite.
    """
    if lost := int(np.sum(~np.isfinite(np.asarray(errors, float) + np.asarray(variance, float)))):
        raise ValueError(f"{lost} of {len(errors)} errors of position are not finite; leave these touches out")
    std = np.asarray(stds, float)
    total = std[None] ** 2 + np.asarray(variance, float)[:, None]
    density = np.exp(-0.5 * np.asarray(errors, float)[:, None] ** 2 / total) / np.sqrt(2 * np.pi * total)
    share = np.full(len(std), 1 / len(std))
    for _ in range(steps):
        joint = share * density
        belonging = joint / (joint.sum(1, keepdims=True) + outlier_density + np.finfo(float).tiny)
        share = belonging.sum(0) + prior_touches
        share = share / share.sum()
    return ScaleMixture(std, share)


def outlier_range(overtravel: Length) -> Length:
    """Compute the length of the range in which the press of an outlying touch may end.

    Args:
        overtravel: Distance (m) beyond the site at which a press gives up.

    Returns:
        The length (m).
    """
    return 2 * overtravel + TOUCH_ERRORS.stray_range
