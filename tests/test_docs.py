"""README and docs are true: their commands exist, with the options that they print, their links lead somewhere, and
their names are those of the code.
"""

import ast
import contextlib
import importlib
import importlib.util
import inspect
import io
import re
import shlex
import tomllib
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import i2t

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").glob("*.md"))]
FENCE = re.compile(r"^```([a-z]*)\n(.*?)^```", re.M | re.S)
COMMAND = re.compile(r"python -m (?:i2t|experiments)[^`\n]*")


def _commands(text: str) -> list[list[str]]:
    """The words after `python -m` of each command of i2t in a page: in fenced blocks, in indented lines and
    in the middle of a sentence.
    """
    shells = [block for language, block in FENCE.findall(text) if language in ("", "bash", "sh", "console")]
    prose = FENCE.sub("", text)
    indented = re.findall(r"^ {4,}(?:\$ )?(python -m .*)$", prose, re.M)
    inline = [" ".join(span.split()) for span in re.findall(r"`(python -m [^`]+)`", prose)]
    found = []
    for line in "\n".join([*shells, *indented, *inline]).replace("\\\n", " ").splitlines():
        for command in COMMAND.findall(line.split("  #")[0]):
            words = shlex.split(re.split(r"&&|;|\|", command)[0], comments=True)
            found.append(words[2:])
    return found


COMMANDS = sorted({(page.name, tuple(words)) for page in PAGES for words in _commands(page.read_text())})


def test_commands_are_found_wherever_they_are_printed():
    page = """
Say `python -m i2t.collect
--help`, or

    python -m experiments.benchmark --turns 3

```
python -m pip install -e . && python -m experiments.train --preset "debug"  # a minute
python -m i2t.convert summary \\
    DATA
```

```python
python = "python -m i2t.nowhere"
```
"""
    assert sorted(" ".join(words) for words in _commands(page)) == [
        "experiments.benchmark --turns 3",
        "experiments.train --preset debug",
        "i2t.collect --help",
        "i2t.convert summary DATA",
    ]


def _main(module: str) -> Callable[[Sequence[str]], int]:
    """What `python -m` runs."""
    entry = f"{module}.__main__" if importlib.util.find_spec(module).submodule_search_locations else module
    return importlib.import_module(entry).main


@cache
def _help(module: str, subcommand: str | None) -> str:
    main = _main(module)
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(out), pytest.raises(SystemExit) as ended:
        main([*([subcommand] if subcommand else []), "--help"])
    assert ended.value.code in (0, None), f"{module} {subcommand or ''} --help ends with {ended.value.code}"
    return out.getvalue()


@pytest.mark.parametrize(
    ("page", "words"), COMMANDS, ids=lambda value: value if isinstance(value, str) else " ".join(value)
)
def test_a_printed_command_exists_with_its_options(page, words):
    module, *args = words
    assert importlib.util.find_spec(module), f"{page} names {module}, which does not exist"
    text = _help(module, None)
    if args and not args[0].startswith("-") and re.search(rf"(?<![\w-]){re.escape(args[0])}(?![\w-])", text):
        with contextlib.suppress(pytest.fail.Exception):
            text += _help(module, args[0])
    for flag in (arg.split("=")[0] for arg in args if arg.startswith("--")):
        assert re.search(rf"(?<![\w-]){re.escape(flag)}(?![\w-])", text), f"{page}: {module} has no option {flag}"


def test_a_printed_command_is_complete():
    assert not [f"{page}: {' '.join(words)}" for page, words in COMMANDS if "..." in words]


TABLE = "x_mm,y_mm,depth_mm,force_N," + ",".join(f"b{chip}{axis}_uT" for chip in range(5) for axis in "xyz")
CHEAP = (  # in an order in which each finds what it needs; "TABLE.csv" is written by the test
    "i2t.hardware.reskin --list",
    "i2t.hardware.rig lab.toml --example",
    "i2t.hardware.rig lab.toml",
    "i2t.convert presses TABLE.csv DATA --indenter sphere:4.0",
    "i2t.convert summary DATA",
    "i2t.convert pack DATA PACKED",
    "i2t.convert npz DATA DATA.npz",
    "i2t.convert robomimic DATA DATA.hdf5",
    "i2t.convert csv DATA TABLE",
)


def test_the_quick_commands_run_as_printed(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    rows = [f"{x},{-x},0.{x + 3},1.5," + ",".join(str(10 * x + i) for i in range(15)) for x in range(-2, 3)]
    Path("TABLE.csv").write_text("\n".join([TABLE, *rows]) + "\n")
    printed = {" ".join(words) for _, words in COMMANDS}
    for command in CHEAP:
        assert command in printed, f"no page prints {command}: take it out of the test"
        module, *args = command.split()
        assert _main(module)(args) == 0, f"{command}: {capsys.readouterr().err}"
    assert np.load("DATA.npz")["reading"].shape == (5, 15)


def _python_blocks() -> list[tuple[str, str]]:
    found = [(page.name, block) for page in PAGES for language, block in FENCE.findall(page.read_text())
             if language == "python"]  # fmt: skip
    assert len(found) > 8
    return found


@pytest.mark.parametrize(("page", "block"), _python_blocks())
def test_python_on_a_page_calls_what_exists_with_its_arguments(page, block):
    tree = ast.parse(block)
    names: dict[str, Any] = {"i2t": i2t}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            exec(compile(ast.Module([node], []), page, "exec"), names)
    for call in (node for node in ast.walk(tree) if isinstance(node, ast.Call)):
        first, *rest = ast.unparse(call.func).split(".")
        if first not in names or not all(part.isidentifier() for part in rest):
            continue  # a method of what the block made
        function = names[first]
        for part in rest:
            assert hasattr(function, part), f"{page}: {ast.unparse(call.func)} does not exist"
            function = getattr(function, part)
        given = {keyword.arg: None for keyword in call.keywords}
        with contextlib.suppress(ValueError):  # of a function of C there is no signature
            inspect.signature(function).bind(*call.args, **given)


def test_the_version_is_one_everywhere():
    version = i2t.__version__
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    citation = re.search(r"^version: (\S+)$", (ROOT / "CITATION.cff").read_text(), re.M)
    newest = re.search(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(), re.M)
    assert (project["version"], citation[1], newest[1]) == (version, version, version)


def test_what_is_not_released_has_no_date_of_release():
    citation, changes = (ROOT / "CITATION.cff").read_text(), (ROOT / "CHANGELOG.md").read_text()
    _, state = re.search(r"^## (\S+) \((.+)\)$", changes, re.M).groups()
    dated = re.search(r"^date-released: (\S+)$", citation, re.M)
    assert (dated[1] if dated else "unreleased") == state


def test_the_distribution_says_who_made_it_and_where_the_method_is_from():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    citation = (ROOT / "CITATION.cff").read_text()
    assert [f'  - name: "{author["name"]}"' in citation for author in project["authors"]] == [True]
    assert f'url: "{project["urls"]["Paper"]}"' in citation
    assert (
        f"Programming Language :: Python :: {project['requires-python'].removeprefix('>=')}" in project["classifiers"]
    )


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_to_files_and_named_files_exist(page):
    text = page.read_text()
    for target in re.findall(r"\]\(([^)#\s]+)", text):
        if "://" not in target and not target.startswith("mailto:"):
            assert (page.parent / target).exists(), f"{page.name} links to {target}"
    for path in re.findall(r"`((?:i2t|experiments|tests|examples|notebooks|docs)/[\w./-]+\.(?:py|md|ipynb))`", text):
        assert (ROOT / path).exists(), f"{page.name} names {path}"


def test_tests_that_a_page_names_exist():
    found = [
        (page.name, *named)
        for page in PAGES
        for named in re.findall(r"\b((?:tests/[\w/]+/)?test_\w+\.py)(?:::(\w+))?", page.read_text())
    ]
    assert len([name for *_, name in found if name]) > 20
    for page, file, name in found:
        paths = [ROOT / file] if "/" in file else [*(ROOT / "tests").rglob(file)]
        code = "".join(path.read_text() for path in paths if path.is_file())
        assert code, f"{page} names {file}, which does not exist"
        assert not name or f"def {name}(" in code, f"{page} names {file}::{name}, which does not exist"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_dotted_names_are_those_of_the_code(page):
    for name in set(re.findall(r"`((?:i2t|experiments)(?:\.\w+)+)(?:\([^`]*\))?`", page.read_text())):
        parts = name.split(".")
        for split in range(len(parts), 0, -1):
            module = ".".join(parts[:split])
            with contextlib.suppress(ModuleNotFoundError):
                if importlib.util.find_spec(module):
                    break
        found = importlib.import_module(module)
        for attribute in parts[split:]:
            assert hasattr(found, attribute), f"{page.name}: {name} does not exist"
            found = getattr(found, attribute)
