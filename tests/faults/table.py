"""Faults: each is caused on purpose once in a trial, and has goals that its measurements must meet."""

import json
import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np

Trial: TypeAlias = dict[str, Any]  # numbers by name, as JSON holds them, and maybe what was `said`
MAX_SAID, MAX_LETTERS = 4, 90  # of what was said, that the report shows


class Measure(NamedTuple):
    """A number of the trials that must stay small: the worst of them, or the share of another number."""

    name: str  # of the number in a trial
    most: float = math.inf  # that may be seen; infinite where it is only stated
    unit: str = ""
    of: str = ""  # name of the number of which it is a share, both summed over the trials


NOTICED = Measure("noticed", 0.5, "s")  # the error of a driver, after the fault


@dataclass(frozen=True)
class Fault:
    """A fault."""

    section: str
    name: str
    trial: Callable[[int], Trial | None]  # makes the trial of a number; None where it could not be made
    count: int  # trials at full size
    measures: tuple[Measure, ...]


class FaultRow(NamedTuple):
    """A row of the report."""

    section: str
    fault: str
    tried: str
    measured: str
    goal: str
    met: bool | None  # None where there is no goal


def run_trials(fault: Fault, count: int, path: Path) -> list[Trial]:
    """The first trials of a fault; those that are kept are not made again, and each is kept as it is made.

    Args:
        fault: The fault.
        count: Number of trials.
        path: File of the trials, one a line; its folder is made.

    Returns:
        The trials that could be made, in the order of their numbers.
    """
    kept = _kept(path)
    for number in range(count):
        made = None if number in kept else fault.trial(number)
        if made is None:
            continue
        kept[number] = made
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("a") as file:
            file.write(json.dumps({"number": number, **made}) + "\n")
        if len(kept) % 10 == 0:
            print(f"{fault.name}: {len(kept)} of {count}", flush=True)
    return [kept[number] for number in sorted(kept) if number < count]


def _kept(path: Path) -> dict[int, Trial]:
    """Trials that are kept; a last line that was cut short by a kill is left out."""
    kept: dict[int, Trial] = {}
    for line in path.read_text().splitlines() if path.exists() else ():
        try:
            made = json.loads(line)
        except ValueError:
            continue
        kept[int(made.pop("number"))] = made
    return kept


def judge(fault: Fault, trials: list[Trial], count: int) -> FaultRow:
    """The row of a fault.

    Args:
        fault: The fault.
        trials: Trials that were made.
        count: Number of trials that were to be made.

    Returns:
        The row; a goal is missed too where less than half of the trials could be made, or a number is NaN.
    """
    told = [_measured(measure, trials) for measure in fault.measures] if trials else []
    said = Counter(str(trial["said"])[:MAX_LETTERS] for trial in trials if "said" in trial)
    texts = [text for text, _ in told] + [f'{times} x "{text}"' for text, times in said.most_common(MAX_SAID)]
    goals = [f"{each.name} <= {each.most:g}" for each in fault.measures if math.isfinite(each.most)]
    met = 2 * len(trials) >= count and all(kept for _, kept in told) if goals else None
    return FaultRow(fault.section, fault.name, f"{len(trials)} of {count}", "; ".join(texts), "; ".join(goals), met)


def _measured(measure: Measure, trials: list[Trial]) -> tuple[str, bool]:
    """Text of a number, and whether it is as small as it must be."""
    values = np.array([trial[measure.name] for trial in trials], float)
    if measure.of:
        whole = sum(trial[measure.of] for trial in trials)
        seen = float(values.sum() / whole) if whole else math.nan
        text = f"{measure.name} {seen:.4g}{measure.unit} of {whole:g} {measure.of}"
    else:
        seen = float(values.max())  # NaN where any is
        text = f"{measure.name} median {np.median(values):.4g}, worst {seen:.4g} {measure.unit}".rstrip()
    return text, seen <= measure.most


def report(rows: list[FaultRow]) -> str:
    """Rows as a table in Markdown.

    Args:
        rows: The rows.

    Returns:
        The table.
    """
    outcomes = {True: "met", False: "MISSED", None: ""}
    lines = ["| section | fault | trials | measured | goal | |", "| --- | --- | --- | --- | --- | --- |"]
    lines += [f"| {' | '.join(row[:5])} | {outcomes[row.met]} |" for row in rows]
    return "\n".join(lines)
