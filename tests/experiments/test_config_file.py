"""--config: the options of an earlier run, from its config.json."""

import json
import math
import typing
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from experiments.active_touch.arguments import ActiveTouchArgs
from experiments.calibrate.arguments import CalibrateArgs
from experiments.common import runs
from experiments.common.commands import command, command_of_parts
from experiments.common.config_file import config_path, options_of_config
from experiments.common.options import RunOptions
from experiments.fidelity.arguments import FidelityArgs
from experiments.recognize.arguments import DatasetArgs, RecordedArgs, SimulateArgs
from experiments.reconstruct.arguments import PatchArgs, ReconstructArgs
from experiments.registration.arguments import FramesArgs
from experiments.shapes.arguments import ShapesArgs
from experiments.studies.arguments import StudyArgs
from experiments.train.arguments import TrainArgs
from experiments.tsne.arguments import TsneArgs
from i2t.cli.options import Limits, read_options
from i2t.paper.config import PaperOptions

KINDS = (
    ActiveTouchArgs, CalibrateArgs, FidelityArgs, SimulateArgs, DatasetArgs, RecordedArgs, ReconstructArgs, PatchArgs,
    FramesArgs, ShapesArgs, StudyArgs, TrainArgs, TsneArgs,
)  # fmt: skip
WORDS = st.text(st.characters(codec="utf-8"), max_size=8)
FILES = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=8)


def values(hint: Any, limits: Limits | None = None) -> st.SearchStrategy:
    """Any value of an option's type within its limits."""
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    if origin is Annotated:
        return values(parts[0], next((note for note in parts[1:] if isinstance(note, Limits)), limits))
    if is_dataclass(hint):
        return options(hint)
    if origin in (typing.Union, UnionType):
        return st.one_of([values(part, limits) for part in parts])
    if origin is tuple:
        if parts[-1] is Ellipsis:
            return st.lists(values(parts[0], limits), max_size=3).map(tuple)
        return st.tuples(*(values(part, limits) for part in parts))
    if origin is Literal:
        return st.sampled_from(parts)
    if hint is int:
        bounds = (limits or Limits(1)).minimum, (limits or Limits(1)).maximum
        return st.integers(*(int(bound) if math.isfinite(bound) else None for bound in bounds))
    if hint is float:
        return st.floats((limits or Limits(0)).minimum, 1e6, exclude_min=limits is not None and limits.above)
    return {str: WORDS, bool: st.booleans(), type(None): st.none(), Path: FILES.map(Path)}[hint]


def options(kind: Any) -> st.SearchStrategy:
    """Any options of a command, but those that config.json leaves out."""
    hints = typing.get_type_hints(kind, include_extras=True)
    names = [field.name for field in fields(kind) if field.name not in runs.RUN_OPTIONS]
    return st.builds(kind, **{name: values(hints[name]) for name in names})


def write_config(path: Path, args: Any, /, **changes: Any) -> Path:
    """The config.json that `begin` writes, without the experiment."""
    config = runs.settings(args) | {"experiment": {}, "kind": type(args).__name__} | changes
    runs.write_json(path, config)
    return path


@pytest.mark.parametrize("kind", KINDS)
def test_options_survive_config_json(kind, tmp_path_factory):
    path = tmp_path_factory.mktemp("run") / runs.CONFIG

    @settings(max_examples=10, deadline=None)
    @given(args=options(kind))
    def survives(args):
        write_config(path, args)
        given_options = options_of_config(path, kind, "")
        assert given_options == args
        assert read_options(kind, ["--config", str(path)], program="", config=(), default=given_options) == replace(
            args, config=path
        )

    survives()


def test_every_command_that_writes_config_json_is_tested():
    def subclasses(kind):
        return {kind}.union(*map(subclasses, kind.__subclasses__()))

    experiments = {kind for kind in subclasses(RunOptions) if kind.__module__.startswith("experiments.")}
    assert {kind for kind in experiments if "common" not in kind.__module__} == set(KINDS)


def test_the_command_line_overrides_the_file_and_the_file_chooses_the_part(tmp_path, monkeypatch, capsys):
    """The folder of a run names its config.json, and options that it leaves out have their defaults."""
    given_options = []
    monkeypatch.setattr("experiments.common.commands.importlib.import_module", lambda _: Module)

    class Module:
        run = staticmethod(given_options.append)

    train = command(TrainArgs, "experiments.train.run")
    before = TrainArgs(preset="debug", epochs=3, paper=PaperOptions(bottleneck=3), out=tmp_path / "a", workers=2)
    write_config(tmp_path / runs.CONFIG, before)
    out = tmp_path / "b"
    assert train([f"--config={tmp_path}", "--out", str(out), "--epochs", "5", "--paper.encoder-width", "7"]) == 0
    paper = PaperOptions(bottleneck=3, encoder_width=7)
    assert given_options.pop() == TrainArgs(preset="debug", epochs=5, paper=paper, out=out, config=tmp_path)

    parts = {"one": (TsneArgs, "experiments.tsne.run"), "two": (FidelityArgs, "experiments.fidelity.run")}
    main = command_of_parts("experiments.none", parts)
    (tmp_path / "table.csv").write_text("b0x_uT\n1\n")
    path = write_config(tmp_path / "c.json", FidelityArgs(dataset=(tmp_path / "table.csv",), seed=4))
    assert main(["--config", str(path), "--out", str(out)]) == 0
    assert given_options.pop() == FidelityArgs(dataset=(tmp_path / "table.csv",), seed=4, out=out, config=path)
    assert main(["one", "--config", str(path)]) == 2
    capsys.readouterr()
    assert main(["ne", "--config", str(path)]) == 2
    assert capsys.readouterr().err == "error: ne is no part of python -m experiments.none; did you mean one?\n"
    assert config_path(["--dataset", "x"]) is None
    assert config_path([]) is None


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"kind": "TrainArgs"}, "is of a run of another command than python -m experiments.recognize simulate"),
        ({"args": None}, "is not the config.json of a run"),
        ({"args": {"trained_run": "x"}}, "its option --trained-run is called --pad-model now; rename it in the file"),
        ({"args": {"epizodes": 3}}, "its option epizodes is unknown; did you mean episodes?"),
        ({"args": {"colour": 3}}, "its option colour is unknown; delete it from the file"),
        ({"args": {"out": "x"}}, "its option out is unknown; "),
        ({"args": {"episodes": "many"}}, "its option episodes cannot be 'many'; correct it in the file"),
        ({"args": {"method": "none"}}, "its option method cannot be 'none'"),
        ({"args": {"episodes": 0}}, "--episodes is 0; give at least 1"),
    ],
)  # fmt: skip
def test_a_wrong_file_is_refused_in_one_sentence(tmp_path, capsys, changes, problem):
    path = write_config(tmp_path / "c.json", SimulateArgs(), **changes)
    parts = {"simulate": (SimulateArgs, "experiments.recognize.run")}
    code = command_of_parts("experiments.recognize", parts)(["simulate", "--config", str(path)])
    message = capsys.readouterr().err
    assert code == 2
    assert message.count("\n") == 1
    assert problem in message


def test_missing_options_and_files_are_refused(tmp_path, capsys):
    path = write_config(tmp_path / "c.json", SimulateArgs(), kind="DatasetArgs")
    parts = {"dataset": (DatasetArgs, "experiments.recognize.recorded")}
    main = command_of_parts("experiments.recognize", parts)
    config = json.loads(path.read_text())
    path.write_text(json.dumps(config | {"args": {"unit": "mm"}}))
    assert main(["--config", str(path)]) == 2
    assert "its option dataset is missing; add it to the file" in capsys.readouterr().err
    assert main(["--config", str(tmp_path / "none.json")]) == 2
    assert "none.json" in capsys.readouterr().err
