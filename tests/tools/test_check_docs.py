"""`tools.check_docs` finds a planted fault of each kind with its place, and reports nothing else."""

import json
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from tools.check_docs import __main__ as command
from tools.check_docs import code, linters, numbers, pages
from tools.check_docs.pages import ROOT, PageProblem

SCRIPTS = Path(sys.executable).parent
LINTED = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]
PLANTED = [
    (pages.files, "See `i2t/nowhere.py`.", "i2t/nowhere.py does not exist"),
    (pages.files, "See `i2t/types.py`.", ""),
    (pages.figures, "![short](figures/a.png)", "has no text"),
    (pages.tests, "`test_nowhere.py` shows it.", "no test test_nowhere.py"),
    (pages.tests, "`test_check_docs.py::test_nothing` shows it.", "test_nothing"),
    (pages.tests, "`tests/tools/test_check_docs.py` shows it.", ""),
    (pages.commands, "Say `python -m i2t.nowhere\n--help`.", "no command i2t.nowhere"),
    (pages.commands, "    python -m i2t.rather nothing", "no command i2t.rather"),
    (pages.commands, "```\npython -m i2t.place \\\n  --nothing 3 && true  # a minute\n```", "no option --nothing"),
    (pages.commands, "Say `python -m i2t.place ...`.", "not complete"),
    (pages.commands, "```python\nx = 'python -m i2t.nowhere'\n```\n\n    python -m i2t.place --host h | cat", ""),
    (pages.commands, "Say `i2t nowhere`.", "no command i2t nowhere"),
    (pages.commands, "```\n$ i2t place \\\n  --nothing 3\n```", "i2t place has no option --nothing"),
    (pages.commands, "```\nexport A=1 && i2t convert presses --nothing\n```", "no option --nothing"),
    (pages.commands, "Say `i2t convert presses A B --unit mm` or `i2t`.\n\n    i2t view D --html", ""),
    (pages.tables, "<!-- table: paper methods -->\n| before |\n<!-- end of table -->", "not what docs/results holds"),
    (pages.tables, "<!-- table: all summary -->\n| before |\n<!-- end of table -->", "not what docs/results holds"),
    (pages.tables, "<!-- table: nothing methods -->\n<!-- end of table -->", "no step nothing"),
    (pages.advice, "Type `pip install 'i2t[view]'`.", "names an unknown package or extra"),
    (pages.advice, "Type `pip install 'imagine2touch[view]'`.", "names an unknown package or extra"),
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


def _run(*words, cwd=ROOT):
    """The output of a linter that finds mistakes."""
    done = subprocess.run([str(word) for word in words], capture_output=True, text=True, check=False, cwd=cwd)
    assert done.returncode == 1, done.stdout + done.stderr
    return done.stdout + done.stderr


IMPORTS = {  # of a module that is planted, and which contract forbids them
    "i2t/dataset/planted_upward.py": ("def late():\n    from i2t.recognition.belief import Particles", "floors"),
    "i2t/dataset/planted_relative.py": ("from ..recognition.belief import Particles", "floors"),
    "i2t/planted_package/__init__.py": ("", "floors"),
    "i2t/skin/planted_face.py": ("if TYPE_CHECKING:\n    import i2t", "face"),
    "i2t/skin/planted_test.py": ("from tests.helpers import touches", "library"),
    "i2t/objects/planted_jax.py": ("def late():\n    import jax", "jax"),
    "i2t/hardware/planted_indirect.py": ("import i2t.depth.planted_flax", "jax"),
    "i2t/depth/planted_flax.py": ("from flax import nnx", "jax"),
    "i2t/skin/planted_circle.py": ("from i2t.skin import planted_other", "circles"),
    "i2t/skin/planted_other.py": ("def late():\n    from .planted_circle import name", "circles"),
    "experiments/planted_tool.py": ("from tools import gallery", "experiments"),
    "tools/planted_test.py": ("import tests.conftest", "tools"),
}


def test_imports_against_a_contract_are_found_however_they_are_written(tmp_path):
    for source in (path for name in ("i2t", "experiments", "tools") for path in (ROOT / name).rglob("*.py")):
        copy = tmp_path / source.relative_to(ROOT)
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(source, copy)
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    for path, (source, _) in IMPORTS.items():
        (tmp_path / path).parent.mkdir(exist_ok=True)
        (tmp_path / path).write_text(source)
    report = _run(SCRIPTS / "lint-imports", "--no-cache", "--no-logo", cwd=tmp_path)
    contracts = {each["id"]: each["name"] for each in LINTED["importlinter"]["contracts"]}
    sections = {name: re.split(r"\n.+\n-{9,}\n", report.split(f"\n{name}\n-")[1])[0] for name in contracts.values()}
    for path, (_, contract) in IMPORTS.items():
        module = path.removesuffix(".py").removesuffix("/__init__").replace("/", ".")
        assert module.rpartition(".")[2] in sections[contracts[contract]]
    assert len(set(contracts)) == len({contract for _, contract in IMPORTS.values()})


@pytest.mark.parametrize(
    ("source", "finding"),
    [
        ("import importlib\n\nimportlib.import_module('..belief', __package__)\n", "import_module` is banned"),
        ('def f(a: int, b: int):\n    """Add.\n\n    Args:\n        a: One.\n    """\n', "`b`"),
        (
            'def f(a: int):\n    """Show.\n\n    Args:\n        a: One.\n        c: Three.\n    """\n    print(a)\n',
            "`c`",
        ),
        ('def f(a: int):\n    """Show.\n\n    Returns:\n        It.\n    """\n    print(a)\n', "should not have"),
    ],
)
def test_the_configured_rules_of_ruff_are_active(source, finding):
    words = [sys.executable, "-m", "ruff", "check", "--stdin-filename", "i2t/dataset/planted.py", "-"]
    done = subprocess.run(words, input=source, capture_output=True, text=True, check=False, cwd=ROOT)
    assert finding in done.stdout


def test_a_docstring_without_sections_is_found(tmp_path):
    (finding,) = code.docstrings(tmp_path, "def f(a: int) -> int:\n    'Double.'")
    assert (finding.line, finding.sentence) == (1, "f has no section Args, Returns")
    right = (
        "def _f(a): ...\nclass A:\n    def f(self, a):\n        'Halve, as in `B.f`.'\n    def test_it(self, make): ..."
    )
    assert not list(code.docstrings(tmp_path, right))


def test_links_anchors_and_names_that_lead_nowhere_are_found(tmp_path):
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / "index.md").write_text(
        "# A\n\n[file](nowhere.md) [page](other.md#lost) [here](#gone) `i2t.types.Nothing` [right](other.md#kept)\n"
    )
    (tmp_path / "docs" / "other.md").write_text("# Other\n\n## Kept\n")
    words = [
        "-m",
        "sphinx",
        "-W",
        "--keep-going",
        "-q",
        "-b",
        "dummy",
        "-c",
        ROOT / "docs",
        tmp_path,
        tmp_path / "site",
    ]
    report = _run(sys.executable, *words)
    assert [name for name in ("nowhere.md", "lost", "gone", "i2t.types.Nothing") if name not in report] == []
    assert "kept" not in report


def test_calls_of_missing_names_on_a_page_are_found(tmp_path):
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / "case.md").write_text(
        "# Case\n\n```python\ni2t.nothing()\ni2t.make_object('a', unknown=1)\nmine.say(i2t.DataError)\n```\n"
    )
    for name in ("README", "CONTRIBUTING", "CHANGELOG"):
        (tmp_path / f"{name}.md").touch()
    files = linters.write_code(tmp_path, tmp_path / "code")
    assert len(files) > 40
    report = _run(sys.executable, "-m", "mypy", *[path for path in files if path.stem == "case"])
    assert 'case.py:4: error: Module has no attribute "nothing"' in report
    assert 'case.py:5: error: Unexpected keyword argument "unknown"' in report
    assert "case.py:6" not in report


def test_findings_are_lines_and_the_exit_code(monkeypatch, capsys):
    for module in (pages, numbers, code):
        monkeypatch.setattr(module, "findings", lambda root: [])
    monkeypatch.setattr(linters, "start", lambda root, folder, site: {})
    assert command.main(["--no-site"]) == 0
    monkeypatch.setattr(numbers, "findings", lambda root: [PageProblem(root / "docs" / "a.md", 3, "it is wrong")])
    assert command.main([]) == 1
    assert capsys.readouterr().out.splitlines()[-1] == "docs/a.md:3: it is wrong"
    monkeypatch.setattr(numbers, "findings", lambda root: [])
    monkeypatch.setattr(linters, "start", lambda root, folder, site: {
        "a linter": subprocess.Popen([sys.executable, "-c", "print('b.py:1: wrong, too'); exit(1)"],
                                     stdout=subprocess.PIPE, text=True)})  # fmt: skip
    assert command.main([]) == 1
    assert capsys.readouterr().out.splitlines()[-1] == "a linter: b.py:1: wrong, too"
