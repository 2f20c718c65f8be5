"""The figures of the documents.

    python -m experiments.train                        a pad, touches, a predictor
    python -m tools.gallery                      all figures, a few minutes
    python -m tools.gallery --only press patches some of them

Each figure is one function of `tools.gallery.figures`, which shows how it is made.
Results go to --out, a PNG for each figure.
"""

from PIL import Image

from i2t import viz
from tools.gallery.arguments import FIGURE_NAMES, GalleryArgs
from tools.gallery.figures import FIGURES, Story

PALETTE_SIZE = 256  # of a picture, which keeps it small


def run(args: GalleryArgs) -> None:
    """Draw the figures asked for."""
    args.out.mkdir(parents=True, exist_ok=True)
    story = Story(args.pad_model)
    for name in args.only or FIGURE_NAMES:
        path = viz.save_figure(FIGURES[name](story), args.out / f"{name}.png")
        Image.open(path).convert("RGB").quantize(PALETTE_SIZE, method=Image.Quantize.MAXCOVERAGE).save(
            path, optimize=True
        )
        print(f"{path}: {FIGURES[name].__doc__}")
