"""Scores of methods on held-out touches, and selection of the best predictor on validation touches, which may be a
baseline.

Validation touches are held out like test touches: by whole objects, sessions, spatial blocks or times. The confidence
in the selection comes from resampling whole groups of them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from i2t.intervals import grouped_interval, student_interval
from i2t.prediction.fit import PreparedTouches
from i2t.prediction.methods import Method
from i2t.prediction.metrics import score
from i2t.prediction.predictor import Predictor, coverage, std_scale
from i2t.prediction.touch_model import Reading


class Lead(NamedTuple):
    """Lead in R2 of one method over another on the same touches."""

    r2: float  # difference of R2
    low: float  # 95 % interval over groups
    high: float


class MethodChoice(NamedTuple):
    """The selected method and its lead over the baselines."""

    best: str
    r2: dict[str, float]  # of every method on validation touches; NaN if its predictions are not finite
    best_baseline: str
    over_baseline: Lead  # of the best method over the best baseline
    best_on_pressure: str | None
    pressure_over_baseline: Lead | None

    @property
    def pressure_loses(self) -> bool:
        """Whether the best method on predicted pressure is worse than the best baseline: by more than 0.01 of R2 with
        an interval below 0, or by more than 0.05.
        """
        lead = self.pressure_over_baseline
        return lead is not None and (lead.r2 < -0.05 or (lead.r2 < -0.01 and lead.high < 0))

    def to_json(self) -> dict[str, Any]:
        """Convert the choice for metrics.json.

        Returns:
            Names of the methods, and differences of R2 with their intervals.
        """
        return {
            "best": self.best,
            "best_baseline": self.best_baseline,
            "over_best_baseline": self.over_baseline._asdict(),
            "best_on_pressure": self.best_on_pressure,
            "pressure_over_best_baseline": self.pressure_over_baseline and self.pressure_over_baseline._asdict(),
        }


class Evaluation(NamedTuple):
    """Results of the methods on held-out touches."""

    predicted: dict[str, np.ndarray]  # (test touches, 3 chips) uT, mean by method
    std: dict[str, np.ndarray]  # (test touches, 3 chips) uT, standard deviation by method
    choice: MethodChoice  # by validation touches
    coverage: dict[str, float]  # share of validation values in the 90 % range, by method
    predictors: dict[str, Predictor]  # with standard deviations scaled on the validation touches


def evaluate(
    prepared: PreparedTouches,
    methods: Sequence[Method],
    fitted: Mapping[str, Predictor],
    others: Mapping[str, Reading] | None = None,
) -> Evaluation:
    """Scale the standard deviations on the validation touches, select a predictor on the validation and selection
    touches, and predict the test touches.

    Args:
        prepared: The touches and their split.
        methods: All methods.
        fitted: Predictors by the title of their method.
        others: Other predictions of the held-out touches by title. They are scored like methods, but never selected.

    Returns:
        Predictions of the test touches, and the selected method.

    Raises:
        ValueError: A method predicts arrays of a wrong shape, or standard deviations that are negative or not finite.
    """
    split, readings = prepared.split, prepared.touches.dataset.touches.reading
    selection = prepared.selection_rows
    held_out = selection | split.test
    tuning, testing, selecting = split.validation[held_out], split.test[held_out], selection[held_out]
    truth = readings[split.validation]
    batch = prepared.touches.batch(held_out)
    predicted, std, validated, covered, predictors = {}, {}, {}, {}, {}
    readings_of = {name: predictor.predict_batch(batch) for name, predictor in fitted.items()} | dict(others or {})
    for name, reading in readings_of.items():
        if {np.shape(reading.mean), np.shape(reading.std)} != {readings[held_out].shape}:
            raise ValueError(
                f"{name} predicts means and standard deviations of shapes {np.shape(reading.mean)} and "
                f"{np.shape(reading.std)} where readings are {readings[held_out].shape}"
            )
        if np.isfinite(reading.mean).all() and not (np.isfinite(reading.std).all() and (reading.std >= 0).all()):
            raise ValueError(f"{name} predicts standard deviations that are negative or not finite")
        reading = Reading(reading.mean, np.maximum(reading.std, 1e-6))  # uT, because errors are divided by it
        on_validation = Reading(reading.mean[tuning], reading.std[tuning])
        scale = std_scale(truth, on_validation)
        validated[name] = reading.mean[selecting]
        covered[name] = coverage(truth, on_validation._replace(std=scale * on_validation.std))
        predicted[name], std[name] = reading.mean[testing], scale * reading.std[testing]
        if name in fitted:
            predictors[name] = replace(fitted[name], std_scale=scale)
    choice = choose(
        readings[selection],
        {name: validated[name] for name in fitted},
        split.groups[selection],
        baselines=[method.title for method in methods if method.baseline],
        on_pressure=[
            method.title
            for method in methods
            if method.title in predictors and not method.baseline and predictors[method.title].pressure is not None
        ],
    )
    r2 = choice.r2 | {name: score(readings[selection], validated[name]).r2 for name in others or ()}
    return Evaluation(predicted, std, choice._replace(r2=r2), covered, predictors)


def choose(
    truth: np.ndarray,
    predicted: Mapping[str, np.ndarray],
    groups: np.ndarray,
    *,
    baselines: Sequence[str],
    on_pressure: Sequence[str],
) -> MethodChoice:
    """Select the method with the least squared error on validation touches.

    Args:
        truth: Measured readings of the validation touches, `(n, 3 chips)`, uT.
        predicted: Predicted readings by method, `(n, 3 chips)`, uT.
        groups: Session, spatial block or time interval of each touch, `(n,)`.
        baselines: Names of the methods that are baselines.
        on_pressure: Names of the methods on predicted contact pressure that are not baselines.

    Returns:
        The method with the least error among those with finite predictions, and its lead over the best baseline.

    Raises:
        ValueError: No method or no baseline has finite predictions.
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
    """Compute the lead in R2 of one method over another.

    Args:
        truth: Measured readings, `(n, 3 chips)`, uT.
        error: Squared error of the method at each touch, `(n,)`, uT^2.
        other: Squared error of the other method, `(n,)`, uT^2.
        groups: Group of each touch, `(n,)`. Touches of one group are not independent.

    Returns:
        The difference of R2 with its 95 % interval over groups.
    """
    spread = ((truth - truth.mean(0)) ** 2).sum(1)

    def difference(rows: np.ndarray) -> float:
        return float((other[rows] - error[rows]).sum() / max(spread[rows].sum(), 1e-12))

    return Lead(difference(np.arange(len(truth))), *grouped_interval(difference, groups))


def choice_over_pads(parts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Select the best method on validation touches over several pads, and compute its lead over the best baseline.

    Args:
        parts: Metrics of each pad and seed, with the same methods.

    Returns:
        Names of the method and the baseline, mean validation R2 by method, the lead with its 95 % interval over pads
        (Student's t), and the numbers of touches, sessions and objects of validation.
    """
    pads = sorted({str(part["pad"]) for part in parts})
    finite = [name for name in parts[0]["validation_r2"] if all(_is_finite(p["validation_r2"][name]) for p in parts)]
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


def _is_finite(value: float | None) -> bool:
    return value is not None and bool(np.isfinite(value))


def position_note(choice: MethodChoice, by_position: Sequence[str]) -> list[str]:
    """Note that a predictor from the tip's position explains more than the selected method.

    Args:
        choice: The selected method.
        by_position: Titles of the predictors from positions.

    Returns:
        A list of one sentence, or an empty list.
    """
    best = max(by_position, key=lambda name: choice.r2[name], default=choice.best)
    if not choice.r2[best] > choice.r2[choice.best]:
        return []
    return [
        f"{best}, which uses the tip's position and applies to this tip only, explains more of the validation touches "
        f"than any method (R2 {choice.r2[best]:.3f}, {choice.best} {choice.r2[choice.best]:.3f})"
    ]


def pressure_note(choice: MethodChoice, recorded: Path | None) -> list[str]:
    """Note that the best method on predicted pressure is worse than a baseline, and name the command that finds causes.

    Args:
        choice: The selected method.
        recorded: Path of recorded touches, or None if touches are simulated.

    Returns:
        A list of one sentence, or an empty list.
    """
    method, baseline = choice.best_on_pressure, choice.best_baseline
    if method is None or not choice.pressure_loses:
        return []
    sentence = f"{method} loses to {baseline} on validation touches"
    if recorded is None:
        return [sentence]
    return [f"{sentence}; python -m experiments.fidelity --dataset {recorded} tests likely causes"]
