"""Expectation of the next frame of a board, from its own statistics.

Each value is predicted from the last few of its channel, x[t] = m + sum_k w_k (x[t - k] - m), with weights fitted by
least squares to what came of late (a linear predictor; Makhoul, "Linear prediction: a tutorial review", 1975). A field
moves many channels together and damage one: what is left of a value is therefore compared with what the other channels
of the same frame leave to expect, r_i = (Q e)_i / Q_ii, with the inverse Q of the errors' covariance. Of a field that
swings fast as well as of one that stands still, r is of the size of the noise. A value far outside of that is damage,
or the beginning of something new: the frame after it tells.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

ORDER = 4  # values of a channel that the next is predicted from
KEPT_FRAMES = 128  # that the weights are fitted to
MIN_FITTED_FRAMES = 32
REFIT_FRAMES = 8  # between two fits
LEAST_FRAMES = 12  # received frames that a fit needs
MAX_GAP_FRAMES = 8  # that were lost and are filled in; behind a longer gap the last value is what is known
FORECAST_RIDGE = 1e-3  # of the mean square of a channel, added so that a constant one can be fitted
COMMON_DIRECTIONS = 2  # directions in which the channels' errors go together
FEW_ROWS = 10.0  # of which a fit explains more than of others: it grants more where it has few
MIN_OWN_VARIANCE_SHARE, MIN_STD_SHARE = 0.3, 0.8  # of what is usual on the same axis of all chips
FLOOR = np.array([0.02, 0.3, 0.3, 0.3])  # K, uT, standard deviation that is always granted
UNUSUAL_VALUE_STDS = 5.0  # standard deviations, beyond which a value has to be borne out
LASTING_CHANGE_SHARE = 0.5  # of that, by which a later value must be off to the same side
OUTLIER_STDS = 4.0  # standard deviations, to which errors count in a fit
EARLY_CHANGE = np.array([0.6, 25.0, 25.0, 25.0])  # K, uT, from frame to frame, before anything is fitted
STD_PER_MEDIAN = 1.4826  # of the size of Gaussian errors


class Expectation(NamedTuple):
    """Statistics of a board's values. Missing values are carried on as they were last known."""

    history: Float[np.ndarray, "frames chips 4"]  # t, x, y, z, the newest last
    came: Bool[np.ndarray, " frames"]  # which of them were received; the others are filled in
    middle: Float[np.ndarray, "chips 4"]
    weights: Float[np.ndarray, "chips 4 k"]  # of the newest value first
    precision: Float[np.ndarray, "c c"]  # Q, of all channels of all chips
    spread: Float[np.ndarray, "chips 4"]  # standard deviation of r
    frames: int  # so far
    since_fit: int = 0

    @property
    def fitted(self) -> bool:
        """Tell whether the weights are fitted to received frames."""
        return self.frames >= MIN_FITTED_FRAMES

    @property
    def next(self) -> Float[np.ndarray, "chips 4"]:
        """The values of the next frame."""
        newest = self.history[: -ORDER - 1 : -1]
        return self.middle + np.einsum("kij,ijk->ij", newest - self.middle, self.weights[..., : len(newest)])


def begin(table: Float[np.ndarray, "chips 4"]) -> Expectation:
    """Begin with one frame.

    Args:
        table: t, x, y, z of each chip; NaN is missing.

    Returns:
        The next is expected to be the same.
    """
    known = np.nan_to_num(table)
    weights = np.zeros((*known.shape, ORDER))
    weights[..., 0] = 1.0
    return Expectation(
        history=known[None],
        came=np.ones(1, bool),
        middle=np.zeros(known.shape),
        weights=weights,
        precision=np.eye(known.size),
        spread=np.tile(EARLY_CHANGE, (len(known), 1)),
        frames=1,
    )


class Doubt(NamedTuple):
    """Unusual values of a frame."""

    left: Float[np.ndarray, "chips 4"]  # K, uT, what neither the past nor the other channels explain
    values: Bool[np.ndarray, "chips 4"]  # those of which that is more than usual

    def __bool__(self) -> bool:
        return bool(self.values.any())


def doubt(expected: Expectation, table: Float[np.ndarray, "chips 4"], gap: int) -> Doubt:
    """Find the values that differ much more from what was expected than they usually do.

    Args:
        expected: Before the frame.
        table: Of the frame; what is missing is not unusual.
        gap: Frames that were lost before it.

    Returns:
        The answer.
    """
    left = _left(expected.precision, np.nan_to_num(table - _filled(expected, gap).next))
    return Doubt(left, (np.abs(left) > _most(expected)) & ~np.isnan(table))


def is_borne_out(expected: Expectation, found: Doubt, after: Float[np.ndarray, "chips 4"], gap: int) -> bool:
    """Test whether unusual values of a frame last: a later frame is off to the same side.

    Args:
        expected: Before the doubtful frame.
        found: Its unusual values.
        after: Of the later frame.
        gap: Frames between the last that was taken and this one.

    Returns:
        True where that holds for all of them.
    """
    left = _left(expected.precision, np.nan_to_num(after - _filled(expected, gap).next))
    lasts = (left * np.sign(found.left) > LASTING_CHANGE_SHARE * _most(expected)) | np.isnan(after)
    return bool(lasts[found.values].all())


def learn(expected: Expectation, table: Float[np.ndarray, "chips 4"], gap: int) -> Expectation:
    """Learn from one more frame.

    Args:
        expected: Before the frame.
        table: Of the frame; NaN is missing.
        gap: Frames that were lost before it.

    Returns:
        What is known then.
    """
    ahead = _filled(expected, gap)
    known = np.where(np.isnan(table), ahead.next, table)
    learned = ahead._replace(
        history=np.concatenate([ahead.history[-KEPT_FRAMES + 1 :], known[None]]),
        came=np.append(ahead.came[-KEPT_FRAMES + 1 :], True),
        frames=expected.frames + 1,
        since_fit=expected.since_fit + 1,
    )
    first = learned.frames == MIN_FITTED_FRAMES
    return _fit(learned) if first or (learned.fitted and learned.since_fit >= REFIT_FRAMES) else learned


def _most(expected: Expectation) -> Float[np.ndarray, "chips 4"]:
    return UNUSUAL_VALUE_STDS * expected.spread if expected.fitted else expected.spread


def _left(
    precision: Float[np.ndarray, "c c"], error: Float[np.ndarray, "*n chips 4"]
) -> Float[np.ndarray, "*n chips 4"]:
    """Part of each channel's error that the other channels' errors do not explain."""
    flat = error.reshape(*error.shape[:-2], -1)
    return (flat @ precision / np.diagonal(precision)).reshape(error.shape)


def _filled(expected: Expectation, gap: int) -> Expectation:
    """Expectation with lost frames filled in by their forecasts."""
    if gap > MAX_GAP_FRAMES:
        weights = np.zeros_like(expected.weights)
        weights[..., 0] = 1.0
        return expected._replace(weights=weights, middle=np.zeros_like(expected.middle))
    for _ in range(gap):
        expected = expected._replace(
            history=np.concatenate([expected.history, expected.next[None]]), came=np.append(expected.came, False)
        )
    return expected


def _fit(expected: Expectation) -> Expectation:
    """Expectation with weights, precision and spread fitted to the kept frames; outliers count little."""
    history, came = expected.history[-KEPT_FRAMES:], expected.came[-KEPT_FRAMES:]
    middle = np.median(history[came], 0)
    centred = history - middle
    past = np.stack([centred[ORDER - k : len(centred) - k] for k in range(1, ORDER + 1)], -1)  # (n, chips, 4, k)
    past, target = past[came[ORDER:]], centred[ORDER:][came[ORDER:]]
    if len(target) < LEAST_FRAMES:
        return expected._replace(history=history, came=came, since_fit=0)
    share = np.ones(target.shape)
    for _ in range(2):
        weighted = past * share[..., None]
        square, moment = np.einsum("nijk,nijl->jkl", weighted, past), np.einsum("nijk,nij->jk", weighted, target)
        # The axes of all chips swing together, and share their weights; temperatures have their own.
        square, moment = (np.stack([sums[0], *[sums[1:].sum(0)] * 3]) for sums in (square, moment))
        ridge = FORECAST_RIDGE * np.einsum("jkk->j", square) / ORDER + 1e-9
        weights = np.linalg.solve(square + ridge[:, None, None] * np.eye(ORDER), moment[..., None])[..., 0]
        weights = np.broadcast_to(weights, (history.shape[1], *weights.shape))
        error = target - np.einsum("nijk,ijk->nij", past, weights)
        most = OUTLIER_STDS * _spread(error)
        share = np.minimum(1.0, most / np.maximum(np.abs(error), 1e-12)) ** 2
    precision = _precision(np.clip(error, -most, most).reshape(len(error), -1), history.shape[1])
    spread = _spread(_left(precision, error)) * (1 + FEW_ROWS / len(error))
    return expected._replace(
        history=history, came=came, middle=middle, weights=weights, precision=precision, spread=spread, since_fit=0
    )


def _precision(errors: Float[np.ndarray, "n c"], chips: int) -> Float[np.ndarray, "c c"]:
    """Precision Q of errors that have few directions in common."""
    covariance = errors.T @ errors / len(errors)
    sizes, directions = np.linalg.eigh(covariance)
    shared = (directions[:, -COMMON_DIRECTIONS:] * sizes[-COMMON_DIRECTIONS:]) @ directions[:, -COMMON_DIRECTIONS:].T
    own = np.maximum(np.diagonal(covariance) - np.diagonal(shared), 0.0)
    own = np.maximum(own, MIN_OWN_VARIANCE_SHARE * np.median(own.reshape(chips, 4), 0)[None].repeat(chips, 0).ravel())
    return np.linalg.inv(shared + np.diag(own + np.tile(FLOOR, chips) ** 2))


def _spread(errors: Float[np.ndarray, "n chips 4"]) -> Float[np.ndarray, "chips 4"]:
    """Standard deviations, in spite of outliers; the same axis of other chips is about as noisy."""
    own = STD_PER_MEDIAN * np.median(np.abs(errors), 0)
    return np.maximum(np.maximum(own, MIN_STD_SHARE * np.median(own, 0)), FLOOR)
