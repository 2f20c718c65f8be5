"""All unknowns of a recording, one after the other, each from what the ones before have put right."""

from typing import Any

import numpy as np

from i2t.types import Board
from i2t.unknowns.approaches import find_approaches
from i2t.unknowns.chip_field import correct_board, find_board
from i2t.unknowns.findings import Finding, RecordedPresses, find
from i2t.unknowns.heights import HEIGHT_DRIFT, HEIGHT_ZERO, find_height_drift, find_height_zero
from i2t.unknowns.labels import find_force_sign, find_height_axis, find_lag, find_units
from i2t.unknowns.tip import find_tip_radius

GAIN = "gain of the chips"
GROWTH_POWER = 1.75  # of readings with the depth, where a recording does not say
FORCE_POWER = 1.2  # of readings with the force
MIN_ESTIMATE_ROWS = 5
MISSING_SHARE = 0.2  # of the rows in which a channel may be missing


def estimate_unknowns(
    presses: RecordedPresses,
    board: Board | None = None,
    *,
    stated_zero: float | None = None,
    stated_radius: float | None = None,
) -> list[Finding]:
    """Estimate what a recording does not say, or says wrongly.

    Args:
        presses: As recorded, in the order of time; rows whose position or reading is not finite are left out, and so
            are chips that are missing in many of them.
        board: As it is described; without one, and where a chip is missing, nothing is said of its chips.
        stated_zero: Height of first contact (m) that the recording states, where it does.
        stated_radius: Radius of the tip (m) that is assumed.

    Returns:
        A finding for each unknown: units, sign of the force, direction of the height, lag, height zero and its drift,
        the board's turn, order, axes and place, the tip's radius and the chips' gains.
    """
    missing = np.isnan(presses.readings).mean(0) > MISSING_SHARE
    if missing.any():
        presses, board = presses._replace(readings=presses.readings[:, ~missing]), None
    finite = np.isfinite(presses.position).all(1) & np.isfinite(presses.readings).all(1)
    presses = presses.rows(finite)
    if len(presses.readings) < MIN_ESTIMATE_ROWS or not presses.readings.shape[1]:
        return []
    findings = estimate_labels(presses)
    presses = corrected_presses(presses, findings)
    findings += _heights(presses, stated_zero)
    if board is not None:
        findings += find_board(presses, board, growth=growth_of(presses, findings))
    zero = find(findings, HEIGHT_ZERO)
    findings.append(find_tip_radius(presses, None if zero is None else zero.estimate, stated_radius))
    findings.append(
        Finding(
            GAIN,
            "The gain of a chip is not identifiable from one session, as every skin is magnetized unevenly; an "
            "earlier session of the same skin tells it.",
            False,
        )
    )
    return findings


def estimate_labels(presses: RecordedPresses) -> list[Finding]:
    """The part of `estimate_unknowns` that takes a moment: units, signs and lag.

    Args:
        presses: As recorded, in the order of time, all finite.

    Returns:
        The findings.
    """
    findings: list[Finding] = []

    def add(finding: Finding) -> None:
        nonlocal presses
        findings.append(finding)
        presses = corrected_presses(presses, [finding])

    known = presses.height is not None and np.isfinite(presses.height).any()
    depth = np.abs(presses.height - np.nanmax(presses.height)) if presses.height is not None and known else None
    add(find_units(presses.position, presses.readings, depth=depth, force=presses.force)[0])
    if presses.force is not None:
        add(find_force_sign(presses.force, presses.readings))
    if presses.height is not None:
        add(find_height_axis(presses))
    add(find_lag(presses))
    return findings


def corrected_presses(presses: RecordedPresses, findings: list[Finding]) -> RecordedPresses:
    """A recording with what was found put right: units, signs, lag, order and axes of the chips.

    Height zero stays where it is: it is a number, not a mistake of a column.

    Args:
        presses: As recorded.
        findings: About it.

    Returns:
        The presses; with a lag, fewer.
    """
    for finding in findings:
        todo = finding.correction
        presses = presses._replace(
            position=presses.position * todo.get("length_factor", 1.0),
            readings=presses.readings * todo.get("field_factor", 1.0),
            height=_scaled(presses.height, todo.get("depth_factor", 1.0) * todo.get("height_sign", 1.0)),
            force=_scaled(presses.force, todo.get("force_factor", 1.0) * todo.get("force_sign", 1.0)),
        )
        lag = int(todo.get("label_lag_rows", 0))
        if lag:
            presses = _shifted(presses, lag)
        if "chip_order" in todo or "channel_signs" in todo:
            nowhere = Board(np.zeros((presses.readings.shape[1] // 3, 3), np.float32), np.zeros((0, 3, 3), np.float32))
            presses, _ = correct_board(presses, nowhere, [finding])
    return presses


def lag_rows(n: int, lag: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows that belong together where labels are shifted.

    Args:
        n: Rows of the recording.
        lag: Rows: the reading of row i belongs to the labels of row i + lag.

    Returns:
        Rows of the labels, and rows of the readings, of one length.
    """
    rows = np.arange(max(0, -lag), n - max(0, lag))
    return rows + lag, rows


def growth_of(presses: RecordedPresses, findings: list[Finding]) -> np.ndarray | None:
    """Motion of the skin by each press, relative to the others, as well as is known.

    Args:
        presses: With heights or forces, or neither.
        findings: About the height zero, where there are any.

    Returns:
        (n,), or None where nothing is known of how hard was pressed.
    """
    zero = find(findings, HEIGHT_ZERO)
    if presses.height is not None and zero is not None and zero.estimate is not None:
        depth = np.maximum(zero.estimate - np.nan_to_num(presses.height, nan=np.inf), 0)
        power = float(zero.evidence.get("power", GROWTH_POWER))
        return (depth / max(float(depth.mean()), 1e-9)) ** power
    if presses.force is not None and np.isfinite(presses.force).all() and (presses.force > 0).mean() > 0.9:
        force = np.maximum(presses.force, 0)
        return (force / max(float(force.mean()), 1e-9)) ** FORCE_POWER
    return None


def sentences(findings: list[Finding]) -> list[str]:
    """Sentences for a person: first what is wrong, then what was found, then what cannot be told.

    Args:
        findings: Of a recording.

    Returns:
        A sentence for each.
    """
    ordered = sorted(findings, key=lambda one: (not one.wrong, not one.identifiable))
    return [finding.sentence for finding in ordered]


def metrics_of(findings: list[Finding]) -> dict[str, Any]:
    """Findings for a run's metrics.

    Args:
        findings: Of a recording.

    Returns:
        Their fields by name, as JSON can hold them.
    """
    return {finding.name: finding.to_json() for finding in findings}


def _heights(presses: RecordedPresses, stated: float | None) -> list[Finding]:
    """Height zero and its drift: from approaches where the recording follows the tip, else from single presses."""
    if presses.height is None:
        return [find_height_zero(presses)]
    if np.isfinite(presses.height).all():
        approaches = find_approaches(np.asarray(presses.height, np.float64), presses.readings)
        if approaches:
            return _of_approaches(np.array([one.zero for one in approaches]), stated, presses.height)
    zero = find_height_zero(presses, stated)
    if zero.estimate is None:
        return [zero]
    return [zero, find_height_drift(presses, zero.estimate)]


def _of_approaches(zeros: np.ndarray, stated: float | None, height: np.ndarray) -> list[Finding]:
    """Findings of the zeros of several approaches in a row."""
    zero, count = float(np.median(zeros)), len(zeros)
    spread = float(np.max(np.abs(zeros - zero)))
    half = max(0.05e-3, 1.2533 * 1.645 * float(np.std(zeros)) / np.sqrt(count))
    change = float(zeros[-1] - zeros[0])
    moves = count >= 4 and abs(change) > 0.1e-3 and abs(np.corrcoef(np.arange(count), zeros)[0, 1]) > 0.7
    off = 0.0 if stated is None else zero - stated
    above = int((height > zero).sum())
    wrong = bool(stated is not None and abs(off) > max(half, 0.1e-3))
    first = Finding(
        HEIGHT_ZERO,
        f"First contact is at {1e3 * zero:.3f} mm, the median of {count} approaches, up to {1e3 * spread:.2f} mm "
        f"off it ({above} rows are above it).",
        identifiable=True, wrong=wrong, estimate=zero, low=zero - half,
        high=zero + half, unit="m", evidence={"approaches": count, "largest_deviation_mm": 1e3 * spread},
        correction={"height_zero_m": zero} if wrong else {},
    )  # fmt: skip
    said = "moves" if moves else "does not move steadily"
    second = Finding(
        HEIGHT_DRIFT,
        f"Height zero {said} from approach to approach: {1e3 * zeros[0]:.2f} mm in the first and {1e3 * zeros[-1]:.2f} "
        "mm in the last.",
        identifiable=count >= 4, wrong=False, estimate=1e3 * change, unit="mm",
        evidence={"first_mm": 1e3 * zeros[0], "last_mm": 1e3 * zeros[-1], "approaches": count},
    )  # fmt: skip
    return [first, second]


def _scaled(values: np.ndarray | None, factor: float) -> np.ndarray | None:
    return values if values is None or factor == 1 else values * factor


def _shifted(presses: RecordedPresses, lag: int) -> RecordedPresses:
    """Readings of row i with the labels of row i + lag."""
    label_rows, reading_rows = lag_rows(len(presses.readings), lag)
    return presses.rows(label_rows)._replace(readings=presses.readings[reading_rows])
