"""Noise, drift, hysteresis and creep of a recording, compared with the simulator's, and what bounds any model.

Each is estimated from what the recording has: noise from rows in air or, without, from presses that were repeated;
hysteresis from strokes that go in and come out, and from what a press leaves in the next one; creep from loads that are
held. The simulator's sizes are those of `i2t.skin.noise.Noise` and of `i2t.skin.faults.Faults.typical`.
"""

from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from experiments.fidelity.config import FidelityPreset
from experiments.fidelity.describe import load_of, one_tip
from experiments.fidelity.forward import (
    PressSet,
    choose_simple_gp,
    explained_share,
    left_out,
    predict_simple_gp,
    press_set,
)
from experiments.fidelity.sections import CannotTellError, Section, cell
from i2t.calibration.heads import TARGETS, SkinRecording
from i2t.calibration.recordings import MIN_CHANGE, STREAM_GAP_S, VALUES_PER_CHIP, is_stream
from i2t.skin.faults import Faults
from i2t.skin.noise import Noise
from i2t.viz import style

MIN_STILL_ROWS = 20
REPEAT_DISTANCE_M = 0.15e-3  # of presses that count as repeated
REPEAT_LOAD_SHARE = 0.04  # of the load's range
MIN_REPEATS = 30
MIN_STROKE_ROWS = 12
MIN_TURNS = 2  # strokes that go in and come out
HELD_M, HELD_S = 0.02e-3, 0.5  # a held depth changes by less, for longer
SMALLEST_UT = 1e-9
SIGNIFICANT_STD_ERRORS = 3.0
SLOPE_ROWS = 200  # on which the ceiling of a location is estimated
GRADIENT_STEP = 0.1e-3  # m
CONDITION = 1e-9


class NoiseSizes(NamedTuple):
    """Standard deviations of one reading at rest, uT."""

    xy: float
    z: float
    how: str


def noise(recording: SkinRecording, preset: FidelityPreset, section: Section) -> None:
    """Noise at rest and drift, compared with the simulator's."""
    rows = [["quantity", "recording", "simulator", "ratio"]]
    section.part(lambda: _noise_rows(recording, section, rows))
    section.part(lambda: _drift_rows(recording, section, rows))
    if len(rows) == 1:
        section.status = "cannot tell"
        return
    section.tables["noise and drift"] = rows
    section.figures["Noise and drift"] = _noise_figure(recording, section)


def hysteresis(recording: SkinRecording, preset: FidelityPreset, section: Section) -> None:
    """Hysteresis within a stroke and from press to press, and creep."""
    rows = [["quantity", "recording", "simulator"]]
    section.part(lambda: _stroke_hysteresis(recording, section, rows))
    section.part(lambda: _creep(recording, section, rows))
    section.part(lambda: _press_hysteresis(recording, preset, section, rows))
    if len(rows) == 1:
        section.status = "cannot tell"
    else:
        section.tables["hysteresis and creep"] = rows


def ceilings(recording: SkinRecording, preset: FidelityPreset, section: Section) -> None:
    """Limits that repeated presses set to the best model."""
    presses = press_set(recording)
    rows, predicted = left_out(presses, preset.forward_rows)
    reached = explained_share(presses.readings[rows], predicted)
    section.numbers["r2_plain_gp_leave_one_out"] = reached
    section.sentences.append(
        f"A plain Gaussian process of {len(rows)} presses explains R2 {reached:.4f} of each from the others."
    )
    section.part(lambda: _repeat_ceiling(presses, preset, section))


def _repeat_ceiling(presses: PressSet, preset: FidelityPreset, section: Section) -> None:
    noise_of_repeats = _repeat_noise(presses)
    total = np.mean(np.sum((presses.readings - presses.readings.mean(0)) ** 2, axis=1))
    ceiling = 1 - float(np.sum(noise_of_repeats**2) / total)
    section.numbers |= {"repeat_std_uT": noise_of_repeats.tolist(), "r2_ceiling": ceiling}
    reached = section.numbers["r2_plain_gp_leave_one_out"]
    said = (
        f"so that no model can explain more than R2 {ceiling:.4f}"
        if reached <= ceiling
        else f"more than noise, as R2 {reached:.4f} is explained where that would leave {ceiling:.4f} to explain"
    )
    section.sentences.append(
        f"Presses repeated at one place and load differ by {np.sqrt(np.mean(noise_of_repeats**2)):.2f} uT (standard "
        f"deviation of a channel), {said}."
    )
    section.part(lambda: _location_ceiling(presses, preset, noise_of_repeats, section))


def _noise_rows(recording: SkinRecording, section: Section, rows: list[list[str]]) -> None:
    found, simulated = _noise_at_rest(recording), Noise()
    of_reading = np.sqrt((1 - simulated.common) / simulated.contact_samples + simulated.common)
    for axis, size, own in (("x, y", found.xy, simulated.xy), ("z", found.z, simulated.z)):
        rows.append([f"noise of one sample, {axis} (uT)", cell(size, 2), cell(own, 2), cell(size / own, 2)])
    length = np.linalg.norm(recording.readings, axis=1)
    channels = recording.readings.shape[1]
    ratio = float(np.percentile(length, 90) / np.sqrt(channels * (2 * found.xy**2 + found.z**2) / VALUES_PER_CHIP))
    section.numbers["noise"] = {
        "xy_uT": found.xy, "z_uT": found.z, "how": found.how, "signal_to_noise": ratio,
        "simulator": {
            "xy_uT": simulated.xy, "z_uT": simulated.z, "mean_of_samples_xy_uT": simulated.xy * of_reading,
            "mean_of_samples_z_uT": simulated.z * of_reading,
        },
    }  # fmt: skip
    section.sentences.append(
        f"Noise is estimated from {found.how}. "
        f"A strong reading (90th percentile) is {ratio:.0f} times as long as the noise."
    )


def _noise_at_rest(recording: SkinRecording) -> NoiseSizes:
    """Noise from differences of rows that follow each other in air, else of presses that were repeated."""
    contact, y = recording.targets.get("contact"), recording.readings
    seconds = np.diff(recording.time)
    follows = (np.diff(recording.session) == 0) & ~(seconds > STREAM_GAP_S) & np.isfinite(seconds)
    if contact is not None:
        air = contact[:, 0] == 0
        still = air[1:] & air[:-1] & follows
        if still.sum() >= MIN_STILL_ROWS:
            change = np.diff(y, axis=0)[still]
            size = np.std(np.clip(change, *np.percentile(change, [1, 99], axis=0)), axis=0) / np.sqrt(2)
            how = f"{int(still.sum())} pairs of rows that follow each other in air"
            return NoiseSizes(*_by_axis(size), how)
    size = _repeat_noise(press_set(recording))
    return NoiseSizes(*_by_axis(size), "presses that were repeated, which adds what a skin does not repeat")


def _by_axis(size: np.ndarray) -> tuple[float, float]:
    chips = size.reshape(-1, VALUES_PER_CHIP)
    return float(np.sqrt(np.mean(chips[:, :2] ** 2))), float(np.sqrt(np.mean(chips[:, 2] ** 2)))


def _repeat_noise(presses: PressSet) -> np.ndarray:
    """Noise (c,) uT of one press, from pairs of neighbours as near as can be, less what their loads explain."""
    one, other = repeated_pairs(presses)
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


def repeated_pairs(presses: PressSet, most: int = 20000) -> tuple[np.ndarray, np.ndarray]:
    """Rows of presses at one place with about one load that do not follow each other in one stroke."""
    from scipy.spatial import cKDTree

    range_of_load = max(float(np.ptp(presses.load)), 1e-12)
    x = np.column_stack([presses.position / REPEAT_DISTANCE_M, presses.load / (REPEAT_LOAD_SHARE * range_of_load)])
    some = (
        np.arange(len(x)) if len(x) <= 3000 else np.sort(np.random.default_rng(0).choice(len(x), 3000, replace=False))
    )
    found = cKDTree(x[some]).query_pairs(1.0, output_type="ndarray")
    if len(found) > most:
        found = found[np.random.default_rng(0).choice(len(found), most, replace=False)]
    one, other = some[found[:, 0]], some[found[:, 1]]
    streams = len(np.unique(presses.session)) > 1
    apart = (presses.session[one] != presses.session[other]) if streams else np.ones(len(one), bool)
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
    simulated = Noise()
    median = float(np.median(change))
    rows.append(
        ["drift over the recording, median channel (uT)", cell(median, 1), cell(simulated.drift, 1),
         cell(median / simulated.drift, 1)]
    )  # fmt: skip
    rows.append(["the same, largest channel (uT)", cell(float(change.max()), 1), "64.0 (seen on real boards)", "-"])
    section.numbers["drift"] = {
        "median_uT": median, "largest_uT": float(change.max()), "by_channel_uT": change.tolist(),
        "simulator_median_uT": simulated.drift,
    }  # fmt: skip


def _noise_figure(recording: SkinRecording, section: Section) -> Figure:
    figure = Figure(figsize=(10, 3.2), layout="constrained")
    bars, drift = figure.subplots(1, 2)
    sizes = section.numbers.get("noise")
    if sizes:
        bars.bar([0, 1], [sizes["xy_uT"], sizes["z_uT"]], 0.4, color=style.BLUE, label="recording")
        bars.bar(
            [0.4, 1.4], [sizes["simulator"]["xy_uT"], sizes["simulator"]["z_uT"]], 0.4, color=style.ORANGE,
            label="simulator",
        )  # fmt: skip
        bars.set_xticks([0.2, 1.2], ["x, y", "z"])
        bars.set(ylabel="noise of one sample (uT)")
        bars.legend()
    else:
        bars.set_axis_off()
    if recording.baseline is not None:
        some = np.linspace(0, len(recording) - 1, min(len(recording), 2000)).astype(int)
        drift.plot(some, (recording.baseline - recording.baseline[0])[some], lw=0.6)
        drift.set(xlabel="row", ylabel="change of what was subtracted (uT)")
    else:
        drift.set_axis_off()
    return figure


class _Stroke(NamedTuple):
    load: np.ndarray
    readings: np.ndarray
    time: np.ndarray


def _strokes(recording: SkinRecording) -> tuple[str, list[_Stroke]]:
    one_tip(recording)
    name, load = load_of(recording)
    if name == "none" and recording.varies("shear") and recording.known("position").all():
        name, load = "slide", _slid_distance(recording)
    if name == "none":
        raise CannotTellError("Strokes in and out need a load that is known.")
    found = []
    for session in np.unique(recording.session):
        rows = np.flatnonzero((recording.session == session) & np.isfinite(load))
        if len(rows) >= MIN_STROKE_ROWS and np.ptp(load[rows]) > 0.3 * np.nanmax(np.abs(load)):
            found.append(_Stroke(load[rows], recording.readings[rows], recording.time[rows]))
    return name, found


def _slid_distance(recording: SkinRecording) -> np.ndarray:
    """Distance (n,) m along the skin from where a stroke began."""
    position = recording.targets["position"]
    begins = np.unique(recording.session, return_index=True, return_inverse=True)
    return np.linalg.norm(position - position[begins[1][begins[2].ravel()]], axis=1)


def _stroke_hysteresis(recording: SkinRecording, section: Section, rows: list[list[str]]) -> None:
    """Area between the ways in and out of each stroke, of its height."""
    _, strokes = _strokes(recording)
    loops, kept = [], []
    for stroke in strokes:
        deepest = int(np.argmax(stroke.load))
        inward, outward = slice(0, deepest + 1), slice(deepest, None)
        if min(deepest, len(stroke.load) - deepest) < MIN_STROKE_ROWS // 3:
            continue
        signal = _along_largest(stroke.readings)
        height = float(np.ptp(signal))
        if not height:
            continue
        top = float(np.max(stroke.load))
        low = float(max(np.min(stroke.load[inward]), np.min(stroke.load[outward])))
        at = np.linspace(low + 0.1 * (top - low), top - 0.1 * (top - low), 20)
        ways = [_averaged(stroke.load[part], signal[part], at) for part in (inward, outward)]
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


def _along_largest(readings: np.ndarray) -> np.ndarray:
    """Readings along the direction in which they change most."""
    centred = readings - readings.mean(0)
    direction = np.linalg.svd(centred, full_matrices=False)[2][0]
    return centred @ direction


def _averaged(load: np.ndarray, signal: np.ndarray, at: np.ndarray) -> np.ndarray:
    order = np.argsort(load)
    return np.interp(at, load[order], signal[order])


def _creep(recording: SkinRecording, section: Section, rows: list[list[str]]) -> None:
    """Growth of a reading while a depth is held, per tenfold time."""
    name, strokes = _strokes(recording)
    if name not in ("depth", "slide") or not np.isfinite(recording.time).any():
        raise CannotTellError("Creep is measured where a depth is held and times are known.")
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
        raise CannotTellError(f"No depth is held for {HELD_S:g} s, so that creep is unknown.")
    faults = Faults.typical()
    own = faults.relaxation * faults.layer_share / 3
    rows.append(["creep of a held press, per tenfold time", cell(float(np.mean(growth)), 4), cell(own, 4)])
    section.numbers["creep"] = {"holds": len(growth), "share_per_decade": growth, "simulator": own}


def _press_hysteresis(
    recording: SkinRecording, preset: FidelityPreset, section: Section, rows: list[list[str]]
) -> None:
    """Share of the press before that each chip keeps: its residual against the reading before."""
    presses = press_set(recording, at_least=60)
    if is_stream(recording):
        raise CannotTellError("Rows follow each other in strokes: what a press leaves in the next one is unknown.")
    chosen, predicted = left_out(presses, preset.forward_rows)
    residual = presses.readings[chosen] - predicted
    before = np.zeros_like(residual)
    first = presses.row[chosen] > 0
    before[first] = recording.readings[presses.row[chosen][first] - 1]
    kept, sure = [], []
    for chip in range(residual.shape[1] // VALUES_PER_CHIP):
        part = slice(VALUES_PER_CHIP * chip, VALUES_PER_CHIP * (chip + 1))
        x, y = before[:, part] - before[:, part].mean(0), residual[:, part]
        weight = float(np.sum(x * x)) + 1e-12
        coefficient = float(np.sum(x * y) / weight)
        error = float(np.sqrt(np.sum((y - coefficient * x) ** 2) / max(y.size - 1, 1) / weight))
        kept.append(coefficient)
        sure.append(abs(coefficient) > SIGNIFICANT_STD_ERRORS * error)
    largest = int(np.argmax(np.abs(kept)))
    rows.append(
        ["part of the press before that the worst chip keeps", cell(kept[largest]), cell(Faults.typical().hysteresis)]
    )
    section.numbers["hysteresis_of_chips"] = {"by_chip": kept, "beyond_chance": sure}
    section.sentences.append(
        f"Chip {largest} keeps {kept[largest]:+.3f} of the press before "
        f"({'beyond' if sure[largest] else 'within'} chance)."
    )


def _location_ceiling(
    presses: PressSet, preset: FidelityPreset, noise_of_repeats: np.ndarray, section: Section
) -> None:
    """Least standard deviation of position and load that any unbiased head can have at this noise (Cramer and Rao)."""
    order = np.random.default_rng(0).permutation(len(presses.load))
    settings, known = choose_simple_gp(presses, order), order[: preset.forward_rows]
    at = presses.coordinates[order[:SLOPE_ROWS]]
    ranges = [*np.ptp(presses.position, axis=0), MIN_CHANGE["position"] * (np.ptp(presses.load) > 0) * 2]
    moves = [part for part in range(3) if ranges[part] > MIN_CHANGE["position"]]
    unit = np.array([GRADIENT_STEP, GRADIENT_STEP, 0.02])
    slopes = []
    for part in moves:
        step = np.zeros(3)
        step[part] = unit[part]
        change = predict_simple_gp(settings, presses, known, at + step) - predict_simple_gp(
            settings, presses, known, at - step
        )
        slopes.append(change / (2 * unit[part]))
    white = np.stack(slopes, axis=-1) / np.maximum(noise_of_repeats, 1e-3)[None, :, None]
    information = np.einsum("nci,ncj->nij", white, white)
    information += CONDITION * np.trace(information, axis1=1, axis2=2)[:, None, None] * np.eye(len(moves))
    variance = np.diagonal(np.linalg.inv(information), axis1=1, axis2=2)
    section.numbers["bounds"] = {}
    names = ("position", "position", presses.load_name)
    for name in dict.fromkeys(names[part] for part in moves):
        columns = [i for i, part in enumerate(moves) if names[part] == name]
        size = np.sqrt(np.sum(variance[:, columns], axis=1))
        size = size if name == "position" else size * presses.load.std()
        kind = TARGETS[name]
        median, rms = kind.scale * float(np.median(size)), kind.scale * float(np.sqrt(np.mean(size**2)))
        section.numbers["bounds"][name] = {"median": median, "rms": rms, "unit": kind.unit}
        section.sentences.append(
            f"At the scatter of these repeats a head without a prior tells {name} to {median:.3f} {kind.unit} at best "
            "(standard deviation, median over presses; Cramer-Rao, slopes of a plain Gaussian process); one that has "
            "learned where presses are can do better."
        )
