"""Draw the figures of the documents.

    python -m experiments.train                     a pad, touches and a predictor
    python -m tools.gallery                         all figures, a few minutes
    python -m tools.gallery --only press patches    some figures

Each figure is a function of `tools.gallery.figures`. Results go to --out, one PNG for each figure.
"""

from PIL import Image

from i2t import viz
from tools.gallery.arguments import FIGURE_NAMES, GalleryArgs
from tools.gallery.figures import FIGURES, Story


def run(args: GalleryArgs) -> None:
    """Draw the selected figures."""
    args.out.mkdir(parents=True, exist_ok=True)
    story = Story(args.pad_model)
    for name in args.only or FIGURE_NAMES:
        path = viz.save_figure(FIGURES[name](story), args.out / f"{name}.png")
        small = Image.open(path).convert("RGB").quantize(256, kmeans=8, dither=Image.Dither.NONE)  # small files
        small.save(path, optimize=True)
        print(f"{path}: {FIGURES[name].__doc__}")
