"""Description of a recording, and checks for signs of a faulty one."""

import numpy as np

from experiments.fidelity.forward import load_of, one_tip
from experiments.fidelity.sections import CannotTellError, Section, join
from i2t.recordings.diagnose import Finding, check_presses, diagnose, find_force_sign, metrics_of
from i2t.recordings.read import MAX_STREAM_STEP_S, TARGETS, SkinRecording
from i2t.recordings.segmentation import MAD_TO_STD
from i2t.skin.boards import AXES_OF_CHIP

# Microtesla per step of (x and y, z) by gain at resolution 0 (MLX90393 data sheet, sensitivity table, 0xC); each
# higher resolution, 1 to 3, doubles it.
CHIP_STEPS_UT = np.array([
    (0.751, 1.210), (0.601, 0.968), (0.451, 0.726), (0.376, 0.605),
    (0.300, 0.484), (0.250, 0.403), (0.200, 0.323), (0.150, 0.242),
])  # fmt: skip
MICROTESLA_PER_UNIT = {"uT": 1.0, "mT": 1e3, "gauss": 100.0, "nT": 1e-3}
MIN_GAPS = 20  # fewest differences of values from which a step or a noise is estimated


def describe(recording: SkinRecording, section: Section) -> None:
    """Report counts, ranges, unit and rate."""
    n, c = recording.readings.shape
    sessions, numbers = len(np.unique(recording.session)), section.numbers
    section.sentences += [
        f"{n} {recording.source} readings of {c // AXES_OF_CHIP} chips ({c} channels) in {sessions} strokes or "
        "sessions.",
        *recording.notes,
    ]
    numbers |= {"rows": n, "channels": c, "sessions": sessions, "source": recording.source}
    seconds = np.diff(recording.time)
    if np.isfinite(seconds).any():
        gap, span = float(np.nanmedian(seconds)), float(np.nanmax(recording.time) - np.nanmin(recording.time))
        numbers["time"] = {"median_gap_s": gap, "span_s": span}
        section.sentences.append(f"There is a row every {gap:.3g} s (median) over {span / 60:.1f} minutes.")
    else:
        section.sentences.append("No times are known, so rates, creep and drift per hour are unknown.")
    section.tables["known targets"] = _known(recording, numbers)
    section.sentences.append(_unit(recording, numbers))


def check(recording: SkinRecording, section: Section, findings: list[Finding]) -> None:
    """Report signs of a faulty recording, one sentence each; estimates such as its lag are added to `findings`."""
    warnings: list[str] = []
    _check_channels(recording, warnings, section.numbers)
    _check_targets(recording, warnings, section.numbers)
    section.part(lambda: _check_presses(recording, warnings, section.numbers))
    section.part(lambda: _check_unknowns(recording, warnings, section, findings))
    section.numbers["warnings"] = warnings
    section.sentences[:0] = warnings or ["The checks found no fault."]


def _known(recording: SkinRecording, numbers: dict) -> list[list[str]]:
    rows, numbers["known"] = [["target", "rows", "from", "to", "unit"]], {}
    for name, kind in TARGETS.items():
        rows_known = recording.known_rows(name)
        ends = ["-", "-"]
        if rows_known.any():
            values = kind.scale * recording.targets[name][rows_known]
            low, high = values.min(0), values.max(0)
            numbers["known"][name] = {"rows": int(rows_known.sum()), "low": low.tolist(), "high": high.tolist()}
            ends = [" / ".join(f"{v:.3g}" for v in end) for end in (low, high)]
        rows.append([name, str(int(rows_known.sum())), *ends, kind.unit])
    return rows


def _raw(recording: SkinRecording) -> np.ndarray:
    return recording.readings if recording.baseline is None else recording.readings + recording.baseline


def _unit(recording: SkinRecording, numbers: dict) -> str:
    """Infer the unit from the steps of the values."""
    steps = np.array([_step(channel) for channel in _raw(recording).T])
    axes = np.delete(steps, np.s_[2::AXES_OF_CHIP]), steps[2::AXES_OF_CHIP]
    xy_and_z = np.array([np.nanmedian(part) if np.isfinite(part).any() else np.nan for part in axes])
    numbers["steps"] = dict(zip(("xy", "z"), xy_and_z.tolist(), strict=True))
    if not np.isfinite(xy_and_z).all():
        return "The values have no steps (they are means or were rounded), so their unit is assumed to be uT."
    values = f"Values have steps of {xy_and_z[0]:.4g} (x, y) and {xy_and_z[1]:.4g} (z)"
    for unit, factor in MICROTESLA_PER_UNIT.items():
        ratio = factor * xy_and_z / (CHIP_STEPS_UT[:, None] * 2.0 ** np.arange(4)[:, None])  # by gain and resolution
        fits = np.argwhere((np.abs(ratio - 1) < 0.02).all(-1))
        if len(fits):
            numbers["unit"] = unit
            chip = f"an MLX90393 in {unit} (for example gain {fits[0, 0]} and resolution {fits[0, 1]})"
            wrong = "" if unit == "uT" else f": multiply them by {factor:g} to have uT"
            return f"{values}, the steps of {chip}{wrong}."
    return f"{values}, which match no known chip; the unit is assumed to be uT."


def _step(values: np.ndarray) -> float:
    """Smallest step of a channel if nearly all values are multiples of it, else NaN."""
    levels = np.unique(values)
    gaps = np.diff(levels)
    gaps = gaps[gaps > 4e-6 * np.abs(values).max()]  # smaller gaps are rounding, as of float32 before a subtraction
    if len(gaps) < MIN_GAPS:
        return np.nan
    step = float(np.median(gaps[gaps < 1.5 * gaps.min()]))
    for stop in (10, 100, len(levels)):  # refine over longer stretches, in which an error of the step adds up
        span = levels[:stop] - levels[0]
        counts = np.round(span / step)
        step = float(span @ counts / max(counts @ counts, 1)) or step
    off = np.abs(gaps / step - np.round(gaps / step))
    return step if np.median(off) < 0.05 else np.nan


def _check_channels(recording: SkinRecording, warnings: list[str], numbers: dict) -> None:
    y, raw = recording.readings, _raw(recording)
    constant, live = np.flatnonzero(np.ptp(y, axis=0) == 0), np.flatnonzero(np.ptp(y, axis=0) > 0)
    same: list[tuple[int, int]] = []
    if len(live) > 1 and len(y) >= 30:
        alike = live[np.argwhere(np.triu(np.corrcoef(y[:, live].T) > 0.9999, 1))]
        same = [(int(i), int(j)) for i, j in alike if np.ptp(y[:, i] - y[:, j]) < 1e-6 * np.ptp(y)]
    step = np.array([_step(channel) for channel in raw.T])
    jump, whole = np.abs(np.diff(raw, axis=0)), 2**16 * np.nan_to_num(step, nan=1.0)
    # An overflow is a jump of about 65 536 steps in a channel whose other jumps are far smaller. Steps that come from
    # the digits of a text file give no such jumps.
    near = np.abs(jump - whole) < 0.1 * whole
    wrapped = np.flatnonzero(np.isfinite(step) & near.any(0) & (near | (jump < whole / 2)).all(0))
    for name, channels, problem in (
        ("constant_channels", constant.tolist(), "never change: a dead axis, or a chip that does not answer."),
        ("equal_channels", same, "are equal: one channel of each pair is a copy."),
        ("wrapped_channels", wrapped.tolist(), "jump by 65 536 steps: 16-bit values overflowed; unwrap them."),
    ):
        numbers[name] = channels
        warnings += [f"Channels {join(channels)} {problem}"] if channels else []


def _check_targets(recording: SkinRecording, warnings: list[str], numbers: dict) -> None:
    for name in ("travel", "force", "position"):
        if recording.known_rows(name).any() and not recording.varies(name):
            warnings.append(f"All rows have the same {name}, so its effect on readings is unknown.")
    back = (np.diff(recording.time) < 0) & (np.diff(recording.session) == 0)
    numbers["rows_back_in_time"] = int(back.sum())
    if back.any():
        warnings.append(
            f"Time goes backwards {back.sum()} times, first at row {int(np.argmax(back)) + 2}: the rows are not in "
            "order of time, or the clock was set; do not trust rates and drift."
        )
    contact = recording.targets.get("contact")
    if contact is not None and (contact[:, 0] == 0).sum() > 5 and (contact[:, 0] == 1).sum() > 5:
        length = np.linalg.norm(recording.readings, axis=1)
        air, touched = (float(np.median(length[contact[:, 0] == answer])) for answer in (0, 1))
        air = float(np.sqrt(max(air**2 - _noise_in_air(recording) ** 2, 0)))
        numbers["median_length_uT"] = {"air": air, "contact": touched}
        if air > 0.1 * touched:
            warnings.append(
                f"The median magnitude of readings is {air:.1f} uT in air (without noise) and {touched:.1f} uT in "
                "contact: the ambient field is not subtracted, or the skin does not return to rest."
            )


def changes_in_air(recording: SkinRecording) -> np.ndarray:
    """Differences `(n, c)` in microtesla of consecutive rows in air; empty if contact is not known."""
    contact = recording.targets.get("contact")
    if contact is None:
        return np.zeros((0, recording.readings.shape[1]))
    air = contact[:, 0] == 0
    follows = (np.diff(recording.session) == 0) & (np.diff(recording.time) <= MAX_STREAM_STEP_S)
    return np.diff(recording.readings, axis=0)[air[1:] & air[:-1] & follows]


def _noise_in_air(recording: SkinRecording) -> float:
    """Magnitude (uT) of the noise of a reading in air."""
    change = changes_in_air(recording)
    if len(change) < MIN_GAPS:
        return 0.0
    return float(np.linalg.norm(MAD_TO_STD * np.median(np.abs(change), axis=0) / np.sqrt(2)))


def _check_presses(recording: SkinRecording, warnings: list[str], numbers: dict) -> None:
    one_tip(recording)
    name, load = load_of(recording)
    rows = recording.known_rows("position") & np.isfinite(load)
    if rows.sum() < 2:
        raise CannotTellError("Checks for repeated rows and for changes need positions and loads.")
    position = recording.targets["position"][rows]
    warned = check_presses(position, np.abs(load[rows]), recording.readings[rows], by_force=name == "force")
    warnings += [finding.sentence for finding in warned if finding.wrong]
    numbers["presses"] = metrics_of(warned)


def _check_unknowns(recording: SkinRecording, warnings: list[str], section: Section, findings: list[Finding]) -> None:
    """Estimate height zero, lag, signs, units and the board's position with `i2t.recordings.diagnose`."""
    one_tip(recording)
    if recording.known_rows("position").any():
        findings += diagnose(recording.presses(), recording.board)
    elif recording.known_rows("force").any():
        findings.append(find_force_sign(recording.targets["force"][:, 0], recording.readings))
    else:
        raise CannotTellError("Estimates of height zero, lag, signs and units need positions or forces.")
    section.numbers["unknowns"] = metrics_of(findings)
    warnings += [finding.sentence for finding in findings if finding.wrong]
    section.sentences += [finding.sentence for finding in findings if finding.identifiable and not finding.wrong]
    if corrected := [finding.name for finding in findings if finding.correction]:
        section.sentences.append(
            f"The rest of the report uses the corrected recording. Corrections: {join(corrected)}."
        )
    if unknown := [finding.name for finding in findings if not finding.identifiable]:
        section.sentences.append(f"Not identifiable from this recording: {join(unknown)}.")
