"""Learning curves of calibration: baselines and i2t's own, on three ways of holding presses out."""

import time
from collections.abc import Sequence
from functools import partial
from itertools import permutations, product
from typing import TypeAlias

import numpy as np
from matplotlib.figure import Figure

from experiments.common.intervals import with_interval
from experiments.fidelity.config import FidelityPreset
from experiments.fidelity.forward import (
    BASELINE_METHODS,
    SIMPLE_GP,
    ForwardMethod,
    PressSet,
    explained_share,
    loses_beyond_chance,
    press_set,
)
from experiments.fidelity.sections import CannotTellError, Section, cell
from i2t.calibration import calibrate
from i2t.calibration.recordings import SkinRecording
from i2t.dataset import square_blocks
from i2t.prediction.metrics import student_interval
from i2t.types import Board
from i2t.viz import style

CALIBRATED = "i2t.calibrate"
RANDOM_ROWS, WHOLE_BLOCKS, LATER_ROWS = "random presses", "whole blocks", "later in time"
MIN_TEST_ROWS, MIN_POOL_ROWS = 5, 5
OWN_PRESSES = 20  # of a session, next to all of another
LOST_R2 = 0.01  # less than this is level
R2_DIGITS = 3  # as printed
AT_LEAST_AS_GOOD = "is at least as good as every baseline"
COLOURS_OF_METHODS = (style.GREY, style.ORANGE, style.BLUE, style.GREEN, style.RED)
MethodErrors: TypeAlias = dict[str, dict[int, list[np.ndarray]]]  # squared errors (n,) by method, count and draw
MethodScores: TypeAlias = dict[str, dict[int, dict[str, float]]]  # R2 by method and count: mean, low, high
Splits: TypeAlias = dict[str, tuple[np.ndarray, np.ndarray]]  # rows to learn from and to test on


def calibration_curves(recording: SkinRecording, preset: FidelityPreset, seed: int, section: Section) -> None:
    """R2 of readings by the number of presses, for each method and each way of holding out."""
    presses = press_set(recording)
    splits = hold_out_presses(presses, preset, seed)
    if presses.load_name == "none":
        section.sentences.append("No load is known that varies: presses are known by their position alone.")
    counts = [n for n in preset.counts if any(n <= len(pool) for pool, _ in splits.values())]
    if not counts:
        raise CannotTellError(f"{len(presses.load)} presses leave fewer than {min(preset.counts)} to calibrate with.")
    methods = BASELINE_METHODS | {CALIBRATED: by_calibrate(recording.board)}
    errors = _errors(presses, methods, splits, counts, preset, seed=seed, section=section)
    section.numbers |= {"load": presses.load_name, "r2": {}, "held_out": {n: len(t) for n, (_, t) in splits.items()}}
    for split, (_, test) in splits.items():
        total = float(np.sum((presses.readings[test] - presses.readings[test].mean(0)) ** 2)) or float("nan")
        scores = {
            name: {
                n: _summary([1 - float(np.sum(missed) / total) for missed in draws]) for n, draws in by_count.items()
            }
            for name, by_count in errors[split].items()
        }
        section.numbers["r2"][split] = scores
        section.tables[f"held out: {split} ({len(test)} presses)"] = [
            ["R2, mean of the draws [95 %]", *map(str, counts)],
            *([name, *(_interval_cell(by_count.get(n)) for n in counts)] for name, by_count in scores.items()),
        ]
        section.sentences += _compare_with_baselines(split, scores, errors[split])
    section.figures["calibration_curves"] = _figure(section.numbers["r2"])


def hold_out_presses(presses: PressSet, preset: FidelityPreset, seed: int) -> Splits:
    """Rows to learn from and to test on, by how they are held out; ways that leave too few are left out."""
    n, rng, share = len(presses.load), np.random.default_rng(seed), preset.held_out_share
    every = rng.permutation(n)
    held_out = max(round(share * n), min(MIN_TEST_ROWS, n // 3))
    found = {RANDOM_ROWS: (every[held_out:], every[:held_out])}
    block = square_blocks(presses.position, 1e-3 * preset.block_mm)
    if block.max() >= 4:
        chosen = rng.permutation(block.max() + 1)[: max(round(share * (block.max() + 1)), 1)]
        held = np.isin(block, chosen)
        found[WHOLE_BLOCKS] = (every[~held[every]], every[held[every]])
    later = np.arange(n) >= n - held_out
    found[LATER_ROWS] = (every[~later[every]], every[later[every]])
    usable = {
        name: (pool, np.sort(test[: preset.test_rows]))
        for name, (pool, test) in found.items()
        if len(test) >= MIN_TEST_ROWS and len(pool) >= MIN_POOL_ROWS
    }
    if not usable:
        raise CannotTellError(f"{n} presses are too few to calibrate with some and to test on others.")
    return usable


def by_calibrate(board: Board | None) -> ForwardMethod:
    """Predictions of `i2t.calibrate` from the known presses."""

    def method(presses: PressSet, known: np.ndarray, test: np.ndarray) -> np.ndarray:
        own = board if board is not None and board.num_readings == presses.readings.shape[1] else None
        at = presses.position - ((presses.position.min(0) + presses.position.max(0)) / 2 if own is None else 0)
        # Of a force sensor with its axis turned, which the checks report.
        load = np.maximum(-presses.load if np.mean(presses.load < 0) > 0.5 else presses.load, 0)
        loads = [None if presses.load_name == "none" else load[rows] for rows in (known, test)]
        calibration = calibrate(
            at[known], loads[0], presses.readings[known], load_kind=presses.load_name, board=own,  # type: ignore[arg-type]
        )  # fmt: skip
        return np.asarray(calibration.predict(at[test], loads[1])[0], np.float64)

    return method


def _errors(
    presses: PressSet, methods: dict[str, ForwardMethod], splits: Splits, counts: Sequence[int], preset: FidelityPreset,
    *, seed: int, section: Section,
) -> dict[str, MethodErrors]:  # fmt: skip
    """Squared errors of the tested rows by split, method, count and draw. A method that is over its time gets no
    further draw, and one that fails says so.
    """
    errors: dict[str, MethodErrors] = {split: {name: {} for name in methods} for split in splits}
    seconds = dict.fromkeys(methods, 0.0)
    for draw, (name, method) in product(range(preset.draws), methods.items()):
        began = time.process_time()
        if draw and seconds[name] > preset.method_seconds:
            continue
        for split, (pool, test) in splits.items():
            order = np.random.default_rng((seed, draw)).permutation(pool)
            for n in (count for count in counts if count <= len(order)):
                try:
                    predicted = method(presses, order[:n], test)
                except (ValueError, ArithmeticError, np.linalg.LinAlgError) as error:
                    section.sentences.append(f"{name} cannot be fitted to {n} presses: {error}.")
                    continue
                missed = np.sum((presses.readings[test] - predicted) ** 2, axis=1)
                errors[split][name].setdefault(n, []).append(missed)
        seconds[name] += time.process_time() - began
    return errors


def _summary(values: list[float]) -> dict[str, float]:
    if len(values) < 2:
        return {"draws": len(values), "mean": values[0], "low": float("nan"), "high": float("nan")}
    mean, low, high = map(float, student_interval(values))
    return {"draws": len(values), "mean": mean, "low": low, "high": high}


def _interval_cell(summary: dict[str, float] | None) -> str:
    return "-" if summary is None else with_interval(*(summary[end] for end in ("mean", "low", "high")))


def _compare_with_baselines(split: str, curves: MethodScores, errors: MethodErrors) -> list[str]:
    """Compare i2t's calibration with the best baseline at each count, by the numbers as they are printed."""
    if not curves[CALIBRATED]:
        return [f"Held out {split}: {CALIBRATED} predicts nothing."]
    found: dict[str, list[str]] = {}
    for n, own in curves[CALIBRATED].items():
        rivals = {
            name: by_count[n]["mean"] for name, by_count in curves.items() if name != CALIBRATED and n in by_count
        }
        best = max(rivals, key=lambda name: rivals[name])
        mine, theirs = (round(value, R2_DIGITS) for value in (own["mean"], rivals[best]))
        where = f"{n} presses ({mine:.{R2_DIGITS}f}, {best} {theirs:.{R2_DIGITS}f})"
        if mine >= theirs:
            found.setdefault(AT_LEAST_AS_GOOD, []).append(f"{n} presses")
        elif own["mean"] >= rivals[best] - LOST_R2:
            found.setdefault(f"lies within {LOST_R2:g} of the best baseline", []).append(where)
        else:
            draws = zip(errors[CALIBRATED][n], errors[best][n], strict=False)  # the slower one may have fewer
            both = (np.mean(part, axis=0) for part in zip(*draws, strict=True))
            loses = loses_beyond_chance(*both)
            verdict = "loses to a baseline" if loses else "lies below a baseline, within chance,"
            found.setdefault(verdict, []).append(where)
    if list(found) == [AT_LEAST_AS_GOOD]:
        return [f"Held out {split}: {CALIBRATED} {AT_LEAST_AS_GOOD} at every number of presses."]
    return [f"Held out {split}: {CALIBRATED} {verdict} at {', '.join(where)}." for verdict, where in found.items()]


def _figure(r2: dict[str, MethodScores]) -> Figure:
    figure = Figure(figsize=(4.4 * len(r2), 3.6), layout="constrained")
    panels = figure.subplots(1, len(r2), squeeze=False)[0]
    for axes, (split, curves) in zip(panels, r2.items(), strict=True):
        for colour, (name, by_count) in zip(COLOURS_OF_METHODS, curves.items(), strict=False):
            mean, low, high = ([one[end] for one in by_count.values()] for end in ("mean", "low", "high"))
            axes.plot(list(by_count), mean, "o-", ms=3, color=colour, label=name)
            axes.fill_between(list(by_count), low, high, color=colour, alpha=0.2, lw=0)
        axes.set(xscale="log", ylim=(-0.1, 1), xlabel="presses to calibrate with", title=f"held out: {split}")
        axes.grid(alpha=0.3)
    panels[0].set_ylabel("R² over all channels")
    panels[0].legend(fontsize=7)
    return figure


# --- several sessions of one skin ---


def across_sessions(recordings: Sequence[SkinRecording], preset: FidelityPreset, seed: int, section: Section) -> None:
    """R2 between sessions of the same skin, as they are, and what a few presses of its own tell of each."""
    rows = [["known", "predicted", "as it is", f"from {OWN_PRESSES} presses of its own"]]
    section.numbers["r2"] = {}
    for known, other in permutations(recordings, 2):
        section.part(partial(_across, known, other, preset, seed, section, rows))
    if len(rows) == 1:
        raise CannotTellError(" ".join(section.sentences) or "No two recordings can be compared.")
    section.tables["R2 of one session's readings as another predicts them"] = rows


def _across(
    known: SkinRecording, other: SkinRecording, preset: FidelityPreset, seed: int, section: Section,
    rows: list[list[str]],
) -> None:  # fmt: skip
    """A plain Gaussian process of one session on another, and one of some presses of that session."""
    before, now = _alike(known, other)
    order = np.random.default_rng(seed).permutation(len(now.load))
    own, test = order[:OWN_PRESSES], order[OWN_PRESSES : OWN_PRESSES + preset.test_rows]
    if len(test) < MIN_TEST_ROWS:
        raise CannotTellError(f"{other.name} has too few presses to test {known.name} on.")
    both = now._replace(
        position=np.concatenate([before.position, now.position]),
        load=np.concatenate([before.load, now.load]),
        readings=np.concatenate([before.readings, now.readings]),
    )
    past = np.random.default_rng(seed).permutation(len(before.load))[: preset.forward_rows]
    predict = BASELINE_METHODS[SIMPLE_GP]
    scores = {
        "as it is": explained_share(now.readings[test], predict(both, past, len(before.load) + test)),
        SIMPLE_GP: explained_share(now.readings[test], predict(now, own, test)),
    }
    section.numbers["r2"][f"{known.name} -> {other.name}"] = scores
    rows.append([known.name, other.name, *map(cell, scores.values())])


def _alike(known: SkinRecording, other: SkinRecording) -> tuple[PressSet, PressSet]:
    """The presses of both with one kind of load."""
    if known.readings.shape[1] != other.readings.shape[1]:
        raise CannotTellError(f"{known.name} and {other.name} have another number of channels.")
    before, now = press_set(known), press_set(other)
    if before.load_name != now.load_name:
        raise CannotTellError(
            f"{known.name} knows {before.load_name} as its load and {other.name} {now.load_name}; what one says of the "
            "other needs one kind of load."
        )
    return before, now
