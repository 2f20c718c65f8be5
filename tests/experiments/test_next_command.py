"""What a finished command prints last: where its results are, and a command that exists."""

import importlib
import importlib.util
import pkgutil
import shlex
from pathlib import Path

import pytest

import experiments
from experiments.common.checks import with_trained_run
from experiments.common.commands import say_where
from experiments.common.runs import METRICS

OPTIONS = [
    options
    for module in pkgutil.iter_modules(experiments.__path__, "experiments.")
    for name in ("arguments", "config")
    if module.ispkg and importlib.util.find_spec(f"{module.name}.{name}")
    for options in vars(importlib.import_module(f"{module.name}.{name}")).values()
    if isinstance(options, type) and "next_command" in vars(options)
]


def test_results_pictures_and_the_next_command_are_named_where_there_are_any(tmp_path, capsys):
    say_where(tmp_path, "python -m experiments.train")
    assert capsys.readouterr().out == ""
    (tmp_path / METRICS).write_text("{}")
    (tmp_path / "curves.png").touch()
    say_where(tmp_path, "python -m experiments.train")
    said = capsys.readouterr().out
    assert said == f"\nresults and pictures (curves.png) are in {tmp_path}\nnext: python -m experiments.train\n"


def test_a_run_of_training_is_suggested_first_where_there_is_none(tmp_path):
    study = "python -m experiments.studies open_set"
    assert with_trained_run(study, tmp_path) == f"python -m experiments.train --out {tmp_path}"
    (tmp_path / METRICS).write_text("{}")
    assert with_trained_run(study, tmp_path) == f"{study} --trained-run {tmp_path}"


class Named:
    """Options whose every value is a word; there is one skin, which needs no name."""

    skin_name = None

    def __getattr__(self, name: str) -> str:
        return "x"


@pytest.mark.parametrize("options", OPTIONS, ids=lambda options: options.__module__)
def test_what_is_suggested_can_be_typed(options):
    """Its words name a command of this package, and options it has."""
    python, dash, module, *words = shlex.split(vars(options)["next_command"].fget(Named()))
    assert (python, dash) == ("python", "-m")
    found = importlib.util.find_spec(module)
    origin = Path(found.origin)
    files = origin.parent.glob("*.py") if found.submodule_search_locations else [origin]
    source = "\n".join(file.read_text() for file in files)
    flags = [word.removeprefix("--").replace("-", "_") for word in words if word.startswith("--") and word != "--help"]
    assert not [flag for flag in flags if f"    {flag}: " not in source]
