"""Scores of methods on touches that none was fitted to, and the choice of the predictor: the best on validation
touches, baselines included.

Validation touches are held out as test touches are, by whole objects, sessions, blocks of places or times, and how sure
the choice is comes from resampling whole groups of them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from experiments.train.prepare import Prepared
from i2t.intervals import grouped_interval, student_interval
from i2t.prediction.methods import Method
from i2t.prediction.metrics import score
from i2t.prediction.predictor import Predictor, coverage, std_scale
from i2t.prediction.touch_model import Reading

LEVEL_R2 = 0.01  # a lead of less than this is none


class Lead(NamedTuple):
    """Lead in R2 of one method over another on the same touches."""

    r2: float  # difference of R2
    low: float  # 95 % interval over groups
    high: float


class MethodChoice(NamedTuple):
    """The method that is kept, and how sure that is."""

    best: str
    r2: dict[str, float]  # on validation touches, of every row; NaN where a method's prediction is not finite
    best_baseline: str
    over_baseline: Lead  # of the best over the best baseline
    best_on_pressure: str | None
    pressure_over_baseline: Lead | None

    @property
    def pressure_loses(self) -> bool:
        """Tell whether the best method on predicted pressure explains less than the best baseline, beyond chance or by
        so much that chance is no excuse.
        """
        lead = self.pressure_over_baseline
        return lead is not None and lead.r2 < -LEVEL_R2 and (lead.high < 0 or lead.r2 < -5 * LEVEL_R2)

    def to_json(self) -> dict[str, Any]:
        """The choice as numbers for metrics.json.

        Returns:
            Names and differences of R2 with their intervals.
        """
        return {
            "best": self.best,
            "best_baseline": self.best_baseline,
            "over_best_baseline": self.over_baseline._asdict(),
            "best_on_pressure": self.best_on_pressure,
            "pressure_over_best_baseline": self.pressure_over_baseline and self.pressure_over_baseline._asdict(),
        }


class Evaluation(NamedTuple):
    """Results of the methods on touches that none was fitted to."""

    predicted: dict[str, np.ndarray]  # (test touches, 3 chips) uT, by method
    std: dict[str, np.ndarray]  # likewise
    choice: MethodChoice  # on validation touches
    coverage: dict[str, float]  # share of validation values in the 90 % range, by method
    predictors: dict[str, Predictor]  # their standard deviations scaled on the validation touches


def evaluate(
    prepared: Prepared,
    methods: Sequence[Method],
    fitted: Mapping[str, Predictor],
    others: Mapping[str, Reading] | None = None,
) -> Evaluation:
    """Scale the standard deviations on the validation touches, choose a predictor on these and those that only choose;
    predict the test touches.

    Args:
        prepared: The touches and their split.
        methods: All methods.
        fitted: Predictors by the title of their method.
        others: Readings of the touches that validate or test by what is no method: judged alike, never kept.

    Returns:
        Predictions of the test touches, and the choice among the methods.

    Raises:
        ValueError: A method predicts arrays of other shapes than the readings', or impossible standard deviations.
    """
    split, readings = prepared.split, prepared.touches.dataset.touches.reading
    judging = prepared.judging_rows
    held_out = judging | split.test
    tuning, testing, judged = split.validation[held_out], split.test[held_out], judging[held_out]
    truth = readings[split.validation]
    asked = prepared.touches.batch(held_out)
    predicted, std, validated, covered, predictors = {}, {}, {}, {}, {}
    readings_of = {name: predictor.predict_batch(asked) for name, predictor in fitted.items()} | dict(others or {})
    for name, reading in readings_of.items():
        if {np.shape(reading.mean), np.shape(reading.std)} != {readings[held_out].shape}:
            raise ValueError(
                f"{name} predicts means and standard deviations of shapes {np.shape(reading.mean)} and "
                f"{np.shape(reading.std)} where readings are {readings[held_out].shape}"
            )
        if np.isfinite(reading.mean).all() and not (np.isfinite(reading.std).all() and (reading.std >= 0).all()):
            raise ValueError(f"{name} predicts standard deviations that are negative or not finite")
        reading = Reading(reading.mean, np.maximum(reading.std, 1e-6))  # uT, because errors are divided by it
        seen = Reading(reading.mean[tuning], reading.std[tuning])
        scale = std_scale(truth, seen)
        validated[name] = reading.mean[judged]
        covered[name] = coverage(truth, Reading(seen.mean, scale * seen.std))
        predicted[name], std[name] = reading.mean[testing], scale * reading.std[testing]
        if name in fitted:
            predictors[name] = replace(fitted[name], std_scale=scale)
    choice = choose(
        readings[judging],
        {name: validated[name] for name in fitted},
        split.groups[judging],
        baselines=[method.title for method in methods if method.baseline],
        on_pressure=[
            method.title
            for method in methods
            if method.title in predictors and not method.baseline and predictors[method.title].pressure is not None
        ],
    )
    r2 = choice.r2 | {name: score(readings[judging], validated[name]).r2 for name in others or ()}
    return Evaluation(predicted, std, choice._replace(r2=r2), covered, predictors)


def choose(
    truth: np.ndarray,
    predicted: Mapping[str, np.ndarray],
    groups: np.ndarray,
    *,
    baselines: Sequence[str],
    on_pressure: Sequence[str],
) -> MethodChoice:
    """Choose by the squared error on validation touches.

    Args:
        truth: (n, 3 chips) uT, of the validation touches.
        predicted: Readings (n, 3 chips) uT by method.
        groups: (n,) session, spatial block or stretch of time of each touch.
        baselines: Names of the methods that are baselines.
        on_pressure: Names of the methods on predicted contact pressure that are no baselines.

    Returns:
        The method with the least error of all whose predictions are finite; of equal ones, the first.
    """
    finite = {name: mean for name, mean in predicted.items() if np.isfinite(mean).all()}
    errors = {name: ((mean - truth) ** 2).sum(1) for name, mean in finite.items()}
    r2 = {name: score(truth, mean).r2 if name in finite else float("nan") for name, mean in predicted.items()}

    def least(names: Sequence[str]) -> str | None:
        usable = [name for name in names if name in errors]
        return min(usable, key=lambda name: float(errors[name].sum())) if usable else None

    best, baseline, pressed = least(list(predicted)), least(baselines), least(on_pressure)
    if best is None or baseline is None:
        raise ValueError("no method predicts finite readings; look for readings or patches that are not finite")
    return MethodChoice(
        best,
        r2,
        baseline,
        lead_of(truth, errors[best], errors[baseline], groups),
        best_on_pressure=pressed,
        pressure_over_baseline=None if pressed is None else lead_of(truth, errors[pressed], errors[baseline], groups),
    )


def lead_of(truth: np.ndarray, error: np.ndarray, other: np.ndarray, groups: np.ndarray) -> Lead:
    """Lead in R2 of one method's errors over another's.

    Args:
        truth: (n, 3 chips) uT.
        error: (n,) uT^2, squared errors of the method.
        other: (n,) uT^2, of the other.
        groups: (n,) of touches that are not independent.

    Returns:
        The difference with its 95 % interval over groups.
    """
    spread = ((truth - truth.mean(0)) ** 2).sum(1)

    def difference(rows: np.ndarray) -> float:
        return float((other[rows] - error[rows]).sum() / max(spread[rows].sum(), 1e-12))

    return Lead(difference(np.arange(len(truth))), *grouped_interval(difference, groups))


def choice_over_pads(parts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The method that is best on validation touches over several pads, and its lead over the best baseline.

    Args:
        parts: Metrics of each pad and seed, of the same methods.

    Returns:
        Mean validation R2 by method, both names, and the lead with its 95 % interval over pads (Student's t); and how
        many touches, sessions and objects validated.
    """
    pads = sorted({str(part["pad"]) for part in parts})
    finite = [name for name in parts[0]["validation_r2"] if all(_is_number(p["validation_r2"][name]) for p in parts)]
    of_pad = {
        name: np.array([np.mean([p["validation_r2"][name] for p in parts if str(p["pad"]) == pad]) for pad in pads])
        for name in finite
    }
    mean = {name: float(values.mean()) for name, values in of_pad.items()}
    best = max(mean, key=lambda name: mean[name])
    baseline = max((name for name in parts[0]["baselines"] if name in mean), key=lambda name: mean[name])
    return {
        "best": best,
        "best_baseline": baseline,
        "validation_r2": mean,
        "over_best_baseline": Lead(*student_interval(of_pad[best] - of_pad[baseline]))._asdict(),
        "validated_on": {
            "touches": sum(part["validated_on"]["touches"] for part in parts),
            "groups": sum(part["validated_on"]["groups"] for part in parts),
            "objects": max(part["validated_on"]["objects"] for part in parts),
        },
    }


def _is_number(value: float | None) -> bool:
    return value is not None and bool(np.isfinite(value))


def position_note(choice: MethodChoice, by_position: Sequence[str]) -> list[str]:
    """A sentence where what is given the position of one tip explains more than the method that is kept.

    Args:
        choice: On validation touches.
        by_position: Titles of the rows that are given positions.

    Returns:
        The sentence, if there is one.
    """
    best = max(by_position, key=lambda name: choice.r2[name], default=choice.best)
    if not choice.r2[best] > choice.r2[choice.best]:
        return []
    return [
        f"{best}, which is given the tip's position and knows this tip only, explains more of the validation touches "
        f"than any method (R2 {choice.r2[best]:.3f}, {choice.best} {choice.r2[choice.best]:.3f})"
    ]


def pressure_note(choice: MethodChoice, recorded: Path | None) -> list[str]:
    """A sentence where a method on predicted pressure loses to a baseline, and what tells why.

    Args:
        choice: On validation touches.
        recorded: Where the touches are from; None where they are simulated.

    Returns:
        The sentence, if there is one.
    """
    method, baseline = choice.best_on_pressure, choice.best_baseline
    if method is None or not choice.pressure_loses:
        return []
    said = f"{method} loses to {baseline} on validation touches"
    if recorded is None:
        return [said]
    return [f"{said}; python -m experiments.fidelity --dataset {recorded} tests likely causes"]
