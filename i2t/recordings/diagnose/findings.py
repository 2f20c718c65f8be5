"""Findings of a diagnosis, the corrections that they imply, and their form in a data set's meta and in metrics."""

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from i2t.recordings.presses import Presses


class FindingName(StrEnum):
    """Names of the hypotheses that a diagnosis tests on a recording (units, signs, lag, height zero, turn of the board,
    ...), as written in data sets and metrics.
    """

    UNITS = "units"
    FORCE_SIGN = "sign of the force"
    TRAVEL_SIGN = "sign of the travel"
    HEIGHT_AXIS = "height axis"
    LAG = "lag of the labels"
    HEIGHT_ZERO = "height zero"
    STAGE = "board on the stage"
    REPEATED_ROWS = "repeated rows"
    CHANGED_SKIN = "changed skin"
    STEEL_TIP = "tip of steel"


# Advice on a finding that a recording cannot answer, by the name of the hypothesis.
ADVICE: Mapping[str, str] = {
    FindingName.UNITS: "check the unit of x and y, and continue if the presses were made at one place",
    FindingName.FORCE_SIGN: "check the axes of the force",
    FindingName.TRAVEL_SIGN: "check the travels that are negative",
    FindingName.HEIGHT_AXIS: "check that travel grows into the skin",
    FindingName.LAG: "continue if each row holds the reading of its own press",
    FindingName.HEIGHT_ZERO: "continue if travel counts from first contact",
    FindingName.STAGE: "check that x and y follow the board's axes",
}


@dataclass(frozen=True)
class Finding:
    """Result of testing one hypothesis on a recording.

    Attributes:
        name: Name of the hypothesis, one of `FindingName` if the library tested it.
        sentence: Result as a sentence for a person.
        identifiable: Whether the recording can answer the question.
        wrong: Whether the recording contradicts what it states and should be corrected.
        untested: Whether the hypothesis was not tested, because the recording lacks the presses or columns for it.
        estimate: Estimated value in `unit`; None if there is none.
        low: Lower end of the estimate's 90 % interval, in `unit`.
        high: Upper end of the estimate's 90 % interval, in `unit`.
        unit: Unit of `estimate`, `low` and `high`.
        evidence: Numbers behind the sentence, by name.
        correction: Change to make to the recording, in types that JSON can hold; empty if nothing is wrong.
    """

    name: str
    sentence: str
    identifiable: bool
    wrong: bool = False
    untested: bool = False
    estimate: float | None = None
    low: float | None = None
    high: float | None = None
    unit: str = ""
    evidence: Mapping[str, float | int | list[int]] = field(default_factory=dict)
    correction: Mapping[str, Any] = field(default_factory=dict)

    @property
    def advice(self) -> str:
        """Clause on how to go on if the question is open; empty if there is nothing to do."""
        return "" if self.identifiable or self.wrong or self.untested else ADVICE.get(self.name, "")

    def to_json(self) -> dict[str, Any]:
        """Convert the finding to types that JSON can hold.

        Returns:
            The fields by name; non-finite numbers are None.
        """
        return {name: _to_json(value) for name, value in asdict(self).items()}


def not_identifiable(
    name: FindingName, reason: str, *, untested: bool = False, evidence: Mapping[str, float | int] | None = None
) -> Finding:
    """Create the finding of a test whose question the recording cannot answer.

    Args:
        name: Name of the hypothesis.
        reason: Clause that completes "not identifiable, because".
        untested: Whether the recording lacks the presses or columns for the test.
        evidence: Numbers behind the reason, by name.

    Returns:
        The finding without an estimate.
    """
    sentence = f"{name.capitalize()}: not identifiable, because {reason}."
    return Finding(name, sentence, False, untested=untested, evidence=dict(evidence or {}))


def find(findings: Iterable[Finding], name: str) -> Finding | None:
    """Look up a finding by the name of its hypothesis.

    Args:
        findings: Findings to search.
        name: Name of the hypothesis.

    Returns:
        The first finding of that name, or None if there is none.
    """
    return next((finding for finding in findings if finding.name == name), None)


# --- corrections ---


class Correction(NamedTuple):
    """Correction of a recording: factors for its columns, the number of rows by which labels lag behind readings, and
    the map (a rotation or mirror) from the stage's x and y to the board's.
    """

    length: float = 1.0
    field: float = 1.0
    height: float = 1.0
    force: float = 1.0
    lag: int = 0  # rows by which labels lag behind readings, as `lag_rows` takes them
    board_from_stage: Float[np.ndarray, "2 2"] | None = None


def correction_of(findings: Iterable[Finding]) -> Correction:
    """Combine the corrections of several findings.

    Args:
        findings: Findings about one recording.

    Returns:
        The correction. Where no finding corrects anything, factors are 1, the lag is 0 and the map is None.
    """
    changes = {name: value for finding in findings for name, value in finding.correction.items()}
    board_from_stage = changes.get("board_from_stage")
    return Correction(
        length=changes.get("length_factor", 1.0),
        field=changes.get("field_factor", 1.0),
        height=changes.get("travel_factor", 1.0) * changes.get("height_sign", 1.0),
        force=changes.get("force_factor", 1.0) * changes.get("force_sign", 1.0),
        lag=int(changes.get("label_lag_rows", 0)),
        board_from_stage=None if board_from_stage is None else np.asarray(board_from_stage, np.float64),
    )


def corrected_presses(presses: Presses, findings: Iterable[Finding]) -> Presses:
    """Correct the units, signs and lag of presses.

    Heights keep their origin: first contact is a number that callers read from its finding.

    Args:
        presses: Presses as recorded.
        findings: Findings about these presses.

    Returns:
        The corrected presses. A lag leaves fewer of them.
    """
    correction = correction_of(findings)
    label_rows, reading_rows = lag_rows(len(presses.readings), correction.lag)
    labels = presses.rows(label_rows)
    return labels._replace(
        position=labels.position * correction.length,
        readings=presses.readings[reading_rows] * correction.field,
        height=None if labels.height is None else labels.height * correction.height,
        force=None if labels.force is None else labels.force * correction.force,
    )


def lag_rows(n: int, lag: int) -> tuple[np.ndarray, np.ndarray]:
    """Match the rows of a recording's labels with those of its readings, given the lag between them.

    Args:
        n: Number of rows in the recording.
        lag: Lag in rows: the reading of row i belongs to the labels of row i + lag.

    Returns:
        Row numbers of the labels and row numbers of the readings, two arrays of equal length.
    """
    rows = np.arange(max(0, -lag), n - max(0, lag))
    return rows + lag, rows


# --- the meta of a data set, and the metrics of a run ---


def findings_to_meta(session: str, findings: Iterable[Finding]) -> dict[str, str]:
    """Write findings as an entry of a data set's meta.

    Args:
        session: Name of the session that was diagnosed.
        findings: Findings about the session.

    Returns:
        A mapping with one entry, whose value is JSON text.
    """
    # `i2t.dataset.card` looks for keys that begin like this.
    return {f"unknowns of {session}": json.dumps([finding.to_json() for finding in findings], allow_nan=False)}


def metrics_of(findings: Iterable[Finding]) -> dict[str, Any]:
    """Convert findings to entries of a run's metrics.

    Args:
        findings: Findings about one recording.

    Returns:
        The fields of each finding, by the finding's name, in types that JSON can hold.
    """
    return {finding.name: finding.to_json() for finding in findings}


def _to_json(value: Any) -> Any:
    """Convert NumPy's numbers to Python's, and non-finite numbers to None."""
    if isinstance(value, Mapping):
        return {str(key): _to_json(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_to_json(part) for part in value]
    value = value.item() if isinstance(value, np.generic) else value
    return None if isinstance(value, float) and not math.isfinite(value) else value
