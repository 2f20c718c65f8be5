"""What a finished command prints last: where its results are, and a command that can be typed."""

from pathlib import Path

import pytest

from experiments.calibrate.arguments import CalibrateArgs
from experiments.common.commands import print_outcome
from experiments.common.runs import METRICS
from experiments.recognize.arguments import DatasetArgs, SimulateArgs
from experiments.train.arguments import TrainArgs
from tools.check_docs import pages


def test_results_pictures_and_the_next_command_are_named_where_there_are_any(tmp_path, capsys):
    print_outcome(tmp_path, "python -m experiments.train")
    assert capsys.readouterr().out == ""
    (tmp_path / METRICS).write_text("{}")
    (tmp_path / "curves.png").touch()
    print_outcome(tmp_path, "python -m experiments.train")
    said = capsys.readouterr().out
    assert said == f"\nresults and pictures (curves.png) are in {tmp_path}\nnext: python -m experiments.train\n"


RECORDED = {"dataset": Path("DATA")}


@pytest.mark.parametrize(
    ("options", "given"),
    [
        (TrainArgs, {}), (TrainArgs, RECORDED), (SimulateArgs, {}), (DatasetArgs, RECORDED), (CalibrateArgs, {}),
        (CalibrateArgs, RECORDED),
    ],
)  # fmt: skip
def test_suggested_commands_can_be_typed(options, given, tmp_path):
    """After a calibration with a known tip, a pad of the same presses is suggested; without presses, nothing."""
    (tmp_path / METRICS).write_text('{"tip": "sphere:4"}')
    suggested = options(out=tmp_path, **given).next_command
    assert bool(suggested) == (options is not CalibrateArgs or bool(given))
    assert not list(pages.commands(pages.ROOT / "README.md", f"    {suggested}\n"))
