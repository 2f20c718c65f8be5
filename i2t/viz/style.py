"""Style of all figures: colours, markers, titles, and how a figure is shown and written.

Colours are the colour-blind safe set of Okabe and Ito (2008); maps are drawn in cividis.
"""

import io
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from i2t.files.writing import replacing

BLUE, ORANGE, GREEN, RED, PINK, SKY, GREY = (
    "#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9", "#666666",
)  # fmt: skip
COLOURS = (BLUE, ORANGE, GREEN, RED, PINK, SKY, GREY)
MARKERS = "osD^vP*"
MM_PER_M = 1e3
KPA_PER_PA = 1e-3


class Picture(Figure):
    """A figure that notebooks show as it is, whatever their backend."""

    def _repr_png_(self) -> bytes:
        png = io.BytesIO()
        FigureCanvasAgg(self).figure.savefig(png, format="png", dpi=90, bbox_inches="tight")
        return png.getvalue()


def save_figure(figure: Figure, path: Path | str) -> Path:
    """Write a figure in the format of the file's ending, whole or not at all.

    Args:
        figure: What to write.
        path: The file; its folder is made if it is not there.

    Returns:
        The file.

    Raises:
        DataError: It cannot be written; FullDiskError if the disk is full, or failed.
    """
    FigureCanvasAgg(figure)
    with replacing(Path(path)) as temporary:
        figure.savefig(temporary, dpi=150, bbox_inches="tight")
    return Path(path)


def titled(title: str, simulated: bool) -> str:
    """A title that says where its numbers come from.

    Args:
        title: What is shown.
        simulated: Whether any of it was simulated.

    Returns:
        The title, with "(simulated)" where it is.
    """
    return f"{title} (simulated)" if simulated else title
