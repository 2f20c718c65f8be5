"""The skin's bytes against recorded and hostile streams, and its driver against a board in another process."""

import os
import re
import socket
import struct
import subprocess
import sys
import threading
import time
import tty
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from i2t.emulators.reskin_board import NOISE_UT, Readings, corrupt, started
from i2t.errors import DeviceError, DeviceTimeoutError, NotConnectedError
from i2t.hardware.protocols import Samples, SkinCounters
from i2t.hardware.reskin import driver, frames, monitor, quantization, recording
from i2t.hardware.reskin import stream as streaming
from i2t.hardware.reskin.driver import Replay, ReSkin
from i2t.hardware.reskin.frames import Decoder, FrameLimits, decode, decode_any, decoders, diagnose
from i2t.hardware.reskin.layouts import Format, FrameLayout, encode
from i2t.hardware.reskin.stream import BoardInfo
from i2t.skin.boards import make_board

SIZE = 82
PATIENCE = 20.0  # s that a loaded machine may need for what takes a moment


def rest(count: int, seed: int = 0, noise: float = 1.0, temperature: float | None = None) -> tuple:
    """Readings and temperatures of a real board at rest, by its measured noise."""
    board = Readings(noise, 0.0, temperature, seed)
    pairs = [board.at(0.0) for _ in range(count)]
    return np.array([reading for reading, _ in pairs]), np.array([celsius for _, celsius in pairs])


def stream(count: int, form: Format = Format.BINARY, **kwargs) -> list[bytes]:
    return [encode(*sample, form, i) for i, sample in enumerate(zip(*rest(count, **kwargs), strict=True))]


def decoded(data: bytes, form: Format = Format.BINARY, limits: FrameLimits | None = None) -> tuple:
    return decode(Decoder(FrameLayout(form), limits or FrameLimits()), data)


def counted(decoder: Decoder) -> dict:
    """The decoder's state, without its arrays."""
    arrays = ("last", "early", "steps", "usual", "wrapped")
    return {name: part for name, part in decoder._asdict().items() if name not in arrays}


def adds_up(decoder: Decoder, total: int) -> bool:
    return decoder.bytes == decoder.taken + decoder.skipped + len(decoder.rest) == total


# The formats, by hand from the public firmware.

TEXTS = (Format.TEXT, Format.TEXT_GLUED, Format.FRAMED_TEXT)
DIGITS = {Format.TEXT: 2, Format.TEXT_GLUED: 2, Format.FRAMED_TEXT: 1}
WITH_TEMPERATURE = (Format.BINARY, Format.TEXT, Format.TEXT_GLUED)

FIELD = np.arange(15) * 10.0 + 1.25
CELSIUS = np.array([24.5, 24.75, 25.0, 25.25, 25.5])
CHIP = {
    Format.TEXT: "{1:.2f}\t{2:.2f}\t{3:.2f}\t{0:.2f}\t",
    Format.TEXT_GLUED: "{0:.2f}\t{1:.2f}\t{2:.2f}\t{3:.2f}",
}


def by_hand(form: Format) -> bytes:
    chips = [(celsius, *field) for celsius, field in zip(CELSIUS, FIELD.reshape(5, 3), strict=True)]
    if form == Format.BINARY:
        return b"".join(struct.pack("<4f", *chip) for chip in chips) + b"\r\n"
    if form == Format.FRAMED:
        counted = b"\x00" + struct.pack("<15f", *FIELD)
        check = 0
        for byte in counted:
            check ^= byte
        return b"\xaa\x55" + counted + bytes([check])
    if form == Format.FRAMED_TEXT:
        shown = (f"[S{i + 1}:{x:.1f},{y:.1f},{z:.1f}]" for i, (_, x, y, z) in enumerate(chips))
        return f"FRAME: {' '.join(shown)}\r\n".encode()
    return "".join(CHIP[form].format(*chip) for chip in chips).encode() + b"\r\n"


@pytest.mark.parametrize("form", Format)
def test_formats_are_those_of_the_firmware(form):
    assert encode(FIELD, CELSIUS, form) == by_hand(form)
    (decoder,), found = decode_any(decoders(), b"7\r\n" + 4 * by_hand(form))
    assert decoder.layout == FrameLayout(form)
    assert len(found) >= 3  # a line of text ends for certain when the next one begins
    for frame in found:
        np.testing.assert_array_equal(frame.reading, np.round(FIELD, DIGITS.get(form, 9)))
        np.testing.assert_array_equal(frame.temperature, CELSIUS if form in WITH_TEMPERATURE else 5 * [np.nan])


def test_a_framed_frame_has_64_bytes_as_its_maker_says():
    whole = by_hand(Format.FRAMED)
    assert len(whole) == FrameLayout(Format.FRAMED).size == 64
    assert encode(FIELD, CELSIUS, Format.FRAMED, 0x1FF)[2] == 0xFF


@pytest.mark.parametrize("form", Format)
def test_every_frame_of_a_clean_stream_arrives_once(form):
    whole = stream(200, form)
    decoder, found = decoded(b"".join(whole)[50:] + b"\r\n", form)
    assert [frame.end for frame in found] == [
        sum(map(len, whole[: i + 1])) - 50 - (form in TEXTS) for i in range(1, 200)
    ]
    assert (decoder.lost, decoder.gaps) == (0, 0)
    step = 0.5 * 10.0 ** -DIGITS.get(form, 4) + 1e-9
    np.testing.assert_allclose([frame.reading for frame in found], rest(200)[0][1:], atol=step)


@settings(max_examples=30, deadline=None)
@given(
    st.sampled_from(list(Format)), st.integers(0, 1000), st.lists(st.integers(0, 5000), max_size=12), st.integers(0, 90)
)
def test_chunks_do_not_matter(form, seed, cuts, start):
    data = corrupt(b"".join(stream(30, form, seed=seed % 5)), 0.004, 0.001, np.random.default_rng(seed))[start:]
    once, expected = decode_any(decoders(), data)
    candidates, found = decoders(), []
    edges = [0, *sorted(min(cut, len(data)) for cut in cuts), len(data)]
    for begin, end in pairwise(edges):
        candidates, more = decode_any(candidates, data[begin:end])
        found += more
        assert all(adds_up(decoder, end) for decoder in candidates)
    assert [frame.end for frame in found] == [frame.end for frame in expected]
    np.testing.assert_array_equal([f.reading for f in found], [f.reading for f in expected])
    np.testing.assert_equal([counted(decoder) for decoder in candidates], [counted(decoder) for decoder in once])


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000), st.sampled_from([0.001, 0.01, 0.1]), st.sampled_from([0.0, 0.001, 0.05]))
def test_no_corruption_gives_an_implausible_frame(seed, substitute, drop):
    limits = FrameLimits()
    data = corrupt(b"".join(stream(40, seed=seed % 3)), substitute, drop, np.random.default_rng(seed))
    decoder, found = decoded(data)
    assert adds_up(decoder, len(data))
    assert decoder.taken == SIZE * len(found)
    for frame in found:
        size = np.abs(frame.reading)
        assert ((size == 0) | (size >= limits.min_field)).all()
        assert (size <= limits.full_scale).all()
        assert ((frame.temperature >= limits.min_temperature) & (frame.temperature <= limits.max_temperature)).all()


@settings(max_examples=40, deadline=None)
@given(st.binary(max_size=3000), st.sampled_from(list(Format)))
def test_noise_is_no_board(data, form):
    decoder, found = decoded(data, form)
    assert not found
    assert adds_up(decoder, len(data))
    assert diagnose(data)


def test_changed_bytes_cost_their_own_frames_only():
    whole = stream(4000)
    data = b"".join(whole)
    bad = corrupt(data, 0.01, 0.0, np.random.default_rng(0))
    decoder, found = decoded(bad)
    intact = {SIZE * (i + 1) for i in range(4000) if bad[SIZE * i : SIZE * (i + 1)] == whole[i]}
    ends = {frame.end for frame in found}
    assert not {end % SIZE for end in ends} - {0}  # none misaligned
    assert len(intact & ends) >= 0.98 * len(intact)
    assert adds_up(decoder, len(data))
    assert decoder.frames + decoder.lost + decoder.skipped // SIZE >= 4000 - 40
    # What passes unseen is bounded: each value lies within the jump of the frame before, which itself may be off.
    truth = rest(4000)[0]
    worst = max(np.abs(frame.reading - truth[frame.end // SIZE - 1]).max() for frame in found)
    assert worst <= 2 * FrameLimits().max_jump + 8 * max(NOISE_UT)


def test_lost_bytes_cost_their_own_frames_only():
    whole = stream(4000)
    rng = np.random.default_rng(1)
    sent = [corrupt(frame, 0.0, 0.001, rng) for frame in whole]
    ends = np.cumsum([len(part) for part in sent])
    decoder, found = decoded(b"".join(sent))
    intact = {int(end) for end, part in zip(ends, sent, strict=True) if len(part) == SIZE}
    delivered = {frame.end for frame in found}
    assert len(intact & delivered) >= 0.95 * len(intact)
    assert delivered <= set(ends.tolist())  # every frame ends where one was sent
    assert abs(decoder.lost - (4000 - len(found))) <= 0.05 * (4000 - len(found)) + 2


@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_line_ends_within_numbers_do_not_mislead(noise):
    """With 34.513 degrees on five chips there are six line ends in a frame."""
    (celsius,) = struct.unpack("<f", bytes.fromhex("980d0a42"))
    assert round(celsius, 3) == 34.513
    data = b"".join(stream(6, noise=noise, temperature=celsius))
    assert data.count(b"\r\n") >= 36
    for start in range(SIZE):
        _, found = decoded(data[start:])
        assert [(frame.end + start) % SIZE for frame in found] == [0] * (6 - (start > 0))


def ambiguous() -> bytes:
    """A frame that repeated is just as plausible three bytes later."""
    frame = b"\x42\x0d\x0a\x42" + 76 * b"\x42" + b"\r\n"
    assert all(
        frames._values(FrameLayout(), (2 * frame)[begin : begin + SIZE], FrameLimits()) is not None for begin in (0, 3)
    )
    return frame


@pytest.mark.parametrize("start", [0, 3, 40])
def test_two_alignments_are_one_too_many(start):
    data = (20 * ambiguous())[start:]
    decoder, found = decoded(data)
    assert not found
    assert "alignments" in diagnose(data)
    clean = stream(5)
    _, found = decode(decoder, b"".join(clean))
    assert [frame.end for frame in found] == [len(data) + SIZE * (i + 1) for i in range(5)]


def test_two_candidates_in_a_row_are_too_few_and_three_are_enough():
    """Without a frame before them, two candidates that adjoin may be chance."""
    noise = np.random.default_rng(0).bytes(200).replace(b"\r\n", b"")
    for count in (1, 2, 3, 4):
        data = noise + b"".join(stream(count)) + noise
        _, found = decoded(data)
        assert len(found) == (count if count >= 3 else 0)


def test_a_lasting_jump_is_true_and_a_single_one_is_not():
    readings, celsius = rest(20)
    readings[8] += 3000.0  # alone
    readings[12:] += 500.0  # a magnet came
    _, found = decoded(b"".join(encode(r, c) for r, c in zip(readings, celsius, strict=True)))
    assert [frame.end // SIZE - 1 for frame in found] == [i for i in range(20) if i != 8]


@pytest.mark.parametrize("value", [np.nan, np.inf, 6e4, 1e-6])
def test_one_impossible_value_condemns_its_frame(value):
    readings, celsius = rest(10)
    readings[5, 7] = value
    decoder, found = decoded(b"".join(encode(r, c) for r, c in zip(readings, celsius, strict=True)))
    assert len(found) == 9
    assert (decoder.lost, decoder.gaps, decoder.skipped) == (1, 1, SIZE)


# The converter's steps.


def test_steps_are_learned_exactly_and_in_spite_of_damage():
    found, _ = learned(0.0)
    np.testing.assert_allclose(found.size[1:], [0.150, 0.150, 0.242], rtol=2.0**-24)  # the rounding of one value
    # Counts from 25 degrees are some twenty, in float32 about 24.6 degrees.
    np.testing.assert_allclose(found.size[0], 1 / 45.2, rtol=np.spacing(np.float32(24.6)) / 0.4)
    damaged, delivered = learned(0.01)
    np.testing.assert_allclose(damaged.size[1:], found.size[1:], rtol=2.0**-24)
    assert sum(found.fit(table) for table in delivered) < len(delivered)


def learned(substitute: float) -> tuple:
    data = corrupt(b"".join(stream(300)), substitute, 0.0, np.random.default_rng(0))
    decoder, found = decoded(data)
    return decoder.steps, [np.column_stack([f.temperature, f.reading.reshape(5, 3)]) for f in found]


@pytest.mark.full
def test_real_boards_send_whole_numbers_of_steps(shared_data):
    """eFlesh's recordings: 16 times the MLX90393's finest steps, 0.150 and 0.242 uT, in every one of 3600 samples."""
    path = shared_data / "eflesh" / "normal" / "20250401_014340_probe" / "sensor.csv.gz"
    fields = np.loadtxt(path, delimiter=",")[:, 1:].reshape(-1, 5, 3)
    recorded = np.concatenate([np.full((len(fields), 5, 1), 24.0), fields], axis=2)
    found = quantization.learn_steps(recorded[:128])
    np.testing.assert_allclose(found.size[1:], [2.4, 2.4, 3.872], rtol=1e-7)
    assert np.isnan(found.size[0])  # constant here
    assert all(found.fit(table) for table in recorded)
    # And what was recorded comes back through the decoder.
    data = b"".join(encode(field.ravel(), np.full(5, 24.0)) for field in fields)
    _, frames_found = decoded(data)
    assert len(frames_found) >= 0.999 * len(fields)  # a value that is off alone, and for one frame, may be damage
    sent = fields.reshape(-1, 15)[[frame.end // SIZE - 1 for frame in frames_found]]
    np.testing.assert_array_equal([frame.reading for frame in frames_found], sent)


def test_what_has_no_steps_is_not_judged_by_any():
    table = np.random.default_rng(0).normal(30.0, 4.0, (128, 5, 4))
    found = quantization.learn_steps(table)
    assert np.isnan(found.size).all()
    assert found.fit(table[0])
    assert np.isnan(quantization.learn_steps(np.ones((128, 5, 4))).size).all()


def test_changed_values_are_seldom_whole_numbers_of_steps():
    count, first = 3000, 300  # frames; those after the steps are known are judged
    whole = stream(count)
    bad = corrupt(b"".join(whole), 0.01, 0.0, np.random.default_rng(2))
    changed = {SIZE * (i + 1) for i in range(first, count) if bad[SIZE * i : SIZE * (i + 1)] != whole[i]}
    _, found = decoded(bad)
    # Powers of two times a value, its negative, and sums like 5 x 0.150 = 2^-1 + 2^-2 are whole numbers of steps too.
    assert len(changed & {frame.end for frame in found}) <= 0.04 * len(changed)


def test_steps_that_no_longer_fit_are_given_up():
    readings, celsius = rest(400)
    readings[200:] += np.random.default_rng(0).uniform(-0.07, 0.07, (200, 15))
    decoder, found = decoded(b"".join(encode(r, c) for r, c in zip(readings, celsius, strict=True)))
    assert np.isnan(decoder.steps.size).all()
    assert len(found) == 400 - frames.MAX_MISFITS
    assert decoder.lost == frames.MAX_MISFITS


def test_what_is_wrong_is_said():
    assert "sends nothing" in diagnose(b"")
    assert "baud" in diagnose(np.random.default_rng(0).bytes(2000))
    thirteen = b"1.00\t2.00\t3.00\t24.50\t" * 3 + b"1.00\t\r\n"
    assert "13 plausible numbers, not 20" in diagnose(10 * thirteen)
    readings, celsius = rest(10)
    celsius[:, 3] = -998.1  # what the firmware makes of a chip that does not answer
    assert "chip 3 reads -998.1 degrees" in diagnose(b"".join(map(encode, readings, celsius)))


# Boards of any number of chips.


@pytest.mark.parametrize("form", Format)
@pytest.mark.parametrize("chips", [1, 4, 16, 25])
def test_frames_of_any_board_are_read(form, chips):
    board = Readings(1.0, 0.0, None, 0, make_board(f"grid-1x{chips}"))
    sent = [board.at(0.0) for _ in range(30)]
    data = b"\r\n" + b"".join(encode(*sample, form, i) for i, sample in enumerate(sent)) + b"\r\n"
    (decoder,), found = decode_any(decoders(chips=chips), data)
    assert decoder.layout == FrameLayout(form, chips)
    assert len(found) == 30
    assert decoder.lost == 0
    step = 0.6 * 10.0 ** -DIGITS.get(form, 3)
    np.testing.assert_allclose([frame.reading for frame in found], [reading for reading, _ in sent], atol=step)
    celsius = np.array([celsius for _, celsius in sent]) if form in WITH_TEMPERATURE else np.full((30, chips), np.nan)
    np.testing.assert_allclose([frame.temperature for frame in found], celsius, atol=step)
    assert not decode_any(decoders(chips=chips + 1), data)[1]
    assert f"frames of {chips} chips come, not of 7" in diagnose(data, chips=7)


@pytest.mark.full
@pytest.mark.parametrize(("name", "chips"), [("grid-2x2", 4), ("grid-4x4", 16)])
def test_an_emulated_board_of_any_size_is_read_end_to_end(name, chips):
    with started("--board", name, "--field", "--noise", "0") as (port, process):
        host, number = process.stdout.readline().split()[1].split(":")
        with pytest.raises(DeviceError, match=f"frames of {chips} chips come, not of 5; say which board it is"):
            ReSkin(port, 115200).connect()
        with ReSkin(port, chips=chips) as skin:
            assert len(skin.features.channels) == 3 * chips
            samples = skin.read(5, PATIENCE)
            assert samples.reading.shape == (5, 3 * chips)
            assert samples.temperature.shape == (5, chips)
            sent = 15 * np.arange(3.0 * chips)
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
                out.sendto(sent.astype("<f4").tobytes(), (host, int(number)))
            felt = until(lambda: changed(skin, samples.reading[-1]))
            np.testing.assert_allclose(felt, sent, atol=0.25)


@pytest.mark.full
def test_the_monitor_draws_every_chip_of_a_board(capsys):
    with started("--board", "grid-2x2") as (port, _):
        assert monitor.main(["--port", port, "--board", "grid-2x2", "--seconds", "1"]) == 0
    assert "change of all 12" in capsys.readouterr().out
    shown = Samples(np.arange(2), np.arange(2.0), np.zeros((2, 48)), np.full((2, 16), 25.0))
    info = BoardInfo("port", None, Format.BINARY)
    lines = monitor.picture(info, "emulated", SkinCounters(), shown, np.zeros(48), scale=100.0)
    assert len([line for line in lines if re.match(r"\d+ [xyz] ", line)]) == 48
    assert monitor.main(["--board", "round"]) == 2
    assert "is not known" in capsys.readouterr().err


# Recordings.


def test_a_recording_gives_back_what_was_put_in(tmp_path):
    path = tmp_path / "skin"
    sent = [(5.0, b"abc"), (5.5, b""), (6.25, b"\r\n")]
    with recording.create(path) as file:
        for at, chunk in sent:
            recording.append(file, at, chunk)
    assert list(recording.chunks(path, 1.0)) == [(at - 5.0, chunk) for at, chunk in sent]
    path.write_bytes(path.read_bytes()[:-1])  # cut off
    assert list(recording.chunks(path, 1.0)) == [(0.0, b"abc"), (0.5, b"")]
    with pytest.raises(FileExistsError):
        recording.create(path)
    path.write_bytes(bytes(range(200)))
    bare = list(recording.chunks(path, 10_000.0))
    assert b"".join(chunk for _, chunk in bare) == bytes(range(200))
    assert [at for at, _ in bare] == pytest.approx([0.0, 5e-3, 10e-3, 15e-3])


def test_a_board_is_recorded_and_replayed(tmp_path):
    path = tmp_path / "skin"
    with started("--mid-frame", "20") as (port, _), ReSkin(port) as skin:
        begun = skin.latest(PATIENCE).number[-1]
        skin.record(path)
        skin.read(100, PATIENCE)
        skin.stop_recording()
        played = skin.since(begun)
        with pytest.raises(DeviceError, match="exists already"):
            skin.record(path)
    with Replay(path, speed=20.0) as again:
        rows = until(lambda: collect(again))
    assert again.features.source == "replay"
    assert again.info.form == Format.BINARY
    # The recording starts within a frame; from there on both saw the same bytes.
    assert len(rows.reading) >= 98
    starts = range(len(played.reading) - 89)
    assert any(np.array_equal(played.reading[i : i + 90], rows.reading[:90]) for i in starts)


def collect(skin) -> Samples | None:
    """All samples of a skin that ends by itself; None where this computer was too busy to hear the end just then."""
    said = failure(skin)
    if "too busy" in said:
        return None
    assert "is over" in said
    return skin.since(-1)


def until(find):
    """What `find` returns, as soon as that is something."""
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        if (found := find()) is not None:
            return found
        time.sleep(0.01)
    raise AssertionError("it never came")


# The driver and a board in another process.


def failure(skin, kind: type[DeviceError] = DeviceError, words: str = "") -> str:
    """What the skin says once it fails with these words."""

    def ask() -> str | None:
        try:
            skin.latest()
        except kind as error:
            return str(error) if words in str(error) else None
        return None

    return until(ask)


@pytest.mark.parametrize("form", Format)
def test_the_driver_finds_the_format(form):
    with started("--format", form) as (port, _), ReSkin(port) as skin:
        samples = skin.read(40, PATIENCE)
        assert skin.info == BoardInfo(port, 115200, form)  # a pseudo-terminal has any rate
        np.testing.assert_allclose(samples.reading.mean(axis=0), rest(1, noise=0.0)[0][0], atol=5 * 4.6 / np.sqrt(40))
        if form in WITH_TEMPERATURE:
            np.testing.assert_allclose(samples.temperature, 24.6, atol=0.6)
        else:
            assert np.isnan(samples.temperature).all()
        assert skin.counters.lost == 0


def test_a_hostile_line_is_survived_and_counted():
    switches = ("--temperature=34.513", "--mid-frame=3", "--substitute=0.002", "--drop=0.0005", "--rate=800")
    with started(*switches) as (port, _), ReSkin(port, rate=800.0) as skin:
        skin.read(400, PATIENCE)
        counters = skin.counters
        samples = skin.since(-1)
    assert counters.lost > 0
    assert counters.gaps > 0
    assert 0.01 < counters.loss < 0.3  # 19 % of the frames are touched
    assert np.abs(samples.reading - rest(1, noise=0.0)[0]).max() <= 2 * FrameLimits().max_jump + 8 * max(NOISE_UT)
    np.testing.assert_allclose(samples.temperature, 34.513, atol=2 * FrameLimits().max_warming)


def test_unplugging_is_noticed_and_replugging_resumes(tmp_path):
    link = tmp_path / "skin"
    with started("--link", str(link), "--unplug-after", "0.5", "--replug-after", "0.8") as (port, _):
        skin = ReSkin(port)
        assert skin.features.source == "emulated"
        with skin:
            skin.read(20, PATIENCE)
            message = failure(skin)
            assert re.fullmatch(r"the skin on .* is gone \(.*\); plug it in and connect again", message)
            with pytest.raises(DeviceError, match="is gone"):
                skin.read(1)
            before = skin.counters.samples
            assert len(skin.since(-1).number) == before  # what came is still there
            with pytest.raises(DeviceError, match="is gone"):
                skin.since(before)

            def again() -> bool | None:
                try:
                    skin.connect()
                except DeviceError:
                    return None
                return True

            until(again)
            samples = skin.read(20, PATIENCE)
            assert samples.number[0] >= before
            assert skin.counters.connects == 2
            assert np.all(np.diff(skin.since(-1).time) >= 0)


def test_silence_is_noticed_and_ends():
    with started("--silent-after", "0.4", "--silent-for", "1.0") as (port, _), ReSkin(port) as skin:
        assert "check its cable" in failure(skin, DeviceTimeoutError, "has been silent for")
        with pytest.raises(DeviceTimeoutError, match="samples in"):
            skin.read(4000, timeout=0.05)
        skin.read(20, PATIENCE)
        skin.latest(PATIENCE)


def test_a_computer_that_does_not_listen_does_not_blame_the_board(monkeypatch):
    with started() as (port, _), ReSkin(port) as skin:
        monkeypatch.setattr(skin, "_process", lambda chunk, now: time.sleep(PATIENCE / 20))
        assert "too busy to listen" in failure(skin, DeviceTimeoutError, "this computer")


@pytest.mark.full
def test_a_board_that_never_speaks_is_given_up(monkeypatch):
    monkeypatch.setattr(streaming, "FIRST_BYTE_S", 0.3)
    with (
        started("--silent-after", "0") as (port, _),
        pytest.raises(DeviceTimeoutError, match="the board sends nothing"),
    ):
        ReSkin(port).connect()


@pytest.mark.full
def test_the_baud_rate_is_found_or_said_to_be_wrong(monkeypatch):
    monkeypatch.setattr(streaming, "FIRST_FRAME_S", 0.3)
    monkeypatch.setattr(driver, "START_UP_S", 0.0)
    with started("--baud", "460800") as (port, _):
        with pytest.raises(DeviceError, match=r"at 9600 baud: .* check the baud rate"):
            ReSkin(port, 9600).connect()
        with ReSkin(port) as skin:
            assert skin.info.baud == 460800
    with started("--baud", "57600", "--format", "text") as (port, _), ReSkin(port, 57600) as skin:
        assert skin.info.form == Format.TEXT


def test_a_port_in_use_or_missing_or_no_port_is_said_to_be_so(tmp_path):
    with started() as (port, _), ReSkin(port), pytest.raises(DeviceError, match="in use by another program"):
        ReSkin(port).connect()
    with pytest.raises(DeviceError, match=r"there is no port .*nowhere"):
        ReSkin(str(tmp_path / "nowhere")).connect()
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(DeviceError, match="is it a serial port"):
        ReSkin(str(tmp_path / "file")).connect()
    with pytest.raises(DeviceError, match="cannot be read"):
        Replay(tmp_path / "nowhere").connect()
    with pytest.raises(DeviceError, match=r"no skin in .*: the board sends nothing"):
        Replay(tmp_path / "file").connect()


def test_the_queue_lets_go_of_the_oldest_and_counts():
    with started("--rate", "2000") as (port, _), ReSkin(port, rate=2000.0, capacity=50) as skin:
        skin.since(-1)
        first = skin.read(1, PATIENCE).number[-1]
        skin.since(first - 1)
        until(lambda: True if skin.counters.samples > first + 300 else None)
        late = skin.since(first)
        assert len(late.number) == 50
        assert skin.counters.overflowed >= late.number[0] - first - 1 - 50 > 0
        with pytest.raises(ValueError, match="queue holds"):
            skin.read(51)


class Port:
    """A port that gives what it is told, then fails."""

    def __init__(self, chunks, error, at: str) -> None:
        self.chunks, self.error, self.at, self.closed = list(chunks), error, at, False

    @property
    def in_waiting(self) -> int:
        if not self.chunks and self.at == "in_waiting":
            raise self.error
        return len(self.chunks[0]) if self.chunks else 0

    def read(self, size: int) -> bytes:
        if not self.chunks:
            raise self.error
        return self.chunks.pop(0)

    def reset_input_buffer(self) -> None:
        pass

    def close(self) -> None:
        self.closed = True


@pytest.mark.parametrize(
    ("error", "at"),
    [(OSError(5, "Input/output error"), "in_waiting"), (TypeError("NoneType"), "read"), (MemoryError("none"), "read")],
)
def test_the_reader_never_dies_quietly(error, at):
    skin = ReSkin("/dev/skin")
    port = Port([b"".join(stream(20)), *stream(20, seed=1)], error, at)
    skin._serial = lambda *_, **__: port
    skin.connect()
    assert "the skin on /dev/skin is gone" in failure(skin)
    assert len(skin.since(-1).number) == 40
    assert port.closed
    skin.close()
    with pytest.raises(DeviceError):
        skin.read(1)


def test_a_full_disk_is_not_survived_in_silence(monkeypatch, tmp_path):
    with started() as (port, _), ReSkin(port) as skin:
        skin.record(tmp_path / "skin")

        def full(*_):
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(recording, "append", full)
        assert re.search("recording the skin on .* failed .*No space left", failure(skin))


def test_it_can_be_closed_from_anywhere_and_at_once():
    with started() as (port, _):
        skin = ReSkin(port)
        skin.connect()
        outcome: list[str] = []

        def wait() -> None:
            try:
                skin.read(4000, PATIENCE)
            except DeviceError as error:
                outcome.append(str(error))

        waiting = threading.Thread(target=wait)
        waiting.start()
        time.sleep(0.1)
        closing = threading.Thread(target=skin.close)
        closing.start()
        closing.join(PATIENCE)
        waiting.join(PATIENCE)
        assert not closing.is_alive()
        assert outcome == [f"the skin on {port} was closed; connect it again"]


def usb(device: str, vid: int | None, serial_number: str | None = None) -> SimpleNamespace:
    return SimpleNamespace(device=device, vid=vid, pid=1, description="QT Py", serial_number=serial_number)


def test_ports_are_found_by_who_made_the_board(monkeypatch):
    skin = ReSkin()
    monkeypatch.setattr(skin, "_comports", lambda: [usb("/dev/ttyS0", None)])
    with pytest.raises(DeviceError, match="no USB serial port"):
        skin.connect()
    monkeypatch.setattr(skin, "_comports", lambda: [usb("/dev/ttyUSB0", 0x0403), usb("/dev/ttyACM0", 0x239A)])
    assert skin._find() == "/dev/ttyACM0"
    assert [board.port for board in skin.ports()] == ["/dev/ttyACM0", "/dev/ttyUSB0"]
    assert skin.ports()[0] == BoardInfo("/dev/ttyACM0", None, Format.BINARY, "Adafruit QT Py", None, "239a:0001")
    monkeypatch.setattr(skin, "_comports", lambda: [usb("/dev/ttyACM0", 0x239A), usb("/dev/ttyACM1", 0x239A)])
    with pytest.raises(DeviceError, match=r"more than one .*ttyACM0 .*ttyACM1 .*name its port"):
        skin.connect()


def test_a_board_that_comes_back_under_another_name_is_known(monkeypatch):
    skin = ReSkin("/dev/nowhere0")
    skin._info = BoardInfo("/dev/nowhere0", 115200, Format.BINARY, "QT Py", "A1", "239a:0001")
    monkeypatch.setattr(skin, "_comports", lambda: [usb("/dev/nowhere1", 0x239A, "A1"), usb("/dev/other", 0x239A, "B")])
    assert skin._find() == "/dev/nowhere1"
    monkeypatch.setattr(skin, "_comports", lambda: [usb("/dev/other", 0x239A, "B")])
    assert skin._find() == "/dev/nowhere0"  # another board is not taken for it


def test_fields_that_are_sent_to_the_board_are_felt():
    with started("--field", "--noise", "0") as (port, process), ReSkin(port) as skin:
        host, number = process.stdout.readline().split()[1].split(":")
        still = skin.read(1, PATIENCE).reading[0]
        sent = 15 * np.arange(15.0)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
            out.sendto(sent.astype("<f4").tobytes(), (host, int(number)))
        felt = until(lambda: changed(skin, still))
    np.testing.assert_allclose(felt, sent, atol=0.25)


def test_what_was_sent_to_nobody_is_not_read():
    """A board that talked for a second to a port that nobody read has filled its buffer with the past."""
    with started("--field", "--noise", "0") as (port, process):
        host, number = process.stdout.readline().split()[1].split(":")
        holder = os.open(port, os.O_RDWR | os.O_NOCTTY)
        tty.setraw(holder)
        time.sleep(0.5)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
            out.sendto(np.full(15, 45.0, "<f4").tobytes(), (host, int(number)))
        time.sleep(0.2)
        with ReSkin(port) as skin:
            skin.read(20, PATIENCE)
            felt = skin.since(-1).reading
        os.close(holder)
    np.testing.assert_allclose(felt - rest(1, noise=0.0)[0], 45.0, atol=0.25)


class LatePort(Port):
    """A port whose last chunk is read late."""

    def read(self, size: int) -> bytes:
        if len(self.chunks) == 1:
            time.sleep(0.3)
        return super().read(size)


def test_a_late_read_is_counted_and_dated_back():
    skin = ReSkin("/dev/skin")
    whole = stream(120)
    skin._serial = lambda *_, **__: LatePort([b"".join(whole[:20]), b"".join(whole[20:])], OSError(5, "gone"), "read")
    skin.connect()
    until(lambda: skin.counters.samples == len(whole) or None)  # a busy machine may call it silent meanwhile
    assert skin.counters.stalls == 1
    times = skin.since(-1).time
    steps = np.diff(times[20:])  # the late chunk's frames, at the rate of the last second: 100 since the first chunk
    np.testing.assert_allclose(steps, steps.mean(), rtol=1e-6)
    assert 0.99 * 0.3 <= 99 * steps.mean() <= PATIENCE
    assert (np.diff(times) >= 0).all()


def changed(skin, still: np.ndarray) -> np.ndarray | None:
    change = skin.read(1, PATIENCE).reading[0] - still
    return change if np.any(change != 0) else None


def test_the_board_ends_with_the_program_that_started_it():
    with started() as (port, process):
        process.stdin.close()
        assert process.wait(PATIENCE) == 0
        process.stdin = None
    assert not os.path.exists(port) or port.startswith("/dev/pts/")


@pytest.mark.full
def test_the_driver_needs_no_jax_and_no_sdk_to_be_imported():
    code = (
        "import sys, i2t.hardware.reskin.driver, i2t.hardware.reskin.monitor, i2t.emulators.reskin_board as board\n"
        "assert 'jax' not in sys.modules and 'serial' not in sys.modules\n"
        "i2t.hardware.reskin.driver.ReSkin()\n"
        "assert 'jax' not in sys.modules and 'serial' in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


# The monitor.


def test_a_bar_shows_sign_size_and_overflow():
    half = monitor.HALF_BAR_WIDTH
    assert monitor.bar(0.0) == half * " " + "|" + half * " "
    assert monitor.bar(0.5) == half * " " + "|" + half // 2 * "#" + half // 2 * " "
    assert monitor.bar(-1.0) == half * "#" + "|" + half * " "
    assert monitor.bar(3.0).endswith("#>")
    assert monitor.bar(-3.0).startswith("<#")
    assert {len(monitor.bar(part)) for part in np.linspace(-2, 2, 41)} == {2 * half + 1}


def test_the_picture_says_what_was_read():
    readings, celsius = rest(20, noise=0.0)
    shown = Samples(np.arange(20), np.arange(20.0), readings + FIELD, celsius)
    counters = SkinCounters(samples=990, lost=10, gaps=7, skipped=800, rate=399.96)
    info = BoardInfo("/dev/ttyACM0", 115200, Format.BINARY, "QT Py", "A1", "239a:80cb")
    lines = monitor.picture(info, "real", counters, shown, readings[0], scale=100.0)
    assert lines[0] == "/dev/ttyACM0  real  binary  115200 baud  QT Py 239a:80cb A1"
    assert "400.0 Hz  990 samples  lost 10 (1.00 %) in 7 gaps  800 stray bytes" in lines[1]
    rows = [line.split() for line in lines[4:19]]
    assert [float(row[2]) for row in rows] == pytest.approx(FIELD, abs=0.051)
    assert float(lines[19].split()[-2]) == pytest.approx(np.linalg.norm(FIELD), abs=0.05)


def test_the_monitor_runs(capsys, monkeypatch, tmp_path):
    attempts = (tmp_path / f"skin-{i}" for i in range(20))  # a monitor that other programs starve ends with 1
    with started("--press", "1") as (port, _):
        path = next(p for p in attempts if monitor.main(["--port", port, "--seconds", "2", "--record", str(p)]) == 0)
    assert "Hz" in capsys.readouterr().out
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    assert any(monitor.main(["--replay", str(path), "--seconds", "1"]) == 0 for _ in range(20))
    shown = capsys.readouterr().out
    assert "replay" in shown
    assert "\x1b[21F\x1b[J" in shown  # drawn over the last picture
    assert monitor.main(["--port", str(tmp_path / "nowhere")]) == 1
    assert capsys.readouterr().err.startswith("error: there is no port")
    assert monitor.main(["--list"]) == 0


def test_not_connected_is_said():
    skin = ReSkin("/dev/skin")
    for call in (skin.latest, lambda: skin.read(1), lambda: skin.since(-1), lambda: skin.info):
        with pytest.raises(NotConnectedError):
            call()
