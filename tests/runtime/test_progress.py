"""Progress is a bar on a terminal and an occasional line in a log."""

import os
import subprocess
import sys
from io import StringIO

import pytest

from i2t.runtime import progress as module
from i2t.runtime.progress import progress


def test_a_log_has_no_redraws(monkeypatch, capsys):
    assert list(progress(range(1000), desc="quick")) == list(range(1000))
    assert capsys.readouterr() == ("", "")
    monkeypatch.setattr(module, "LOG_INTERVAL_S", 0.0)
    with progress(total=40, desc="slow", unit="touch") as bar:
        for _ in range(4):
            bar.update(10)
    lines = capsys.readouterr().err.splitlines()
    assert lines[-1].startswith("slow: 40 of 40 touch in 00:00")
    assert all(line.startswith("slow: ") and "\r" not in line for line in lines)


def test_a_terminal_has_a_bar(monkeypatch):
    stream = StringIO()
    stream.isatty = lambda: True
    monkeypatch.setattr(sys, "stderr", stream)
    assert list(progress(range(3), desc="three")) == [0, 1, 2]
    assert "three: 100%" in stream.getvalue()


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
