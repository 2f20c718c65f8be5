"""Description of a recording, and contradictions of a sound one."""

import numpy as np

from experiments.fidelity.forward import load_of, one_tip
from experiments.fidelity.sections import CannotTellError, Section, join
from i2t.recordings.diagnose import Finding, check_presses, diagnose, find_force_sign, metrics_of
from i2t.recordings.read import MAX_STREAM_STEP_S, TARGETS, SkinRecording
from i2t.recordings.segmentation import MAD_TO_STD
from i2t.skin.boards import AXES_OF_CHIP

# uT for each step of x and y and of z, by gain at resolution 0 (MLX90393 data sheet, sensitivity table, 0xC);
# resolutions 1 to 3 double it each.
CHIP_STEPS_UT = np.array([
    (0.751, 1.210), (0.601, 0.968), (0.451, 0.726), (0.376, 0.605),
    (0.300, 0.484), (0.250, 0.403), (0.200, 0.323), (0.150, 0.242),
])  # fmt: skip
STEP_TOLERANCE = 0.02
MIN_GAPS = 20  # between values, to tell a step from
SAME_VALUE = 4e-6  # of the largest: by less, values differ by their rounding, as of float32 before a subtraction
MICROTESLA_IN = {"uT": 1.0, "mT": 1e3, "gauss": 100.0, "nT": 1e-3}  # uT in each
COUNTS_OF_16_BITS = 2**16
JUMP_TOLERANCE = 0.1  # of a jump of so many steps
STILL_IN_AIR = 0.1  # of the readings' size in contact, that they may keep in air
EQUAL_CHANNEL_CORRELATION = 0.9999  # correlation of two channels that are one
MIN_ALIKE_ROWS = 30


def describe(recording: SkinRecording, section: Section) -> None:
    """Counts, ranges, unit and rate."""
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
        section.sentences.append(f"Rows come every {gap:.3g} s (median) over {span / 60:.1f} minutes.")
    else:
        section.sentences.append("No times are known, so that rates, creep and drift per hour are unknown.")
    section.tables["what is known of the rows"] = _known(recording, numbers)
    section.sentences.append(_unit(recording, numbers))


def check(recording: SkinRecording, section: Section, findings: list[Finding]) -> None:
    """Find contradictions of a sound recording; a sentence for each finding. What is estimated of it joins the
    findings.
    """
    found: list[str] = []
    _check_channels(recording, found, section.numbers)
    _check_targets(recording, found, section.numbers)
    section.part(lambda: _check_presses(recording, found, section.numbers))
    section.part(lambda: _check_unknowns(recording, found, section, findings))
    section.numbers["warnings"] = found
    section.sentences[:0] = found or ["Nothing that was looked for contradicts a sound recording."]


def _known(recording: SkinRecording, numbers: dict) -> list[list[str]]:
    rows, numbers["known"] = [["target", "rows", "from", "to", "unit"]], {}
    for name, kind in TARGETS.items():
        known = recording.known_rows(name)
        ends = ["-", "-"]
        if known.any():
            values = kind.scale * recording.targets[name][known]
            low, high = values.min(0), values.max(0)
            numbers["known"][name] = {"rows": int(known.sum()), "low": low.tolist(), "high": high.tolist()}
            ends = [" / ".join(f"{v:.3g}" for v in end) for end in (low, high)]
        rows.append([name, str(int(known.sum())), *ends, kind.unit])
    return rows


def _raw(recording: SkinRecording) -> np.ndarray:
    return recording.readings if recording.baseline is None else recording.readings + recording.baseline


def _unit(recording: SkinRecording, numbers: dict) -> str:
    """Unit that the steps of the values suggest."""
    steps = np.array([_step(channel) for channel in _raw(recording).T])
    axes = np.delete(steps, np.s_[2::AXES_OF_CHIP]), steps[2::AXES_OF_CHIP]
    found = np.array([np.nanmedian(part) if np.isfinite(part).any() else np.nan for part in axes])
    numbers["steps"] = dict(zip(("xy", "z"), found.tolist(), strict=True))
    if not np.isfinite(found).all():
        return "The values have no steps (they are means or were rounded), so that their unit is taken on trust as uT."
    values = f"Values have steps of {found[0]:.4g} (x, y) and {found[1]:.4g} (z)"
    for unit, factor in MICROTESLA_IN.items():
        ratio = factor * found / (CHIP_STEPS_UT[:, None] * 2.0 ** np.arange(4)[:, None])  # by gain and resolution
        fits = np.argwhere((np.abs(ratio - 1) < STEP_TOLERANCE).all(-1))
        if len(fits):
            numbers["unit"] = unit
            chip = f"an MLX90393 in {unit} (such as gain {fits[0, 0]} and resolution {fits[0, 1]})"
            wrong = "" if unit == "uT" else f": multiply them by {factor:g} to have uT"
            return f"{values}, which are those of {chip}{wrong}."
    return f"{values}, of no chip that is known here; taken as uT."


def _step(values: np.ndarray) -> float:
    """Smallest step of a channel, if nearly all values are whole numbers of it; NaN else."""
    levels = np.unique(values)
    gaps = np.diff(levels)
    gaps = gaps[gaps > SAME_VALUE * np.abs(values).max()]
    if len(gaps) < MIN_GAPS:
        return np.nan
    step = float(np.median(gaps[gaps < 1.5 * gaps.min()]))
    for most in (10, 100, len(levels)):  # over ever longer stretches, along which an error of the step grows
        way = levels[:most] - levels[0]
        counts = np.round(way / step)
        step = float(way @ counts / max(counts @ counts, 1)) or step
    off = np.abs(gaps / step - np.round(gaps / step))
    return step if np.median(off) < 0.05 else np.nan


def _check_channels(recording: SkinRecording, found: list[str], numbers: dict) -> None:
    y, raw = recording.readings, _raw(recording)
    constant, live = np.flatnonzero(np.ptp(y, axis=0) == 0), np.flatnonzero(np.ptp(y, axis=0) > 0)
    same: list[tuple[int, int]] = []
    if len(live) > 1 and len(y) >= MIN_ALIKE_ROWS:
        alike = live[np.argwhere(np.triu(np.corrcoef(y[:, live].T) > EQUAL_CHANNEL_CORRELATION, 1))]
        same = [(int(i), int(j)) for i, j in alike if np.ptp(y[:, i] - y[:, j]) < 1e-6 * np.ptp(y)]
    step = np.array([_step(channel) for channel in raw.T])
    jump, whole = np.abs(np.diff(raw, axis=0)), COUNTS_OF_16_BITS * np.nan_to_num(step, nan=1.0)
    # Values that ran over jump by about 65 536 steps, and else by far less; the steps of a text's digits are others.
    near = np.abs(jump - whole) < JUMP_TOLERANCE * whole
    wrapped = np.flatnonzero(np.isfinite(step) & near.any(0) & (near | (jump < whole / 2)).all(0))
    for name, channels, said in (
        ("constant_channels", constant.tolist(), "never change: a dead axis, or a chip that does not answer."),
        ("equal_channels", same, "are the same numbers: one of each pair is a copy."),
        ("wrapped_channels", wrapped.tolist(), "jump by 65 536 steps: 16-bit values ran over; unwrap them."),
    ):
        numbers[name] = channels
        found += [f"Channels {join(channels)} {said}"] if channels else []


def _check_targets(recording: SkinRecording, found: list[str], numbers: dict) -> None:
    for name in ("travel", "force", "position"):
        if recording.known_rows(name).any() and not recording.varies(name):
            found.append(f"All rows have one {name}, so that it does not show how readings change with it.")
    back = (np.diff(recording.time) < 0) & (np.diff(recording.session) == 0)
    numbers["rows_back_in_time"] = int(back.sum())
    if back.any():
        found.append(
            f"Times go back {back.sum()} times, first at row {int(np.argmax(back)) + 2}: rows are not in the order of "
            "time, or the clock was set; rates and drift are not to be trusted."
        )
    contact = recording.targets.get("contact")
    if contact is not None and (contact[:, 0] == 0).sum() > 5 and (contact[:, 0] == 1).sum() > 5:
        length = np.linalg.norm(recording.readings, axis=1)
        air, touched = (float(np.median(length[contact[:, 0] == answer])) for answer in (0, 1))
        air = float(np.sqrt(max(air**2 - _noise_in_air(recording) ** 2, 0)))
        numbers["median_length_uT"] = {"air": air, "contact": touched}
        if air > STILL_IN_AIR * touched:
            found.append(
                f"Readings in air are {air:.1f} uT long (median, without their noise) where those in contact are "
                f"{touched:.1f}: the ambient is not subtracted, or the skin does not come back."
            )


def changes_in_air(recording: SkinRecording) -> np.ndarray:
    """(n, c) uT, differences of rows that follow each other in air; none where contact is not known."""
    contact = recording.targets.get("contact")
    if contact is None:
        return np.zeros((0, recording.readings.shape[1]))
    air = contact[:, 0] == 0
    follows = (np.diff(recording.session) == 0) & (np.diff(recording.time) <= MAX_STREAM_STEP_S)
    return np.diff(recording.readings, axis=0)[air[1:] & air[:-1] & follows]


def _noise_in_air(recording: SkinRecording) -> float:
    """Length (uT) of the noise of a reading in air."""
    change = changes_in_air(recording)
    if len(change) < MIN_GAPS:
        return 0.0
    return float(np.linalg.norm(MAD_TO_STD * np.median(np.abs(change), axis=0) / np.sqrt(2)))


def _check_presses(recording: SkinRecording, found: list[str], numbers: dict) -> None:
    one_tip(recording)
    name, load = load_of(recording)
    rows = recording.known_rows("position") & np.isfinite(load)
    if rows.sum() < 2:
        raise CannotTellError("Repeated rows and changes are looked for where positions and loads are known.")
    position = recording.targets["position"][rows]
    warned = check_presses(position, np.abs(load[rows]), recording.readings[rows], by_force=name == "force")
    found += [finding.sentence for finding in warned if finding.wrong]
    numbers["presses"] = metrics_of(warned)


def _check_unknowns(recording: SkinRecording, found: list[str], section: Section, findings: list[Finding]) -> None:
    """Height zero, lag, signs, units and the board's place, as `i2t.recordings.diagnose` estimates them."""
    one_tip(recording)
    if recording.known_rows("position").any():
        findings += diagnose(recording.presses(), recording.board)
    elif recording.known_rows("force").any():
        findings.append(find_force_sign(recording.targets["force"][:, 0], recording.readings))
    else:
        raise CannotTellError("What a recording does not say of itself is estimated where positions are known.")
    section.numbers["unknowns"] = metrics_of(findings)
    found += [finding.sentence for finding in findings if finding.wrong]
    section.sentences += [finding.sentence for finding in findings if finding.identifiable and not finding.wrong]
    if corrected := [finding.name for finding in findings if finding.correction]:
        section.sentences.append(f"All that follows is of the recording put right: {join(corrected)}.")
    if unknown := [finding.name for finding in findings if not finding.identifiable]:
        section.sentences.append(f"The recording cannot tell: {join(unknown)}.")
