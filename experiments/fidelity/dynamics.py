"""Noise, drift, hysteresis and creep of a recording, compared with the simulator's, and upper limits of any model's R2.

Noise is estimated from rows in air or else from repeated presses, hysteresis from loading and unloading strokes and
from the remainder of one press in the next, creep from held loads. The simulator's values are those of
`i2t.skin.noise.Noise` and `i2t.skin.faults.Faults.typical`.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from experiments.common.tables import cell
from experiments.fidelity.config import FidelityPreset
from experiments.fidelity.describe import changes_in_air
from experiments.fidelity.forward import explained_share, load_of, one_tip, predicted_from_others, press_set
from experiments.fidelity.sections import CannotTellError, Section
from i2t.recordings.presses import LoadedPresses
from i2t.recordings.read import MAX_STREAM_STEP_S, SkinRecording
from i2t.skin.boards import AXES_OF_CHIP
from i2t.skin.faults import FAULT_MODEL, Faults
from i2t.skin.noise import Noise

MIN_REPEATED_PAIRS = 30
MIN_STROKE_ROWS = 12
HOLD_TRAVEL_M, HOLD_TIME_S = 0.02e-3, 0.5  # a held travel changes by less than this, for at least this time


def noise(recording: SkinRecording, section: Section) -> None:
    """Report noise at rest and drift, compared with the simulator's."""
    rows = [["quantity", "recording", "simulator", "ratio"]]
    section.part(lambda: _noise_rows(recording, section, rows))
    section.part(lambda: _drift_rows(recording, section, rows))
    _close(section, "noise and drift", rows)


def hysteresis(recording: SkinRecording, preset: FidelityPreset, section: Section) -> None:
    """Report creep, and hysteresis within a stroke and from press to press."""
    rows = [["quantity", "recording", "simulator"]]
    section.part(lambda: _stroke_hysteresis(recording, section, rows))
    section.part(lambda: _creep(recording, section, rows))
    section.part(lambda: _press_hysteresis(recording, preset, section, rows))
    _close(section, "hysteresis and creep", rows)


def repeatability(recording: SkinRecording, preset: FidelityPreset, section: Section) -> None:
    """Report the largest R2 that the scatter of repeated presses allows."""
    presses = press_set(recording)
    rows, predicted = predicted_from_others(presses, preset.forward_rows)
    reached = explained_share(presses.readings[rows], predicted)
    section.numbers["r2_leave_one_out_gp"] = reached
    section.sentences.append(
        f"A Gaussian process over position and load reaches R2 {reached:.4f} by leave-one-out on {len(rows)} presses."
    )
    size = _repeat_noise(presses)
    total = np.mean(np.sum((presses.readings - presses.readings.mean(0)) ** 2, axis=1))
    limit = 1 - float(np.sum(size**2) / total)
    section.numbers |= {"repeat_std_uT": size.tolist(), "r2_repeatability_limit": limit}
    conclusion = (
        f"so no model can exceed R2 {limit:.4f}"
        if reached <= limit
        else f"which would limit R2 to {limit:.4f}; as {reached:.4f} is reached, more than noise differs between them"
    )
    section.sentences.append(
        f"Repeated presses at one position and load scatter by {np.sqrt(np.mean(size**2)):.2f} uT (standard deviation "
        f"of a channel), {conclusion}."
    )


def _close(section: Section, caption: str, rows: list[list[str]]) -> None:
    """Add the table to the section, or mark the section as "cannot tell" if the table is empty."""
    if len(rows) == 1:
        section.status = "cannot tell"
    else:
        section.tables[caption] = rows


# --- noise and drift ---


def _noise_rows(recording: SkinRecording, section: Section, rows: list[list[str]]) -> None:
    change, simulated = changes_in_air(recording), Noise()
    if len(change) >= 20:
        size = np.std(np.clip(change, *np.percentile(change, [1, 99], axis=0)), axis=0) / np.sqrt(2)
        source = f"{len(change)} pairs of consecutive rows in air"
    else:
        size = _repeat_noise(press_set(recording))
        source = "repeated presses, whose scatter includes changes of the skin"
    by_axis = size.reshape(-1, AXES_OF_CHIP)
    xy, z = (float(np.sqrt(np.mean(part**2))) for part in (by_axis[:, :2], by_axis[:, 2]))
    for axis, measured, own in (("x, y", xy, simulated.xy), ("z", z, simulated.z)):
        rows.append([f"noise of one sample, {axis} (uT)", cell(measured, 2), cell(own, 2), cell(measured / own, 2)])
    strong = float(np.percentile(np.linalg.norm(recording.readings, axis=1), 90))
    ratio = strong / float(np.sqrt(len(size) * (2 * xy**2 + z**2) / AXES_OF_CHIP))
    section.numbers["noise"] = {
        "xy_uT": xy, "z_uT": z, "how": source, "signal_to_noise": ratio,
        "simulator": {"xy_uT": simulated.xy, "z_uT": simulated.z},
    }  # fmt: skip
    section.sentences.append(
        f"Noise is estimated from {source}. The magnitude of a strong reading (90th percentile) is {ratio:.0f} times "
        "that of the noise."
    )


def _repeat_noise(presses: LoadedPresses) -> np.ndarray:
    """Noise `(c,)` (uT) of one press, from repeated pairs after removing the effect of their load difference."""
    first, second = _repeated_pairs(presses)
    if len(first) < MIN_REPEATED_PAIRS:
        raise CannotTellError(
            f"{len(first)} pairs of presses share a position and a load; {MIN_REPEATED_PAIRS} are needed for the noise."
        )
    change = presses.readings[first] - presses.readings[second]
    span = presses.load[first] - presses.load[second]
    if np.ptp(span) > 0:
        slope = (span @ change) / (span @ span)
        change = change - span[:, None] * slope
    inside = np.abs(change) <= np.percentile(np.abs(change), 99, axis=0)  # excludes slips
    return np.sqrt(np.sum(np.where(inside, change, 0) ** 2, axis=0) / np.maximum(inside.sum(0), 1) / 2)


def _repeated_pairs(presses: LoadedPresses) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of presses within 0.15 mm and 4 % of the load range of each other, and from different strokes if there are
    several.
    """
    load_range = max(float(np.ptp(presses.load)), 1e-12)
    x = np.column_stack([presses.position / 0.15e-3, presses.load / (0.04 * load_range)])
    subset = np.arange(len(x))
    if len(x) > 3000:
        subset = np.sort(np.random.default_rng(0).choice(len(x), 3000, replace=False))
    pairs = cKDTree(x[subset]).query_pairs(1.0, output_type="ndarray")
    if len(pairs) > 20_000:
        pairs = pairs[np.random.default_rng(0).choice(len(pairs), 20_000, replace=False)]
    first, second = subset[pairs[:, 0]], subset[pairs[:, 1]]
    assert presses.session is not None
    if len(np.unique(presses.session)) == 1:
        return first, second
    apart = presses.session[first] != presses.session[second]
    return first[apart], second[apart]


def _drift_rows(recording: SkinRecording, section: Section, rows: list[list[str]]) -> None:
    base = recording.baseline
    if base is None or not len(np.unique(base, axis=0)) > 2:
        raise CannotTellError(
            "The subtracted ambient field is not known, so drift shows only as a change between the halves (see the "
            "checks)."
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
        _, first, session_index = np.unique(recording.session, return_index=True, return_inverse=True)
        start = position[first[session_index.ravel()]]
        name, load = "slide", np.linalg.norm(position - start, axis=1)
    if name == "none":
        raise CannotTellError("Hysteresis and creep need a known load.")
    strokes = []
    for session in np.unique(recording.session):
        rows = np.flatnonzero((recording.session == session) & np.isfinite(load))
        if len(rows) >= MIN_STROKE_ROWS and np.ptp(load[rows]) > 0.3 * np.nanmax(np.abs(load)):
            strokes.append(_Stroke(load[rows], recording.readings[rows], recording.time[rows]))
    return name, strokes


def _stroke_hysteresis(recording: SkinRecording, section: Section, rows: list[list[str]]) -> None:
    """Report the gap between the loading and unloading curves of each stroke, as a fraction of its height."""
    _, strokes = _strokes(recording)
    loops, kept = [], []
    for stroke in strokes:
        deepest = int(np.argmax(stroke.load))
        inward, outward = slice(0, deepest + 1), slice(deepest, None)
        centred = stroke.readings - stroke.readings.mean(0)
        signal = centred @ np.linalg.svd(centred, full_matrices=False)[2][0]  # direction of largest variance
        height = float(np.ptp(signal))
        if min(deepest, len(stroke.load) - deepest) < MIN_STROKE_ROWS // 3 or not height:
            continue
        top = float(np.max(stroke.load))
        low = float(max(np.min(stroke.load[inward]), np.min(stroke.load[outward])))
        at = np.linspace(low + 0.1 * (top - low), top - 0.1 * (top - low), 20)
        curves = []
        for part in (inward, outward):
            order = np.argsort(stroke.load[part])
            curves.append(np.interp(at, stroke.load[part][order], signal[part][order]))
        loops.append(float(np.mean(np.abs(curves[1] - curves[0])) / height))
        kept.append(abs(float(np.mean(signal[-3:]) - np.mean(signal[:3]))) / height)
    if len(loops) < 2:
        raise CannotTellError("Fewer than two strokes have a loading and an unloading curve, so hysteresis is unknown.")
    rows.append(["gap of loading and unloading curves, fraction of the height", cell(float(np.mean(loops))), "0.000"])
    rows.append(["remainder after a stroke, fraction of its height", cell(float(np.mean(kept))), "0.000"])
    section.numbers["hysteresis"] = {"strokes": len(loops), "loop_share": loops, "left_share": kept}
    section.sentences.append(
        f"In {len(loops)} strokes the loading and unloading curves differ by {100 * np.mean(loops):.1f} % of the "
        "height; those of the simulator coincide (its hysteresis is from press to press)."
    )


def _creep(recording: SkinRecording, section: Section, rows: list[list[str]]) -> None:
    """Report the growth of a reading per tenfold time while a travel is held."""
    name, strokes = _strokes(recording)
    if name not in ("travel", "slide") or not np.isfinite(recording.time).any():
        raise CannotTellError("Creep needs a held travel and known times.")
    growth = []
    for stroke in strokes:
        deep = stroke.load > 0.5 * stroke.load.max()
        begins = np.concatenate([[True], np.abs(np.diff(stroke.load)) > HOLD_TRAVEL_M]) | ~deep
        run = np.cumsum(begins)
        for number in np.unique(run[deep]):
            held = np.flatnonzero((run == number) & deep)
            seconds = stroke.time[held] - stroke.time[held[0]]
            if len(held) >= 4 and np.ptp(stroke.load[held]) < HOLD_TRAVEL_M and seconds[-1] >= HOLD_TIME_S:
                signal = np.linalg.norm(stroke.readings[held], axis=1) + 1e-9
                growth.append(np.polyfit(np.log10(seconds + 0.1), signal / signal[0], 1)[0])
    if not growth:
        raise CannotTellError(f"No travel is held for {HOLD_TIME_S:g} s, so creep is unknown.")
    own = Faults.typical().relaxation * FAULT_MODEL.layer_share / 3
    rows.append(["creep of a held press, per tenfold time", cell(float(np.mean(growth)), 4), cell(own, 4)])
    section.numbers["creep"] = {"holds": len(growth), "share_per_decade": growth, "simulator": own}


def _press_hysteresis(
    recording: SkinRecording, preset: FidelityPreset, section: Section, rows: list[list[str]]
) -> None:
    """Report the fraction of the previous press that each chip keeps, by regression on the previous reading."""
    presses, gap = press_set(recording, at_least=60), np.diff(recording.time)
    if np.isfinite(gap).any() and np.nanmedian(gap) < MAX_STREAM_STEP_S:
        raise CannotTellError("The rows are a stream of strokes, so the remainder of one press in the next is unknown.")
    chosen, predicted = predicted_from_others(presses, preset.forward_rows)
    assert presses.row is not None
    residual, row = presses.readings[chosen] - predicted, presses.row[chosen]
    before = np.where((row > 0)[:, None], recording.readings[np.maximum(row - 1, 0)], 0.0)
    x, y = (part.reshape(len(part), -1, AXES_OF_CHIP) for part in (before - before.mean(0), residual))
    weight = (x**2).sum((0, 2)) + 1e-12
    kept = (x * y).sum((0, 2)) / weight
    left = ((y - kept[:, None] * x) ** 2).sum((0, 2))
    sure = np.abs(kept) > 3 * np.sqrt(left / max(y[:, 0].size - 1, 1) / weight)
    worst = int(np.argmax(np.abs(kept)))
    own = cell(Faults.typical().hysteresis)
    rows.append(["fraction of the previous press that the worst chip keeps", cell(float(kept[worst])), own])
    section.numbers["hysteresis_of_chips"] = {
        "by_chip": kept.tolist(), "beyond_chance": sure.tolist(), "simulator": Faults.typical().hysteresis,
    }  # fmt: skip
    section.sentences.append(
        f"Chip {worst} keeps {kept[worst]:+.3f} of the previous press ({'beyond' if sure[worst] else 'within'} chance)."
    )
