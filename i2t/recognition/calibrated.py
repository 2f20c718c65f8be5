"""Calibrated beliefs: temperature scaling, and Platt calibration of the unknown class.

Errors of a pad model or of an object's pose are shared by all touches of an episode, but a belief treats touches as
independent and becomes overconfident. Both calibrations therefore soften a belief the more touches it contains. Their
parameters are fitted on validation episodes. Shapes are those of `i2t.recognition.metrics`.

Sources: temperature scaling, Guo et al. (ICML 2017); logit calibration, Platt (Advances in Large Margin Classifiers,
1999). The probability of an unknown object should depend on the touches and not on how often such objects occur:
`with_unknown_prior` moves a belief from one prior to another.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import optimize
from scipy.special import expit, logit, logsumexp, softmax

from i2t.recognition.belief import MIN_PROBABILITY
from i2t.recognition.metrics import PROBABILITY_FLOOR
from i2t.types import Array

# --- temperature scaling of the objects ---


class TemperatureScaling(NamedTuple):
    """Temperature scaling of beliefs: log probabilities after t touches are divided by a temperature that grows with t.

    The temperature is `initial` * (1 + `growth` * (t - 1)).
    """

    initial: float = 1.0
    growth: float = 0.0

    def temperature(self, touches: Array | float) -> Any:
        """Compute the temperature, by which log probabilities are divided.

        Args:
            touches: Number of touches of the episode so far, at least 1.

        Returns:
            Temperature after this number of touches.
        """
        return self.initial * (1 + self.growth * (touches - 1))

    def apply(self, p: Float[Array, "*shape c"], touches: Array | float) -> Float[np.ndarray, "*shape c"]:
        """Calibrate probabilities without changing the order of the classes.

        Args:
            p: Probabilities of the classes.
            touches: Number of touches in each belief, broadcast against all but the last axis.

        Returns:
            Calibrated probabilities of the same shape.
        """
        divisor = np.asarray(self.temperature(touches), np.float64)[..., None]
        return softmax(_logs(p) / divisor, axis=-1)


# Default temperature by which the log posterior of an episode is divided. It was fitted to 1020 simulated episodes on
# six pads, whose validation objects were twice as far from their stated poses as stated (`experiments.studies
# stopping`). Up to that distance, an episode that stops is wrong about as rarely as requested.
POSTERIOR_TEMPERATURE = TemperatureScaling(initial=1.88, growth=0.22)


def fit_temperature(p: Float[Array, "e t c"], truth: Int[Array, " e"], *, smoothing: float = 0.0) -> TemperatureScaling:
    """Fit the temperature that minimises the log loss of beliefs over all touches of validation episodes.

    Args:
        p: `(e, t, c)` probabilities of c classes after each of t touches in e episodes.
        truth: `(e,)` indices of the true classes.
        smoothing: Fraction of the episodes as in `fit_temperature_to_sets`.

    Returns:
        Temperature as a function of the number of touches.

    Raises:
        ValueError: There is no episode, or a belief is not finite.
    """
    return fit_temperature_to_sets([(p, truth)], smoothing=smoothing)


def fit_temperature_to_sets(
    sets: Sequence[tuple[Float[Array, "_ _ _"], Int[Array, " _"]]], *, smoothing: float = 0.0
) -> TemperatureScaling:
    """Fit one temperature to sets of episodes that differ in the number of touches or classes.

    Args:
        sets: Beliefs of validation episodes, and their true classes.
        smoothing: Fraction of the episodes that count as if every class had been true equally often, so that a few
            episodes that are all right claim no certainty (Platt's targets).

    Returns:
        Temperature with the smallest mean log loss over all episodes and touches.

    Raises:
        ValueError: There is no episode, or a belief is not finite.
    """
    ready = [(_logs(p), np.asarray(truth)[:, None, None]) for p, truth in sets]
    count = sum(logs.shape[0] * logs.shape[1] for logs, _ in ready)
    _check_episodes(count)

    def loss(x: np.ndarray) -> float:
        scaling, total = TemperatureScaling(np.exp(x[0]), np.exp(x[1])), 0.0
        for logs, truth in ready:
            scaled = logs / scaling.temperature(np.arange(1, logs.shape[1] + 1.0))[None, :, None]
            right = (1 - smoothing) * np.take_along_axis(scaled, truth, -1)[..., 0] + smoothing * scaled.mean(-1)
            total += np.sum(logsumexp(scaled, axis=-1) - right)
        return float(total / count)

    bounds = ((-4.0, 4.0), (-12.0, 1.0))
    # One start for touches that share few errors, and one for touches that share most of them.
    starts = [np.array([0.0, np.log(growth)]) for growth in (0.05, 0.5)]
    initial, growth = np.exp(_minimise(loss, starts, bounds))
    return TemperatureScaling(float(initial), float(growth))


def calibrated_beliefs(
    p: Float[Array, "e t c"], temperature: TemperatureScaling = POSTERIOR_TEMPERATURE
) -> Float[Array, "e t c"]:
    """Calibrate beliefs of whole episodes by temperature scaling, without changing the order of the classes.

    Args:
        p: `(e, t, c)` probabilities of c classes after each of t touches in e episodes.
        temperature: The fitted temperature.

    Returns:
        Calibrated beliefs of the same shape.
    """
    return temperature.apply(p, np.arange(1, p.shape[1] + 1.0))


def _logs(p: Float[Array, "*shape"]) -> Float[np.ndarray, "*shape"]:
    return np.log(np.maximum(np.asarray(p, np.float64), MIN_PROBABILITY))


# --- the unknown class ---


def with_unknown_prior(
    p: Float[Array, "*shape objects"], p_unknown: Float[Array, "*shape"], old: float, new: float
) -> tuple[Float[Array, "*shape objects"], Float[Array, "*shape"]]:
    """Convert beliefs to another prior probability of unknown objects, by Bayes' rule.

    Args:
        p: Probabilities of the known objects.
        p_unknown: Probability of the unknown class.
        old: Prior probability of unknown objects in these beliefs, in (0, 1).
        new: New prior probability, in [0, 1).

    Returns:
        Probabilities of the known objects and of the unknown class under the new prior.

    Raises:
        ValueError: A prior lies outside its range.
    """
    if not (0 < old < 1 and 0 <= new < 1):
        raise ValueError(f"with_unknown_prior: priors {old} and {new} must lie in (0, 1) and [0, 1)")
    odds = new / (1 - new) * (1 - old) / old
    joined = np.concatenate([np.asarray(p, np.float64), odds * np.asarray(p_unknown, np.float64)[..., None]], axis=-1)
    total = joined.sum(-1, keepdims=True)
    # A belief that excludes all known objects becomes uniform if the new prior excludes unknown ones.
    uniform = np.append(np.full(np.shape(p)[-1], 1 / np.shape(p)[-1]), 0)
    joined = np.where(total > 0, joined / np.where(total > 0, total, 1), uniform)
    return joined[..., :-1], joined[..., -1]


class PlattScaling(NamedTuple):
    """Platt calibration of the probability that an object is unknown.

    The log odds L after t touches become `offset` + `slope` / (1 + `growth` (t - 1)) L.
    """

    offset: float
    slope: float
    growth: float = 0.0

    def apply(self, p_unknown: Float[Array, "*shape"], touches: Array | float) -> Float[Array, "*shape"]:
        """Calibrate probabilities of the unknown class.

        Args:
            p_unknown: Probability of the unknown class.
            touches: Number of touches in each belief, broadcast against it.

        Returns:
            Calibrated probabilities of the same shape.
        """
        return expit(self.offset + self.slope / (1 + self.growth * (touches - 1)) * _log_odds(p_unknown))


def fit_platt(p_unknown: Float[Array, "e t"], unknown: Bool[Array, " e"]) -> PlattScaling:
    """Fit the calibration of the unknown class with the smallest log loss over all touches.

    Args:
        p_unknown: `(e, t)` probability of the unknown class after each of t touches in e validation episodes.
        unknown: `(e,)` True where the object was unknown.

    Returns:
        Offset, slope and growth of the fitted calibration.

    Raises:
        ValueError: There is no episode, or a probability is not finite.
    """
    _check_episodes(np.size(p_unknown))
    log_odds, touches = _log_odds(p_unknown), np.arange(1, np.shape(p_unknown)[1] + 1)
    sign = np.where(np.asarray(unknown, bool), 1.0, -1.0)[:, None]

    def loss(x: np.ndarray) -> float:
        return float(np.mean(np.logaddexp(0, -sign * (x[0] + x[1] / (1 + x[2] * (touches - 1)) * log_odds))))

    bounds = (-20.0, 20.0), (0.01, 10.0), (0.0, 10.0)
    return PlattScaling(*_minimise(loss, [np.array([0.0, 1.0, 0.0])], bounds).tolist())


def _check_episodes(count: int) -> None:
    if count == 0:
        raise ValueError("there is no episode to calibrate beliefs on; give validation episodes")


def _minimise(loss: Callable[[np.ndarray], float], starts: Sequence[np.ndarray], bounds: Sequence[tuple]) -> np.ndarray:
    """Minimise a loss from the best of some starts. Raise ValueError if it is not finite there."""
    with np.errstate(invalid="ignore"):
        finite = all(np.isfinite(loss(start)) for start in starts)
    if not finite:
        raise ValueError("the log loss of these beliefs is not finite; look for probabilities that are not finite")
    best: np.ndarray = optimize.minimize(loss, min(starts, key=loss), method="Nelder-Mead", bounds=bounds).x
    return best


def apply_platt(
    p: Float[Array, "e t objects"], p_unknown: Float[Array, "e t"], scaling: PlattScaling
) -> tuple[Float[Array, "e t objects"], Float[Array, "e t"]]:
    """Calibrate the probability of the unknown class; the known objects share the rest in the same proportions.

    Args:
        p: Probabilities of the known objects.
        p_unknown: Probability of the unknown class.
        scaling: The fitted calibration.

    Returns:
        Calibrated probabilities of the known objects and of the unknown class.
    """
    unknown = scaling.apply(p_unknown, np.arange(1, np.shape(p_unknown)[1] + 1))
    p = np.asarray(p, np.float64)
    total = p.sum(-1, keepdims=True)
    share = np.where(total > 0, p / np.where(total > 0, total, 1), 1 / p.shape[-1])
    return share * (1 - unknown)[..., None], unknown


def _log_odds(p: Array) -> np.ndarray:
    """Compute log odds, clipped to the range of single precision."""
    return logit(np.clip(np.asarray(p, np.float64), PROBABILITY_FLOOR, 1 - PROBABILITY_FLOOR))
