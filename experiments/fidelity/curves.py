"""Calibration curves with presses held out in three ways, by the methods of `experiments.calibrate`, and predictions of
one session from another.
"""

import math
from collections.abc import Sequence
from functools import partial
from itertools import permutations
from typing import TypeAlias

import numpy as np

from experiments.calibrate.evaluate import ErrorCurves, learning_curves, summarise
from experiments.calibrate.held_out import PressSplit
from experiments.calibrate.methods import CALIBRATED
from experiments.calibrate.report import figure
from experiments.common.tables import cell
from experiments.fidelity.config import FidelityPreset
from experiments.fidelity.forward import SIMPLE_GP, explained_share, loses_beyond_chance, press_set, simple_gp
from experiments.fidelity.sections import CannotTellError, Section
from i2t.dataset import square_blocks
from i2t.recordings.loads import ASSUMED_TRAVEL_M
from i2t.recordings.presses import LoadedPresses
from i2t.recordings.read import SkinRecording
from i2t.types import Board

MIN_ROWS = 5  # for calibration and for the test
OWN_PRESSES = 20  # presses of the predicted session that its own Gaussian process is fitted to
Splits: TypeAlias = dict[str, tuple[np.ndarray, np.ndarray]]  # calibration and test rows by way of holding out


def calibration_curves(recording: SkinRecording, preset: FidelityPreset, seed: int, section: Section) -> None:
    """Report R2 of readings by the number of presses, for each method and each way of holding out."""
    presses = press_set(recording)
    if presses.load_kind == "none":
        section.sentences.append("No load is known that varies, so readings are predicted from position alone.")
    splits = hold_out_presses(presses, preset, seed)
    most = max(len(pool) for pool, _ in splits.values())
    counts = [n for n in preset.counts if n <= most]
    if not counts:
        least = min(preset.counts)
        raise CannotTellError(
            f"{len(presses.load)} presses leave {most} to calibrate with when others are held out, and {least} "
            f"are needed; {math.ceil(least / (1 - preset.held_out_share))} are enough."
        )
    splits = {name: (pool, test) for name, (pool, test) in splits.items() if len(pool) >= counts[0]}
    usable, r2 = pushing_presses(presses, recording.board), {}
    for name, (pool, test) in splits.items():
        scores = learning_curves(usable, [PressSplit({name: test}, pool)], counts=counts, draws=preset.draws, seed=seed)
        r2[name] = summarise(scores.r2[name])
        section.tables[f"held out: {name} ({len(test)} presses)"] = [
            ["R2, mean of the draws [95 %]", *map(str, counts)],
            *([method, *(cell(by_count.get(n)) for n in counts)] for method, by_count in r2[name].items()),
        ]
        section.sentences.append(compare_with_baselines(name, scores.errors[name]))
    section.numbers |= {"load": presses.load_kind, "r2": r2, "held_out": {n: len(t) for n, (_, t) in splits.items()}}
    section.figures["calibration_curves"] = figure({"r2": r2, "source": recording.source, "draws": preset.draws})


def hold_out_presses(presses: LoadedPresses, preset: FidelityPreset, seed: int) -> Splits:
    """Split the presses into calibration and test rows in each way that leaves enough of both."""
    n, rng, share = len(presses.load), np.random.default_rng(seed), preset.held_out_share
    order = rng.permutation(n)
    held_out = max(round(share * n), min(MIN_ROWS, n // 3))
    splits = {"random presses": (order[held_out:], order[:held_out])}
    block = square_blocks(presses.position, 1e-3 * preset.block_mm)
    if block.max() >= 4:
        chosen = rng.permutation(block.max() + 1)[: max(round(share * (block.max() + 1)), 1)]
        held = np.isin(block, chosen)
        splits["whole blocks"] = (order[~held[order]], order[held[order]])
    later = np.arange(n) >= n - held_out
    splits["later in time"] = (order[~later[order]], order[later[order]])
    usable = {
        name: (pool, np.sort(test[: preset.test_rows]))
        for name, (pool, test) in splits.items()
        if min(len(test), len(pool)) >= MIN_ROWS
    }
    if not usable:
        raise CannotTellError(
            f"{n} presses are too few to calibrate with some and test on others; {3 * MIN_ROWS} are enough."
        )
    return usable


def pushing_presses(presses: LoadedPresses, board: Board | None) -> LoadedPresses:
    """Prepare presses for the calibration methods.

    Negative loads become zero (the checks have reported their sign), unknown loads become one travel, and positions on
    an unknown board are centred.
    """
    own = board if board is not None and board.num_readings == presses.readings.shape[1] else None
    at = presses.position - ((presses.position.min(0) + presses.position.max(0)) / 2 if own is None else 0)
    load, kind = np.maximum(presses.load, 0), presses.load_kind
    if kind == "none":
        load, kind = np.full(len(load), ASSUMED_TRAVEL_M), "travel"
    return presses._replace(position=at, load=load, load_kind=kind, unnamed_board=own)


def compare_with_baselines(split: str, errors: ErrorCurves) -> str:
    """Describe where i2t's calibration loses to a baseline by more than chance, or state that it does nowhere."""
    lost = [
        f"{n} presses ({name})"
        for name, by_count in errors.items()
        for n, draws in by_count.items()
        if loses_beyond_chance(np.mean(errors[CALIBRATED][n], axis=0), np.mean(draws, axis=0))
    ]
    if not lost:
        return f"Held out {split}: no baseline beats {CALIBRATED} by more than chance."
    return f"Held out {split}: {CALIBRATED} loses to a baseline at {', '.join(lost)}."


# --- several sessions of one skin ---


def across_sessions(recordings: Sequence[SkinRecording], preset: FidelityPreset, seed: int, section: Section) -> None:
    """Report R2 of each session predicted from another, and from a few presses of its own."""
    rows = [["session", "predicted session", "R2", f"R2 from {OWN_PRESSES} presses of the predicted session"]]
    section.numbers["r2"] = {}
    for source, other in permutations(recordings, 2):
        section.part(partial(_across, source, other, preset, seed, section, rows))
    if len(rows) == 1:
        raise CannotTellError(" ".join(section.sentences) or "No two recordings can be compared.")
    section.tables["R2 of one session's readings predicted from another"] = rows


def _across(
    source: SkinRecording, target: SkinRecording, preset: FidelityPreset, seed: int, section: Section,
    rows: list[list[str]],
) -> None:  # fmt: skip
    """Score a Gaussian process of one session on another session, and one fitted to a few presses of the latter."""
    before, now = _alike(source, target)
    order = np.random.default_rng(seed).permutation(len(now.load))
    own, test = order[:OWN_PRESSES], order[OWN_PRESSES : OWN_PRESSES + preset.test_rows]
    if len(test) < MIN_ROWS:
        raise CannotTellError(
            f"{target.name} has {len(now.load)} presses, too few to test {source.name} on; "
            f"{OWN_PRESSES + MIN_ROWS} are enough."
        )
    both = now._replace(
        position=np.concatenate([before.position, now.position]),
        load=np.concatenate([before.load, now.load]),
        readings=np.concatenate([before.readings, now.readings]),
    )
    past = np.random.default_rng(seed).permutation(len(before.load))[: preset.forward_rows]
    scores = {
        "predicted from the other session": explained_share(
            now.readings[test], simple_gp(both, past, len(before.load) + test)
        ),
        SIMPLE_GP: explained_share(now.readings[test], simple_gp(now, own, test)),
    }
    section.numbers["r2"][f"{source.name} -> {target.name}"] = scores
    rows.append([source.name, target.name, *map(cell, scores.values())])


def _alike(source: SkinRecording, target: SkinRecording) -> tuple[LoadedPresses, LoadedPresses]:
    """Select the presses of two sessions, which must have the same channels and kind of load."""
    if source.readings.shape[1] != target.readings.shape[1]:
        raise CannotTellError(f"{source.name} and {target.name} differ in their number of channels.")
    before, now = press_set(source), press_set(target)
    if before.load_kind != now.load_kind:
        raise CannotTellError(
            f"The load is {before.load_kind} in {source.name} and {now.load_kind} in {target.name}; predicting one "
            "from the other needs the same kind of load."
        )
    return before, now
