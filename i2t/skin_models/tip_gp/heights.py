"""Local heights of a skin that is not flat: the travel by which a press differs from its stated load.

Heights are a Gaussian process over positions, common to all channels, in typical loads of the first kind. They are
measured by leave-one-out errors along the slopes of the readings by the load. Because the roughness of a skin is
unknown, there are several hypotheses, one of them a flat skin.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import logsumexp

from i2t.leave_one_out import leave_out_rows
from i2t.skin_models.tip_gp.kernel import squared_distance
from i2t.types import in_one_line


@dataclass(frozen=True)
class Roughness:
    """Hypotheses on a skin's roughness: standard deviation (typical loads) and length (m) of its heights, priors."""

    prior: float = 0.5  # prior probability that a skin has local heights
    error_exponent: float = 1.0  # exponent of the leave-one-out error in the probability of a hypothesis
    min_share: float = 0.01  # probability below which a hypothesis is dropped
    stds: tuple[float, ...] = (0.02, 0.06, 0.12)  # standard deviations of the local heights, in typical loads
    lengths: tuple[float, ...] = (1.0e-3, 2.0e-3, 4.0e-3)  # m, length scales of the local heights
    measurement_std: float = 5e-3  # smallest error, in typical loads, of the height that a press measures


ROUGHNESS = Roughness()  # default hypotheses on the size and length of a skin's local heights, and their prior


@in_one_line
class Heights(NamedTuple):
    """Local heights of a skin that is not flat, measured at n presses, and j hypotheses of its roughness.

    Heights are in typical loads of the first kind of load.
    """

    std: Float[np.ndarray, " j"]
    length: Float[np.ndarray, " j"]  # m, length scale of the heights
    share: Float[np.ndarray, " j"]  # probability of these heights; the remainder up to 1 is that of a flat skin
    measured: Float[np.ndarray, " n"]
    variance: Float[np.ndarray, " n"]  # variance of the measured heights


class SlopedErrors(NamedTuple):
    """Leave-one-out errors (uT) of a mixture on n presses, and slopes of the predictions (uT per typical load)."""

    error: Float[np.ndarray, "n c"]  # uT, error of each prediction
    variance: Float[np.ndarray, "n c"]  # uT^2, variance of each error
    slope: Float[np.ndarray, "n c"]  # uT per typical load, slope of each prediction
    height: Float[np.ndarray, " n"]  # heights used in the predictions, in typical loads


def measured_heights(std: Float[np.ndarray, " j"], length: Float[np.ndarray, " j"], held_out: SlopedErrors) -> Heights:
    """Measure a skin's local heights by leave-one-out errors of presses, and give each hypothesis the probability 1.

    Args:
        std: `(j,)` standard deviations of the heights (typical loads), one for each hypothesis.
        length: `(j,)` correlation lengths of the heights (m).
        held_out: Leave-one-out errors of n presses.

    Returns:
        The heights at the n presses under each hypothesis.
    """
    error, variance, slope, own = held_out
    total = np.maximum(np.sum(slope**2 / variance, axis=1), 1e-12)
    measured = own + np.sum(slope * error / variance, axis=1) / total
    return Heights(std, length, np.ones(len(std)), measured, 1 / total + ROUGHNESS.measurement_std**2)


def hypothesis_shares(
    heights: Heights, position: Float[np.ndarray, "n 2"], held_out: SlopedErrors
) -> Float[np.ndarray, " j"]:
    """Compute the probabilities of hypotheses on a skin's roughness from leave-one-out errors.

    The errors are corrected by heights from which the press itself is left out as well.

    Args:
        heights: Heights measured under all hypotheses.
        position: `(n, 2)` positions of the presses (m).
        held_out: Leave-one-out errors of the presses.

    Returns:
        `(j,)` probabilities of the hypotheses; the remainder up to 1 is that of a flat skin.
    """
    error, _, slope, own = held_out
    missed = [np.sum((error + slope * own[:, None]) ** 2)]
    for inverse in height_inverses(heights, position):
        without = leave_out_rows(np.diagonal(inverse), (inverse @ heights.measured)[:, None])
        height = heights.measured - without.error[:, 0]
        missed.append(np.sum((error - slope * (height - own)[:, None]) ** 2))
    prior = np.full(len(missed), ROUGHNESS.prior / len(heights.std))
    prior[0] = 1 - ROUGHNESS.prior
    log = np.log(prior) - ROUGHNESS.error_exponent * len(error) / 2 * np.log(np.maximum(missed, 1e-30))
    return np.exp(log - logsumexp(log))[1:]


def height_inverses(heights: Heights, position: Float[np.ndarray, "n 2"]) -> list[Float[np.ndarray, "n n"]]:
    """Invert the covariances of a skin's measured local heights.

    Args:
        heights: Heights measured at n presses.
        position: `(n, 2)` positions of these presses (m).

    Returns:
        `(n, n)` inverse covariance for each hypothesis.
    """
    square, noise = squared_distance(position, position), np.diag(heights.variance)
    pairs = zip(heights.std, heights.length, strict=True)
    return [np.linalg.inv(std**2 * np.exp(-square / (2 * length**2)) + noise) for std, length in pairs]


def heights_at(
    heights: Heights, square: Float[np.ndarray, "m n"], inverses: list[Float[np.ndarray, "n n"]]
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Predict a skin's local heights at m other positions.

    Args:
        heights: Heights measured at n presses.
        square: `(m, n)` squared distances of the positions from these presses (m^2).
        inverses: The result of `height_inverses`.

    Returns:
        `(m,)` means (typical loads) and variances of the heights over all hypotheses, among them a flat skin.
    """
    mean, square_mean = np.zeros(len(square)), np.zeros(len(square))
    for i, inverse in enumerate(inverses):
        near = heights.std[i] ** 2 * np.exp(-square / (2 * heights.length[i] ** 2))
        own = near @ (inverse @ heights.measured)
        left = heights.std[i] ** 2 - np.einsum("mn,mn->m", near @ inverse, near)
        mean += heights.share[i] * own
        square_mean += heights.share[i] * (own**2 + np.maximum(left, 0))
    return mean, np.maximum(square_mean - mean**2, 0)
