"""Noise, drift, hysteresis and creep of a recording, compared with the simulator's, and what bounds any model.

Each is estimated from what the recording has: noise from rows in air or, without, from presses that were repeated;
hysteresis from strokes that go in and come out, and from what a press leaves in the next one; creep from loads that are
held. The simulator's sizes are those of `i2t.skin.noise.Noise` and of `i2t.skin.faults.Faults.typical`.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from experiments.common.tables import cell
from experiments.fidelity.config import FidelityPreset
from experiments.fidelity.describe import changes_in_air
from experiments.fidelity.forward import (
    explained_share,
    load_of,
    one_tip,
    predicted_from_others,
    press_set,
)
from experiments.fidelity.sections import CannotTellError, Section
from i2t.recordings.presses import LoadedPresses
from i2t.recordings.read import MAX_STREAM_STEP_S, SkinRecording
from i2t.skin.boards import AXES_OF_CHIP
from i2t.skin.faults import FAULT_MODEL, Faults
from i2t.skin.noise import Noise

MIN_STILL_ROWS = 20
REPEAT_DISTANCE_M = 0.15e-3  # of presses that count as repeated
REPEAT_LOAD_SHARE = 0.04  # of the load's range
REPEAT_ROWS, MOST_PAIRS = 3000, 20000  # that are looked at
MIN_REPEATS = 30
MIN_STROKE_ROWS = 12
MIN_TURNS = 2  # strokes that go in and come out
HELD_M, HELD_S = 0.02e-3, 0.5  # a held travel changes by less, for longer
SMALLEST_UT = 1e-9
SIGNIFICANT_STD_ERRORS = 3.0


def noise(recording: SkinRecording, section: Section) -> None:
    """Noise at rest and drift, compared with the simulator's."""
    rows = [["quantity", "recording", "simulator", "ratio"]]
    section.part(lambda: _noise_rows(recording, section, rows))
    section.part(lambda: _drift_rows(recording, section, rows))
    _close(section, "noise and drift", rows)


def hysteresis(recording: SkinRecording, preset: FidelityPreset, section: Section) -> None:
    """Hysteresis within a stroke and from press to press, and creep."""
    rows = [["quantity", "recording", "simulator"]]
    section.part(lambda: _stroke_hysteresis(recording, section, rows))
    section.part(lambda: _creep(recording, section, rows))
    section.part(lambda: _press_hysteresis(recording, preset, section, rows))
    _close(section, "hysteresis and creep", rows)


def repeatability(recording: SkinRecording, preset: FidelityPreset, section: Section) -> None:
    """Limits that repeated presses set to the best model."""
    presses = press_set(recording)
    rows, predicted = predicted_from_others(presses, preset.forward_rows)
    reached = explained_share(presses.readings[rows], predicted)
    section.numbers["r2_leave_one_out_gp"] = reached
    section.sentences.append(
        f"A GP on position and load of {len(rows)} presses explains R2 {reached:.4f} of each from the others."
    )
    size = _repeat_noise(presses)
    total = np.mean(np.sum((presses.readings - presses.readings.mean(0)) ** 2, axis=1))
    limit = 1 - float(np.sum(size**2) / total)
    section.numbers |= {"repeat_std_uT": size.tolist(), "r2_repeatability_limit": limit}
    said = (
        f"so that no model can explain more than R2 {limit:.4f}"
        if reached <= limit
        else f"more than noise, as R2 {reached:.4f} is explained where that would leave {limit:.4f} to explain"
    )
    section.sentences.append(
        f"Presses repeated at one place and load differ by {np.sqrt(np.mean(size**2)):.2f} uT (standard deviation of a "
        f"channel), {said}."
    )


def _close(section: Section, caption: str, rows: list[list[str]]) -> None:
    """The table of a section, if any row was found."""
    if len(rows) == 1:
        section.status = "cannot tell"
    else:
        section.tables[caption] = rows


# --- noise and drift ---


def _noise_rows(recording: SkinRecording, section: Section, rows: list[list[str]]) -> None:
    change, simulated = changes_in_air(recording), Noise()
    if len(change) >= MIN_STILL_ROWS:
        size = np.std(np.clip(change, *np.percentile(change, [1, 99], axis=0)), axis=0) / np.sqrt(2)
        how = f"{len(change)} pairs of rows that follow each other in air"
    else:
        size = _repeat_noise(press_set(recording))
        how = "presses that were repeated, which adds what a skin does not repeat"
    by_axis = size.reshape(-1, AXES_OF_CHIP)
    xy, z = (float(np.sqrt(np.mean(part**2))) for part in (by_axis[:, :2], by_axis[:, 2]))
    for axis, found, own in (("x, y", xy, simulated.xy), ("z", z, simulated.z)):
        rows.append([f"noise of one sample, {axis} (uT)", cell(found, 2), cell(own, 2), cell(found / own, 2)])
    strong = float(np.percentile(np.linalg.norm(recording.readings, axis=1), 90))
    ratio = strong / float(np.sqrt(len(size) * (2 * xy**2 + z**2) / AXES_OF_CHIP))
    section.numbers["noise"] = {
        "xy_uT": xy, "z_uT": z, "how": how, "signal_to_noise": ratio,
        "simulator": {"xy_uT": simulated.xy, "z_uT": simulated.z},
    }  # fmt: skip
    section.sentences.append(
        f"Noise is estimated from {how}. A strong reading (90th percentile) is {ratio:.0f} times as long as the noise."
    )


def _repeat_noise(presses: LoadedPresses) -> np.ndarray:
    """Noise (c,) uT of one press, from pairs of neighbours as near as can be, less what their loads explain."""
    one, other = _repeated_pairs(presses)
    if len(one) < MIN_REPEATS:
        raise CannotTellError(
            f"{len(one)} pairs of presses share a place and a load; {MIN_REPEATS} are needed to tell what repeats."
        )
    change = presses.readings[one] - presses.readings[other]
    span = presses.load[one] - presses.load[other]
    if np.ptp(span) > 0:
        slope = (span @ change) / (span @ span)
        change = change - span[:, None] * slope
    inside = np.abs(change) <= np.percentile(np.abs(change), 99, axis=0)  # one slip is no noise
    return np.sqrt(np.sum(np.where(inside, change, 0) ** 2, axis=0) / np.maximum(inside.sum(0), 1) / 2)


def _repeated_pairs(presses: LoadedPresses) -> tuple[np.ndarray, np.ndarray]:
    """Rows of presses at one place with about one load that do not follow each other in one stroke."""
    range_of_load = max(float(np.ptp(presses.load)), 1e-12)
    x = np.column_stack([presses.position / REPEAT_DISTANCE_M, presses.load / (REPEAT_LOAD_SHARE * range_of_load)])
    some = np.arange(len(x))
    if len(x) > REPEAT_ROWS:
        some = np.sort(np.random.default_rng(0).choice(len(x), REPEAT_ROWS, replace=False))
    found = cKDTree(x[some]).query_pairs(1.0, output_type="ndarray")
    if len(found) > MOST_PAIRS:
        found = found[np.random.default_rng(0).choice(len(found), MOST_PAIRS, replace=False)]
    one, other = some[found[:, 0]], some[found[:, 1]]
    assert presses.session is not None
    if len(np.unique(presses.session)) == 1:
        return one, other
    apart = presses.session[one] != presses.session[other]
    return one[apart], other[apart]


def _drift_rows(recording: SkinRecording, section: Section, rows: list[list[str]]) -> None:
    base = recording.baseline
    if base is None or not len(np.unique(base, axis=0)) > 2:
        raise CannotTellError(
            "What was subtracted from the readings is not known here, so that drift shows only in what changed between "
            "the halves (see the checks)."
        )
    tenth = max(len(base) // 10, 1)
    change = np.abs(np.median(base[-tenth:], axis=0) - np.median(base[:tenth], axis=0))
    median, largest = float(np.median(change)), float(change.max())
    rows.append(["drift over the recording, median channel (uT)", cell(median, 1), "4.0 (seen on real boards)", "-"])
    rows.append(["the same, largest channel (uT)", cell(largest, 1), "64.0 (seen on real boards)", "-"])
    section.numbers["drift"] = {"median_uT": median, "largest_uT": largest}


# --- hysteresis and creep ---


class _Stroke(NamedTuple):
    load: np.ndarray
    readings: np.ndarray
    time: np.ndarray


def _strokes(recording: SkinRecording) -> tuple[str, list[_Stroke]]:
    one_tip(recording)
    name: str
    name, load = load_of(recording)
    if name == "none" and recording.varies("shear") and recording.known_rows("position").all():
        position = recording.targets["position"]
        _, first, of = np.unique(recording.session, return_index=True, return_inverse=True)
        name, load = "slide", np.linalg.norm(position - position[first[of.ravel()]], axis=1)  # from where it began
    if name == "none":
        raise CannotTellError("Strokes in and out need a load that is known.")
    found = []
    for session in np.unique(recording.session):
        rows = np.flatnonzero((recording.session == session) & np.isfinite(load))
        if len(rows) >= MIN_STROKE_ROWS and np.ptp(load[rows]) > 0.3 * np.nanmax(np.abs(load)):
            found.append(_Stroke(load[rows], recording.readings[rows], recording.time[rows]))
    return name, found


def _stroke_hysteresis(recording: SkinRecording, section: Section, rows: list[list[str]]) -> None:
    """Area between the ways in and out of each stroke, of its height."""
    _, strokes = _strokes(recording)
    loops, kept = [], []
    for stroke in strokes:
        deepest = int(np.argmax(stroke.load))
        inward, outward = slice(0, deepest + 1), slice(deepest, None)
        centred = stroke.readings - stroke.readings.mean(0)
        signal = centred @ np.linalg.svd(centred, full_matrices=False)[2][0]  # along which they change most
        height = float(np.ptp(signal))
        if min(deepest, len(stroke.load) - deepest) < MIN_STROKE_ROWS // 3 or not height:
            continue
        top = float(np.max(stroke.load))
        low = float(max(np.min(stroke.load[inward]), np.min(stroke.load[outward])))
        at = np.linspace(low + 0.1 * (top - low), top - 0.1 * (top - low), 20)
        ways = []
        for part in (inward, outward):
            order = np.argsort(stroke.load[part])
            ways.append(np.interp(at, stroke.load[part][order], signal[part][order]))
        loops.append(float(np.mean(np.abs(ways[1] - ways[0])) / height))
        kept.append(abs(float(np.mean(signal[-3:]) - np.mean(signal[:3]))) / height)
    if len(loops) < MIN_TURNS:
        raise CannotTellError("No strokes go in and come out with rows all the way, so that hysteresis is unknown.")
    rows.append(["hysteresis: ways in and out apart, of the stroke's height", cell(float(np.mean(loops))), "0.000"])
    rows.append(["what is left after a stroke, of its height", cell(float(np.mean(kept))), "0.000"])
    section.numbers["hysteresis"] = {"strokes": len(loops), "loop_share": loops, "left_share": kept}
    section.sentences.append(
        f"In {len(loops)} strokes the ways in and out lie {100 * np.mean(loops):.1f} % of the height apart; the "
        "simulator's skins come back the way they went (their hysteresis is from press to press)."
    )


def _creep(recording: SkinRecording, section: Section, rows: list[list[str]]) -> None:
    """Growth of a reading while a travel is held, per tenfold time."""
    name, strokes = _strokes(recording)
    if name not in ("travel", "slide") or not np.isfinite(recording.time).any():
        raise CannotTellError("Creep is measured where a travel is held and times are known.")
    growth = []
    for stroke in strokes:
        deep = stroke.load > 0.5 * stroke.load.max()
        begins = np.concatenate([[True], np.abs(np.diff(stroke.load)) > HELD_M]) | ~deep
        run = np.cumsum(begins)
        for number in np.unique(run[deep]):
            held = np.flatnonzero((run == number) & deep)
            seconds = stroke.time[held] - stroke.time[held[0]]
            if len(held) >= 4 and np.ptp(stroke.load[held]) < HELD_M and seconds[-1] >= HELD_S:
                signal = np.linalg.norm(stroke.readings[held], axis=1) + SMALLEST_UT
                growth.append(np.polyfit(np.log10(seconds + 0.1), signal / signal[0], 1)[0])
    if not growth:
        raise CannotTellError(f"No travel is held for {HELD_S:g} s, so that creep is unknown.")
    own = Faults.typical().relaxation * FAULT_MODEL.layer_share / 3
    rows.append(["creep of a held press, per tenfold time", cell(float(np.mean(growth)), 4), cell(own, 4)])
    section.numbers["creep"] = {"holds": len(growth), "share_per_decade": growth, "simulator": own}


def _press_hysteresis(
    recording: SkinRecording, preset: FidelityPreset, section: Section, rows: list[list[str]]
) -> None:
    """Share of the press before that each chip keeps: its residual against the reading before."""
    presses, gap = press_set(recording, at_least=60), np.diff(recording.time)
    if np.isfinite(gap).any() and np.nanmedian(gap) < MAX_STREAM_STEP_S:
        raise CannotTellError("Rows follow each other in strokes: what a press leaves in the next one is unknown.")
    chosen, predicted = predicted_from_others(presses, preset.forward_rows)
    assert presses.row is not None
    residual, row = presses.readings[chosen] - predicted, presses.row[chosen]
    before = np.where((row > 0)[:, None], recording.readings[np.maximum(row - 1, 0)], 0.0)
    x, y = (part.reshape(len(part), -1, AXES_OF_CHIP) for part in (before - before.mean(0), residual))
    weight = (x**2).sum((0, 2)) + 1e-12
    kept = (x * y).sum((0, 2)) / weight
    left = ((y - kept[:, None] * x) ** 2).sum((0, 2))
    sure = np.abs(kept) > SIGNIFICANT_STD_ERRORS * np.sqrt(left / max(y[:, 0].size - 1, 1) / weight)
    worst = int(np.argmax(np.abs(kept)))
    own = cell(Faults.typical().hysteresis)
    rows.append(["part of the press before that the worst chip keeps", cell(float(kept[worst])), own])
    section.numbers["hysteresis_of_chips"] = {
        "by_chip": kept.tolist(), "beyond_chance": sure.tolist(), "simulator": Faults.typical().hysteresis,
    }  # fmt: skip
    section.sentences.append(
        f"Chip {worst} keeps {kept[worst]:+.3f} of the press before ({'beyond' if sure[worst] else 'within'} chance)."
    )
