"""Commands that installing i2t puts on the path, and the list of those to run from the checkout."""

import importlib
import platform
import re
import tomllib
from importlib import metadata
from pathlib import Path

import pytest

from i2t.cli.commands import COMMANDS, COMMON_COMMANDS, EXPERIMENTS, main

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def test_every_experiment_is_listed():
    commands = {
        ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__main__")
        for pattern in ("experiments/*/__main__.py", "tools/*/__main__.py", "tools/*.py", "tests/*/__main__.py")
        for path in ROOT.glob(pattern)
        if path.name != "__init__.py"
    }
    assert commands == set(EXPERIMENTS)


def test_ten_commands_are_listed_by_default_and_all_on_request(capsys):
    def listed(*words):
        assert main(words) == 0
        return [line.split()[2] for line in capsys.readouterr().out.splitlines() if line.startswith("python")]

    assert len(COMMON_COMMANDS) == 10
    assert sorted(listed()) == sorted(COMMON_COMMANDS)
    assert listed("--all") == [*COMMANDS, *EXPERIMENTS]


def test_versions_name_python_and_each_installed_package_that_is_required(capsys):
    assert main(["--versions"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == f"i2t {PROJECT['version']}"
    listed = {line.split()[0]: line.split()[-1] for line in lines}
    assert listed["Python"] == platform.python_version()
    for requirement in PROJECT["dependencies"]:
        name = re.match(r"[\w-]+", requirement)[0]
        assert listed[name] == metadata.version(name)
    assert "imagine2touch" not in listed


def test_an_installed_command_prints_its_usage(capsys, monkeypatch):
    assert list(PROJECT["scripts"]) == ["i2t-collect", "i2t-convert", "i2t-reskin", "i2t-view"]
    for name, entry in PROJECT["scripts"].items():
        monkeypatch.setattr("sys.argv", [name, "--help"])
        module, function = entry.split(":")
        with pytest.raises(SystemExit) as ended:
            getattr(importlib.import_module(module), function)()
        assert ended.value.code in (0, None)
        assert "usage: python -m i2t." in capsys.readouterr().out
