"""The report as one HTML file that needs nothing else."""

import base64
import html
import io
from collections.abc import Mapping, Sequence
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from experiments.fidelity.sections import Section
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


def write_page(path: Path, title: str, recordings: Mapping[str, Sequence[Section]]) -> None:
    """Write the report, a chapter for each recording; the file appears whole or not at all."""
    parts = [HEAD.format(title=html.escape(title)), "<ul>"]
    parts += [f'<li><a href="#r{i}">{html.escape(name)}</a></li>' for i, name in enumerate(recordings)]
    parts.append("</ul>")
    for i, (name, sections) in enumerate(recordings.items()):
        parts.append(f'<h2 id="r{i}">{html.escape(name)}</h2>')
        parts += [_section(section) for section in sections]
    parts.append("</body></html>\n")
    with replacing(path) as temporary:
        temporary.write_text("\n".join(parts), encoding="utf-8")


def embedded(figure: Figure) -> str:
    """A figure as the source of an image."""
    png = io.BytesIO()
    FigureCanvasAgg(figure)
    figure.savefig(png, format="png", dpi=80)
    return "data:image/png;base64," + base64.b64encode(png.getvalue()).decode()


def _section(section: Section) -> str:
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
        parts.append(f'<figure><img alt="{html.escape(caption)}" src="{embedded(figure)}"></figure>')
    return "\n".join(parts)
