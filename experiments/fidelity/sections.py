"""Parts of the report, the sentences in place of parts that a recording cannot support, and the page they make."""

import base64
import html
import io
import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from i2t.files import replacing

HEAD = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>{title}</title>
<style>
body {{ font: 15px/1.45 sans-serif; max-width: 1100px; margin: 2em auto; padding: 0 1em; color: #222; }}
h2 {{ border-bottom: 2px solid #0072B2; padding-bottom: .2em; margin-top: 2em; }}
table {{ border-collapse: collapse; margin: .6em 0 1.2em; }}
caption {{ text-align: left; font-weight: bold; padding-bottom: .3em; }}
td, th {{ border: 1px solid #ccc; padding: .2em .6em; text-align: left; font-size: 13px; }}
img {{ max-width: 100%; }}
.cannot, .failed {{ color: #777; }} .failed {{ color: #b00; }}
</style></head><body>
<h1>{title}</h1>
"""


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


def cell(value: float | int | None, digits: int = 3) -> str:
    """A number for a table."""
    if value is None or value != value:  # NaN
        return "-"
    return str(value) if isinstance(value, int) else f"{value:.{digits}f}"


def join(names: Sequence[Any], most: int = 12) -> str:
    """Names in a sentence, not all of many."""
    shown = ", ".join(map(str, names[:most]))
    return shown if len(names) <= most else f"{shown} and {len(names) - most} more"


def say(section: Section) -> Section:
    """Print a section as a person reads it, and return it."""
    print(f"\n{section.title}" + ("" if section.status == "found" else f" ({section.status})"))
    for sentence in section.sentences:
        print(f"  {sentence}")
    for caption, rows in section.tables.items():
        print_table(caption, rows)
    return section


def print_table(caption: str, rows: list[list[str]]) -> None:
    """A table as a person reads it."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    print(f"  {caption}")
    for row in rows:
        print("    " + "  ".join(f"{value:{width}}" for value, width in zip(row, widths, strict=True)).rstrip())


def write_page(path: Path, title: str, chapters: Mapping[str, Sequence[Section]]) -> None:
    """Write the report as one file that needs nothing else, a chapter for each recording; it appears whole or not at
    all.
    """
    parts = [HEAD.format(title=html.escape(title)), "<ul>"]
    parts += [f'<li><a href="#r{i}">{html.escape(name)}</a></li>' for i, name in enumerate(chapters)]
    parts.append("</ul>")
    for i, (name, sections) in enumerate(chapters.items()):
        parts.append(f'<h2 id="r{i}">{html.escape(name)}</h2>')
        parts += [_page_section(section) for section in sections]
    parts.append("</body></html>\n")
    with replacing(path) as temporary:
        temporary.write_text("\n".join(parts), encoding="utf-8")


def _page_section(section: Section) -> str:
    kind = {"cannot tell": " class=cannot", "failed": " class=failed"}.get(section.status, "")
    parts = [f"<h3{kind}>{html.escape(section.title)}</h3>"]
    if section.sentences:
        parts.append(f"<ul{kind}>" + "".join(f"<li>{html.escape(s)}</li>" for s in section.sentences) + "</ul>")
    for caption, rows in section.tables.items():
        body = "".join(
            "<tr>" + "".join(f"<{tag}>{html.escape(value)}</{tag}>" for value in row) + "</tr>"
            for row, tag in zip(rows, ["th", *["td"] * len(rows)], strict=False)
        )
        parts.append(f"<table><caption>{html.escape(caption)}</caption>{body}</table>")
    for caption, figure in section.figures.items():
        png = io.BytesIO()
        FigureCanvasAgg(figure)
        figure.savefig(png, format="png", dpi=80)
        source = "data:image/png;base64," + base64.b64encode(png.getvalue()).decode()
        parts.append(f'<figure><img alt="{html.escape(caption)}" src="{source}"></figure>')
    return "\n".join(parts)
