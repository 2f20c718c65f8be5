"""Progress is a bar on a terminal and an occasional line in a log."""

import os
import subprocess
import sys
from io import StringIO

import pytest
import tqdm

from i2t.runtime import progress as module
from i2t.runtime.progress import progress


def test_a_log_has_no_redraws(monkeypatch, capsys):
    assert list(progress(range(1000), desc="quick")) == list(range(1000))
    assert capsys.readouterr() == ("", "")
    monkeypatch.setattr(module, "FIRST_LINE_S", 0.0)
    monkeypatch.setattr(module, "LOG_INTERVAL_S", 0.0)
    with progress(total=40, desc="slow", unit="touches") as bar:
        for _ in range(4):
            bar.update(10)
    lines = capsys.readouterr().err.splitlines()
    assert lines[-1].startswith("slow: 40 of 40 touches in 00:00")
    assert all(line.startswith("slow: ") and "\r" not in line for line in lines)


@pytest.fixture
def clock(monkeypatch):
    """A clock that the test advances, as a list with the time in s."""
    now = [0.0]
    monkeypatch.setattr(tqdm.std, "time", lambda: now[0])
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    return now


def test_the_remaining_time_is_estimated_from_the_second_batch_on(clock, capsys):
    """The first batch, which includes compilation, takes 20 s and the others 2 s each."""
    with progress(total=360, desc="simulating", unit="touches") as bar:
        for seconds in (20, *9 * [2]):
            clock[0] += seconds
            bar.update(36)
    assert capsys.readouterr().err == "simulating: 72 of 360 touches in 00:22, 00:16 to go\n"


def test_work_whose_first_batch_is_long_is_reported_without_an_estimate(clock, capsys):
    bar = progress(range(4), desc="pads", unit="fits", at_most=True)
    for number, _ in enumerate(bar):
        clock[0] += 100.0 if number == 0 else 0.0
        bar.refresh()  # as for a message between batches; the first has not ended
        clock[0] += 100.0 if number == 0 else 50.0
        if number == 2:
            break
    lines = ["1 of at most 4 fits in 03:20", "2 of at most 4 fits in 04:10, at most 01:40 to go"]
    assert capsys.readouterr().err.splitlines() == [f"pads: {line}" for line in lines]


def test_a_terminal_has_a_bar(monkeypatch):
    stream = StringIO()
    stream.isatty = lambda: True
    monkeypatch.setattr(sys, "stderr", stream)
    assert list(progress(range(3), desc="three")) == [0, 1, 2]
    assert "three: 100%" in stream.getvalue()
    assert "3/3 steps [" in stream.getvalue()


def test_a_bar_leaves_the_first_batch_out_of_its_estimate(clock, monkeypatch):
    stream = StringIO()
    stream.isatty = lambda: True
    monkeypatch.setattr(sys, "stderr", stream)
    with progress(total=4, desc="training", unit="epochs", at_most=True) as bar:
        for seconds in (30, 1):
            clock[0] += seconds
            bar.update()
    assert "1/4 epochs at most [00:30<?]" in stream.getvalue()
    assert "2/4 epochs at most [00:31<00:02]" in stream.getvalue()


def test_the_environment_silences_it():
    program = "from i2t.runtime.progress import progress; list(progress(range(3), desc='three', mininterval=0))"
    environment = {**os.environ, "TQDM_DISABLE": "1"}
    process = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True
    )
    assert process.stderr == ""


@pytest.mark.parametrize("kind", [module._Bar, module._Lines])
def test_progress_whose_making_was_interrupted_is_closed_in_silence(kind):
    """Ctrl-C may come before tqdm has set its fields; `__del__` must still succeed."""
    kind.__new__(kind).close()
