"""Notebooks as HTML: every notebook, or those named, run from top to bottom and written with its figures.

    python -m tools.notebooks                          all of them, to runs/notebooks
    python -m tools.notebooks skin_physics --debug     one, at the size of the tests

Needs `pip install "imagine2touch[notebooks]"`. The notebooks themselves are stored without outputs, and are not
changed.
"""

import json
import os
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import tyro

from experiments.common.commands import command
from i2t.errors import require_extra

FOLDER = Path(__file__).parents[1] / "notebooks"
LIMIT = 900  # s for one cell


@dataclass(frozen=True)
class NotebookArgs:
    """Run notebooks and write them as HTML."""

    names: tyro.conf.Positional[tuple[str, ...]] = ()  # all, unless named
    out: Path = Path("runs/notebooks")
    debug: bool = False  # small, in seconds


def run(args: NotebookArgs) -> list[Path]:
    """Run the notebooks; returns the files written. Raises ValueError for a name that is none, or where Jupyter is
    missing.
    """
    known = sorted(path.stem for path in FOLDER.glob("*.ipynb"))
    unknown = [name for name in args.names if name not in known]
    if unknown or not known:
        raise ValueError(f"no notebook is called {', '.join(unknown)}; {FOLDER} has {', '.join(known) or 'none'}")
    for module in ("nbconvert", "ipykernel"):
        require_extra(module, "a page of a notebook")
    args.out.mkdir(parents=True, exist_ok=True)
    return [render(name, args.out, args.debug) for name in args.names or known]


def render(name: str, out: Path, debug: bool) -> Path:
    """Run one notebook in a kernel of its own, in the present folder, and write it as HTML."""
    import nbformat
    from nbclient import NotebookClient
    from nbconvert import HTMLExporter

    started = time.perf_counter()
    book = nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)
    if debug:
        os.environ["I2T_NOTEBOOK"] = "debug"
    os.environ["TQDM_DISABLE"] = "1"  # a page would show every step of a bar
    NotebookClient(book, timeout=LIMIT, kernel_name="python3").execute()
    page, _ = HTMLExporter().from_notebook_node(book)
    path = out / f"{name}.html"
    path.write_text(page)
    print(f"{path}: run in {time.perf_counter() - started:.0f} s")
    return path


def sources(path: Path) -> list[str]:
    """The code cells of a notebook."""
    cells = json.loads(path.read_text())["cells"]
    return ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]


main = command(NotebookArgs, "tools.notebooks")

if __name__ == "__main__":
    sys.exit(main())
