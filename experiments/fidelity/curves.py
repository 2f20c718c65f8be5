"""Learning curves of calibration: baselines and i2t's own, on three ways of holding presses out."""

import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import product
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
from i2t.calibration.heads import SkinRecording, corrected_recording
from i2t.dataset import square_blocks
from i2t.prediction.metrics import student_interval
from i2t.unknowns.alignment import aligned_prediction, fit_session_map, lay_over, predict_session
from i2t.viz import style

CALIBRATED = "i2t.calibrate"
RANDOM_ROWS, WHOLE_BLOCKS, LATER_ROWS = "random presses", "whole blocks", "later in time"
MIN_TEST_ROWS, MIN_POOL_ROWS = 5, 5
LOST_R2 = 0.01  # less than this is level
R2_DIGITS = 3  # as printed
LOADS = ("depth", "force")
AT_LEAST_AS_GOOD = "is at least as good as every baseline"
MethodErrors: TypeAlias = dict[str, dict[int, list[np.ndarray]]]  # squared errors (n,) by method, count and draw
COLOURS_OF_METHODS = (style.GREY, style.ORANGE, style.BLUE, style.GREEN, style.RED)


def calibration_curves(recording: SkinRecording, preset: FidelityPreset, seed: int, section: Section) -> None:
    """R2 of readings by the number of presses, for each method and each way of holding out."""
    presses = press_set(recording)
    splits = hold_out_presses(presses, preset, seed)
    methods = BASELINE_METHODS | {CALIBRATED: by_calibrate(recording)}
    if presses.load_name == "none":
        section.sentences.append("No load is known that varies: presses are known by their position alone.")
    counts = [n for n in preset.counts if any(n <= len(pool) for pool, _ in splits.values())]
    if not counts:
        raise CannotTellError(f"{len(presses.load)} presses leave fewer than {min(preset.counts)} to calibrate with.")
    section.numbers |= {"load": presses.load_name, "r2": {}, "held_out": {n: len(t) for n, (_, t) in splits.items()}}
    scores, errors = _curves(presses, methods, splits, counts=counts, preset=preset, seed=seed, section=section)
    for split, curves in scores.items():
        section.numbers["r2"][split] = curves
        header = ["R2, mean of the draws [95 %]", *(str(n) for n in counts)]
        section.tables[f"held out: {split} ({len(splits[split][1])} presses)"] = [
            header,
            *([name, *(_interval_cell(by_count.get(n)) for n in counts)] for name, by_count in curves.items()),
        ]
        section.sentences += _compare_with_baselines(split, curves, errors[split])
    section.figures["Calibration curves"] = _figure(section.numbers["r2"])


def across_sessions(recordings: Sequence[SkinRecording], preset: FidelityPreset, seed: int, section: Section) -> None:
    """R2 between sessions of the same skin, as they are and with a gain and an offset for each channel."""
    rows = [["known", "predicted", "as it is", "aligned by 20 presses", "from 20 presses of its own"]]
    section.numbers["r2"] = {}
    for known in recordings:
        for other in recordings:
            if known is not other:
                section.part(partial(_across, known, other, preset, seed, section, rows))
    if len(rows) == 1:
        raise CannotTellError(" ".join(section.sentences) or "No two recordings can be compared.")
    section.tables["R2 of one session's readings as another predicts them"] = rows


def hold_out_presses(presses: PressSet, preset: FidelityPreset, seed: int) -> dict[str, tuple[np.ndarray, np.ndarray]]:
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


def by_calibrate(recording: SkinRecording) -> ForwardMethod:
    """Predictions of `i2t.calibrate` from the known presses."""
    board = recording.board
    if board is not None and board.num_readings != recording.readings.shape[1]:
        board = None

    def method(presses: PressSet, known: np.ndarray, test: np.ndarray) -> np.ndarray:
        middle = (presses.position.min(0) + presses.position.max(0)) / 2 if board is None else np.zeros(2)
        load: np.ndarray | None = presses.load
        if presses.load_name == "none":
            load = None
        elif np.mean(presses.load < 0) > 0.5:
            load = -presses.load  # a force sensor with its axis turned, which the checks report
        load = None if load is None else np.maximum(load, 0)
        calibration = calibrate(
            presses.position[known] - middle,
            None if load is None else load[known],
            presses.readings[known],
            load_kind=presses.load_name,  # type: ignore[arg-type]
            board=board,
        )
        predicted = calibration.predict(presses.position[test] - middle, None if load is None else load[test])
        return np.asarray(predicted[0], np.float64)

    return method


def _curves(
    presses: PressSet,
    methods: dict[str, ForwardMethod],
    splits: dict[str, tuple[np.ndarray, np.ndarray]],
    *,
    counts: Sequence[int],
    preset: FidelityPreset,
    seed: int,
    section: Section,
) -> tuple[dict[str, dict[str, dict[int, dict[str, float]]]], dict[str, MethodErrors]]:
    """Mean R2 and its interval by split, method and count, and squared errors of the tested rows in each draw. A method
    that is over its time gets no further draw, and one that fails says so.
    """
    errors: dict[str, MethodErrors] = {split: {name: {} for name in methods} for split in splits}
    values: dict[str, dict[str, dict[int, list[float]]]] = {s: {name: {} for name in methods} for s in splits}
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
                    said = f"{name} cannot be fitted to {n} presses: {error}."
                    section.sentences += [] if said in section.sentences else [said]
                    continue
                r2 = explained_share(presses.readings[test], predicted)
                values[split][name].setdefault(n, []).append(r2)
                missed = np.sum((presses.readings[test] - predicted) ** 2, axis=1)
                errors[split][name].setdefault(n, []).append(missed)
        seconds[name] += time.process_time() - began
    summaries = {
        split: {
            name: {n: {"draws": len(r2), **_summary(r2)} for n, r2 in by_count.items()}
            for name, by_count in by_method.items()
        }
        for split, by_method in values.items()
    }
    return summaries, errors


def _summary(values: list[float]) -> dict[str, float]:
    if len(values) < 2:
        return {"mean": float(values[0]), "low": float("nan"), "high": float("nan")}
    return dict(zip(("mean", "low", "high"), map(float, student_interval(values)), strict=True))


def _interval_cell(summary: dict[str, float] | None) -> str:
    return "-" if summary is None else with_interval(*(summary[end] for end in ("mean", "low", "high")))


def _compare_with_baselines(
    split: str, curves: dict[str, dict[int, dict[str, float]]], errors: MethodErrors
) -> list[str]:
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


def _figure(r2: dict[str, dict[str, dict[int, dict[str, float]]]]) -> Figure:
    figure = Figure(figsize=(4.4 * len(r2), 3.6), layout="constrained")
    panels = figure.subplots(1, len(r2), squeeze=False)[0]
    for axes, (split, curves) in zip(panels, r2.items(), strict=True):
        for colour, (name, by_count) in zip(COLOURS_OF_METHODS, curves.items(), strict=False):
            counts = list(by_count)
            axes.plot(counts, [by_count[n]["mean"] for n in counts], "o-", ms=3, color=colour, label=name)
            low, high = ([by_count[n][end] for n in counts] for end in ("low", "high"))
            axes.fill_between(counts, low, high, color=colour, alpha=0.2, lw=0)
        axes.set(xscale="log", ylim=(-0.1, 1), xlabel="presses to calibrate with", title=f"held out: {split}")
        axes.grid(alpha=0.3)
    panels[0].set_ylabel("R² over all channels")
    panels[0].legend(fontsize=7)
    return figure


def _across(
    known: SkinRecording,
    other: SkinRecording,
    preset: FidelityPreset,
    seed: int,
    section: Section,
    rows: list[list[str]],
) -> None:
    """One session's map on another, as it is and laid over it."""
    before, now, load_known = _alike(known, other)
    order = np.random.default_rng(seed).permutation(len(now.load))
    own, test = order[:20], order[20 : 20 + preset.test_rows]
    if len(test) < MIN_TEST_ROWS:
        raise CannotTellError(f"{other.name} has too few presses to test {known.name} on.")
    past = np.random.default_rng(seed).permutation(len(before.load))[: preset.forward_rows]
    session = fit_session_map(before.position[past], before.load[past], before.readings[past])
    unit = "N" if "force" in (before.load_name, now.load_name) else "m"
    alignment, _, findings = lay_over(
        session, now.position[own], now.load[own], now.readings[own], load_known=load_known, unit=unit
    )
    put_back = corrected_recording(other, findings[-1:]).readings[now.row[test]]
    aligned = aligned_prediction(session, alignment, now.position[test], now.load[test])
    scores = {
        "as it is": explained_share(now.readings[test], predict_session(session, now.position[test], now.load[test])),
        "aligned": explained_share(put_back, aligned),
        SIMPLE_GP: explained_share(now.readings[test], BASELINE_METHODS[SIMPLE_GP](now, own, test)),
    }
    section.sentences += [
        f"{known.name} laid over {other.name} by {len(own)} presses: "
        + finding.sentence.replace("The earlier session", "it").replace("the earlier session", known.name)
        for finding in findings
    ]
    section.numbers["r2"][f"{known.name} -> {other.name}"] = scores | {
        "shift_m": alignment.shift.tolist(), "load_offset": alignment.load, "gain": alignment.gain.tolist(),
    }  # fmt: skip
    rows.append([known.name, other.name, *(cell(score) for score in scores.values())])


def _alike(known: SkinRecording, other: SkinRecording) -> tuple[PressSet, PressSet, bool]:
    """The presses of both with one kind of load, and whether it counts from one zero in both. A session that does not
    tell how hard was pressed gets the middle of the other's loads, from which the alignment finds its own.
    """
    if known.readings.shape[1] != other.readings.shape[1]:
        raise CannotTellError(f"{known.name} and {other.name} have another number of channels.")
    before, now = press_set(known), press_set(other)
    if {before.load_name, now.load_name} == {"depth", "force"}:
        shared = next((name for name in ("force", "depth") if known.varies(name) and other.varies(name)), None)
        if shared is None:
            raise CannotTellError(
                f"{known.name} knows {before.load_name} as its load and {other.name} {now.load_name}; what one says "
                "of the other needs one kind of load."
            )
        before, now = (press_set(_with_load(one, shared)) for one in (known, other))
    if before.load_name == now.load_name:
        return before, now, now.load_name == "force"
    if now.load_name == "none":
        return before, now._replace(load=np.full_like(now.load, np.median(before.load))), False
    return before._replace(load=np.full_like(before.load, np.median(now.load))), now, False


def _with_load(recording: SkinRecording, load: str) -> SkinRecording:
    """A recording that knows no other load."""
    kept = {name: values for name, values in recording.targets.items() if name == load or name not in LOADS}
    return replace(recording, targets=kept)
