"""Bytes of a ReSkin or AnySkin board to frames, and back: pure functions on whatever part of the stream has come.

The boards' public firmware sends temperature t (degrees Celsius) and field x, y, z (uT) of n chips, five by default, in
one of three ways:

    binary       n x little-endian float32 (t, x, y, z), then CR LF: 16 n + 2 bytes
    text         n x "x\\ty\\tz\\tt\\t", two decimals, then CR LF (ReSkin)
    text-glued   n x "t\\tx\\ty\\tz" with nothing between chips, two decimals, then CR LF (AnySkin)

There is no header, counter or checksum, CR LF also occurs within numbers (34.513 degrees is 98 0d 0a 42), and a byte
may be changed or lost. So a *candidate* is a stretch of the right form whose 4 n values are plausible, and a candidate
is a *frame* if

    it lies within `max_jump` of the last frame in every channel, or
    it begins a run of `run_length` adjoining candidates, each within `max_jump` of the one before, that no other
    candidate overlaps.

Candidates are tried from the first byte after the last frame onwards, so a changed byte costs its own frame, a lost
byte the frame it was in, and a sudden but lasting change of the field nothing. In the binary format values must also be
whole numbers of the converter's steps once these are known (`i2t.hardware.reskin.quantization`), which is as good as a
checksum. What may pass unseen is a changed value within `max_jump` of the last one, and after the first frames one that
is a whole number of steps too. What is decided depends on the stream alone, not on how it was cut into chunks.
"""

import re
import struct
from dataclasses import dataclass
from enum import StrEnum
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from i2t.hardware.reskin.quantization import NO_STEPS, ConverterSteps, learn_steps
from i2t.skin import boards

DEFAULT_CHIPS = len(boards.reskin_board().chips)

LEARNING_FRAMES = 128  # from which the converter's steps are learned
MAX_MISFITS = 64  # candidates in a row that the steps alone exclude, after which these are not believed any more
VALUE_TEXT_BYTES = 20  # of a number in a line with its separator; it has at most 9 characters
LINE_END = b"\r\n"
MIN_TEMPERATURE_SIZE = 1e-3  # degrees; the step is 1/45 and does not begin at 0, so nothing but zero lies below

_NUMBER = rb"(-?\d{1,6}\.\d\d)"


class Format(StrEnum):
    """What a board sends."""

    BINARY = "binary"
    TEXT = "text"
    TEXT_GLUED = "text-glued"


class FrameLayout(NamedTuple):
    """How the frames of a board look."""

    form: Format = Format.BINARY
    chips: int = DEFAULT_CHIPS

    @property
    def binary(self) -> struct.Struct:
        """The values and the end of a binary frame."""
        return _binary(self.chips)

    @property
    def line(self) -> re.Pattern[bytes]:
        """A line of text, from the end of the line before to its own carriage return."""
        return _line(self.form, self.chips)

    @property
    def max_line_bytes(self) -> int:
        """No line is longer."""
        return VALUE_TEXT_BYTES * 4 * self.chips


@lru_cache
def _binary(chips: int) -> struct.Struct:
    return struct.Struct(f"<{4 * chips}f{len(LINE_END)}s")


@lru_cache
def _line(form: Format, chips: int) -> re.Pattern[bytes]:
    numbers = rb"\t".join([_NUMBER] * (4 * chips)) if form == Format.TEXT else rb"\t".join([_NUMBER] * 4) * chips
    return re.compile(rb"\n?" + numbers + rb"\t?\r?")


@dataclass(frozen=True)
class FrameLimits:
    """What can be true of a frame. `full_scale` is the range of the chip (MLX90393); a board of known gain has a
    smaller one, 2^15 of its steps.
    """

    min_temperature: float = -40.0  # degrees Celsius
    max_temperature: float = 85.0
    full_scale: float = 50e3  # uT
    min_field: float = 0.1  # uT; the finest step is 0.15, so nothing but zero lies below
    max_jump: float = 100.0  # uT, from one frame to the next, in each channel: 15 standard deviations at rest
    max_warming: float = 2.0  # K, from one frame to the next
    run_length: int = 3  # candidates in a row that are believed without a frame before them


class Frame(NamedTuple):
    """One sample of all chips."""

    end: int  # bytes of the stream up to and with this frame
    reading: Float[np.ndarray, " c"]  # uT, in the board's order
    temperature: Float[np.ndarray, " chips"]  # degrees Celsius


class Decoder(NamedTuple):
    """Where decoding stands. `bytes == taken + skipped + len(rest)` at all times."""

    layout: FrameLayout = FrameLayout()
    limits: FrameLimits = FrameLimits()
    rest: bytes = b""  # not decided yet
    last: np.ndarray | None = None  # (chips, 4) t, x, y, z of the last frame
    early: tuple[np.ndarray, ...] = ()  # the first frames, until the steps are learned
    steps: ConverterSteps | None = None
    misfits: int = 0  # candidates in a row that only the steps excluded
    frames: int = 0
    taken: int = 0  # bytes in frames
    skipped: int = 0  # bytes in none
    gap: int = 0  # of those, since the last frame
    gaps: int = 0  # stretches of skipped bytes between frames
    lost: int = 0  # frames that were in them, by their length

    @property
    def bytes(self) -> int:
        """All that came."""
        return self.taken + self.skipped + len(self.rest)


def decoders(limits: FrameLimits | None = None, chips: int = DEFAULT_CHIPS) -> tuple[Decoder, ...]:
    """One decoder for each format, for `decode_any`.

    Args:
        limits: What can be true of a frame.
        chips: How many the board has.

    Returns:
        Decoders at the beginning of a stream.
    """
    return tuple(Decoder(FrameLayout(form, chips), limits or FrameLimits()) for form in Format)


def decode_any(candidates: tuple[Decoder, ...], chunk: bytes) -> tuple[tuple[Decoder, ...], list[Frame]]:
    """Take the next bytes of a stream whose format is not known.

    Args:
        candidates: Decoders that may fit.
        chunk: The next bytes.

    Returns:
        The decoders that may still fit, only one from the first frame on, and its frames.
    """
    found = [decode(decoder, chunk) for decoder in candidates]
    hits = [(frames[0].end, i) for i, (_, frames) in enumerate(found) if frames]
    if not hits:
        return tuple(decoder for decoder, _ in found), []
    decoder, frames = found[min(hits)[1]]
    return (decoder,), frames


def decode(decoder: Decoder, chunk: bytes) -> tuple[Decoder, list[Frame]]:
    """Take the next bytes of the stream.

    Args:
        decoder: Where decoding stands.
        chunk: The next bytes.

    Returns:
        Where it stands then, and the frames that are certain by now.
    """
    data = decoder.rest + chunk
    data_start = decoder.taken + decoder.skipped  # of `data` in the stream
    frames: list[Frame] = []
    search = 0  # candidates are looked for from here
    done = 0  # bytes before are in frames or in none
    while True:
        begin, end = _window(decoder.layout, data, search)
        decoder, done = decoder._replace(gap=decoder.gap + begin - done), begin
        if end is None:
            break
        decoder, values = _candidate(decoder, data[begin:end])
        certain = _is_frame(decoder, values, data, begin, end)
        if certain is None:
            break
        if not certain or values is None:
            search = begin + 1
            continue
        frames.append(Frame(data_start + end, values[:, 1:].ravel(), values[:, 0]))
        decoder = _with_frame(decoder, values, end - begin)
        search = done = end
    return decoder._replace(rest=data[done:], skipped=data_start + done - decoder.taken), frames


def encode(
    reading: Float[np.ndarray, " c"], temperature: Float[np.ndarray, " chips"], form: Format = Format.BINARY
) -> bytes:
    """A frame as a board sends it.

    Args:
        reading: (3 chips,) uT, in the board's order.
        temperature: (chips,) degrees Celsius.
        form: Which firmware the board has.

    Returns:
        The frame's bytes, with its line end.
    """
    field = reading.reshape(len(temperature), 3)
    if form == Format.BINARY:
        return _binary(len(temperature)).pack(*np.column_stack([temperature, field]).ravel(), LINE_END)
    if form == Format.TEXT:
        chips = np.column_stack([field, temperature])
        return b"".join(b"%.2f\t" % value for value in chips.ravel()) + LINE_END
    chips = np.column_stack([temperature, field])
    return b"".join(b"\t".join(b"%.2f" % value for value in chip) for chip in chips) + LINE_END


def diagnose(data: bytes, limits: FrameLimits | None = None, chips: int = DEFAULT_CHIPS) -> str:
    """Why these bytes, which gave no frame, gave none.

    Args:
        data: What a board has sent.
        limits: What can be true of a frame.
        chips: How many the board is taken to have.

    Returns:
        Half a sentence with the remedy.
    """
    limits = limits or FrameLimits()
    if not data:
        return "the board sends nothing; check its cable and that its sketch runs"
    others = [n for n in range(1, boards.MAX_CHIPS + 1) if n != chips and decode_any(decoders(limits, n), data)[1]]
    if others:
        return f"frames of {others[0]} chips come, not of {chips}; say which board it is"
    layout = FrameLayout(Format.BINARY, chips)
    ends = {found.start() for found in re.finditer(LINE_END, data)}
    first = min((end for end in ends if end + layout.binary.size in ends), default=None)
    if first is not None:  # two line ends in the distance of a frame
        *values, _ = layout.binary.unpack_from(data, first + len(LINE_END))
        return _why_implausible(np.array(values).reshape(chips, 4), limits)
    if sum(byte in b"-.0123456789\t\r\n " for byte in data) > 0.95 * len(data):
        lines = data.split(LINE_END)[1:-1]
        counts = [len(re.findall(_NUMBER, line)) for line in lines]
        if counts:
            usual = max(set(counts), key=counts.count)
            return f"its lines hold {usual} plausible numbers, not {4 * chips} of one known order"
    return f"{len(data)} bytes came that are no frames; check the baud rate and that this port is the skin's"


def _why_implausible(table: Float[np.ndarray, "chips 4"], limits: FrameLimits) -> str:
    for chip, (celsius, *field) in enumerate(table):
        if not _plausible(table[chip : chip + 1], limits):
            return (
                f"frames come, but chip {chip} reads {celsius:.4g} degrees and"
                f" ({', '.join(f'{value:.4g}' for value in field)}) uT, which cannot be; check its soldering, or the"
                " limits if the board's gain is unusual"
            )
    return "frames come, but they jump or fit two alignments; keep the skin still while it connects"


def _window(layout: FrameLayout, data: bytes, search: int) -> tuple[int, int | None]:
    """The next stretch that may be a candidate, or where to look again when more bytes have come. A window of text
    begins with the end of the line before it.
    """
    if layout.form == Format.BINARY:
        size = layout.binary.size
        found = data.find(LINE_END, search + size - len(LINE_END))
        if found < 0:
            return max(search, len(data) - size + 1), None
        return found + len(LINE_END) - size, found + len(LINE_END)
    while (begin := data.find(b"\n", search)) >= 0:
        end = data.find(b"\n", begin + 1, begin + layout.max_line_bytes)
        if end >= 0:
            return begin, end
        if len(data) < begin + layout.max_line_bytes:
            return begin, None
        search = begin + 1
    return len(data), None


def _candidate(decoder: Decoder, window: bytes) -> tuple[Decoder, np.ndarray | None]:
    """The values (chips, 4) of a window, None if it is no candidate, and the decoder, which counts what only the
    converter's steps exclude and gives them up after too many.
    """
    values = _values(decoder.layout, window, decoder.limits)
    if values is None or decoder.steps is None or decoder.steps.fit(values):
        return decoder, values
    misfits = decoder.misfits + _near(decoder.last, values, decoder.limits)
    decoder = decoder._replace(misfits=misfits)
    if misfits > MAX_MISFITS:
        return decoder._replace(steps=NO_STEPS), values
    return decoder, None


def _is_frame(decoder: Decoder, values: np.ndarray | None, data: bytes, begin: int, end: int) -> bool | None:
    """Whether a candidate is a frame; None if more bytes must come."""
    if values is None:
        return False
    if _near(decoder.last, values, decoder.limits):
        return True
    return _begins_run(decoder.layout, data, begin, end, decoder.limits)


def _with_frame(decoder: Decoder, values: np.ndarray, size: int) -> Decoder:
    """The decoder after a frame of `size` bytes; the bytes in the gap before it become lost frames."""
    if decoder.gap and decoder.frames:
        lost = max(1, round(decoder.gap / size))
        decoder = decoder._replace(gaps=decoder.gaps + 1, lost=decoder.lost + lost)
    decoder = decoder._replace(last=values, gap=0, misfits=0, taken=decoder.taken + size, frames=decoder.frames + 1)
    if decoder.layout.form != Format.BINARY or decoder.steps is not None:
        return decoder
    early = (*decoder.early, values)
    if len(early) < LEARNING_FRAMES:
        return decoder._replace(early=early)
    return decoder._replace(steps=learn_steps(np.stack(early)), early=())


def _adjoining(layout: FrameLayout, data: bytes, end: int) -> int | None:
    """Where the window that begins at `end` ends; `end` if there is none, None if more bytes must come."""
    if layout.form == Format.BINARY:
        following = end + layout.binary.size
        return following if len(data) >= following else None
    found = data.find(b"\n", end + 1, end + layout.max_line_bytes)
    if found >= 0:
        return found
    return end if len(data) >= end + layout.max_line_bytes else None


def _begins_run(layout: FrameLayout, data: bytes, begin: int, end: int, limits: FrameLimits) -> bool | None:
    """Whether a run of candidates begins here that no other overlaps; None if more bytes must come."""
    values, stop = _values(layout, data[begin:end], limits), end
    for _ in range(limits.run_length - 1):
        following = _adjoining(layout, data, stop)
        if following is None:
            return None
        after = _values(layout, data[stop:following], limits)
        if values is None or after is None or not _near(values, after, limits):
            return False
        values, stop = after, following
    return layout.form != Format.BINARY or not _has_rival(layout, data, begin, stop, limits)  # lines cannot overlap


def _has_rival(layout: FrameLayout, data: bytes, begin: int, stop: int, limits: FrameLimits) -> bool:
    """Whether a candidate in another alignment lies within a run, but for its first bytes."""
    size = layout.binary.size
    end = begin
    while (end := data.find(LINE_END, end + 1, stop)) >= 0:
        first = end + len(LINE_END) - size
        another = first > begin and (first - begin) % size
        if another and _values(layout, data[first : first + size], limits) is not None:
            return True
    return False


def _values(layout: FrameLayout, window: bytes, limits: FrameLimits) -> np.ndarray | None:
    """(chips, 4) t, x, y, z of a window, if they are plausible."""
    if layout.form == Format.BINARY:
        *numbers, end = layout.binary.unpack(window)
        if end != LINE_END:
            return None
        table = np.array(numbers).reshape(layout.chips, 4)
    else:
        line = layout.line.fullmatch(window)
        if line is None:
            return None
        table = np.array([float(number) for number in line.groups()]).reshape(layout.chips, 4)
        if layout.form == Format.TEXT:
            table = np.roll(table, 1, axis=1)
    return table if _plausible(table, limits) else None


def _plausible(table: Float[np.ndarray, "chips 4"], limits: FrameLimits) -> bool:
    """Whether temperatures and fields lie within the limits; NaN does not."""
    celsius, field = table[:, 0], np.abs(table[:, 1:])
    size = np.abs(celsius)
    return bool(
        np.all((celsius >= limits.min_temperature) & (celsius <= limits.max_temperature))
        and np.all((size == 0) | (size >= MIN_TEMPERATURE_SIZE))
        and np.all((field <= limits.full_scale) & ((field == 0) | (field >= limits.min_field)))
    )


def _near(last: np.ndarray | None, values: np.ndarray, limits: FrameLimits) -> bool:
    """Whether a frame may follow another."""
    if last is None:
        return False
    change = np.abs(values - last)
    return bool(np.all(change[:, 0] <= limits.max_warming) and np.all(change[:, 1:] <= limits.max_jump))
