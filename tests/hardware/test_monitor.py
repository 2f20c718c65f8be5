"""The text tool of a skin: its display, its messages, and the table that it saves."""

import csv

import numpy as np
import pytest

from i2t.emulators.reskin_board import Readings, run_board
from i2t.hardware.protocols import Samples, SkinCounters
from i2t.hardware.reskin import monitor

ATTEMPTS = 20


def shown(words, capsys, wanted) -> str:
    """Output of the tool once it has read the board; repeated if other programs starve it."""
    for _ in range(ATTEMPTS):
        capsys.readouterr()
        code, output = monitor.main(words), capsys.readouterr().out
        if code == 0 and wanted in output:
            return output
    raise AssertionError(output)


def test_a_table_lists_each_chip_s_change_and_missing_chips():
    reading = np.where(np.arange(6) < 3, np.arange(60.0).reshape(10, 6), np.nan)
    samples = Samples(np.arange(10), np.arange(10) / 400, reading, np.tile([24.0, np.nan], (10, 1)))
    lines = monitor.table(SkinCounters(samples=90, lost=10, rate=400.0), samples, np.full(6, 27.0))
    assert "400.0 Hz  90 samples  lost 10 (10.00 %)" in lines[0]
    assert lines[2].split() == ["0", "+0.0", "+1.0", "+2.0", "24.0"]
    assert lines[3].split() == ["1", "missing"]
    assert lines[4] == "change of all: 2.2 uT"


@pytest.mark.parametrize(("noise", "health"), [("1", "healthy at rest"), ("0", "UNHEALTHY: chip 0 stands still")])
def test_a_board_is_drawn_kept_and_judged(capsys, monkeypatch, tmp_path, noise, health):
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    with run_board("--noise", noise, "--fail", "1") as (port, _):
        output = shown(["--port", port, "--seconds", "1"], capsys, health)
        assert "emulated  binary" in output
        assert "missing" in output
        assert "\x1b[9F\x1b[J" in output  # drawn over the last table
        path = tmp_path / "a.csv"
        shown(["--port", port, "--seconds", "0.5", "--record", str(path)], capsys, "Hz")
        assert monitor.main(["--port", port, "--seconds", "0.5", "--record", str(path)]) == 2
        assert "exists" in capsys.readouterr().err
    rows = list(csv.DictReader(path.read_text().splitlines()))
    assert list(rows[0])[:5] == ["time_s", "b0x_uT", "b0y_uT", "b0z_uT", "b1x_uT"]
    assert {row["b1x_uT"] for row in rows} == {""}
    rest = Readings(0.0, 0.0, 0).at(0.0)[0]
    np.testing.assert_allclose(np.mean([float(row["b4z_uT"]) for row in rows]), rest[14], atol=5)
    steps = np.diff([float(row["time_s"]) for row in rows])
    assert len(rows) > 20  # of every sample one
    assert (steps >= 0).all()
