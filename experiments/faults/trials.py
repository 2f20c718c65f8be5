"""Trials that are kept as they are made, so that a long section goes on where it was stopped."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

Trial: TypeAlias = dict[str, Any]  # what came of one, as JSON holds it


class TrialStore:
    """The trials of a section in a file, one a line.

    Args:
        path: Of the file; its folder is made.
        report: Hears now and then how far it is.
    """

    def __init__(self, path: Path, report: Callable[[str], None] = print) -> None:
        self._path, self._report = path, report

    def run(self, count: int, trial: Callable[[int], Trial | None]) -> list[Trial]:
        """The first trials by their number; those that are kept are not made again.

        Args:
            count: How many.
            trial: Makes the trial of a number; None where it could not be made, which is not kept.

        Returns:
            The trials that were made, in the order of their numbers.
        """
        kept = self._read()
        for number in range(count):
            if number in kept:
                continue
            made = trial(number)
            if made is None:
                continue
            kept[number] = made
            self._path.parent.mkdir(parents=True, exist_ok=True)
            with self._path.open("a") as file:
                file.write(json.dumps({"number": number, **made}) + "\n")
            if len(kept) % 10 == 0:
                self._report(f"{self._path.stem}: {len(kept)} of {count}")
        return [kept[number] for number in sorted(kept) if number < count]

    def _read(self) -> dict[int, Trial]:
        """Trials that are kept; a last line that was cut short by a kill is left out."""
        kept: dict[int, Trial] = {}
        if self._path.exists():
            for line in self._path.read_text().splitlines():
                try:
                    made = json.loads(line)
                except ValueError:
                    continue
                kept[int(made.pop("number"))] = made
        return kept
