"""Sections of the report, and the sentences that stand in for parts that a recording cannot support."""

import sys
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from matplotlib.figure import Figure

from experiments.common.tables import text_table


class CannotTellError(ValueError):
    """The recording lacks the data for a part of the report; the message is the sentence that gives the reason."""


@dataclass
class Section:
    """One part of the report.

    Attributes:
        title: Heading, also the key in metrics.json.
        status: "found", "cannot tell" or "failed".
        sentences: Text of the section, in order.
        tables: A header and rows of cells for each caption.
        numbers: Values for metrics.json.
        figures: Figures by the stems of their file names.
    """

    title: str
    status: str = "found"
    sentences: list[str] = field(default_factory=list)
    tables: dict[str, list[list[str]]] = field(default_factory=dict)
    numbers: dict[str, Any] = field(default_factory=dict)
    figures: dict[str, Figure] = field(default_factory=dict)

    def part(self, work: Callable[[], None]) -> str:
        """Run one part of the section; missing data or a failure adds a sentence instead of an exception.

        Args:
            work: Function that fills in this part.

        Returns:
            Status of the part: "found", "cannot tell" or "failed".
        """
        try:
            work()
        except CannotTellError as error:
            self.sentences.append(str(error))
            return "cannot tell"
        except Exception as error:  # recordings are unpredictable, and one part must not cost the others
            failure = f"a part failed with {type(error).__name__}: {error}"
            self.sentences.append(failure)
            self.numbers.setdefault("failures", []).append(failure)
            traceback.print_exc(file=sys.stderr)
            return "failed"
        return "found"


def written(title: str, work: Callable[[Section], None]) -> Section:
    """Write a section with `work`; an exception in it becomes a sentence of the section."""
    section = Section(title)
    status = section.part(lambda: work(section))
    section.status = section.status if status == "found" else status
    section.sentences = list(dict.fromkeys(full_stop(sentence) for sentence in section.sentences))
    return section


def full_stop(sentence: str) -> str:
    """End a sentence with exactly one full stop."""
    bare = sentence.rstrip()
    return bare if bare.endswith(("...", "!", "?", ":")) else bare.rstrip(".") + "."


def join(names: Sequence[Any], most: int = 12) -> str:
    """Join names with commas, shortening long lists."""
    shown = ", ".join(map(str, names[:most]))
    return shown if len(names) <= most else f"{shown} and {len(names) - most} more"


def text_of(section: Section) -> str:
    """Format a section as plain text."""
    lines = ["", section.title + ("" if section.status == "found" else f" ({section.status})")]
    lines += [f"  {sentence}" for sentence in section.sentences]
    for caption, (head, *rows) in section.tables.items():
        lines += [f"  {caption}", text_table(head, rows, "    ")]
    return "\n".join(lines)
