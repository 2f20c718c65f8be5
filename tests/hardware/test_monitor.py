"""Streams as tables, and what the monitor shows: the map of the chips, several boards, keys, a fitted field."""

import csv
import os
import sys
import time

import numpy as np
import pytest

from i2t.emulators.reskin_board import Readings, started
from i2t.errors import DataError, DeviceError
from i2t.hardware.reskin import keys, monitor, recording
from i2t.hardware.reskin.layouts import Format, encode
from i2t.hardware.reskin.tables import samples_of, write_table
from i2t.skin.ambient import FreePoses, fit_ambient, save_ambient
from i2t.skin.boards import make_board

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


def shown(words, capsys, wanted, folder=None) -> str:
    """What the monitor prints once it has heard all boards; one that other programs have starved is asked again."""
    for _ in range(ATTEMPTS):
        capsys.readouterr()
        for left in folder.iterdir() if folder else ():
            left.unlink()
        code, said = monitor.main(words), capsys.readouterr().out
        if code == 0 and wanted in said:
            return said
    raise AssertionError(said)


def test_a_recording_becomes_a_table_with_every_sample(tmp_path, capsys):
    readings = at_rest(40)
    readings[10:20, 3:6] = np.nan  # a chip failed on the way
    raw = recorded(tmp_path / "raw", readings)
    samples = samples_of(raw, 5, 400.0)
    np.testing.assert_allclose(samples.reading, readings.astype(np.float32))
    np.testing.assert_allclose(np.diff(samples.time)[3:], 0.01, atol=1e-9)  # the first three are believed together
    for name in ("a.csv", "a.npz"):
        assert monitor.main(["--replay", str(raw), "--record", str(tmp_path / name)]) == 0
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
        samples_of(raw, 4, 400.0)


@pytest.fixture(scope="module")
def field(tmp_path_factory):
    """A file of the field of the emulated board's room, and the chips' offsets."""
    board, rng = make_board("reskin"), np.random.default_rng(0)
    turns = np.tile(np.eye(4), (12, 1, 1))
    turns[:, :3, :3] = [np.linalg.qr(rng.standard_normal((3, 3)))[0] for _ in range(12)]
    turns[:, :3, :3] *= np.sign(np.linalg.det(turns[:, :3, :3]))[:, None, None]
    read = [board.to_board(np.tile(turn[:3, :3].T @ [18.0, 7.0, 41.0], (5, 1))) for turn in turns]
    path = tmp_path_factory.mktemp("ambient") / "field.npz"
    save_ambient(path, fit_ambient(FreePoses(turns, np.array(read)[:, None]), board, model="uniform"))
    return str(path)


def test_what_the_monitor_cannot_show_or_record_is_said(tmp_path, capsys, field):
    (tmp_path / "b-2.csv").write_text("")
    two = ["--port", "a", "--port", "b"]
    for options, code, why in (
        ([*two, "--record", str(tmp_path / "b.csv")], 2, "b-2.csv: exists already"),
        (["--port", "a", "--port", "a"], 2, "names one board twice"),
        (["--port", "a", "--replay", field], 2, "pass one of them"),
        (["--port", str(tmp_path / "nowhere")], 1, "there is no port"),
        (["--ambient", field, "--turn", "0", "0", "0", "--host", "127.0.0.1"], 2, "pass one of them"),
        (["--ambient", field, "--board", "grid-2x2"], 2, "of 5 chips, and the board has 4"),
        (["--ambient", str(tmp_path / "none")], 2, "no such file"),
    ):
        assert monitor.main(options) == code
        assert why in capsys.readouterr().err


@pytest.mark.full
def test_keys_are_heard_one_by_one_and_the_terminal_is_as_before(monkeypatch):
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


@pytest.mark.parametrize(
    ("noise", "health"), [(1.0, monitor.HEALTHY_TEXT), (0.0, "UNHEALTHY: every chip stands still")]
)
def test_the_monitor_draws_a_recording_and_says_whether_the_skin_is_healthy(
    capsys, monkeypatch, tmp_path, noise, health
):
    raw = recorded(tmp_path / "raw", at_rest(800, noise), Format.BINARY, 400.0)
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    said = shown(["--replay", str(raw), "--seconds", "1"], capsys, health)
    assert "replay" in said
    assert "\x1b[21F\x1b[J" in said  # drawn over the last picture


@pytest.mark.full
def test_two_boards_of_other_chip_counts_are_shown_and_recorded_as_tables(tmp_path, capsys):
    tables = [tmp_path / "skin.npz", tmp_path / "skin-2.npz"]
    with started("--board", "grid-2x2") as (square, _), started("--format", "framed") as (five, _):
        words = ["--port", square, "--port", five, "--board", "grid-2x2", "--board", "anyskin", "--seconds", "1.5"]
        said = shown([*words, "--record", str(tables[0])], capsys, "wrote", tmp_path)
    assert said.startswith("board anyskin: chips turned as its makers' viewer publishes")
    assert said.count("wrote ") == 2
    assert "binary" not in said  # one line each and no picture where the output is no terminal
    for path, values, warm in zip(tables, (12, 15), (True, False), strict=True):
        with np.load(path, allow_pickle=False) as arrays:
            assert arrays["reading_uT"].shape[1] == values
            assert len(arrays["time_s"]) > 10
            assert abs(float(arrays["began_unix"]) - time.time()) < 300
            assert np.isfinite(arrays["temperature_C"]).all() == warm
    assert sorted(tmp_path.iterdir()) == sorted(tables)  # no bytes are left behind


@pytest.mark.full
def test_the_monitor_subtracts_a_fitted_field(capsys, field):
    said = ""
    with started("--noise", "0") as (port, _):
        words = ["--port", port, "--seconds", "0.5", "--ambient", field]
        for turned in (["--turn", str(np.pi), "0", "0"], []):  # pointing down, as the board's room has it
            said += shown([*words, *turned], capsys, "change of all 15: ")
    for line in (line.split("change of all 15: ")[1] for line in said.splitlines()):
        assert float(line.split()[0]) < 0.5
        assert "all chips share 45.2 uT, the fitted field has 45.3" in line
