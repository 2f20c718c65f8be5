"""Framed boards: their counter and checksum, chips that fail, converters that wrap, and lines that damage bytes."""

import time

import numpy as np
import pytest

from i2t.emulators.reskin_board import Readings, corrupt, started
from i2t.errors import DeviceError
from i2t.hardware.protocols import Samples, SkinCounters
from i2t.hardware.reskin import driver, frames, monitor, recording
from i2t.hardware.reskin.driver import Replay, ReSkin
from i2t.hardware.reskin.frames import Decoder, decode, diagnose
from i2t.hardware.reskin.layouts import Format, FrameLayout, encode
from i2t.hardware.reskin.quantization import ConverterSteps, wrap_offsets
from i2t.hardware.reskin.stream import BoardInfo
from i2t.skin.ambient import AmbientField, FreePoses, fit_ambient, save_ambient
from i2t.skin.boards import make_board

PATIENCE = 20.0  # s that a loaded machine may need for what takes a moment
SIZE = 64
CELSIUS = np.full(5, 24.0)
FRAMED = (Format.FRAMED, Format.FRAMED_TEXT)


def samples(count, seed=0, noise=1.0):
    board = Readings(noise, 0.0, None, seed)
    return [board.at(0.0)[0] for _ in range(count)]


def sent(readings, form=Format.FRAMED, first=0):
    return [encode(np.asarray(reading, float), CELSIUS, form, first + i) for i, reading in enumerate(readings)]


def decoded(data, form=Format.FRAMED):
    return decode(Decoder(FrameLayout(form)), data)


# What is believed.


@pytest.mark.full
@pytest.mark.parametrize(("substitute", "drop"), [(0.001, 0.0), (0.01, 0.0), (0.0, 0.001), (0.0, 0.01)])
def test_a_damaged_line_delivers_no_wrong_frame_and_loses_no_whole_one(substitute, drop):
    truth, rng = samples(2500), np.random.default_rng(7)
    whole = sent(truth)
    arrived = [corrupt(frame, substitute, drop, rng) for frame in whole]
    number = {int(end): i for i, end in enumerate(np.cumsum([len(frame) for frame in arrived]))}
    decoder, found = decoded(b"".join(arrived))
    intact = {i for i, (a, b) in enumerate(zip(arrived, whole, strict=True)) if a == b}
    delivered = [number.get(frame.end) for frame in found]
    wrong = [i for i, frame in zip(delivered, found, strict=True) if i is None or off(frame, truth[i]) > 1e-3]
    assert len(wrong) <= 0.001 * len(found)
    assert len(intact - set(delivered)) < 0.01 * len(intact)
    sent_since = 2500 - min(i for i in delivered if i is not None)
    assert abs(decoder.lost - (sent_since - len(found))) <= 5  # the counter tells how many are missing


def off(frame, reading):
    return np.abs(frame.reading - reading).max()


def test_every_single_changed_byte_is_found():
    whole = sent(samples(8))
    rng = np.random.default_rng(0)
    for place in range(SIZE):
        bad = bytearray(b"".join(whole))
        bad[4 * SIZE + place] ^= int(rng.integers(1, 256))
        decoder, found = decoded(bytes(bad))
        assert [frame.end // SIZE - 1 for frame in found] == [0, 1, 2, 3, 5, 6, 7]
        assert (decoder.lost, decoder.gaps, decoder.skipped) == (1, 1, SIZE)


def test_two_changes_that_cancel_in_the_checksum_are_a_spike_to_the_frames_around_it():
    whole = sent(samples(8))
    bad = bytearray(b"".join(whole))
    for place in (6, 10):  # the high bytes of two numbers
        bad[4 * SIZE + place] ^= 0x04
    _, found = decoded(bytes(bad))
    assert [frame.end // SIZE - 1 for frame in found] == [0, 1, 2, 3, 5, 6, 7]


def test_a_fast_field_is_believed_by_its_counter():
    slope = 400.0 * np.arange(30)[:, None] + np.asarray(samples(30))
    _, found = decoded(b"".join(sent(slope)))
    np.testing.assert_allclose([frame.reading for frame in found], slope, rtol=1e-6, atol=1e-3)


def test_frames_that_are_missing_as_a_whole_are_counted():
    whole = sent(samples(600))
    gone = {5, 6, 7, 100, *range(200, 270)}
    decoder, found = decoded(b"".join(frame for i, frame in enumerate(whole) if i not in gone))
    assert len(found) == 600 - len(gone)
    assert (decoder.lost, decoder.gaps) == (len(gone), 3)


def test_a_board_without_a_working_counter_loses_nothing():
    decoder, found = decoded(b"".join(encode(reading, CELSIUS, Format.FRAMED, 7) for reading in samples(40)))
    assert (len(found), decoder.lost, decoder.gaps) == (40, 0, 0)


def test_a_line_of_text_that_lost_a_digit_has_to_be_borne_out():
    whole = sent(samples(60, noise=0.3), Format.FRAMED_TEXT)
    wrong = whole[40].replace(b"-41.", b"-4.").replace(b"-40.", b"-4.").replace(b"-42.", b"-4.")
    assert wrong != whole[40]
    _, found = decoded(b"\n" + b"".join([*whole[:40], wrong, *whole[41:]]), Format.FRAMED_TEXT)
    assert len(found) == 59
    assert min(frame.reading.min() for frame in found) > -60


# Chips that fail.


@pytest.mark.parametrize("form", Format)
def test_a_chip_that_fails_is_missing_and_never_zero(form):
    truth = np.array(samples(40))
    truth[10:20, 6:9] = np.nan
    data = b"\n" + b"".join(sent(truth, form)) + b"\n"
    decoder, found = decoded(data, form)
    read = np.array([frame.reading for frame in found])
    assert len(read) == 40
    assert np.isnan(read[10:20, 6:9]).all()
    assert np.isfinite(np.delete(read, np.s_[6:9], axis=1)).all()
    assert np.isfinite(np.delete(read, np.s_[10:20], axis=0)).all()
    assert (decoder.missing, decoder.empty) == (10, 0)


def test_the_maker_writes_err_for_a_chip_that_fails():
    reading = np.arange(15.0) + 1
    reading[3:6] = np.nan
    line = encode(reading, CELSIUS, Format.FRAMED_TEXT)
    assert line.startswith(b"FRAME: [S1:1.0,2.0,3.0] [S2:ERR] [S3:7.0,8.0,9.0]")


def test_two_of_three_frames_without_any_chip_are_counted_and_not_delivered():
    truth = np.array(samples(90))
    truth[np.arange(90) % 3 != 0] = np.nan
    decoder, found = decoded(b"".join(sent(truth)))
    assert (len(found), decoder.empty, decoder.missing, decoder.lost) == (30, 60, 0, 0)
    assert np.isfinite([frame.reading for frame in found]).all()


def test_a_board_of_which_no_chip_answers_is_said_to_be_so():
    data = b"".join(sent(np.full((20, 15), np.nan)))
    assert not decoded(data)[1]
    assert "no chip answers" in diagnose(data)
    bad = bytearray(b"".join(sent(samples(20))))
    bad[SIZE - 1 :: SIZE] = bytes(20)
    assert "checksums do not fit" in diagnose(bytes(bad))


# Converters that wrap.


@pytest.mark.parametrize("form", [Format.FRAMED, Format.FRAMED_TEXT, Format.BINARY])
def test_a_field_that_goes_over_the_converters_end_is_carried_on(form):
    board = Readings(1.0, 0.0, None, 0)
    path = np.concatenate([np.zeros(150), np.linspace(0, 9.5e3, 300), np.full(20, 9.5e3), np.linspace(9.5e3, 0, 300)])
    truth, wrapped = [], []
    for size in path:
        board.field = np.tile([0.0, 0.0, -size], 5)
        wrapped.append(board.at(0.0)[0])
        truth.append(np.array([18.0, -7.0, -41.0 - size]))
    assert np.ptp(np.array(wrapped)[:, 2]) > 15e3  # 15.86 mT, from one end to the other
    decoder, found = decoded(b"\n" + b"".join(sent(wrapped, form)) + b"\n", form)
    assert len(found) >= len(path) - 5
    assert decoder.wraps >= 10  # five chips, there and back; noise may cross the end again
    at = np.array([(frame.end - 2) // (len(encode(wrapped[0], CELSIUS, form))) for frame in found])
    if form != Format.FRAMED_TEXT:  # whose lines are of many lengths
        np.testing.assert_allclose(np.array([f.reading[:3] for f in found])[:, 2], np.array(truth)[at, 2], atol=30)
    assert max(np.abs(np.diff([frame.reading[2] for frame in found]))) < 150
    assert found[-1].reading[2] == pytest.approx(-41.0, abs=25)


def test_a_jump_that_is_none_of_the_converters_is_the_fields():
    low, high, steps = (
        np.full((1, 3), -3e3),
        np.full((1, 3), 6e3),
        ConverterSteps(np.array([np.nan, 0.15, 0.15, 0.242])),
    )
    assert not wrap_offsets(low, high, steps).any()
    assert not wrap_offsets(low, high, None).any()
    ends = np.array([[4.9e3, 4.9e3, 7.9e3]])
    np.testing.assert_allclose(wrap_offsets(ends, -ends, steps), [[9830.4, 9830.4, 15859.712]])
    np.testing.assert_allclose(wrap_offsets(-ends, ends, None), [[-9830.4, -9830.4, -15859.712]])
    assert not wrap_offsets(np.full((1, 3), np.nan), ends, steps).any()


# The real client and a board in another process.


def received(seconds, *switches):
    """All samples of some seconds, and the counters."""
    with started("--format", "framed", *switches) as (port, _), ReSkin(port, capacity=100_000) as skin:
        time.sleep(seconds)
        rows, counters, info = skin.since(-1), skin.counters, skin.info
    return rows, counters, info


def check_line(path, seconds, substitute, drop):
    """What arrives whole is delivered, and nothing else; what this computer was too late to take is no matter here."""
    switches = ("--noise=0", f"--substitute={substitute}", f"--drop={drop}")
    with started("--format", "framed", *switches) as (port, _), ReSkin(port, capacity=100_000) as skin:
        skin.record(path)
        time.sleep(0.1)
        mark = int(skin.latest(PATIENCE).number[-1])
        time.sleep(seconds)
        rows, info = skin.since(mark), skin.info
    data = b"".join(chunk for _, chunk in recording.chunks(path, 1.0))
    truth = Readings(0.0, 0.0, None, 0).at(0.0)[0]
    intact = sum(data.count(encode(truth, CELSIUS, Format.FRAMED, count)) for count in range(256))
    wrong = int((np.abs(rows.reading - truth).max(1) > 1e-3).sum())
    assert info.form == Format.FRAMED
    assert len(rows.number) > 50 * seconds
    assert wrong <= 0.001 * len(rows.number)
    assert len(rows.number) - wrong >= 0.99 * (intact - 60)  # the recording is longer by its two ends


def test_a_framed_board_is_read_over_a_bad_line(tmp_path):
    check_line(tmp_path / "raw", 1.5, 0.01, 0.0)


@pytest.mark.full
@pytest.mark.parametrize(("substitute", "drop"), [(0.001, 0.0), (0.01, 0.0), (0.001, 0.001), (0.0, 0.01)])
def test_a_framed_board_is_read_over_any_bad_line(tmp_path, substitute, drop):
    check_line(tmp_path / "raw", 20.0, substitute, drop)


@pytest.mark.full
def test_chips_that_fail_and_frames_that_are_skipped_are_counted_end_to_end():
    rows, counters, _ = received(1.0, "--fail", "2", "--fail-share", "0.05", "--skip", "0.1", "--noise", "1")
    assert np.isnan(rows.reading[:, 6:9]).all()
    share = np.isnan(rows.reading[:, :3]).all(1).mean()
    assert 0 < share < 0.2
    assert np.isfinite(rows.reading).any(1).all()
    assert counters.missing >= len(rows.number)
    assert 0.02 < counters.loss < 0.25


@pytest.mark.full
def test_a_sketch_that_reads_too_early_is_told_apart_from_a_broken_cable():
    rows, counters, _ = received(1.0, "--empty", "3")
    assert np.isfinite(rows.reading).all()
    assert counters.empty == pytest.approx(2 * counters.samples, abs=6)
    skin = ReSkin("/dev/skin")
    skin._decoder = Decoder(FrameLayout(Format.FRAMED), frames=1, empty=9)
    skin._listened = time.monotonic()
    assert "faster than they measure" in skin._silence(1.0)


@pytest.mark.full
def test_rubbish_after_a_reset_is_waited_out(monkeypatch):
    monkeypatch.setattr(driver, "BAUD_RATES", (115200, 921600))
    switches = ("--format", "framed", "--garbage-for", "1.6", "--baud", "921600")
    with started(*switches) as (port, _), ReSkin(port) as skin:
        assert np.isfinite(skin.read(20, PATIENCE).reading).all()
        assert (skin.info.baud, skin.info.form) == (921600, Format.FRAMED)


@pytest.mark.full
def test_boards_of_other_sizes_are_framed_too():
    with started("--board", "grid-2x2", "--format", "framed-text", "--fail", "1") as (port, _):
        with pytest.raises(DeviceError, match="frames of 4 chips come, not of 5"):
            ReSkin(port).connect()
        with ReSkin(port, chips=4) as skin:
            rows = skin.read(5, PATIENCE)
            assert np.isnan(rows.reading[:, 3:6]).all()
            assert np.isfinite(rows.reading[:, :3]).all()
            assert np.isnan(rows.temperature).all()


# The monitor, and recordings of missing chips.


def test_the_monitor_shows_what_is_missing(capsys, tmp_path):
    reading = np.tile(np.arange(15.0), (3, 1))
    reading[:, 3:6] = np.nan
    shown = Samples(np.arange(3), np.arange(3.0), reading, np.full((3, 5), np.nan))
    info = BoardInfo("port", None, Format.FRAMED)
    lines = monitor.picture(info, "real", SkinCounters(missing=3, empty=2), shown, np.zeros(15), scale=100.0)
    assert "missing chips 3  empty frames 2" in lines[1]
    assert [line.split()[2] for line in lines if line.startswith("1 ")] == 3 * ["missing"]
    assert "change of all 12" in lines[-1]
    assert "nan" not in "\n".join(lines)
    path = tmp_path / "raw"
    with started("--format", "framed", "--fail", "4") as (port, _):
        assert monitor.main(["--port", port, "--seconds", "1", "--record", str(path)]) == 0
    assert "missing chips" in capsys.readouterr().out
    with Replay(path, speed=5.0) as again:
        assert np.isnan(again.since(-1).reading[:, 12:]).all()


def fitted(path) -> AmbientField:
    """The field of the emulated board's room, and the chips' offsets."""
    board, rng = make_board("reskin"), np.random.default_rng(0)
    turns = np.tile(np.eye(4), (12, 1, 1))
    turns[:, :3, :3] = [np.linalg.qr(rng.standard_normal((3, 3)))[0] for _ in range(12)]
    turns[:, :3, :3] *= np.sign(np.linalg.det(turns[:, :3, :3]))[:, None, None]
    read = [board.to_board(np.tile(turn[:3, :3].T @ [18.0, 7.0, 41.0], (5, 1))) for turn in turns]
    field = fit_ambient(FreePoses(turns, np.array(read)[:, None]), board, model="uniform")
    save_ambient(path, field)
    return field


@pytest.mark.full
def test_the_monitor_subtracts_a_fitted_field(capsys, tmp_path):
    path = tmp_path / "field.npz"
    fitted(path)
    with started("--noise", "0") as (port, _):
        turned = ["--turn", str(np.pi), "0", "0"]  # pointing down, as the board's room has it
        assert monitor.main(["--port", port, "--seconds", "0.5", "--ambient", str(path), *turned]) == 0
        assert monitor.main(["--port", port, "--seconds", "0.5", "--ambient", str(path)]) == 0
    sums = [line.split("change of all 15: ")[1] for line in capsys.readouterr().out.splitlines()]
    for line in sums:
        assert float(line.split()[0]) < 0.5
        assert "all chips share 45.2 uT, the fitted field has 45.3" in line


def test_what_the_monitor_cannot_subtract_is_said(capsys, tmp_path):
    path = tmp_path / "field.npz"
    fitted(path)
    for options, why in (
        (["--turn", "0", "0", "0"], "pass --ambient"),
        (["--ambient", str(path), "--turn", "0", "0", "0", "--host", "127.0.0.1"], "pass one of them"),
        (["--ambient", str(path), "--board", "grid-2x2"], "of 5 chips, and the board has 4"),
        (["--ambient", str(tmp_path / "none")], "no such file"),
    ):
        assert monitor.main(options) == 2
        assert why in capsys.readouterr().err


def test_the_decoder_says_which_frames_it_knows():
    assert {layout.form for layout in (each.layout for each in frames.decoders())} == set(Format)
