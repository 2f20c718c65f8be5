"""Findings on the unknowns of a recording, and their way into a data set and back."""

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

META_PREFIX = "unknowns of "  # of a data set's meta: one entry for each session


class RecordedPresses(NamedTuple):
    """Presses of one tip on one skin in the order of time, as they were recorded: nothing of them is trusted yet."""

    position: Float[np.ndarray, "n 2"]  # m, of the tip on the skin
    readings: Float[np.ndarray, "n c"]  # uT, three channels for each chip
    height: Float[np.ndarray, " n"] | None = None  # m, of the tip along the skin's outward normal, from anywhere
    force: Float[np.ndarray, " n"] | None = None  # N; NaN where it was not read
    seconds: Float[np.ndarray, " n"] | None = None  # when

    def rows(self, part: Any) -> "RecordedPresses":
        """Some of them.

        Args:
            part: An index, as of an array.

        Returns:
            These presses.
        """
        height, force, seconds = (None if values is None else values[part] for values in self[2:])
        return RecordedPresses(self.position[part], self.readings[part], height, force, seconds)


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
    evidence: Mapping[str, float | int] = field(default_factory=dict)
    correction: Mapping[str, Any] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """The finding as JSON can hold it: what is not finite is null.

        Returns:
            Its fields by name.
        """
        return {name: _plain(value) for name, value in asdict(self).items()}


def findings_to_meta(session: str, findings: Iterable[Finding]) -> dict[str, str]:
    """Entry of findings in the meta of a data set.

    Args:
        session: Name of the session that was looked at.
        findings: What was found in it.

    Returns:
        One entry of the data set's meta.
    """
    return {META_PREFIX + session: json.dumps([finding.to_json() for finding in findings], allow_nan=False)}


def findings_from_meta(meta: Mapping[str, str]) -> dict[str, list[Finding]]:
    """The findings that a data set carries.

    Args:
        meta: Of the data set.

    Returns:
        Findings by session; entries that no version of i2t wrote are left out.
    """
    found: dict[str, list[Finding]] = {}
    for key, text in meta.items():
        if not key.startswith(META_PREFIX):
            continue
        try:
            found[key.removeprefix(META_PREFIX)] = [Finding(**entry) for entry in json.loads(text)]
        except (ValueError, TypeError):
            continue
    return found


def find(findings: Iterable[Finding], name: str) -> Finding | None:
    """The finding of this name.

    Args:
        findings: To look in.
        name: Of the unknown.

    Returns:
        It, or None.
    """
    return next((finding for finding in findings if finding.name == name), None)


def _plain(value: Any) -> Any:
    """Numbers of NumPy as Python's, what is not finite as None."""
    if isinstance(value, Mapping):
        return {str(key): _plain(part) for key, part in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [_plain(part) for part in value]
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if isinstance(value, int | np.integer):
        return int(value)
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    return value
