"""Heads of a recording, tested in three ways on rows they never saw, with baselines and published figures."""

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
MIN_HEAD_TEST = 5
MIN_INSIDE_90, MAX_INSIDE_90 = 0.85, 0.95  # share of values in the 90 % range, outside of which a sentence says so
CHANCE = 0.05  # probability, at nine in ten, of as many values in the range as are called too many
BEATEN = 0.98  # of the kept head's error, below which a baseline may be said to beat it
SCORES = ["RMSE", "median", "R2", "in the 90 % range", "unfamiliar"]


class HeadScore(NamedTuple):
    """Scores of a head on rows it never saw, in the unit of its target."""

    rows: int
    rmse: float  # of a probability: root of the Brier score
    median: float  # of the length of errors; of a probability: share predicted right
    r2: float  # of a probability: area under the receiver operating characteristic
    inside_90: float  # share of values in the 90 % range; of a probability: expected calibration error
    unfamiliar: float  # share of rows


class HeadTest(NamedTuple):
    """A target's heads on one way of holding out."""

    method: str  # that was kept
    history: int  # rows before a reading that it looks at
    kept: HeadScore
    baselines: dict[str, HeadScore]
    validation: dict[str, float]
    beaten_by: tuple[str, ...]  # baselines, by more than chance


def head_sections(recording: SkinRecording, budget: HeadBudget, share: float, seed: int, section: Section) -> None:
    """Tests of all targets that a recording supports; a sentence for each other one."""
    found = {}
    for target in HEAD_TARGETS:
        try:
            found[target] = test_heads(recording, target, budget, share=share, seed=seed)
        except ValueError as error:
            section.sentences.append(f"No head for {target}: {error}.")
    if not found:
        raise CannotTellError("The recording supports no head.")
    section.numbers["heads"] = {target: to_numbers(tests) for target, tests in found.items()}
    for target, tests in found.items():
        section.tables[caption(target)] = table(target, tests)
        section.sentences += compare_with_baselines(target, tests)
        section.sentences += missed_ranges(target, {name: test.kept for name, test in tests.items()})


def test_heads(
    recording: SkinRecording, target: str, budget: HeadBudget, *, share: float, seed: int
) -> dict[str, HeadTest]:
    """Heads of a target, fitted and tested on rows held out in each way that leaves enough of them."""
    rows = target_rows(recording, target)
    tests, problems = {}, []
    for name, held in held_out_rows(recording.rows(rows), share, seed).items():
        known = _known_of(recording, target, rows[~held])
        try:
            head = fit_head(known, target, budget=budget, seed=seed)
            rivals = {
                method: fit_head(known, target, methods=(method,), budget=budget, seed=seed)
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
            if score.rmse < BEATEN * kept.rmse and loses_beyond_chance(errors, missed)
        ]
        baselines = {method: score for method, (score, _) in scored.items()}
        tests[name] = HeadTest(
            head.method, int(head.record.history), kept, baselines, head.validation, beaten_by=tuple(better)
        )
    if not tests:
        enough = rows_enough(share)
        few = f"{recording.name} knows {target} of {len(rows)} rows, too few to learn from some and test on others"
        raise ValueError(f"{few}; {enough} are enough" if len(rows) < enough else "; ".join(problems))
    return tests


def rows_enough(share: float) -> int:
    """Rows of which a share is enough to test a head and the rest to fit it."""
    return max(math.ceil(MIN_HEAD_TEST / share), math.ceil(HEAD_CONFIG.min_rows / (1 - share)))


test_heads.__test__ = False  # type: ignore[attr-defined]  # no test, whatever its name


def held_out_rows(recording: SkinRecording, share: float, seed: int) -> dict[str, np.ndarray]:
    """Masks of the rows that are held out."""
    n, rng = len(recording), np.random.default_rng(seed)
    groups = hold_out_groups(recording)
    chosen = rng.permutation(groups.max() + 1)[: max(round(share * (groups.max() + 1)), 1)]
    masks = {
        RANDOM_SPLIT: np.isin(np.arange(n), rng.permutation(n)[: round(share * n)]),
        GROUP_SPLIT: np.isin(groups, chosen),
        LATER_SPLIT: np.arange(n) >= round((1 - share) * n),
    }
    return {name: mask for name, mask in masks.items() if MIN_HEAD_TEST <= mask.sum() < n}


def score_head(head: Head, recording: SkinRecording, rows: np.ndarray) -> tuple[HeadScore, np.ndarray]:
    """Score on some rows of a recording, and the squared errors (n,) of these rows."""
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
    """The recording with a target known of some rows only: the others' readings stay what came before."""
    values = np.full_like(recording.targets[target], np.nan)
    values[rows] = recording.targets[target][rows]
    return replace(recording, targets={**recording.targets, target: values})


def caption(target: str) -> str:
    """Caption of a target's table."""
    published = f"; published: {PUBLISHED_FIGURES[target]}" if target in PUBLISHED_FIGURES else ""
    return f"{target} ({TARGETS[target].unit}{published})"


def table(target: str, tests: dict[str, HeadTest]) -> list[list[str]]:
    """A row for each way of holding out and each method."""
    rows = [["held out", "rows", "method", *SCORES]]
    for name, test in tests.items():
        for method, score in {f"{test.method} (kept)": test.kept, **test.baselines}.items():
            rows.append([name, str(score.rows), method, *map(cell, score[1:])])
    return rows


def compare_with_baselines(target: str, tests: dict[str, HeadTest]) -> list[str]:
    """A sentence for each baseline to which the kept head loses on the rows held out; one if there is none."""
    lost = [
        f"{target}, {name}: the kept head ({test.method}, {test.kept.rmse:.3f}) loses to {method} "
        f"({test.baselines[method].rmse:.3f})."
        for name, test in tests.items()
        for method in test.beaten_by
    ]
    return lost or [f"{target}: no baseline beats the kept head on rows held out by more than chance."]


def missed_ranges(target: str, scores: dict[str, HeadScore]) -> list[str]:
    """A sentence for each way of holding out in which too few values lie in the stated range, or more than chance
    explains.
    """
    sentences = []
    for name, score in scores.items():
        range_holds = f"{target}, {name}: the 90 % range holds {100 * score.inside_90:.0f} % of {score.rows} rows; "
        if score.inside_90 < MIN_INSIDE_90:
            sentences.append(range_holds + "do not rely on it there.")
        elif score.inside_90 > MAX_INSIDE_90 and _by_chance(score) < CHANCE:
            sentences.append(range_holds + "it is too wide there, as the head errs less than it says.")
    return sentences


def _by_chance(score: HeadScore) -> float:
    """Probability of as many rows in the range, or more, if it held nine in ten."""
    inside = round(score.inside_90 * score.rows)
    return float(stats.binomtest(inside, score.rows, 0.9, alternative="greater").pvalue)


def to_numbers(tests: dict[str, HeadTest]) -> dict[str, Any]:
    """Scores as metrics.json holds them."""
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
