"""Heads of a recording, tested in three ways on rows they never saw, with baselines and published figures."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from experiments.fidelity.forward import loses_beyond_chance
from experiments.fidelity.sections import CannotTellError, Section, cell
from i2t.calibration.heads import (
    BASELINE_HEADS,
    HEAD_TARGETS,
    STDS_OF_90_PERCENT,
    TARGETS,
    Head,
    HeadBudget,
    HeadPrediction,
    SkinRecording,
    fit_head,
    hold_out_groups,
    root_mean_square,
    target_rows,
)
from i2t.viz import style

PUBLISHED_FIGURES = {
    "position": "eFlesh 0.5 mm, eflesh-touch 1.22 mm",
    "depth": "eflesh-touch 0.39 mm",
    "force": "eFlesh 0.27 N, eflesh-touch 0.080 N",
    "shear": "eFlesh 0.12 N, eflesh-touch 0.055 N",
}
RANDOM_SPLIT, GROUP_SPLIT, LATER_SPLIT = "random rows", "whole blocks or strokes", "later in time"
MIN_HEAD_TEST = 5
MIN_INSIDE_90 = 0.85  # of values in the 90 % range: where fewer are, a sentence says so


class HeadScore(NamedTuple):
    """Scores of a head on rows it never saw, in the unit of its target."""

    rows: int
    rmse: float
    median: float  # of the length of errors
    r2: float
    inside_90: float  # share of values in the 90 % range
    unfamiliar: float  # share of rows


class HeadTest(NamedTuple):
    """A target's heads on one way of holding out."""

    method: str  # that was kept
    history: int  # rows before a reading that it looks at
    kept: HeadScore
    baselines: dict[str, HeadScore]
    validation: dict[str, float]
    errors: np.ndarray  # (n, 2 d) truth and prediction of the test rows
    baseline_errors: dict[str, np.ndarray]  # the same of the baselines


def head_sections(
    recording: SkinRecording, targets: Sequence[str], budget: HeadBudget, share: float, seed: int, section: Section
) -> None:
    """Tests of all targets that a recording supports; a sentence for each other one."""
    found = {}
    for target in targets or HEAD_TARGETS:
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
    section.figures["Heads on rows held out"] = _figure(found)


def test_heads(
    recording: SkinRecording, target: str, budget: HeadBudget, *, share: float, seed: int
) -> dict[str, HeadTest]:
    """Heads of a target, fitted and tested on rows held out in each way that leaves enough of them."""
    rows = target_rows(recording, target)
    tests, problems = {}, []
    for name, held in held_out_rows(recording.rows(rows), share, seed).items():
        known, other = _known_of(recording, target, rows[~held]), rows[held]
        try:
            head = fit_head(known, target, budget=budget, seed=seed)
            baselines = {
                method: fit_head(known, target, methods=(method,), budget=budget, seed=seed)
                for method in BASELINE_HEADS[1:]
            }
        except ValueError as error:
            problems.append(f"{name}: {error}")
            continue
        scored, both = score_head(head, recording, other)
        rivals = {method: score_head(baseline, recording, other) for method, baseline in baselines.items()}
        tests[name] = HeadTest(
            head.method,
            int(head.record.history),
            scored,
            {method: score for method, (score, _) in rivals.items()},
            head.validation,
            both,
            {method: values for method, (_, values) in rivals.items()},
        )
    if not tests:
        raise ValueError("; ".join(problems) or f"{recording.name} has too few rows to hold some out")
    return tests


test_heads.__test__ = False  # type: ignore[attr-defined]  # no test, whatever its name


def heads_across(recordings: Sequence[SkinRecording], budget: HeadBudget, seed: int, section: Section) -> None:
    """Heads of each recording on the others, as a skin that was mounted again or worn would be read."""
    rows = [["target", "fitted to", "tested on", "rows", "RMSE", "median", "R2", "in the 90 % range", "unfamiliar"]]
    numbers: dict[str, Any] = {}
    for target in HEAD_TARGETS:
        for known in recordings:
            try:
                head = fit_head(known, target, budget=budget, seed=seed)
            except ValueError:
                continue  # the recording's own part says why
            for other in recordings:
                if other is known:
                    continue
                try:
                    score, _ = score_head(head, other, target_rows(other, target))
                except ValueError as error:
                    section.sentences.append(f"{target} of {other.name} is not predicted from {known.name}: {error}.")
                    continue
                numbers[f"{target}: {known.name} -> {other.name}"] = score._asdict()
                section.sentences += missed_ranges(target, {f"from {known.name} to {other.name}": score})
                rows.append(
                    [
                        f"{target} ({TARGETS[target].unit})",
                        known.name,
                        other.name,
                        str(score.rows),
                        *(cell(value) for value in score[1:]),
                    ]
                )
    if len(rows) == 1:
        raise CannotTellError(" ".join(section.sentences) or "No two recordings share a target that a head predicts.")
    section.numbers["heads"] = numbers
    section.tables["Heads of one session on another, as they are"] = rows


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
    """Score on some rows of a recording, with truth and prediction."""
    predicted = HeadPrediction(*(part[rows] for part in head.predict(recording.readings, recording.session)))
    truth = recording.targets[head.target][rows]
    error, unfamiliar = predicted.mean - truth, float(np.mean(predicted.unfamiliar))
    both = np.column_stack([truth, predicted.mean])
    scale = TARGETS[head.target].scale
    total = float(np.sum((truth - truth.mean(0)) ** 2))
    inside = float(np.mean(np.abs(error) <= STDS_OF_90_PERCENT * predicted.std))
    r2 = 1 - float(np.sum(error**2)) / total if total > 0 else float("nan")
    rmse, median = scale * root_mean_square(error), scale * float(np.median(np.linalg.norm(error, axis=1)))
    return HeadScore(len(truth), rmse, median, r2, inside, unfamiliar), both


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
    rows = [["held out", "rows", "method", "RMSE", "median", "R2", "in the 90 % range", "unfamiliar"]]
    for name, test in tests.items():
        for method, score in {f"{test.method} (kept)": test.kept, **test.baselines}.items():
            rows.append([name, str(score.rows), method, *(cell(value) for value in score[1:])])
    return rows


def compare_with_baselines(target: str, tests: dict[str, HeadTest]) -> list[str]:
    """A sentence for each baseline to which the kept head loses on the rows held out; one if there is none."""
    lost = [
        f"{target}, {name}: the kept head ({test.method}, {test.kept.rmse:.3f}) loses to {method} ({score.rmse:.3f})."
        for name, test in tests.items()
        for method, score in test.baselines.items()
        if score.rmse < 0.98 * test.kept.rmse
        and loses_beyond_chance(_squared(test.errors), _squared(test.baseline_errors[method]))
    ]
    return lost or [f"{target}: no baseline beats the kept head on rows held out by more than chance."]


def missed_ranges(target: str, scores: dict[str, HeadScore]) -> list[str]:
    """A sentence for each way of holding out in which too few values lie in the stated range."""
    return [
        f"{target}, {name}: the 90 % range holds {100 * score.inside_90:.0f} % of {score.rows} rows; do not rely on "
        "it there."
        for name, score in scores.items()
        if score.inside_90 < MIN_INSIDE_90
    ]


def _squared(both: np.ndarray) -> np.ndarray:
    """Squared errors (n,) of truth and prediction side by side."""
    d = both.shape[1] // 2
    return np.sum((both[:, :d] - both[:, d:]) ** 2, axis=1)


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


def _figure(found: dict[str, dict[str, HeadTest]]) -> Figure:
    figure = Figure(figsize=(3.6 * len(found), 3.4), layout="constrained")
    panels = figure.subplots(1, len(found), squeeze=False)[0]
    for axes, (target, tests) in zip(panels, found.items(), strict=True):
        kind = TARGETS[target]
        test = tests.get(GROUP_SPLIT) or next(iter(tests.values()))
        both = kind.scale * test.errors
        d = both.shape[1] // 2
        for i in range(d):
            axes.plot(both[:, i], both[:, d + i], ".", ms=2, color=style.COLOURS[i], label="xy"[i] if d > 1 else None)
        ends = [both[:, :d].min(), both[:, :d].max()]
        axes.plot(ends, ends, color=style.GREY, lw=0.8)
        axes.set(
            xlabel=f"measured {target} ({kind.unit})",
            ylabel=f"predicted ({kind.unit})",
            title=f"{target}, {test.method}",
        )
    return figure
