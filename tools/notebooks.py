"""Run notebooks and write them as HTML with their figures.

    python -m tools.notebooks                          all notebooks, to runs/notebooks
    python -m tools.notebooks skin_physics --debug     one notebook, in the size of the tests

Requires `pip install -e ".[notebooks]"`. The notebooks themselves are stored without outputs and stay
unchanged.
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


@dataclass(frozen=True)
class NotebookArgs:
    """Run notebooks and write them as HTML."""

    names: tyro.conf.Positional[tuple[str, ...]] = ()  # names of the notebooks; default: all
    out: Path = Path("runs/notebooks")  # output folder
    debug: bool = False  # small sizes, in seconds


def run(args: NotebookArgs) -> list[Path]:
    """Run the notebooks, and return the files written; `ValueError` for an unknown name or without Jupyter."""
    names = sorted(path.stem for path in FOLDER.glob("*.ipynb"))
    unknown = [name for name in args.names if name not in names]
    if unknown or not names:
        raise ValueError(f"no notebook is called {', '.join(unknown)}; {FOLDER} has {', '.join(names) or 'none'}")
    for module in ("nbconvert", "ipykernel"):
        require_extra(module, "a page of a notebook")
    args.out.mkdir(parents=True, exist_ok=True)
    return [render(name, args.out, args.debug) for name in args.names or names]


def render(name: str, out: Path, debug: bool) -> Path:
    """Run one notebook in its own kernel, in the current folder, and write it as HTML."""
    import nbformat
    from nbclient import NotebookClient
    from nbconvert import HTMLExporter

    started = time.perf_counter()
    book = nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)
    if debug:
        os.environ["I2T_NOTEBOOK"] = "debug"
    os.environ["TQDM_DISABLE"] = "1"  # else the page shows every step of a progress bar
    NotebookClient(book, timeout=900, kernel_name="python3").execute()
    page, _ = HTMLExporter().from_notebook_node(book)
    path = out / f"{name}.html"
    path.write_text(page)
    print(f"{path}: run in {time.perf_counter() - started:.0f} s")
    return path


def sources(path: Path) -> list[str]:
    """Code cells of a notebook."""
    cells = json.loads(path.read_text())["cells"]
    return ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]


main = command(NotebookArgs, "tools.notebooks")

if __name__ == "__main__":
    sys.exit(main())
