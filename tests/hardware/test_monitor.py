"""The text tool of a skin: what it draws and says, recordings and their tables."""

import csv

import numpy as np
import pytest

from i2t.emulators.reskin_board import Readings, started
from i2t.errors import DataError, DeviceError
from i2t.hardware.reskin import monitor, recording
from i2t.hardware.reskin.layouts import Format, encode
from i2t.hardware.reskin.monitor import samples_of, write_table

ATTEMPTS = 20


def recorded(path, readings, form=Format.FRAMED, rate=100.0):
    """A recording of a board."""
    with recording.create(path) as file:
        for i, reading in enumerate(readings):
            recording.append(file, 7.0 + i / rate, encode(reading, np.full(5, 24.0), form, i))
    return path


def at_rest(count, noise=1.0):
    board = Readings(noise, 0.0, None, 0)
    return np.array([board.at(0.0)[0] for _ in range(count)])


def shown(words, capsys, wanted) -> str:
    """What the tool prints once it has heard the board; one that other programs have starved is asked again."""
    for _ in range(ATTEMPTS):
        capsys.readouterr()
        code, said = monitor.main(words), capsys.readouterr().out
        if code == 0 and wanted in said:
            return said
    raise AssertionError(said)


def test_a_recording_becomes_a_table_with_every_sample(tmp_path, capsys):
    readings = at_rest(40)
    readings[10:20, 3:6] = np.nan  # a chip failed on the way
    raw = recorded(tmp_path / "raw", readings)
    samples = samples_of(raw, 5)
    np.testing.assert_allclose(samples.reading, readings.astype(np.float32))
    np.testing.assert_allclose(np.diff(samples.time)[3:], 0.01, atol=1e-9)  # the first three are believed together
    assert monitor.main(["--replay", str(raw), "--record", str(tmp_path / "a.csv")]) == 0
    assert "wrote 40 samples" in capsys.readouterr().out
    with (tmp_path / "a.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0])[:5] == ["time_s", "b0x_uT", "b0y_uT", "b0z_uT", "b1x_uT"]
    assert [row["b1x_uT"] == "" for row in rows] == [10 <= i < 20 for i in range(40)]
    np.testing.assert_allclose([float(row["b4z_uT"]) for row in rows], readings[:, 14], atol=1e-5)
    with pytest.raises(DataError, match="exists already"):
        write_table(tmp_path / "a.csv", samples)
    with pytest.raises(DeviceError, match="frames of 5 chips come, not of 4"):
        samples_of(raw, 4)


def test_what_cannot_be_shown_or_recorded_is_said(tmp_path, capsys):
    (tmp_path / "raw").write_bytes(b"")
    for options, code, why in (
        (["--port", "a", "--replay", str(tmp_path / "raw")], 2, "pass one of them"),
        (["--port", str(tmp_path / "nowhere")], 1, "there is no port"),
        (["--record", str(tmp_path / "a.csv")], 2, "record bytes, and then make the table with --replay"),
        (["--replay", str(tmp_path / "none")], 2, "none"),
    ):
        assert monitor.main(options) == code
        assert why in capsys.readouterr().err


@pytest.mark.parametrize(
    ("noise", "health"), [(1.0, monitor.HEALTHY_TEXT), (0.0, "UNHEALTHY: every chip stands still")]
)
def test_it_draws_a_recording_and_says_whether_the_skin_is_healthy(capsys, monkeypatch, tmp_path, noise, health):
    raw = recorded(tmp_path / "raw", at_rest(800, noise), Format.BINARY, 400.0)
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    said = shown(["--replay", str(raw), "--seconds", "1"], capsys, health)
    assert "replay" in said
    assert "\x1b[21F\x1b[J" in said  # drawn over the last picture


def test_a_bar_ends_in_an_arrow_where_it_is_too_short():
    assert monitor.bar(0.5) == f"{'':16}|########{'':8}"
    assert monitor.bar(-2.0) == f"<{'#' * 15}|{'':16}"
    assert len({len(monitor.bar(part)) for part in (-3.0, -1.0, 0.0, 0.2, 1.0, 9.0)}) == 1


@pytest.mark.full
def test_a_board_is_shown_and_recorded(tmp_path, capsys):
    with started("--board", "grid-2x2", "--format", "framed") as (port, _):
        path = tmp_path / "skin.bytes"
        words = ["--port", port, "--board", "grid-2x2", "--seconds", "1.5", "--record", str(path)]
        assert monitor.main(words) == 0
    said = capsys.readouterr().out
    assert "Hz" in said
    assert "chip" not in said  # one line and no picture where the output is no terminal
    assert samples_of(path, 4).reading.shape[1] == 12
