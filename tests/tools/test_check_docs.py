"""`tools.check_docs` finds a planted fault of each kind, says where it is, and says nothing of what is right."""

import ast
import json
import textwrap

import pytest

from tools.check_docs import __main__ as command
from tools.check_docs import code, numbers, pages
from tools.check_docs.pages import ROOT, Finding

PLANTED = [
    (pages.links, "See [it](nowhere.md).", "nowhere.md does not exist"),
    (pages.links, "See `i2t/nowhere.py`.", "i2t/nowhere.py does not exist"),
    (pages.links, "See [it](start.md), [that](https://example.org/x) and `i2t/types.py`.", ""),
    (pages.anchors, "See [it](limits.md#nowhere) and [that](#here).\n\n## Here", "limits.md has no heading nowhere"),
    (pages.anchors, "See [it](recognition.md#how-sure-it-is) and [that](#it-is-here).\n\n## It is here!", ""),
    (pages.figures, "![short](figures/a.png)", "has no text"),
    (pages.tests, "`test_nowhere.py` shows it.", "no test test_nowhere.py"),
    (pages.tests, "`test_check_docs.py::test_nothing` shows it.", "test_nothing"),
    (pages.tests, "`tests/tools/test_check_docs.py` shows it.", ""),
    (pages.names, "`i2t.types.Nothing` is taken.", "i2t.types.Nothing does not exist"),
    (pages.names, "`i2t.types.Patch` and `i2t.press(pad)` are taken.", ""),
    (pages.commands, "Say `python -m i2t.nowhere\n--help`.", "no command i2t.nowhere"),
    (pages.commands, "    python -m i2t.rather nothing", "no command i2t.rather"),
    (pages.commands, "```\npython -m i2t.place \\\n  --nothing 3 && true  # a minute\n```", "no option --nothing"),
    (pages.commands, "Say `python -m i2t.place ...`.", "not complete"),
    (pages.commands, "```python\nx = 'python -m i2t.nowhere'\n```\n\n    python -m i2t.place --host h | cat", ""),
    (pages.python, "```python\ni2t.nothing()\n```", "i2t.nothing does not exist"),
    (pages.python, "```python\ni2t.make_object('a', unknown=1)\n```", "unknown"),
    (pages.python, "```python\ni2t.make_object('a').mesh.anything()\n```", ""),
    (pages.tables, "<!-- table: paper methods -->\n| before |\n<!-- end of table -->", "not what docs/results holds"),
    (pages.tables, "<!-- table: all summary -->\n| before |\n<!-- end of table -->", "not what docs/results holds"),
    (pages.tables, "<!-- table: nothing methods -->\n<!-- end of table -->", "no step nothing"),
    (pages.advice, "Type `pip install 'i2t[view]'`.", "installs what there is not"),
    (pages.advice, "Type `pip install -e '.[view]'`.", ""),
    (numbers.numbers, "It reaches .83.", "no table holds the number .83"),
    (numbers.numbers, "It reaches .83 and 12 %.\n\n| a | 0.826 |\n| b | 0.118 |", ""),
    (numbers.numbers, "It reaches .83.\n\n| a | 0.841 |", "number .83"),
    (numbers.numbers, "It takes 93 s for 4321 touches of 0.25 mm.\n\n| 93 s |\n\n| 4321 | 0.25 |", ""),
    (numbers.numbers, "It takes 93 s.", "93 s"),
    (numbers.numbers, "A *4.8 mm* tip, 48 x 48 pixels, 300 touches, 95 %, Python 3.11, `0.123`, $0.123$ (2019).", ""),
    (pages.notebook, json.dumps({"cells": [{"cell_type": "code", "source": ["from experiments import a"],
                                            "outputs": [1], "execution_count": 1}]}), "outputs"),
]  # fmt: skip


@pytest.mark.parametrize(("check", "text", "said"), PLANTED)
def test_a_planted_fault_of_a_page_is_found(check, text, said):
    page = ROOT / "docs" / "start.md"
    found = list(check(page, f"\n{text}\n"))
    assert bool(found) == bool(said)
    assert said in " ".join(each.sentence for each in found)
    assert all(each.path == page and 1 <= each.line <= 2 + text.count("\n") for each in found)


def _trees(**sources: str) -> dict[str, ast.Module]:
    return {name.replace("__", "."): ast.parse(textwrap.dedent(source)) for name, source in sources.items()}


@pytest.mark.parametrize(
    "source",
    [
        "from i2t.recognition import belief",
        "from ..recognition.belief import Particles",
        "from .. import ObjectRecognizer",
        "import_module('..recognition.belief', __package__)",
        "def late():\n    from i2t.recognition.belief import Particles",
        "if TYPE_CHECKING:\n    import i2t",
        "from tests.helpers import touches",
    ],
)
def test_an_import_upwards_is_found_however_it_is_written(source):
    trees = _trees(i2t__dataset__case=source, i2t__recognition__belief="")
    assert [name for name, *_ in code.floors(trees)] == ["i2t.dataset.case"]
    below = _trees(i2t__dataset__case="import numpy\nfrom ..types import Array\nfrom . import files", i2t__types="")
    assert not list(code.floors(below))


def test_a_circle_is_found_however_it_is_written():
    one = "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from .two import B"
    trees = _trees(i2t__dataset__one=one, i2t__dataset__two="def f():\n    from i2t.dataset import one")
    ((_, _, said),) = code.circle(trees)
    assert "i2t.dataset.one -> i2t.dataset.two -> i2t.dataset.one" in said


def test_what_a_docstring_leaves_out_is_found():
    source = '''
    def f(a: int, b: int) -> int:
        """Add.

        Args:
            a: One.
        """
    '''
    ((_, line, said),) = code.docstrings(_trees(i2t__case=source))
    assert (line, said) == (2, "f does not say b, return")


def test_findings_are_lines_and_the_exit_code(monkeypatch, capsys):
    for module in (pages, numbers, code):
        monkeypatch.setattr(module, "findings", lambda root: [])
    assert command.main(["--no-site"]) == 0
    monkeypatch.setattr(pages, "site", lambda root: [Finding(root / "docs" / "a.md", 3, "it is wrong")])
    assert command.main([]) == 1
    assert capsys.readouterr().out.splitlines()[-1] == "docs/a.md:3: it is wrong"
