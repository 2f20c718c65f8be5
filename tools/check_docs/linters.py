"""External linters: import-linter for the contracts of pyproject.toml, mypy for the Python of pages and of examples in
docstrings, and Sphinx for links, anchors and names.
"""

import inspect
import subprocess
import sys
import textwrap
from pathlib import Path

import i2t
from tools.check_docs.pages import BLOCK, pages_of

PRELUDE = (
    "import i2t; import jax; import numpy as np\n"  # precedes each example, whose other undefined names are allowed
)
REQUIRED_ON_SITE = {
    "reference_api": ("load_predictor",),
    "commands/experiments-recognize": ("--max-touches", "--pad-model"),
    "commands/i2t-hand-eye": ("--square", "--dictionary"),
    "commands/i2t-convert": ("--quarter-turns",),
    "tutorial_own_object": ("copybutton.js", "highlight-output", 'class="figure wide"'),
    "../notebooks/paper": ("The paper",),
    "physics": ("<math",),
    "index": ('src="../_images/overview.png"',),
}


def start(root: Path, folder: Path, *, site: bool = True) -> dict[str, subprocess.Popen[str]]:
    """Start all linters in parallel.

    Args:
        root: Root of the checkout.
        folder: Empty folder for generated code and pages.
        site: Whether to build the site too.

    Returns:
        Running processes by the linter's name.
    """
    scripts = Path(sys.executable).parent
    commands = {
        "import-linter": [str(scripts / "lint-imports"), "--no-cache", "--no-logo"],
        "mypy": [sys.executable, "-m", "mypy", "--no-error-summary",
                 *map(str, write_code(root, folder / "code"))],
    }  # fmt: skip
    if site:
        commands["sphinx"] = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q",
                              "-D", "nb_execution_mode=off",  # the tests run the notebooks
                              "-c", "docs", ".", str(folder / "site")]  # fmt: skip
    return {
        name: subprocess.Popen(words, cwd=root, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
        for name, words in commands.items()
    }


def finish(running: dict[str, subprocess.Popen[str]], folder: Path) -> list[str]:
    """Wait for the linters.

    Args:
        running: Processes that `start` returned.
        folder: Folder that was passed to `start`.

    Returns:
        Reports of the linters with findings.
    """
    outputs = {name: process.communicate()[0] for name, process in running.items()}
    reports = [f"{name}: {outputs[name].strip()}" for name, process in running.items() if process.returncode]
    for name, needed in REQUIRED_ON_SITE.items() if "sphinx" in running and not reports else ():
        text = (folder / "site" / "docs" / f"{name}.html").read_text()
        reports += [f"docs/{name}.md: the page lacks {words}" for words in needed if words not in text]
    return reports


def write_code(root: Path, folder: Path) -> list[Path]:
    """Write the Python of each page, keeping its line numbers, and the example of each public name.

    Args:
        root: Root of the checkout.
        folder: Folder to create and write to.

    Returns:
        The files, named after pages and public names.
    """
    sources = {f"example_{name}": _example(name) for name in i2t.__all__}
    for page in pages_of(root):
        text = page.read_text()
        lines = [""] * (text.count("\n") + 1)
        for block in BLOCK.finditer(text):
            if block[1] == "python":
                first = text.count("\n", 0, block.start(2))
                lines[first : first + block[2].count("\n")] = block[2].splitlines()
        sources[page.stem] = PRELUDE + "\n".join(lines[1:])  # without the title line
    folder.mkdir()
    files = {folder / f"{name}.py": source for name, source in sources.items() if source.strip() != PRELUDE.strip()}
    for path, source in files.items():
        path.write_text(source)
    return list(files)


def _example(name: str) -> str:
    """Example in the docstring of a public name."""
    value = getattr(i2t, name)
    docstring = "" if inspect.ismodule(value) else inspect.getdoc(value) or ""
    return PRELUDE + textwrap.dedent(docstring.partition("Example:\n")[2])
