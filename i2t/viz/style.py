"""Style of all figures: colours, markers, titles, and how a figure is displayed and saved.

Lines use the colour-blind safe palette of Okabe and Ito (2008), and maps use cividis.
"""

import io
from enum import StrEnum
from pathlib import Path

import numpy as np
from jaxtyping import Shaped
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from i2t.files.writing import replacing

MM_PER_M = 1e3
CURVE_MARKERS = "osD^vP*"  # matplotlib's markers of the data series of a figure, in their order


class Colour(StrEnum):
    """Colours of lines and markers in all figures, as hexadecimal RGB codes."""

    BLUE = "#0072B2"
    ORANGE = "#E69F00"
    GREEN = "#009E73"
    RED = "#D55E00"
    PINK = "#CC79A7"
    SKY = "#56B4E9"
    GREY = "#666666"


CURVE_COLOURS = tuple(Colour)  # colours of the data series of a figure, in their order


class Picture(Figure):
    """A figure that notebooks display inline, whatever their backend."""

    def _repr_png_(self) -> bytes:
        png = io.BytesIO()
        FigureCanvasAgg(self).figure.savefig(png, format="png", dpi=90, bbox_inches="tight")
        return png.getvalue()


def save_figure(figure: Figure, path: Path | str) -> Path:
    """Save a figure atomically, in the format of the file's extension.

    Args:
        figure: The figure to save.
        path: Path of the file. Missing folders are created.

    Returns:
        The path of the file.

    Raises:
        DataError: The file cannot be written. It is a FullDiskError if the disk is full or failed.
    """
    FigureCanvasAgg(figure)
    with replacing(Path(path)) as temporary:
        figure.savefig(temporary, dpi=150, bbox_inches="tight")
    return Path(path)


def pixels(figure: Figure, dpi: float = 100) -> Shaped[np.ndarray, "rows columns 3"]:
    """Draw a figure into an array.

    Args:
        figure: The figure to draw.
        dpi: Pixels per inch.

    Returns:
        `(rows, columns, 3)` RGB values from 0 to 255.
    """
    figure.set_dpi(dpi)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def titled(title: str, simulated: bool) -> str:
    """Mark a title as simulated where its data are.

    Args:
        title: The title.
        simulated: Whether any of the data are simulated.

    Returns:
        The title, followed by "(simulated)" if any of the data are.
    """
    return f"{title} (simulated)" if simulated else title
