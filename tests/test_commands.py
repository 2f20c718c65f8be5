"""Commands that installing i2t puts on the path."""

import importlib
import tomllib
from pathlib import Path

import pytest

PROJECT = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]


def test_the_commands_are_these():
    assert list(PROJECT["scripts"]) == ["i2t-collect", "i2t-convert", "i2t-reskin", "i2t-view"]


@pytest.mark.parametrize("name", PROJECT["scripts"])
def test_a_command_says_how_it_is_used(name, capsys, monkeypatch):
    monkeypatch.setattr("sys.argv", [name, "--help"])
    module, function = PROJECT["scripts"][name].split(":")
    main = getattr(importlib.import_module(module), function)
    with pytest.raises(SystemExit) as ended:
        main()  # as the installed command calls it
    assert ended.value.code in (0, None)
    assert "usage: python -m i2t." in capsys.readouterr().out
