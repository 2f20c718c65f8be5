"""Parts of the report, and the sentences in place of parts that a recording cannot support."""

import sys
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from matplotlib.figure import Figure

from experiments.common.tables import text_table


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
        figures: by the names of their files.
    """

    title: str
    status: str = "found"
    sentences: list[str] = field(default_factory=list)
    tables: dict[str, list[list[str]]] = field(default_factory=dict)
    numbers: dict[str, Any] = field(default_factory=dict)
    figures: dict[str, Figure] = field(default_factory=dict)

    def part(self, work: Callable[[], None]) -> str:
        """Do a part of the section; what the recording cannot support, or what fails, becomes a sentence.

        Args:
            work: The part.

        Returns:
            The status of the part.
        """
        try:
            work()
        except CannotTellError as error:
            self.sentences.append(str(error))
            return "cannot tell"
        except Exception as error:  # the report is of recordings that nobody has seen: one part never costs the others
            said = f"a part failed with {type(error).__name__}: {error}"
            self.sentences.append(said)
            self.numbers.setdefault("failures", []).append(said)
            traceback.print_exc(file=sys.stderr)
            return "failed"
        return "found"


def written(title: str, work: Callable[[Section], None]) -> Section:
    """A section as its function writes it. Whatever goes wrong in it is said there, and the others are written."""
    section = Section(title)
    status = section.part(lambda: work(section))
    section.status = section.status if status == "found" else status
    section.sentences = list(dict.fromkeys(full_stop(sentence) for sentence in section.sentences))
    return section


def full_stop(sentence: str) -> str:
    """A sentence with one full stop at its end, whatever it was put together from."""
    bare = sentence.rstrip()
    return bare if bare.endswith(("...", "!", "?", ":")) else bare.rstrip(".") + "."


def join(names: Sequence[Any], most: int = 12) -> str:
    """Names in a sentence, not all of many."""
    shown = ", ".join(map(str, names[:most]))
    return shown if len(names) <= most else f"{shown} and {len(names) - most} more"


def text_of(section: Section) -> str:
    """A section as a person reads it."""
    lines = ["", section.title + ("" if section.status == "found" else f" ({section.status})")]
    lines += [f"  {sentence}" for sentence in section.sentences]
    for caption, (head, *rows) in section.tables.items():
        lines += [f"  {caption}", text_table(head, rows, "    ")]
    return "\n".join(lines)
