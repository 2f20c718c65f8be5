"""Local heights of a skin that is not flat: what a press is deeper or shallower than its load says.

Heights are a Gaussian process over positions, common to all channels, in typical loads of the first kind. Errors of
presses left out measure them, along the slopes of the readings by the load. How rough a skin is, nobody knows: there
are several hypotheses, and one that it is flat.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import logsumexp

from i2t.leave_one_out import leave_out_rows
from i2t.skin_models.tip_gp.kernel import squared_distance
from i2t.types import in_one_line

HEIGHT_SHARE = 0.5  # of belief that a skin has local heights, before any press
HEIGHT_EXPONENT = 1.0  # of the leave-one-out error
MIN_HEIGHT_SHARE = 0.01  # of an idea of how rough a skin is, to be kept
HEIGHT_STDS = (0.02, 0.06, 0.12)  # typical loads
HEIGHT_LENGTHS_M = (1.0e-3, 2.0e-3, 4.0e-3)
HEIGHT_ERROR = 5e-3  # typical loads, standard deviation of what a press measures of its height, at least


@in_one_line
class Heights(NamedTuple):
    """Local heights of the skin, in typical loads of the first kind, averaged over j hypotheses of its roughness."""

    std: Float[np.ndarray, " j"]
    length: Float[np.ndarray, " j"]  # m
    share: Float[np.ndarray, " j"]  # of belief; what is left of 1 is for a skin without heights
    measured: Float[np.ndarray, " n"]
    variance: Float[np.ndarray, " n"]  # of what is measured


class SlopedErrors(NamedTuple):
    """Presses left out, as a mixture predicts them."""

    error: Float[np.ndarray, "n c"]  # uT
    variance: Float[np.ndarray, "n c"]  # uT^2
    slope: Float[np.ndarray, "n c"]  # uT for a typical load more
    height: Float[np.ndarray, " n"]  # with which they were predicted (typical loads)


def measured_heights(std: Float[np.ndarray, " j"], length: Float[np.ndarray, " j"], left_out: SlopedErrors) -> Heights:
    """Heights that errors of presses left out measure, under hypotheses of full weight.

    Args:
        std: Of the heights, under each hypothesis (typical loads).
        length: Over which they change (m).
        left_out: The presses.

    Returns:
        The heights.
    """
    error, variance, slope, own = left_out
    total = np.maximum(np.sum(slope**2 / variance, axis=1), 1e-12)
    measured = own + np.sum(slope * error / variance, axis=1) / total
    return Heights(std, length, np.ones(len(std)), measured, 1 / total + HEIGHT_ERROR**2)


def hypothesis_shares(
    heights: Heights, position: Float[np.ndarray, "n 2"], left_out: SlopedErrors
) -> Float[np.ndarray, " j"]:
    """Weigh the hypotheses by errors of presses left out, their heights left out too.

    Args:
        heights: Measured, under all hypotheses.
        position: Of the presses (m).
        left_out: The presses.

    Returns:
        Shares of belief; what is left of 1 is for a flat skin.
    """
    error, _, slope, own = left_out
    missed = [np.sum((error + slope * own[:, None]) ** 2)]
    for inverse in height_inverses(heights, position):
        without = leave_out_rows(np.diagonal(inverse), (inverse @ heights.measured)[:, None])
        height = heights.measured - without.error[:, 0]
        missed.append(np.sum((error - slope * (height - own)[:, None]) ** 2))
    prior = np.full(len(missed), HEIGHT_SHARE / len(heights.std))
    prior[0] = 1 - HEIGHT_SHARE
    log = np.log(prior) - HEIGHT_EXPONENT * len(error) / 2 * np.log(np.maximum(missed, 1e-30))
    return np.exp(log - logsumexp(log))[1:]


def height_inverses(heights: Heights, position: Float[np.ndarray, "n 2"]) -> list[Float[np.ndarray, "n n"]]:
    """Inverse covariances of the measured heights.

    Args:
        heights: Measured at n presses.
        position: Of these presses (m).

    Returns:
        One for each hypothesis.
    """
    square, noise = squared_distance(position, position), np.diag(heights.variance)
    pairs = zip(heights.std, heights.length, strict=True)
    return [np.linalg.inv(std**2 * np.exp(-square / (2 * length**2)) + noise) for std, length in pairs]


def heights_at(
    heights: Heights, square: Float[np.ndarray, "m n"], inverses: list[Float[np.ndarray, "n n"]]
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Heights at other positions.

    Args:
        heights: Measured at n presses.
        square: Squared distances of the positions from these presses (m^2).
        inverses: As of `height_inverses`.

    Returns:
        Mean and variance (typical loads).
    """
    mean, square_mean = np.zeros(len(square)), np.zeros(len(square))
    for i, inverse in enumerate(inverses):
        near = heights.std[i] ** 2 * np.exp(-square / (2 * heights.length[i] ** 2))
        own = near @ (inverse @ heights.measured)
        left = heights.std[i] ** 2 - np.einsum("mn,mn->m", near @ inverse, near)
        mean += heights.share[i] * own
        square_mean += heights.share[i] * (own**2 + np.maximum(left, 0))
    return mean, np.maximum(square_mean - mean**2, 0)
