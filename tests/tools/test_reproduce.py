"""Steps measure each number of the documents' tables once, and tables are written from these numbers."""

import contextlib
import importlib
import io
import json
import shlex
from pathlib import Path
from types import SimpleNamespace

import pytest

from experiments.common.tables import cell, markdown
from tools.reproduce import __main__ as reproduce
from tools.reproduce.shape_tables import PATCH_SCORES
from tools.reproduce.skin_tables import CALIBRATED, GAIN, NEIGHBOURS, PLAIN, SESSIONS
from tools.reproduce.steps import STEPS
from tools.reproduce.tables import ALL_STEPS, TABLES, shortened, table, write_tables

ROOT = Path(__file__).parents[2]


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
        for option in ("--out", *filter(None, [step.again]), *(["--pad-model"] if step.uses else [])):
            assert option in said.getvalue(), f"{step.name}: {option}"


@pytest.fixture
def reproduced(tmp_path, monkeypatch):
    """The command itself, and the commands that it would run, each of which leaves an empty metrics.json."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "docs").mkdir()
    calls = []

    def run(words, env, check):
        calls.append(words[1:])
        folder = Path(words[words.index("--out") + 1])
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "metrics.json").write_text(json.dumps({"sets": {}}))
        return SimpleNamespace(returncode=0)

    monkeypatch.setattr(reproduce.subprocess, "run", run)
    return lambda *words: reproduce.main(["--out", "runs", "--docs", "docs", *words]), calls


def test_steps_run_once_in_order_resume_and_keep_their_measurements(tmp_path, reproduced):
    command, played = reproduced
    (tmp_path / "runs" / "study").mkdir(parents=True)
    (tmp_path / "runs" / "study" / "config.json").write_text("{}")  # begun, not finished
    assert command("--only", "paper", "study") == command("--only", "paper", "study") == 0
    assert [" ".join(words[:2]) for words in played] == ["-m experiments.train", "-m experiments.recognize"]
    assert "--resume" in played[0]
    assert played[1][-2:] == ["--pad-model", "runs/study"]
    assert json.loads((tmp_path / "docs" / "results" / "paper.json").read_text()) == {"step": "paper", "sets": {}}


def test_a_step_without_its_recording_is_left_out(tmp_path, reproduced, monkeypatch, capsys):
    command, played = reproduced
    step = next(step for step in STEPS if step.needs)
    monkeypatch.setattr(reproduce, "STEPS", (step,))
    assert command() == 0
    assert f"{step.name} is left out: it needs {step.needs}" in capsys.readouterr().out
    assert command("--only", step.name) == 2
    assert not played
    (tmp_path / step.needs).mkdir(parents=True)
    assert command() == 0
    assert len(played) == 1


def test_a_step_that_cannot_run_is_reported_in_one_sentence(reproduced, capsys, monkeypatch):
    command, _ = reproduced
    monkeypatch.setattr(reproduce.subprocess, "run", lambda *_, **__: SimpleNamespace(returncode=3))
    for step, said in {"nothing": "no step nothing", "paper": "paper uses study", "study": "exit code 3"}.items():
        assert command("--only", step) == 2
        assert said in capsys.readouterr().err


def test_a_table_is_written_where_it_was_measured_and_only_there(tmp_path):
    page, results = tmp_path / "page.md", tmp_path / "results"
    page.write_text("<!-- table: paper nothing -->\n<!-- end of table -->\n")
    with pytest.raises(ValueError, match="no table 'nothing' of paper"):
        write_tables(tmp_path)
    page.write_text("<!-- table: reconstruct_objects savings -->\n<!-- end of table -->\n")
    with pytest.raises(ValueError, match="reproduce --only reconstruct_objects"):
        write_tables(tmp_path)
    results.mkdir()
    measured = {"less_than_pose": {"reading": {"5": [0.5, 0.4, 0.6]}}}
    (results / "reconstruct_objects.json").write_text(json.dumps(shortened("reconstruct_objects", measured)))
    assert write_tables(tmp_path) == ["page.md: reconstruct_objects savings"]
    before = page.read_text()
    assert "| reading | 0.50 [0.40, 0.60] |" in before
    write_tables(tmp_path)
    assert page.read_text() == before


def test_a_study_s_own_tables_are_kept_with_few_decimals_and_written():
    columns = [{"name": name, "decimals": 2, "signed": False, "percent": False} for name in ("met", "fused")]
    measured = {"bits": {}, "tables": {"auroc": {"columns": columns, "rows": [["air", 0.98765432]]}}}
    kept = shortened("open_set", measured)
    assert kept == {"step": "open_set", "tables": {"auroc": {"columns": columns, "rows": [["air", 0.987654]]}}}
    assert TABLES["open_set"]["auroc"](kept) == "| met | fused |\n| --- | --- |\n| air | 0.99 |"


def test_local_shapes_are_shown_by_source_and_next_to_their_goal():
    names = [name for name, _ in PATCH_SCORES] + ["edge_degrees_median", "edge_mm_median"]
    methods = {name: dict.fromkeys(names, (value, -0.1, 1.1)) for name, value in (("p", 0.2), ("f", 0.3), ("c", 0.4))}
    measured = {
        "edges": 7,
        "methods": methods,
        "sources": {"catalogue": {"objects": 6, "touches": 30, "methods": methods}},
    }
    prior, first, curve = (f"{value} [-0.10, 1.10]" for value in ("0.20", "0.30", "0.40"))
    by_source = TABLES["reconstruct_patch"]["by source"](measured).splitlines()
    assert by_source[2] == "| " + " | ".join(["catalogue (6)", prior, first, curve, first, curve]) + " |"
    assert len(by_source) == 3
    assert TABLES["reconstruct_patch"]["methods"](measured).endswith(
        "| press curve |" + f" {curve} |" * len(PATCH_SCORES) + " 0.52 | 0, 0.4 |"
    )


def test_policies_are_shown_after_some_touches():
    curves = {"accuracy": {"random": [[0.5, 0.4, 0.6]] * 16}}
    assert TABLES["active_touch"]["policies"](curves).splitlines()[2] == "| random |" + " 0.50 [0.40, 0.60] |" * 3


def test_the_table_of_the_readme_is_small_and_has_one_number_a_cell():
    rows = [line.strip("| ").split(" | ") for line in table(ROOT / "docs", ALL_STEPS, "overview").splitlines()]
    head, _, *body = rows
    assert len(head) == 3
    assert len(body) <= 5
    assert all(len(row) == 3 for row in body)
    assert all(text.count("[") <= 1 for row in body for text in row)
    assert sum(row[1] == "not done" for row in body) >= len(body) - 1


def test_cells_by_hand():
    assert cell([0.5, None, None], 2) == "0.50"
    assert cell({"mean": 0.1, "low": -0.1, "high": 0.3}, 2, signed=True) == "+0.10 [-0.10, +0.30]"
    assert markdown(["a", "b"], [["1", "2"]]) == "| a | b |\n| --- | --- |\n| 1 | 2 |"
    assert set(TABLES) <= {step.name for step in STEPS}


def _curve(*means):
    return {
        count: {"mean": x, "low": x - 0.1, "high": x + 0.1} for count, x in zip(("5", "20", "100"), means, strict=True)
    }


def test_presses_that_a_skin_needs_are_a_table_with_intervals_over_blocks():
    methods = {"mean of the presses": _curve(0, 0, 0), NEIGHBOURS: _curve(0.1, 0.2, 0.3), PLAIN: _curve(0.2, 0.3, 0.4)}
    over = {"blocks": 7, "r2": _curve(0.4, 0.5, 0.6), "differences": {GAIN: _curve(0.2, 0.2, 0.2)}}
    measured = {
        "source": "real", "held_out": {"blocks of 6 mm": 80}, "r2": {"blocks of 6 mm": methods},
        "calibrate_over_blocks": {"blocks of 6 mm": over},
        "inside_90": {"blocks of 6 mm": {CALIBRATED: _curve(0.9, 0.91, 0.92)}},
    }  # fmt: skip
    head, _, *rows = TABLES["calibrate"]["whole blocks"](shortened("calibrate", measured)).splitlines()
    title = "R² on 80 held-out presses in whole blocks, real [95 % over 7 blocks]"
    assert head == f"| {title} | 5 presses | 20 presses | 100 presses |"
    assert rows[0] == f"| {NEIGHBOURS} | 0.100 | 0.200 | 0.300 |"
    assert rows[2].startswith(f"| `{CALIBRATED}` | 0.400 [0.300, 0.500] |")
    assert "| +0.200 [+0.100, +0.300] |" in rows[3]


def test_kinds_of_simulated_skins_are_rows_with_gains():
    case = {"r2": {CALIBRATED: _curve(0.4, 0.5, 0.6)}, "differences": {GAIN: _curve(0.2, 0.2, 0.2)},
            "inside_90": _curve(0.84, 0.9, 0.92)}  # fmt: skip
    table = TABLES["calibrate_simulated"]["kinds of skin"]({"source": "simulated", "cases": {"weak, force": case}})
    assert table.splitlines()[-1].startswith("| weak, force | 0.40, +0.20 [+0.10, +0.30] |")
    assert table.endswith("| 0.84 to 0.92 |")


def _session(shear=False):
    score = {"rmse": 0.5, "inside_90": 0.95}
    test = {"kept": score, "baselines": {"k nearest readings": score, "linear": score}}
    splits = dict.fromkeys(("random rows", "whole blocks or strokes", "later in time"), test)
    noise = {"xy_uT": 2.0, "z_uT": 4.0, "how": "rows in air", "simulator": {"xy_uT": 3.1, "z_uT": 4.6}}
    return {
        "Overview": {"rows": 10, "known": {}},
        "Noise and drift": {"noise": noise, "drift": {"median_uT": 1.0, "largest_uT": 2.0, "simulator_uT": 4.0}},
        "Hysteresis and creep": {} if shear else {"hysteresis": {"loop_share": [0.1, 0.3], "left_share": [0.0]}},
        "Repeatability": {"repeat_std_uT": [3.0, 4.0], "r2_repeatability_limit": 0.9},
        "Heads": {"sentences": [], "heads": dict.fromkeys(("position", "travel", "force", "shear"), splits)},
    }


def test_a_report_on_recordings_is_kept_for_two_tables():
    measured = {"recordings": {name: _session(shear=title == "`shear`") for name, title in SESSIONS.items()}}
    kept = shortened("fidelity", measured)
    assert "known" not in json.dumps(kept)
    assert "sentences" not in json.dumps(kept)
    heads = TABLES["fidelity"]["heads"](kept).splitlines()
    assert [line.split("|")[1].strip() for line in heads[2:]] == [
        "`spatial`, position (mm)", "`spatial`, travel (mm)",
        "`normal`, first, force (N)", "`normal`, second, force (N)",
        "`shear`, shear (N)",
    ]  # fmt: skip
    assert heads[2].count("0.500 (0.95), 0.500 |") == 3
    sessions = TABLES["fidelity"]["sessions"](kept)
    assert (
        "| stroke hysteresis, remainder after the stroke | 0.200, 0.000 | 0.200, 0.000 | 0.200, 0.000 | - | 0, 0 |"
        in sessions
    )
    assert "| 3.5, 0.900 |" in sessions
    assert "creep" not in sessions  # of none
