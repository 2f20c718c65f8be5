"""Bytes of a skin: formats by hand, and frames that are accepted from clean, damaged and hostile streams."""

import functools
import operator
import struct
import zlib
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from i2t.emulators.reskin_board import Readings
from i2t.hardware.reskin import frames
from i2t.hardware.reskin.driver import diagnose
from i2t.hardware.reskin.frames import FIELD_RANGE_UT, TEMPERATURE_RANGE_C, Decoder, decode, decode_any, decoders
from i2t.hardware.reskin.layouts import Format, FrameLayout, encode
from i2t.skin.boards import make_board
from tests.faults.skin import flipped_bits

SIZES = {Format.BINARY: 82, Format.FRAMED: 64, Format.CRC: 87}  # bytes of a frame of five chips
SIZE = SIZES[Format.BINARY]


def rest(count: int, seed: int = 0, noise: float = 1.0, temperature: float | None = None, board=None) -> tuple:
    """Readings and temperatures of a real board at rest, by its measured noise."""
    chips = Readings(noise, 0.0, seed, board)
    pairs = [chips.at(0.0) for _ in range(count)]
    celsius = np.array([celsius for _, celsius in pairs])
    return np.array([reading for reading, _ in pairs]), celsius if temperature is None else 0 * celsius + temperature


def sent(readings, celsius, form: Format = Format.BINARY) -> list[bytes]:
    return [encode(*sample, form, i) for i, sample in enumerate(zip(readings, celsius, strict=True))]


def stream(count: int, form: Format = Format.BINARY, **kwargs) -> list[bytes]:
    return sent(*rest(count, **kwargs), form)


def decoded(data: bytes, form: Format = Format.BINARY) -> tuple:
    return decode(Decoder(FrameLayout(form)), data)


def numbers(delivered_frames, size: int = SIZE) -> list[int]:
    """Numbers of the frames of one size that were found in a stream."""
    assert not any(frame.end % size for frame in delivered_frames)
    return [frame.end // size - 1 for frame in delivered_frames]


def corrupt(chunk: bytes, substitute: float, drop: float, rng: np.random.Generator) -> bytes:
    """Bytes that arrive over a line that changes and drops bytes with these probabilities."""
    data = np.frombuffer(chunk, np.uint8)
    changed = rng.random(data.size) < substitute
    data = data + np.where(changed, rng.integers(1, 256, data.size), 0).astype(np.uint8)
    return data[rng.random(data.size) >= drop].tobytes()


def adds_up(decoder: Decoder, total: int) -> bool:
    return decoder.bytes == decoder.taken + decoder.skipped + len(decoder.rest) == total


# The formats, by hand from the public firmware.

FIELD = np.arange(15) * 10.0 + 1.25
CELSIUS = np.array([24.5, 24.75, 25.0, 25.25, 25.5])
CHIPS = np.column_stack([CELSIUS, FIELD.reshape(5, 3)])
COUNTED = b"\x00" + struct.pack("<15f", *FIELD)
WARM = b"".join(struct.pack("<4f", *chip) for chip in CHIPS)
BY_HAND = {
    Format.BINARY: WARM + b"\r\n",
    Format.FRAMED: b"\xaa\x55" + COUNTED + bytes([functools.reduce(operator.xor, COUNTED)]),
    Format.CRC: b"\xa5\x5a\x00" + WARM + struct.pack("<I", zlib.crc32(b"\x00" + WARM)),
}
CHECKED = (Format.FRAMED, Format.CRC)


@pytest.mark.parametrize("form", Format)
def test_formats_are_those_of_the_firmware(form):
    assert encode(FIELD, CELSIUS, form) == BY_HAND[form]
    (decoder,), delivered_frames = decode_any(decoders(), b"7\r\n" + 4 * BY_HAND[form])
    assert (decoder.layout, len(delivered_frames)) == (FrameLayout(form), 4)
    for frame in delivered_frames:
        np.testing.assert_array_equal(frame.reading, FIELD)
        np.testing.assert_array_equal(frame.temperature, 5 * [np.nan] if form == Format.FRAMED else CELSIUS)
    assert len(BY_HAND[form]) == FrameLayout(form).size == SIZES[form]  # as its maker says
    if form in CHECKED:
        assert encode(FIELD, CELSIUS, form, 0x1FF)[2] == 0xFF


@pytest.mark.parametrize("form", Format)
@pytest.mark.parametrize("chips", [1, 5, 16])
def test_every_frame_of_a_clean_stream_of_any_board_arrives_once(form, chips):
    readings, celsius = rest(40, board=make_board(f"grid-1x{chips}"))
    whole = sent(readings, celsius, form)
    start = len(whole[0]) // 2
    data = b"".join(whole)[start:] + b"\r\n"
    (decoder,), delivered_frames = decode_any(decoders(chips=chips), data)
    assert decoder.layout == FrameLayout(form, chips)
    ends = np.cumsum([len(frame) for frame in whole])[1:] - start
    assert [frame.end for frame in delivered_frames] == ends.tolist()
    assert (decoder.lost, decoder.gaps) == (0, 0)
    np.testing.assert_allclose([frame.reading for frame in delivered_frames], readings[1:], atol=1e-3)
    expected = np.full((39, chips), np.nan) if form == Format.FRAMED else celsius[1:]
    np.testing.assert_allclose([frame.temperature for frame in delivered_frames], expected, atol=1e-3)
    assert not decode_any(decoders(chips + 1), data)[1]
    assert f"frames of {chips} chips arrive, not of 7" in diagnose(data, 7)


@settings(max_examples=30, deadline=None)
@given(
    st.sampled_from(list(Format)),
    st.integers(0, 1000),
    st.sampled_from([(0.004, 0.001), (0.1, 0.0), (0.01, 0.05)]),
    st.lists(st.integers(0, 5000), max_size=12),
    st.integers(0, 90),
)
def test_chunks_do_not_matter_and_no_damage_gives_an_implausible_frame(form, seed, damage, cuts, start):
    data = corrupt(b"".join(stream(30, form, seed=seed % 5)), *damage, np.random.default_rng(seed))[start:]
    once, expected = decode_any(decoders(), data)
    candidates, delivered_frames = decoders(), []
    for begin, end in pairwise([0, *sorted(min(cut, len(data)) for cut in cuts), len(data)]):
        candidates, more = decode_any(candidates, data[begin:end])
        delivered_frames += more
        assert all(adds_up(decoder, end) for decoder in candidates)
    assert [frame.end for frame in delivered_frames] == [frame.end for frame in expected]
    np.testing.assert_array_equal([frame.reading for frame in delivered_frames], [frame.reading for frame in expected])
    for decoder, expected_decoder in zip(candidates, once, strict=True):
        np.testing.assert_equal(decoder._asdict(), expected_decoder._asdict())
    for frame in delivered_frames:
        size = np.abs(frame.reading)
        assert not ((size > 0) & (size < FIELD_RANGE_UT[0])).any()
        assert not (size > FIELD_RANGE_UT[1]).any()
        assert not ((frame.temperature < TEMPERATURE_RANGE_C[0]) | (frame.temperature > TEMPERATURE_RANGE_C[1])).any()


@settings(max_examples=40, deadline=None)
@given(st.binary(max_size=3000), st.sampled_from(list(Format)))
def test_noise_is_not_taken_for_a_board(data, form):
    decoder, delivered_frames = decoded(data, form)
    assert not delivered_frames
    assert adds_up(decoder, len(data))
    assert diagnose(data, 5)


@pytest.mark.parametrize(
    ("form", "substitute", "drop", "missed"),
    [(Format.BINARY, 0.0, 2e-4, 0.04), (Format.FRAMED, 0.01, 0.0, 0.01), (Format.FRAMED, 0.0, 0.01, 0.01),
     (Format.CRC, 0.01, 0.0, 0.03), (Format.CRC, 0.0, 0.01, 0.03)],
)  # fmt: skip
def test_damage_loses_only_the_damaged_frames(form, substitute, drop, missed):
    count, rng = 2500, np.random.default_rng(7)
    truth, celsius = rest(count)
    whole = sent(truth, celsius, form)
    arrived = [corrupt(frame, substitute, drop, rng) for frame in whole]
    number = {int(end): i for i, end in enumerate(np.cumsum([len(frame) for frame in arrived]))}
    decoder, delivered_frames = decoded(b"".join(arrived), form)
    assert adds_up(decoder, max(number))
    intact = {i for i, (a, b) in enumerate(zip(arrived, whole, strict=True)) if a == b}
    delivered = [number.get(frame.end) for frame in delivered_frames]
    assert len(intact - set(delivered)) < missed * len(intact)
    off = [
        np.abs(frame.reading - truth[i]).max()
        for i, frame in zip(delivered, delivered_frames, strict=True)
        if i is not None
    ]
    # Of two changes behind a checksum one in 255 cancels.
    assert delivered.count(None) + np.sum(np.array(off) > 1e-3) <= (
        0.002 * len(delivered_frames) if form == Format.FRAMED else 0
    )
    lost = count - min(i for i in delivered if i is not None) - len(delivered_frames)
    assert abs(decoder.lost - lost) <= 5


@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_line_ends_within_numbers_do_not_split_frames(noise):
    """With 34.513 degrees on five chips there are six line ends in a frame."""
    (celsius,) = struct.unpack("<f", bytes.fromhex("980d0a42"))
    data = b"".join(stream(6, noise=noise, temperature=celsius))
    assert data.count(b"\r\n") >= 36
    for start in range(SIZE):
        _, delivered_frames = decoded(data[start:])
        assert [(frame.end + start) % SIZE for frame in delivered_frames] == [0] * (6 - (start > 0))


@pytest.mark.parametrize("start", [0, 3])
def test_a_stream_with_two_possible_alignments_is_refused(start):
    """A repeated frame is equally plausible three bytes later."""
    frame = b"\x42\x0d\x0a\x42" + 76 * b"\x42" + b"\r\n"
    assert frames._values(FrameLayout(), (2 * frame)[start : start + SIZE]) is not None
    data = (20 * frame)[start:]
    decoder, delivered_frames = decoded(data)
    assert not delivered_frames
    assert "alignments" in diagnose(data, 5)
    _, delivered_frames = decode(decoder, b"".join(stream(5)))
    # The last of them begins a run that has one alignment.
    assert [frame.end for frame in delivered_frames] == [len(data) + SIZE * i for i in range(6)]


@pytest.mark.parametrize("value", [np.nan, np.inf, 6e4, 1e-6])
def test_an_impossible_value_rejects_its_frame_but_a_jump_is_kept(value):
    readings, celsius = rest(20)
    readings[5, 7] = value
    readings[12:] += 500.0  # a magnet came
    decoder, delivered_frames = decoded(b"".join(sent(readings, celsius)))
    assert numbers(delivered_frames) == [i for i in range(20) if i != 5]
    assert (decoder.lost, decoder.gaps, decoder.skipped) == (1, 1, SIZE)


# Checksum and counter.


@pytest.mark.parametrize("form", CHECKED)
def test_every_changed_byte_is_found(form):
    whole, size = b"".join(stream(8, form)), SIZES[form]
    for place, change in enumerate(np.random.default_rng(0).integers(1, 256, size)):
        bad = bytearray(whole)
        bad[4 * size + place] ^= int(change)
        decoder, delivered_frames = decoded(bytes(bad), form)
        assert numbers(delivered_frames, size) == [0, 1, 2, 3, 5, 6, 7]
        assert (decoder.lost, decoder.gaps, decoder.skipped) == (1, 1, size)


def test_flipped_bits_pass_an_exclusive_or_and_no_crc():
    trials = {form: [flipped_bits(form, 0.001, seed, 2000) for seed in range(3)] for form in CHECKED}
    wrong = {form: sum(trial["wrong"] for trial in trials[form]) for form in CHECKED}
    delivered = {form: sum(trial["delivered"] for trial in trials[form]) for form in CHECKED}
    assert wrong[Format.CRC] == 0 < 0.003 * delivered[Format.FRAMED] < wrong[Format.FRAMED]
    for form in CHECKED:
        assert delivered[form] - wrong[form] == sum(trial["whole"] for trial in trials[form])


@pytest.mark.parametrize("form", CHECKED)
def test_a_frame_counter_reveals_lost_frames(form):
    readings, celsius = rest(300)
    gone = {5, 6, 7, 100, *range(200, 270)}
    whole = sent(readings, celsius, form)
    decoder, delivered_frames = decoded(b"".join(frame for i, frame in enumerate(whole) if i not in gone), form)
    assert (len(delivered_frames), decoder.lost, decoder.gaps) == (300 - len(gone), len(gone), 3)
    stuck = b"".join(encode(reading, celsius[0], form, 7) for reading in readings[:40])
    decoder, delivered_frames = decoded(stuck, form)  # a board without a working counter loses nothing
    assert (len(delivered_frames), decoder.lost, decoder.gaps) == (40, 0, 0)


# Chips that fail.


@pytest.mark.parametrize("form", Format)
def test_a_chip_that_fails_is_missing_and_never_zero(form):
    truth, celsius = rest(40)
    truth[10:20, 6:9] = np.nan
    decoder, delivered_frames = decoded(b"\n" + b"".join(sent(truth, celsius, form)) + b"\n", form)
    np.testing.assert_array_equal(np.isnan([frame.reading for frame in delivered_frames]), np.isnan(truth))
    assert (decoder.missing, decoder.empty) == (10, 0)


def test_frames_without_any_chip_are_counted_and_not_delivered():
    truth, celsius = rest(90)
    truth[np.arange(90) % 3 != 0] = np.nan
    decoder, delivered_frames = decoded(b"".join(sent(truth, celsius, Format.FRAMED)), Format.FRAMED)
    assert (len(delivered_frames), decoder.empty, decoder.missing, decoder.lost) == (30, 60, 0, 0)
    assert np.isfinite([frame.reading for frame in delivered_frames]).all()


def test_the_problem_of_a_stream_is_reported():
    readings, celsius = rest(20)
    cold = np.where(np.arange(5) == 3, -998.1, celsius)  # what the firmware makes of a chip that does not answer
    for data, why in (
        (b"", "sends nothing"),
        (np.random.default_rng(0).bytes(2000), "baud"),
        (b"".join(sent(readings, cold)), "chip 3 reads -998.1, "),
        (b"24.5\t1.2\t3.4\t5.6\r\n", "lines of text"),
        (b"".join(sent(np.nan * readings, celsius, Format.FRAMED)), "no chip answers"),
    ):
        assert why in diagnose(data, 5)
