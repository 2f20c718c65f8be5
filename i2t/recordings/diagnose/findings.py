"""Findings on the unknowns of a recording: their corrections, and their way into a data set and back."""

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from i2t.recordings.presses import Presses

META_PREFIX = "unknowns of "  # of a data set's meta: one entry for each session


@dataclass(frozen=True)
class Finding:
    """Finding of a recording on one of its unknowns.

    Attributes:
        name: Of the unknown.
        sentence: For a person.
        identifiable: Whether this recording can tell.
        wrong: Whether the recording contradicts what it states, so that it should be corrected.
        estimate: The value, in `unit`; None where there is none.
        low: Lower end of its 90 % interval.
        high: Upper end.
        unit: Of these.
        evidence: Numbers that the sentence stands on, by name.
        correction: What to do to the recording, as JSON can hold it; empty where nothing is wrong.
    """

    name: str
    sentence: str
    identifiable: bool
    wrong: bool = False
    estimate: float | None = None
    low: float | None = None
    high: float | None = None
    unit: str = ""
    evidence: Mapping[str, float | int | list[int]] = field(default_factory=dict)
    correction: Mapping[str, Any] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """The finding as JSON can hold it: what is not finite is null.

        Returns:
            Its fields by name.
        """
        return {name: _plain(value) for name, value in asdict(self).items()}


def find(findings: Iterable[Finding], name: str) -> Finding | None:
    """The finding of this name.

    Args:
        findings: To look in.
        name: Of the unknown.

    Returns:
        It, or None.
    """
    return next((finding for finding in findings if finding.name == name), None)


# --- corrections ---


class Correction(NamedTuple):
    """What to multiply the columns of a recording by, and how to move its labels and turn its board."""

    length: float = 1.0
    field: float = 1.0
    height: float = 1.0
    force: float = 1.0
    lag: int = 0  # rows, as `lag_rows` takes them
    board_from_stage: Float[np.ndarray, "2 2"] | None = None


def correction_of(findings: Iterable[Finding]) -> Correction:
    """The corrections of findings together.

    Args:
        findings: About one recording.

    Returns:
        What to do to it.
    """
    todo = {name: value for finding in findings for name, value in finding.correction.items()}
    turn = todo.get("board_from_stage")
    return Correction(
        length=todo.get("length_factor", 1.0),
        field=todo.get("field_factor", 1.0),
        height=todo.get("depth_factor", 1.0) * todo.get("height_sign", 1.0),
        force=todo.get("force_factor", 1.0) * todo.get("force_sign", 1.0),
        lag=int(todo.get("label_lag_rows", 0)),
        board_from_stage=None if turn is None else np.asarray(turn, np.float64),
    )


def corrected_presses(presses: Presses, findings: Iterable[Finding]) -> Presses:
    """A recording with what was found put right: units, signs and lag.

    Height zero stays where it is: it is a number, not a mistake of a column.

    Args:
        presses: As recorded.
        findings: About it.

    Returns:
        The presses; with a lag, fewer.
    """
    todo = correction_of(findings)
    label_rows, reading_rows = lag_rows(len(presses.readings), todo.lag)
    labels = presses.rows(label_rows)
    return labels._replace(
        position=labels.position * todo.length,
        readings=presses.readings[reading_rows] * todo.field,
        height=None if labels.height is None else labels.height * todo.height,
        force=None if labels.force is None else labels.force * todo.force,
    )


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


# --- the meta of a data set, and the metrics of a run ---


def findings_to_meta(session: str, findings: Iterable[Finding]) -> dict[str, str]:
    """Entry of findings in the meta of a data set.

    Args:
        session: Name of the session that was looked at.
        findings: What was found in it.

    Returns:
        One entry of the data set's meta.
    """
    return {META_PREFIX + session: json.dumps([finding.to_json() for finding in findings], allow_nan=False)}


def metrics_of(findings: Iterable[Finding]) -> dict[str, Any]:
    """Findings for a run's metrics.

    Args:
        findings: Of a recording.

    Returns:
        Their fields by name, as JSON can hold them.
    """
    return {finding.name: finding.to_json() for finding in findings}


def _plain(value: Any) -> Any:
    """Numbers of NumPy as Python's, what is not finite as None."""
    if isinstance(value, Mapping):
        return {str(key): _plain(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(part) for part in value]
    value = value.item() if isinstance(value, np.generic) else value
    return None if isinstance(value, float) and not math.isfinite(value) else value
