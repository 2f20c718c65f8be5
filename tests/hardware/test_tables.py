"""Streams as tables, the map of the chips, several boards and keys of the monitor."""

import csv
import io
import sys
import time

import numpy as np
import pytest

from i2t.emulators.reskin_board import Readings, started
from i2t.errors import DataError, DeviceError
from i2t.hardware.reskin import keys, monitor, recording
from i2t.hardware.reskin.layouts import Format, encode
from i2t.hardware.reskin.tables import samples_of, write_table
from i2t.skin.boards import make_board

CELSIUS = np.full(5, 24.0)
ATTEMPTS = 20


def recorded(path, count=40):
    """A recording of a board at 100 Hz, and what it measured; one chip failed on the way."""
    board = Readings(1.0, 0.0, None, 0)
    readings = np.array([board.at(0.0)[0] for _ in range(count)])
    readings[10:20, 3:6] = np.nan
    with recording.create(path) as file:
        for i, reading in enumerate(readings):
            recording.append(file, 7.0 + 0.01 * i, encode(reading, CELSIUS, Format.FRAMED, i))
    return readings


def test_a_recording_becomes_a_table_with_every_sample(tmp_path, capsys):
    readings = recorded(tmp_path / "raw")
    samples = samples_of(tmp_path / "raw", 5, 400.0)
    np.testing.assert_allclose(samples.reading, readings.astype(np.float32))
    np.testing.assert_allclose(np.diff(samples.time)[3:], 0.01, atol=1e-9)  # the first three are believed together
    for name in ("a.csv", "a.npz"):
        assert monitor.main(["--replay", str(tmp_path / "raw"), "--record", str(tmp_path / name)]) == 0
        assert "wrote 40 samples" in capsys.readouterr().out
    with (tmp_path / "a.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0])[:5] == ["time_s", "b0x_uT", "b0y_uT", "b0z_uT", "b1x_uT"]
    assert [row["b1x_uT"] == "" for row in rows] == [10 <= i < 20 for i in range(40)]
    np.testing.assert_allclose([float(row["b4z_uT"]) for row in rows], readings[:, 14], atol=1e-5)
    with np.load(tmp_path / "a.npz", allow_pickle=False) as arrays:
        np.testing.assert_allclose(arrays["reading_uT"], readings.astype(np.float32))
        assert np.isnan(arrays["began_unix"])
    with pytest.raises(DataError, match="exists already"):
        write_table(tmp_path / "a.csv", samples)
    with pytest.raises(DeviceError, match="frames of 5 chips come, not of 4"):
        samples_of(tmp_path / "raw", 4, 400.0)


def test_what_the_monitor_cannot_record_is_said_first(tmp_path, capsys):
    recorded(tmp_path / "raw")
    (tmp_path / "b-2.csv").write_text("")
    for options, why in (
        (["--port", "a", "--port", "b", "--record", str(tmp_path / "b.csv")], "b-2.csv: exists already"),
        (["--port", "a", "--port", "a"], "names one board twice"),
        (["--port", "a", "--replay", str(tmp_path / "raw")], "pass one of them"),
    ):
        assert monitor.main(options) == 2
        assert why in capsys.readouterr().err


def test_the_map_shows_chips_where_they_lie():
    board = make_board("reskin")
    field = np.zeros((5, 3))
    field[0], field[1], field[2] = (0, 0, 50), (100, 0, -3), (0, 30, 0)  # centre, +x, +y
    change = np.asarray(board.to_board(field)).ravel()
    change[9:12] = np.nan  # -y
    lines = [line for line in monitor.map_picture(board, change, scale=100.0) if line]
    assert [line.split() for line in lines] == [["↑", "+0"], [".", "+0", ".", "+50", "⇒", "-3"], ["missing"]]


def test_the_first_samples_are_taken_anew_on_request():
    rest = monitor._EarlyRest()
    samples = samples_like(np.full((20, 15), 3.0))
    assert rest(samples)[0][0] == 3.0
    rest.again()
    assert rest(samples_like(np.full((20, 15), 5.0)))[0][0] == 5.0


def samples_like(reading):
    from i2t.hardware.protocols import Samples

    return Samples(np.arange(len(reading)), np.arange(len(reading)) / 400.0, reading, np.full((len(reading), 5), 24.0))


def test_no_key_is_heard_where_there_is_no_terminal(monkeypatch):
    monkeypatch.setattr(sys, "stdin", io.StringIO("zzz"))
    with keys.pressed_keys() as heard:
        assert heard.newest() == ""


@pytest.mark.full
def test_keys_are_heard_one_by_one_and_the_terminal_is_as_before(monkeypatch):
    import os
    import pty
    import termios

    master, slave = pty.openpty()
    before = termios.tcgetattr(slave)
    with os.fdopen(slave) as terminal:
        monkeypatch.setattr(sys, "stdin", terminal)
        with keys.pressed_keys() as heard:
            assert heard.newest() == ""
            os.write(master, b"zm")
            time.sleep(0.05)
            assert heard.newest() == "zm"
        assert termios.tcgetattr(slave) == before
    os.close(master)


def shown(words, folder, capsys) -> str:
    """What the monitor prints once it has heard all boards; one that other programs have starved is asked again."""
    for _ in range(ATTEMPTS):
        capsys.readouterr()
        for left in folder.iterdir():
            left.unlink()
        if monitor.main(words) == 0:
            return capsys.readouterr().out
    raise AssertionError(capsys.readouterr().err)


@pytest.mark.full
def test_two_boards_of_other_chip_counts_are_shown_each_as_what_it_is(tmp_path, capsys):
    table = tmp_path / "skin.npz"
    with started("--board", "grid-2x2") as (square, _), started() as (five, _):
        ports = ["--port", square, "--port", five, "--seconds", "1.5"]
        said = shown([*ports, "--board", "grid-2x2", "--board", "anyskin", "--record", str(table)], tmp_path, capsys)
    assert said.startswith("board anyskin: chips turned as its makers' viewer publishes")
    for path, values in ((table, 12), (tmp_path / "skin-2.npz", 15)):
        with np.load(path, allow_pickle=False) as arrays:
            assert arrays["reading_uT"].shape[1] == values
            assert len(arrays["time_s"]) > 10
    boards = ["--board", "reskin", "--board", "reskin", "--board", "reskin"]
    assert monitor.main([*ports, *boards]) == 2
    assert "--board names 3 boards for 2 ports; give one for all, or one for each" in capsys.readouterr().err


def test_two_boards_are_shown_and_recorded_as_tables(tmp_path, capsys):
    table = tmp_path / "skin.npz"
    with started("--seed", "1") as (one, _), started("--seed", "2", "--format", "framed") as (two, _):
        said = shown(["--port", one, "--port", two, "--seconds", "1.5", "--record", str(table)], tmp_path, capsys)
    assert said.count("wrote ") == 2
    assert "binary" not in said  # one line each and no picture where the output is no terminal
    for path, warm in ((table, True), (tmp_path / "skin-2.npz", False)):
        with np.load(path, allow_pickle=False) as arrays:
            assert len(arrays["time_s"]) > 10
            assert abs(float(arrays["began_unix"]) - time.time()) < 300
            assert np.isfinite(arrays["temperature_C"]).all() == warm
    assert sorted(each.name for each in tmp_path.iterdir()) == ["skin-2.npz", "skin.npz"]  # no bytes are left behind
