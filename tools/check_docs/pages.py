"""Checks of pages and notebooks; each check takes a page and its text, and yields findings."""

import contextlib
import importlib
import importlib.util
import io
import json
import re
import shlex
import tomllib
from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

import i2t
from i2t.cli.commands import COMMANDS, command_of
from tools import snippets
from tools.reproduce.steps import STEPS
from tools.reproduce.tables import ALL_STEPS, MARK, table

ROOT = Path(__file__).parents[2]
PRINTED = re.compile(r"python -m (?:i2t|experiments|tools|tests)[^`\n]*|(?<!\S)i2t [a-z-][^`\n]*")
BLOCK = re.compile(r"^```([a-z]*)\n(.*?)^```", re.M | re.S)


class PageProblem(NamedTuple):
    """A mistake and its location."""

    path: Path
    line: int
    sentence: str


def pages_of(root: Path) -> list[Path]:
    """Pages for users."""
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


def blank(match: re.Match[str]) -> str:
    """Replace a match by spaces, which keeps line numbers."""
    return re.sub(r"[^\n]", " ", match[0])


def files(page: Path, text: str) -> Iterator[PageProblem]:
    """Find names of files of the repository that do not exist; Sphinx checks links."""
    folders = "i2t|experiments|tools|tests|examples|notebooks|docs"
    for match in re.finditer(rf"`((?:{folders})/[\w./-]+\.(?:py|md|ipynb))`", text):
        if not (ROOT / match[1]).exists():
            yield PageProblem(page, _line(text, match.start()), f"{match[1]} does not exist")


def figures(page: Path, text: str) -> Iterator[PageProblem]:
    """Find figures without alternative text."""
    for match in re.finditer(r"!\[([^\]]*)\]\(([^)]+)\)", text):
        if len(match[1]) <= 20 and "://" not in match[2]:
            yield PageProblem(page, _line(text, match.start()), f"the figure {match[2]} has no text")


def tests(page: Path, text: str) -> Iterator[PageProblem]:
    """Find names of tests that do not exist."""
    for match in re.finditer(r"\b((?:tests/[\w/]+/|tests/)?test_\w+\.py)(?:::(\w+))?", text):
        file, name = match[1], match[2]
        paths = [ROOT / file] if "/" in file else [*(ROOT / "tests").rglob(file)]
        code = "".join(path.read_text() for path in paths if path.is_file())
        if not code or (name and f"def {name}(" not in code):
            yield PageProblem(page, _line(text, match.start()), f"there is no test {match[0]}")


def printed_commands(text: str) -> list[tuple[int, list[str]]]:
    """Extract the commands of i2t from fenced blocks, indented lines and sentences of a page.

    Args:
        text: Text of the page.

    Returns:
        Line number of each command, and its words: `i2t imagine` or the module after `python -m`, then the others.
    """
    places = [(match.start(2), match[2]) for match in BLOCK.finditer(text) if match[1] in ("", "bash", "sh", "console")]
    prose = BLOCK.sub(blank, text)
    places += [
        (match.start(1), match[1]) for match in re.finditer(r"^ {4,}(?:\$ )?((?:python -m|i2t) .*)$", prose, re.M)
    ]
    places += [
        (match.start(1), " ".join(match[1].split())) for match in re.finditer(r"`((?:python -m|i2t)\s[^`]+)`", prose)
    ]
    commands = []
    for position, block in places:
        for match in PRINTED.finditer(block.replace("\\\n", "  ")):
            words = shlex.split(re.split(r"&&|;|\||  #", match[0])[0], comments=True)
            words = words[2:] if words[0] == "python" else words
            if words[0] == "i2t" and len(words) > 1 and not words[1].startswith("-"):
                words = [" ".join(words[:2]), *words[2:]]
            commands.append((_line(text, position) + block.count("\n", 0, match.start()), words))
    return commands


def _main_of(name: str) -> Callable[[list[str]], int] | None:
    if name.startswith("i2t "):
        sub_command = name.removeprefix("i2t ")
        return partial(command_of(sub_command), program=name) if sub_command in COMMANDS else None
    try:
        package = importlib.util.find_spec(name)
    except ModuleNotFoundError:
        package = None
    if package is None:
        return None
    return importlib.import_module(f"{name}.__main__" if package.submodule_search_locations else name).main


@cache
def help_of(module: str, part: str = "") -> str:
    """Help text of a command, named as in `printed_commands`; empty if the command does not exist."""
    main = _main_of(module)
    if main is None:
        return ""
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
    """Find commands that do not exist, are incomplete, or lack an option."""
    for line, (module, *args) in printed_commands(text):
        help_text = help_of(module)
        if not help_text:
            yield PageProblem(page, line, f"there is no command {module}")
        elif "..." in args:
            yield PageProblem(page, line, f"the command {module} is not complete")
        elif args and not args[0].startswith("-") and _mentions(help_text, args[0]):
            help_text += help_of(module, args[0])
        for flag in (arg.split("=")[0] for arg in args if arg.startswith("--") and help_text):
            if not _mentions(help_text, flag):
                yield PageProblem(page, line, f"{module} has no option {flag}")


def _mentions(help_text: str, word: str) -> bool:
    return bool(re.search(rf"(?<![\w-]){re.escape(word)}(?![\w-])", help_text))


def tables(page: Path, text: str) -> Iterator[PageProblem]:
    """Find tables that differ from docs/results, and tables on pages that do not print their command."""
    printed = {step.name: f"python {step.command}" for step in STEPS}
    printed[ALL_STEPS] = ""  # tables without a command of their own
    for match in MARK.finditer(text):
        line, step = _line(text, match.start()), match[2]
        if step not in printed:
            yield PageProblem(page, line, f"there is no step {step}")
        elif match[1] + table(ROOT / "docs", step, match[3], page.name) + "\n" + match[4] != match[0]:
            yield PageProblem(page, line, f"the table {step} {match[3]} is not what docs/results holds")
        elif printed[step] not in text:
            yield PageProblem(page, line, f"the table {step} has no command on this page")


def steps_printed(root: Path) -> Iterator[PageProblem]:
    """Find steps of tools.reproduce that no page prints, possibly with further options."""
    printed = [set(words) for page in pages_of(root) for _, words in printed_commands(page.read_text())]
    for step in STEPS:
        words = set(shlex.split(step.command)) - {"-m"}
        if not any(words <= line for line in printed):
            yield PageProblem(root / "tools/reproduce/steps.py", 1, f"no page prints python {step.command}")


def versions(root: Path) -> Iterator[PageProblem]:
    """Find files whose version differs from the package's."""
    project = tomllib.loads((root / "pyproject.toml").read_text())["project"]
    stated = {"pyproject.toml": project["version"]}
    for name, pattern in (("CITATION.cff", r"^version: (\S+)$"), ("CHANGELOG.md", r"^## (\S+)")):
        match = re.search(pattern, (root / name).read_text(), re.M)
        stated[name] = match[1] if match else "none"
    for name, version in stated.items():
        if version != i2t.__version__:
            yield PageProblem(root / name, 1, f"the version is {version}, but that of the package is {i2t.__version__}")


def advice(page: Path, text: str) -> Iterator[PageProblem]:
    """Find install commands with another distribution or with unknown extras."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    for match in re.finditer(r"""pip install -?e? ?["'](\.|[\w.-]+)\[([\w,]+)\]""", text):
        extras_exist = set(match[2].split(",")) <= project["optional-dependencies"].keys()
        if match[1] != "." or not extras_exist:  # the distribution is not on the package index
            yield PageProblem(page, _line(text, match.start()), f"{match[0]} names an unknown package or extra")


def outputs(page: Path, text: str) -> Iterator[PageProblem]:
    """Find snippets of the README, the start page and the tutorials that show no output; the tests compare outputs."""
    if page in snippets.pages_of(ROOT).values():
        for line, sentence in snippets.without_output(text):
            yield PageProblem(page, line, sentence)


def notebook(path: Path, text: str) -> Iterator[PageProblem]:
    """Find notebooks that are stored with outputs or import anything but the package."""
    for cell in json.loads(text)["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "code" and (cell["outputs"] or cell["execution_count"] is not None):
            yield PageProblem(path, 1, "it is stored with outputs")
        if cell["cell_type"] == "code" and re.search(r"^\s*(?:from|import) experiments\b", source, re.M):
            yield PageProblem(path, 1, "it imports experiments, which is not installed")


CHECKS = (files, figures, tests, commands, tables, advice, outputs)
