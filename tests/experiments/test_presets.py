"""Presets are chosen by name, and names of earlier versions are answered by every command that has presets."""

import importlib
import importlib.util
import re
from dataclasses import dataclass
from pathlib import Path

import pytest

from experiments.common.presets import PRESET_NAMES, RENAMED, choose_preset

EXPERIMENTS = Path(__file__).parents[2] / "experiments"
WITH_PRESETS = sorted(
    path.parent.name
    for name in ("arguments.py", "config.py")
    for path in EXPERIMENTS.glob(f"*/{name}")
    if re.search(r"^    preset: ", path.read_text(), re.M)
)


@dataclass(frozen=True)
class Config:
    touches: int = 1000
    seeds: int = 1


def test_a_preset_is_changed_where_something_is_given_and_refused_where_there_is_none():
    presets = {"paper": Config(), "debug": Config(10)}
    assert choose_preset(presets, "debug", seeds=3, touches=None) == Config(10, 3)
    for name, words in {"full": "is called paper now", "nonsense": "is none of paper, debug"}.items():
        with pytest.raises(ValueError, match=f"--preset {name} {words}"):
            choose_preset(presets, name)
    assert set(RENAMED.values()) <= set(PRESET_NAMES)
    assert not set(RENAMED) & set(PRESET_NAMES)


@pytest.mark.parametrize("name", WITH_PRESETS)
def test_every_command_answers_the_old_name(name, capsys):
    module = f"experiments.{name}"
    if importlib.util.find_spec(module).submodule_search_locations:
        module += ".__main__"
    with pytest.raises(SystemExit) as ended:
        importlib.import_module(module).main(["--preset=full", "--out", "x"])
    assert ended.value.code == 2
    assert capsys.readouterr().err == "error: --preset full is called --preset paper now\n"
