"""The tables of the documents are what was measured, by the commands that they print."""

import contextlib
import importlib
import io
import json
import re
import shlex
from pathlib import Path
from types import SimpleNamespace

import pytest

from experiments.reproduce import __main__ as reproduce
from experiments.reproduce.steps import STEPS
from experiments.reproduce.tables import MARK, TABLES, estimate, markdown, shortened, table, write_tables

DOCS = Path(__file__).parents[2] / "docs"
PAGES = sorted([*DOCS.glob("*.md"), DOCS.parent / "README.md"])


def _shown():
    return [(page, *found) for page in PAGES for found in MARK.findall(page.read_text())]


@pytest.mark.parametrize(("page", "text", "step", "name", "end"), _shown())
def test_a_table_is_what_was_measured(page, text, step, name, end):
    assert text + table(DOCS, step, name, page.name) + "\n" + end in page.read_text()


def test_every_table_has_its_command_on_its_page():
    commands = {step.name: f"python {step.command}" for step in STEPS}
    for page, _, step, _, _ in _shown():
        assert commands[step] in page.read_text(), f"{page.name} shows {step} without its command"


def test_every_step_is_a_command_that_takes_these_arguments():
    """The words of each step are options of its command."""
    for step in STEPS:
        _, module, *words = shlex.split(step.command)
        try:
            command = importlib.import_module(f"{module}.__main__")
        except ModuleNotFoundError:
            command = importlib.import_module(module)
        said = io.StringIO()
        if module == "experiments.recognize" and "simulate" not in words:
            words = ["simulate", *words]  # what the command does when it is not told
        with contextlib.redirect_stdout(said), pytest.raises(SystemExit) as ended:
            command.main([*words, "--help"])
        assert ended.value.code == 0
        for option in ("--out", *filter(None, [step.again]), *(["--trained-run"] if step.uses else [])):
            assert option in said.getvalue(), f"{step.name}: {option}"


def test_every_step_is_printed_in_the_documents():
    """Perhaps with further options, such as folders."""
    text = "\n".join(page.read_text() for page in PAGES)
    printed = [shlex.split(line, comments=True)[1:] for line in re.findall(r"python -m experiments\.[^`\n]+", text)]
    for step in STEPS:
        words = set(shlex.split(step.command))
        assert any(words <= set(line) for line in printed), f"no page prints python {step.command}"


def test_a_step_whose_recording_is_not_there_is_left_out(tmp_path, played, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    step = next(step for step in STEPS if step.needs)
    monkeypatch.setattr(reproduce, "STEPS", (step,))
    assert reproduce.main(_args(tmp_path)) == 0
    assert f"{step.name} is left out: it needs the folder {step.needs}" in capsys.readouterr().out
    assert reproduce.main(_args(tmp_path, "--only", step.name)) == 2
    assert f"needs the folder {step.needs}, which is not there" in capsys.readouterr().err
    assert not played
    (tmp_path / step.needs).mkdir(parents=True)
    assert reproduce.main(_args(tmp_path)) == 0
    assert len(played) == 1


def _args(tmp_path, *words):
    return ["--out", str(tmp_path / "runs"), "--docs", str(tmp_path / "docs"), *words]


@pytest.fixture
def played(tmp_path, monkeypatch):
    """Commands that would run, each leaving an empty metrics.json."""
    (tmp_path / "docs").mkdir()
    calls = []

    def run(words, env, check):
        calls.append(words[1:])
        folder = Path(words[words.index("--out") + 1])
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "metrics.json").write_text(json.dumps({"sets": {}}))
        return SimpleNamespace(returncode=0)

    monkeypatch.setattr(reproduce.subprocess, "run", run)
    return calls


def test_steps_run_once_in_order_and_keep_what_they_measured(tmp_path, played):
    assert reproduce.main(_args(tmp_path, "--only", "paper", "study")) == 0
    assert [" ".join(words[:2]) for words in played] == ["-m experiments.train", "-m experiments.recognize"]
    assert played[1][-2:] == ["--trained-run", str(tmp_path / "runs" / "study")]
    assert json.loads((tmp_path / "docs" / "results" / "paper.json").read_text()) == {"step": "paper", "sets": {}}
    assert reproduce.main(_args(tmp_path, "--only", "paper", "study")) == 0
    assert len(played) == 2


def test_an_unfinished_step_goes_on(tmp_path, played):
    (tmp_path / "runs" / "study").mkdir(parents=True)
    (tmp_path / "runs" / "study" / "config.json").write_text("{}")
    assert reproduce.main(_args(tmp_path, "--only", "study")) == 0
    assert "--resume" in played[0]


def test_what_cannot_run_is_said_in_one_sentence(tmp_path, capsys, monkeypatch):
    assert reproduce.main(_args(tmp_path, "--only", "nothing")) == 2
    assert "there is no step nothing" in capsys.readouterr().err
    assert reproduce.main(_args(tmp_path, "--only", "paper")) == 2
    assert "paper uses study, which is not there" in capsys.readouterr().err
    monkeypatch.setattr(reproduce.subprocess, "run", lambda *_, **__: SimpleNamespace(returncode=3))
    assert reproduce.main(_args(tmp_path, "--only", "study")) == 2
    assert "study ended with exit code 3" in capsys.readouterr().err


def test_the_list_says_what_is_done(tmp_path, capsys):
    (tmp_path / "runs" / "study").mkdir(parents=True)
    (tmp_path / "runs" / "study" / "metrics.json").write_text("{}")
    assert reproduce.main(_args(tmp_path, "--list")) == 0
    said = capsys.readouterr().out.splitlines()
    assert len(said) == len(STEPS)
    assert "done" in said[1]
    assert "min" in said[2]


def test_a_page_that_asks_for_what_is_not_there_is_told(tmp_path):
    docs = tmp_path / "docs"
    docs.mkdir()
    (docs / "page.md").write_text("<!-- table: paper nothing -->\n<!-- end of table -->\n")
    with pytest.raises(ValueError, match="no table 'nothing' of paper"):
        write_tables(docs)
    (docs / "page.md").write_text("<!-- table: paper mean -->\n<!-- end of table -->\n")
    with pytest.raises(ValueError, match="reproduce --only paper"):
        write_tables(docs)
    (docs / "results").mkdir()
    measured = {"mean of the sets": {"votes": {"mean": 0.5, "low": 0.4, "high": 0.6}}}
    (docs / "results" / "paper.json").write_text(json.dumps(shortened("paper", measured)))
    assert write_tables(docs) == ["page.md: paper mean"]
    assert "| votes | 0.500 [0.400, 0.600] |" in (docs / "page.md").read_text()
    before = (docs / "page.md").read_text()
    write_tables(docs)
    assert (docs / "page.md").read_text() == before


def test_a_table_that_is_to_come_keeps_what_is_there_until_it_was_measured(tmp_path):
    docs = tmp_path / "docs"
    (docs / "results").mkdir(parents=True)
    text = "<!-- table to come: sites bits -->\n| of before |\n<!-- end of table -->\n"
    (docs / "page.md").write_text(text)
    assert write_tables(docs) == []
    assert (docs / "page.md").read_text() == text
    columns = [{"name": name, "decimals": 2, "signed": False, "percent": False} for name in ("met", "fused")]
    measured = {"bits": {}, "tables": {"bits": {"columns": columns, "rows": [["air", 0.98765432]]}}}
    kept = shortened("sites", measured)
    assert kept == {"step": "sites", "tables": {"bits": {"columns": columns, "rows": [["air", 0.987654]]}}}
    (docs / "results" / "sites.json").write_text(json.dumps(kept))
    assert write_tables(docs) == ["page.md: sites bits"]
    rows = "| met | fused |\n| --- | --- |\n| air | 0.99 |\n"
    assert (docs / "page.md").read_text() == f"<!-- table: sites bits -->\n{rows}<!-- end of table -->\n"


def test_cells_by_hand():
    assert estimate([0.5, None, None], 2) == "0.50"
    assert estimate({"mean": 0.1, "low": -0.1, "high": 0.3}, 2, sign=True) == "+0.10 [-0.10, +0.30]"
    assert markdown(["a", "b"], [["1", "2"]]) == "| a | b |\n| --- | --- |\n| 1 | 2 |"
    assert set(TABLES) <= {step.name for step in STEPS}
