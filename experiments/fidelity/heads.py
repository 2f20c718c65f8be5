"""Heads of a recording, tested on rows held out in three ways, with baselines and published figures."""

import math
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from experiments.common.tables import cell
from experiments.fidelity.forward import loses_beyond_chance
from experiments.fidelity.sections import CannotTellError, Section
from i2t.heads.heads import (
    HEAD_CONFIG,
    HEAD_TARGETS,
    Head,
    HeadPrediction,
    fit_head,
    hold_out_groups,
    target_rows,
)  # fmt: skip
from i2t.heads.regression import BASELINE_HEADS, HeadBudget
from i2t.leave_one_out import STDS_WITHIN_90
from i2t.recordings.read import TARGETS, SkinRecording

PUBLISHED_FIGURES = {
    "position": "eFlesh 0.5 mm, eflesh-touch 1.22 mm",
    "travel": "eflesh-touch 0.39 mm",
    "force": "eFlesh 0.27 N, eflesh-touch 0.080 N",
    "shear": "eFlesh 0.12 N, eflesh-touch 0.055 N",
}
RANDOM_SPLIT, GROUP_SPLIT, LATER_SPLIT = "random rows", "whole blocks or strokes", "later in time"
MIN_TEST_ROWS = 5
SCORES = ["RMSE", "median", "R2", "in the 90 % range", "unfamiliar"]


class HeadScore(NamedTuple):
    """Scores of a head on held-out rows, in the unit of its target."""

    rows: int
    rmse: float  # for a probability: root of the Brier score
    median: float  # of the error's magnitude; for a probability: fraction classified correctly
    r2: float  # for a probability: area under the receiver operating characteristic
    inside_90: float  # fraction of values in the 90 % range; for a probability: expected calibration error
    unfamiliar: float  # fraction of rows far from all training readings


class HeadTest(NamedTuple):
    """Scores of a target's heads for one way of holding out."""

    method: str  # of the kept head
    history: int  # number of previous rows that the head uses
    kept: HeadScore
    baselines: dict[str, HeadScore]
    validation: dict[str, float]
    beaten_by: tuple[str, ...]  # baselines that beat the kept head by more than chance


def head_sections(recording: SkinRecording, budget: HeadBudget, share: float, seed: int, section: Section) -> None:
    """Test heads of all targets that a recording supports, and explain why the others have none."""
    tests_by_target = {}
    for target in HEAD_TARGETS:
        try:
            tests_by_target[target] = test_heads(recording, target, budget, share=share, seed=seed)
        except ValueError as error:
            section.sentences.append(f"No head for {target}: {error}.")
    if not tests_by_target:
        raise CannotTellError("The recording supports no head.")
    section.numbers["heads"] = {target: to_numbers(tests) for target, tests in tests_by_target.items()}
    for target, tests in tests_by_target.items():
        section.tables[caption(target)] = table(target, tests)
        section.sentences += compare_with_baselines(target, tests)
        section.sentences += missed_ranges(target, {name: test.kept for name, test in tests.items()})


def test_heads(
    recording: SkinRecording, target: str, budget: HeadBudget, *, share: float, seed: int
) -> dict[str, HeadTest]:
    """Fit and test heads of a target for each way of holding out that leaves enough rows."""
    rows = target_rows(recording, target)
    tests, problems = {}, []
    for name, held in held_out_rows(recording.rows(rows), share, seed).items():
        training = _known_of(recording, target, rows[~held])
        try:
            head = fit_head(training, target, budget=budget, seed=seed)
            rivals = {
                method: fit_head(training, target, methods=(method,), budget=budget, seed=seed)
                for method in BASELINE_HEADS[1:]
            }
        except ValueError as error:
            problems.append(f"{name}: {error}")
            continue
        kept, errors = score_head(head, recording, rows[held])
        scored = {method: score_head(rival, recording, rows[held]) for method, rival in rivals.items()}
        better = [
            method
            for method, (score, missed) in scored.items()
            if score.rmse < 0.98 * kept.rmse and loses_beyond_chance(errors, missed)
        ]
        baselines = {method: score for method, (score, _) in scored.items()}
        tests[name] = HeadTest(
            head.method, int(head.record.history), kept, baselines, head.validation, beaten_by=tuple(better)
        )
    if not tests:
        enough = rows_enough(share)
        few = f"{recording.name} has {target} in {len(rows)} rows, too few to fit on some and test on others"
        raise ValueError(f"{few}; {enough} are enough" if len(rows) < enough else "; ".join(problems))
    return tests


def rows_enough(share: float) -> int:
    """Smallest number of rows of which the held-out share suffices to test a head and the rest to fit it."""
    return max(math.ceil(MIN_TEST_ROWS / share), math.ceil(HEAD_CONFIG.min_rows / (1 - share)))


test_heads.__test__ = False  # type: ignore[attr-defined]  # no test, whatever its name


def held_out_rows(recording: SkinRecording, share: float, seed: int) -> dict[str, np.ndarray]:
    """Masks `(n,)` of the held-out rows, by way of holding out."""
    n, rng = len(recording), np.random.default_rng(seed)
    groups = hold_out_groups(recording)
    chosen = rng.permutation(groups.max() + 1)[: max(round(share * (groups.max() + 1)), 1)]
    masks = {
        RANDOM_SPLIT: np.isin(np.arange(n), rng.permutation(n)[: round(share * n)]),
        GROUP_SPLIT: np.isin(groups, chosen),
        LATER_SPLIT: np.arange(n) >= round((1 - share) * n),
    }
    return {name: mask for name, mask in masks.items() if MIN_TEST_ROWS <= mask.sum() < n}


def score_head(head: Head, recording: SkinRecording, rows: np.ndarray) -> tuple[HeadScore, np.ndarray]:
    """Score a head on some rows of a recording; also returns the squared errors `(n,)` of these rows."""
    predicted = HeadPrediction(*(part[rows] for part in head.predict(recording.readings, recording.session)))
    truth, kind = recording.targets[head.target][rows], TARGETS[head.target]
    error, unfamiliar = predicted.mean - truth, float(np.mean(predicted.unfamiliar))
    missed = np.sum(error**2, axis=1)
    rmse = kind.scale * float(np.sqrt(np.mean(missed)))
    total = float(np.sum((truth - truth.mean(0)) ** 2))
    inside = float(np.mean(np.abs(error) <= STDS_WITHIN_90 * predicted.std))
    r2 = 1 - float(np.sum(missed)) / total if total > 0 else float("nan")
    return HeadScore(len(truth), rmse, kind.scale * float(np.median(np.sqrt(missed))), r2, inside, unfamiliar), missed


def _known_of(recording: SkinRecording, target: str, rows: np.ndarray) -> SkinRecording:
    """Hide a target in all rows but the given ones; the readings stay, because heads may use the previous rows."""
    values = np.full_like(recording.targets[target], np.nan)
    values[rows] = recording.targets[target][rows]
    return replace(recording, targets={**recording.targets, target: values})


def caption(target: str) -> str:
    """Caption of a target's table."""
    published = f"; published: {PUBLISHED_FIGURES[target]}" if target in PUBLISHED_FIGURES else ""
    return f"{target} ({TARGETS[target].unit}{published})"


def table(target: str, tests: dict[str, HeadTest]) -> list[list[str]]:
    """Rows of a target's table, one for each way of holding out and method."""
    rows = [["held out", "rows", "method", *SCORES]]
    for name, test in tests.items():
        for method, score in {f"{test.method} (kept)": test.kept, **test.baselines}.items():
            rows.append([name, str(score.rows), method, *map(cell, score[1:])])
    return rows


def compare_with_baselines(target: str, tests: dict[str, HeadTest]) -> list[str]:
    """Sentences on the baselines that beat the kept head, or one sentence that none does."""
    lost = [
        f"{target}, {name}: the kept head ({test.method}, {test.kept.rmse:.3f}) loses to {method} "
        f"({test.baselines[method].rmse:.3f})."
        for name, test in tests.items()
        for method in test.beaten_by
    ]
    return lost or [f"{target}: no baseline beats the kept head on rows held out by more than chance."]


def missed_ranges(target: str, scores: dict[str, HeadScore]) -> list[str]:
    """Sentences on the ways of holding out for which the 90 % range is too narrow (it holds fewer than 85 % of the
    values) or too wide (more than 95 %, and more than chance explains).
    """
    sentences = []
    for name, score in scores.items():
        range_holds = f"{target}, {name}: the 90 % range holds {100 * score.inside_90:.0f} % of {score.rows} rows; "
        if score.inside_90 < 0.85:
            sentences.append(range_holds + "do not rely on it there.")
        elif score.inside_90 > 0.95 and _by_chance(score) < 0.05:
            sentences.append(range_holds + "it is too wide there; the errors are smaller than stated.")
    return sentences


def _by_chance(score: HeadScore) -> float:
    """Probability of at least this many rows in the range if its coverage were 90 %."""
    inside = round(score.inside_90 * score.rows)
    return float(stats.binomtest(inside, score.rows, 0.9, alternative="greater").pvalue)


def to_numbers(tests: dict[str, HeadTest]) -> dict[str, Any]:
    """Convert scores for metrics.json."""
    return {
        name: {
            "method": test.method,
            "history": test.history,
            "kept": test.kept._asdict(),
            "baselines": {method: score._asdict() for method, score in test.baselines.items()},
            "validation": test.validation,
        }
        for name, test in tests.items()
    }
