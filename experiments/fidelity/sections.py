"""Parts of the report, and the sentences in place of parts that a recording cannot support."""

import sys
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from matplotlib.figure import Figure


class CannotTellError(ValueError):
    """A recording does not say enough for a part of the report; the message is the sentence that says why."""


@dataclass
class Section:
    """One part of the report.

    Attributes:
        title: of it.
        status: "found", "cannot tell" or "failed".
        sentences: what a person should know, in order.
        tables: by their captions, a header and rows of cells each.
        numbers: for metrics.json.
        figures: by their captions.
    """

    title: str
    status: str = "found"
    sentences: list[str] = field(default_factory=list)
    tables: dict[str, list[list[str]]] = field(default_factory=dict)
    numbers: dict[str, Any] = field(default_factory=dict)
    figures: dict[str, Figure] = field(default_factory=dict)

    def part(self, work: Callable[[], None]) -> None:
        """Do a part of the section; what the recording cannot support, or what fails, becomes a sentence."""
        try:
            work()
        except CannotTellError as error:
            if str(error) not in self.sentences:
                self.sentences.append(str(error))
        except Exception as error:  # as in `written`
            self.failed(error)

    def failed(self, error: Exception) -> None:
        """Say what failed, here and in the numbers."""
        said = f"a part failed with {type(error).__name__}: {error}"
        self.sentences.append(said)
        self.numbers.setdefault("failures", []).append(said)
        traceback.print_exc(file=sys.stderr)


def written(title: str, work: Callable[[Section], None]) -> Section:
    """A section as its function writes it. Whatever goes wrong in it is said there, and the others are written."""
    section = Section(title)
    _write(section, work)
    section.sentences = list(dict.fromkeys(full_stop(sentence) for sentence in section.sentences))
    return section


def _write(section: Section, work: Callable[[Section], None]) -> None:
    try:
        work(section)
    except CannotTellError as error:
        section.status = "cannot tell"
        section.sentences.append(str(error))
    except Exception as error:  # the report is of recordings that nobody has seen: one part never costs the others
        section.status = "failed"
        section.failed(error)


def full_stop(sentence: str) -> str:
    """A sentence with one full stop at its end, whatever it was put together from."""
    bare = sentence.rstrip()
    return bare if bare.endswith(("...", "!", "?", ":")) else bare.rstrip(".") + "."


def cell(value: float | int | None, digits: int = 3) -> str:
    """A number for a table."""
    if value is None or value != value:  # NaN
        return "-"
    return str(value) if isinstance(value, int) else f"{value:.{digits}f}"


def join(names: list[Any], most: int = 12) -> str:
    """Names in a sentence, not all of many."""
    shown = ", ".join(map(str, names[:most]))
    return shown if len(names) <= most else f"{shown} and {len(names) - most} more"


def print_table(caption: str, rows: list[list[str]]) -> None:
    """A table as a person reads it."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    print(f"  {caption}")
    for row in rows:
        print("    " + "  ".join(f"{value:{width}}" for value, width in zip(row, widths, strict=True)).rstrip())
