"""HTML page of a session or data set: a single file that any browser shows, with embedded pictures and no scripts."""

import base64
import html
import io
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from i2t.dataset import Record
from i2t.files.writing import replacing
from i2t.types import ReturnCode
from i2t.view.contents import Contents, readings_of
from i2t.viz.patches import plot_patches
from i2t.viz.skins import plot_readings
from i2t.viz.style import CURVE_COLOURS, Picture, titled

# CSS of the page that shows a recording.
STYLE = (
    "body{font-family:sans-serif;max-width:70em;margin:2em auto;color:#222}img{max-width:100%}"
    "table{border-collapse:collapse;font-size:.85em}td,th{padding:.15em .6em;text-align:right;"
    "border-bottom:1px solid #ddd}td:first-child,th:first-child{text-align:left}"
)


def write_page(contents: Contents, path: Path, *, max_pictured: int = 10, max_rows: int = 1000) -> Path:
    """Write the HTML page of a session or data set.

    Args:
        contents: The session or data set.
        path: Path of the page, ending in .html.
        max_pictured: Maximum number of touches with pictures; if there are more, evenly spaced ones are shown.
        max_rows: Maximum number of touches in the table.

    Returns:
        The path of the page.
    """
    dataset = contents.dataset
    shown = np.unique(np.linspace(0, len(dataset) - 1, min(len(dataset), max_pictured)).round().astype(int))
    names = [f"touch {row + 1}\n{dataset.objects[dataset.touches.object[row]]}" for row in shown]
    touches = dataset.touches
    pictures = [
        ("Readings", plot_readings(dataset.board, {"measured": np.nan_to_num(touches.reading[shown])}, names,
                                   "Readings", contents.simulated)),
        ("Patches", plot_patches(touches.patch[shown], names, "Depth patches", contents.simulated,
                                 window=dataset.window, reach=dataset.reach)),
        *((f"Touch {row + 1}", figure) for row, figure in _time_courses(contents, shown)),
    ]  # fmt: skip
    about = {"touches": str(len(dataset)), "source": dataset.source, **dataset.meta}
    body = [
        f"<h1>{html.escape(titled(str(contents.path.name), contents.simulated))}</h1>",
        _table([("", ""), *about.items()]),
        *(f"<h2>{html.escape(title)}</h2>{_image(figure)}" for title, figure in pictures),
        "<h2>All touches</h2>",
        _table(_rows(contents, max_rows)),
    ]
    page = f"<!doctype html><meta charset=utf-8><title>{html.escape(contents.path.name)}</title><style>{STYLE}</style>"
    with replacing(path) as temporary:
        temporary.write_text(page + "\n".join(body), "utf-8")
    return path


def _time_courses(contents: Contents, shown: np.ndarray) -> list[tuple[int, Figure]]:
    """Plot the time courses of the chosen touches whose series were recorded."""
    records = [(row, contents.record(row)) for row in shown.tolist()]
    return [
        (row, plot_time_course(record, contents.simulated, row))
        for row, record in records
        if "tactile" in record.series
    ]


def plot_time_course(record: Record, simulated: bool, row: int) -> Picture:
    """Plot the readings and forces of a touch over time.

    Args:
        record: Record of the touch, with the series of its samples.
        simulated: Whether the touch is simulated.
        row: Index of the touch.

    Returns:
        Picture with the readings on the left and the forces on the right.
    """
    (time, readings), wrench = readings_of(row, record), record.series.get("wrench")
    figure = Picture(figsize=(9, 3.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    start = time[0] if len(time) else 0.0
    left.plot(time - start, readings, lw=0.7)
    left.set(xlabel="time (s)", ylabel="change of field (µT)")
    if wrench is not None and len(wrench.time):
        for i, axis in enumerate("xyz"):
            right.plot(wrench.time - start, wrench.values[:, i], color=CURVE_COLOURS[i], label=axis, lw=1)
        right.legend(fontsize=8)
    right.set(xlabel="time (s)", ylabel="force on the tool (N)")
    events = "; ".join(f"{when - start:.2f} s {text}" for when, text in record.events)
    figure.suptitle(f"{titled(f'Touch {row + 1}', simulated)}\n{events[:200]}", fontsize=9)
    return figure


def _rows(contents: Contents, max_rows: int) -> list[tuple[str, ...]]:
    dataset = contents.dataset
    touches = dataset.touches
    head = ("file", "object", "session", "end", "norm (µT)", "force (N)", "travel (mm)", "nearest (mm)")
    rows: list[tuple[str, ...]] = [head]
    for row in range(min(len(dataset), max_rows)):
        numbers = (
            float(np.sqrt(np.nansum(touches.reading[row].astype(float) ** 2))), float(touches.force[row]),
            1e3 * float(touches.travel[row]), 1e3 * float(touches.nearest[row]),
        )  # fmt: skip
        rows.append(
            (
                contents.files[row].name if contents.files else str(row + 1),
                dataset.objects[touches.object[row]],
                dataset.sessions[touches.session[row]],
                ReturnCode(int(touches.code[row])).name.lower(),
                *(f"{number:.2f}" if np.isfinite(number) else "" for number in numbers),
            )
        )
    if len(dataset) > max_rows:
        rows.append((f"and {len(dataset) - max_rows} more", *[""] * (len(head) - 1)))
    return rows


def _table(rows: list[tuple[str, ...]]) -> str:
    head, *rest = rows
    lines = ["<tr>" + "".join(f"<th>{html.escape(cell)}</th>" for cell in head) + "</tr>"] if any(head) else []
    lines += ["<tr>" + "".join(f"<td>{html.escape(str(cell))}</td>" for cell in row) + "</tr>" for row in rest]
    return "<table>" + "".join(lines) + "</table>"


def _image(figure: Figure) -> str:
    png = io.BytesIO()
    figure.savefig(png, format="png", dpi=90, bbox_inches="tight")
    return f'<img alt="" src="data:image/png;base64,{base64.b64encode(png.getvalue()).decode()}">'
