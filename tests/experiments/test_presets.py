"""Presets are chosen by name, and names of earlier versions are answered."""

import importlib
import importlib.util
import re
from dataclasses import dataclass
from pathlib import Path

import pytest

from experiments.common.presets import PRESET_NAMES, RENAMED, answer_renamed_value, choose_preset


@dataclass(frozen=True)
class Config:
    touches: int = 1000
    seeds: int = 1


PRESETS = {"paper": Config(), "debug": Config(10)}


def test_a_preset_is_changed_where_something_is_given() -> None:
    assert choose_preset(PRESETS, "debug") == Config(10)
    assert choose_preset(PRESETS, "debug", seeds=3, touches=None) == Config(10, 3)
    assert PRESETS["debug"] == Config(10)


@pytest.mark.parametrize(("name", "words"), [("full", "is called paper now"), ("nonsense", "is none of paper, debug")])
def test_presets_that_are_not_there_are_refused(name: str, words: str) -> None:
    with pytest.raises(ValueError, match=f"--preset {name} {words}"):
        choose_preset(PRESETS, name)


def test_names_of_earlier_versions_lead_to_todays() -> None:
    assert set(RENAMED.values()) <= set(PRESET_NAMES)
    assert not set(RENAMED) & set(PRESET_NAMES)


@pytest.mark.parametrize("argv", [["--preset", "full"], ["--preset=full", "--out", "x"]])
def test_a_renamed_value_is_answered(argv: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        answer_renamed_value(argv, "--preset", RENAMED)
    assert end.value.code == 2
    assert "--preset full is called --preset paper now" in capsys.readouterr().err


def test_other_values_pass() -> None:
    answer_renamed_value(["--preset", "paper", "--out", "full"], "--preset", RENAMED)


def _commands_with_presets() -> list[str]:
    """Folders of experiments whose options have a preset."""
    root = Path(__file__).parents[2] / "experiments"
    options = [*root.glob("*/arguments.py"), *root.glob("*/config.py")]
    return sorted({path.parent.name for path in options if re.search(r"^    preset: ", path.read_text(), re.M)})


def test_commands_are_found_in_the_tree() -> None:
    assert {"active_touch", "calibrate", "faults", "second_world", "train"} <= set(_commands_with_presets())


@pytest.mark.parametrize("name", _commands_with_presets())
def test_every_command_answers_the_old_name(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    module = f"experiments.{name}"
    if importlib.util.find_spec(module).submodule_search_locations:
        module += ".__main__"
    with pytest.raises(SystemExit) as ended:
        importlib.import_module(module).main(["--preset", "full"])
    assert ended.value.code == 2
    assert capsys.readouterr().err == "error: --preset full is called --preset paper now\n"
