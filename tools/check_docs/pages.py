"""Checks of each page. A check takes a page and its text, and gives what is wrong, and where."""

import contextlib
import importlib
import importlib.util
import io
import json
import re
import shlex
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

import i2t
from tools.reproduce.steps import STEPS
from tools.reproduce.tables import LIMITS_TABLE, MARK, README_TABLE, table

ROOT = Path(__file__).parents[2]
COMMAND = re.compile(r"python -m (?:i2t|experiments|tools|tests)[^`\n]*")
FILE = re.compile(r"`((?:i2t|experiments|tools|tests|examples|notebooks|docs)/[\w./-]+\.(?:py|md|ipynb))`")
BLOCK = re.compile(r"^```([a-z]*)\n(.*?)^```", re.M | re.S)


class PageProblem(NamedTuple):
    """A mistake and its place."""

    path: Path
    line: int
    sentence: str


def pages_of(root: Path) -> list[Path]:
    """The pages that users read."""
    return [*(root / f"{name}.md" for name in ("README", "CONTRIBUTING", "CHANGELOG")), *sorted(root.glob("docs/*.md"))]


def findings(root: Path) -> Iterator[PageProblem]:
    """Find mistakes in pages and notebooks."""
    for page in pages_of(root):
        text = page.read_text()
        for check in CHECKS:
            yield from check(page, text)
    yield from steps_printed(root)
    yield from versions(root)
    for path in sorted(root.glob("notebooks/*.ipynb")):
        yield from notebook(path, path.read_text())


def _line(text: str, position: int) -> int:
    return text.count("\n", 0, position) + 1


def blank(found: re.Match[str]) -> str:
    """Spaces in place of what is found, so that lines stay where they are."""
    return re.sub(r"[^\n]", " ", found[0])


def files(page: Path, text: str) -> Iterator[PageProblem]:
    """Files of the repository that are named exist; Sphinx follows the links."""
    for found in FILE.finditer(text):
        if not (ROOT / found[1]).exists():
            yield PageProblem(page, _line(text, found.start()), f"{found[1]} does not exist")


def figures(page: Path, text: str) -> Iterator[PageProblem]:
    """Every figure has a text for those who cannot see it."""
    for found in re.finditer(r"!\[([^\]]*)\]\(([^)]+)\)", text):
        if len(found[1]) <= 20 and "://" not in found[2]:
            yield PageProblem(page, _line(text, found.start()), f"the figure {found[2]} has no text")


def tests(page: Path, text: str) -> Iterator[PageProblem]:
    """Tests that a page names exist."""
    for found in re.finditer(r"\b((?:tests/[\w/]+/|tests/)?test_\w+\.py)(?:::(\w+))?", text):
        file, name = found[1], found[2]
        paths = [ROOT / file] if "/" in file else [*(ROOT / "tests").rglob(file)]
        code = "".join(path.read_text() for path in paths if path.is_file())
        if not code or (name and f"def {name}(" not in code):
            yield PageProblem(page, _line(text, found.start()), f"there is no test {found[0]}")


def printed_commands(text: str) -> list[tuple[int, list[str]]]:
    """The line of each command of i2t in a page, in fenced blocks, indented lines and sentences, and the words after
    `python -m`.
    """
    places = [(found.start(2), found[2]) for found in BLOCK.finditer(text) if found[1] in ("", "bash", "sh", "console")]
    prose = BLOCK.sub(blank, text)
    places += [(found.start(1), found[1]) for found in re.finditer(r"^ {4,}(?:\$ )?(python -m .*)$", prose, re.M)]
    places += [(each.start(1), " ".join(each[1].split())) for each in re.finditer(r"`(python -m [^`]+)`", prose)]
    commands = []
    for position, block in places:
        for found in COMMAND.finditer(block.replace("\\\n", "  ")):
            words = shlex.split(re.split(r"&&|;|\||  #", found[0])[0], comments=True)
            commands.append((_line(text, position) + block.count("\n", 0, found.start()), words[2:]))
    return commands


@cache
def help_of(module: str, part: str = "") -> str:
    """Output of a command for `--help`; nothing if there is no such command."""
    try:
        package = importlib.util.find_spec(module)
    except ModuleNotFoundError:
        package = None
    if package is None:
        return ""
    main = importlib.import_module(f"{module}.__main__" if package.submodule_search_locations else module).main
    printed = io.TextIOWrapper(io.BytesIO(), encoding="utf-8")
    with (
        contextlib.redirect_stdout(printed),
        contextlib.redirect_stderr(io.StringIO()),
        contextlib.suppress(SystemExit),
    ):
        main([*([part] if part else []), "--help"])
    printed.flush()
    return printed.buffer.getvalue().decode()


def commands(page: Path, text: str) -> Iterator[PageProblem]:
    """Commands that are printed exist, are complete, and have the options."""
    for line, (module, *args) in printed_commands(text):
        said = help_of(module)
        if not said:
            yield PageProblem(page, line, f"there is no command {module}")
        elif "..." in args:
            yield PageProblem(page, line, f"the command {module} is not complete")
        elif args and not args[0].startswith("-") and _mentions(said, args[0]):
            said += help_of(module, args[0])
        for flag in (arg.split("=")[0] for arg in args if arg.startswith("--") and said):
            if not _mentions(said, flag):
                yield PageProblem(page, line, f"{module} has no option {flag}")


def _mentions(said: str, word: str) -> bool:
    return bool(re.search(rf"(?<![\w-]){re.escape(word)}(?![\w-])", said))


def tables(page: Path, text: str) -> Iterator[PageProblem]:
    """Tables are what was measured, on a page that prints the command."""
    printed = {step.name: f"python {step.command}" for step in STEPS}
    printed |= dict.fromkeys((README_TABLE[0], LIMITS_TABLE[0]), "")  # tables of no single command
    for found in MARK.finditer(text):
        line, step = _line(text, found.start()), found[2]
        if step not in printed:
            yield PageProblem(page, line, f"there is no step {step}")
        elif found[1] + table(ROOT / "docs", step, found[3], page.name) + "\n" + found[4] != found[0]:
            yield PageProblem(page, line, f"the table {step} {found[3]} is not what docs/results holds")
        elif printed[step] not in text:
            yield PageProblem(page, line, f"the table {step} has no command on this page")


def steps_printed(root: Path) -> Iterator[PageProblem]:
    """Each step of tools.reproduce is printed somewhere, perhaps with further options."""
    found = [set(words) for page in pages_of(root) for _, words in printed_commands(page.read_text())]
    for step in STEPS:
        words = set(shlex.split(step.command)) - {"-m"}
        if not any(words <= line for line in found):
            yield PageProblem(root / "tools/reproduce/steps.py", 1, f"no page prints python {step.command}")


def versions(root: Path) -> Iterator[PageProblem]:
    """The version is one everywhere."""
    project = tomllib.loads((root / "pyproject.toml").read_text())["project"]
    stated = {"pyproject.toml": project["version"]}
    for name, pattern in (("CITATION.cff", r"^version: (\S+)$"), ("CHANGELOG.md", r"^## (\S+)")):
        found = re.search(pattern, (root / name).read_text(), re.M)
        stated[name] = found[1] if found else "none"
    for name, version in stated.items():
        if version != i2t.__version__:
            yield PageProblem(root / name, 1, f"the version is {version}, that of the package {i2t.__version__}")


def advice(page: Path, text: str) -> Iterator[PageProblem]:
    """Advice to install names this distribution and extras that it has."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    for found in re.finditer(r"""pip install -?e? ?["'](\.|[\w.-]+)\[([\w,]+)\]""", text):
        known = set(found[2].split(",")) <= project["optional-dependencies"].keys()
        if found[1] not in (".", project["name"]) or not known:
            yield PageProblem(page, _line(text, found.start()), f"{found[0]} installs what there is not")


def notebook(path: Path, text: str) -> Iterator[PageProblem]:
    """A notebook is stored without outputs and needs the package only."""
    for cell in json.loads(text)["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "code" and (cell["outputs"] or cell["execution_count"] is not None):
            yield PageProblem(path, 1, "it is stored with outputs")
        if cell["cell_type"] == "code" and re.search(r"^\s*(?:from|import) experiments\b", source, re.M):
            yield PageProblem(path, 1, "it imports experiments, which is not installed")


CHECKS = (files, figures, tests, commands, tables, advice)
