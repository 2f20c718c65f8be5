"""README and docs are true: their commands exist, with the options that they print, their links lead somewhere, and
their names are those of the code.
"""

import contextlib
import importlib
import importlib.util
import io
import re
import shlex
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").glob("*.md"))]
FENCE = re.compile(r"^```([a-z]*)\n(.*?)^```", re.M | re.S)
SUBCOMMANDS = re.compile(r"^\s*[│|]?\s*\{([\w,-]+)\}|^[│|]\s+([a-z][\w-]+)\s", re.M)


def _commands(page: Path) -> list[list[str]]:
    """The words of each `python -m` command in a page's fenced blocks."""
    found = []
    for language, block in FENCE.findall(page.read_text()):
        if language in ("", "bash", "sh", "console"):
            for line in block.replace("\\\n", " ").splitlines():
                for part in re.split(r"&&|;", line.split("  #")[0]):
                    words = (
                        shlex.split(part, comments=True) if "'" in part or '"' in part else part.split("#")[0].split()
                    )
                    if words[:2] == ["python", "-m"] and words[2].split(".")[0] in ("i2t", "experiments"):
                        found.append(words[2:])
    return found


COMMANDS = sorted({(page.name, tuple(words)) for page in PAGES for words in _commands(page)})


@cache
def _help(module: str, subcommand: str | None) -> str:
    entry = f"{module}.__main__" if importlib.util.find_spec(module).submodule_search_locations else module
    main = importlib.import_module(entry).main
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


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_to_files_and_named_files_exist(page):
    text = page.read_text()
    for target in re.findall(r"\]\(([^)#\s]+)", text):
        if "://" not in target and not target.startswith("mailto:"):
            assert (page.parent / target).exists(), f"{page.name} links to {target}"
    for path in re.findall(r"`((?:i2t|experiments|tests|examples|notebooks|docs)/[\w./-]+\.(?:py|md|ipynb))`", text):
        assert (ROOT / path).exists(), f"{page.name} names {path}"


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
