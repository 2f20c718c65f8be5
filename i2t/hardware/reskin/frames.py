"""Bytes of a ReSkin or AnySkin board to frames, and back: pure functions on whatever part of the stream has come.

The boards' public firmware sends five chips' temperature (degrees Celsius) and field (uT) in one of three ways:

    binary       5 x little-endian float32 (t, x, y, z), then CR LF: 82 bytes
    text         5 x "x\\ty\\tz\\tt\\t", two decimals, then CR LF (ReSkin)
    text-glued   5 x "t\\tx\\ty\\tz" with nothing between chips, two decimals, then CR LF (AnySkin)

There is no header, counter or checksum, CR LF also occurs within numbers (34.513 degrees is 98 0d 0a 42), and a byte
may be changed or lost. So a *candidate* is a stretch of the right form whose 20 values are plausible, and a candidate
is a *frame* if

    it lies within `jump` of the last frame in every channel, or
    it begins a run of `run` adjoining candidates, each within `jump` of the one before, that no other candidate
    overlaps.

Candidates are tried from the first byte after the last frame onwards, so a changed byte costs its own frame, a lost
byte the frame it was in, and a sudden but lasting change of the field nothing. In the binary format values must also be
whole numbers of the converter's steps once these are known (`i2t.hardware.reskin.quantization`), which is as good as a
checksum. What may pass unseen is a changed value within `jump` of the last one, and after the first frames one that is
on the grid too. What is decided depends on the stream alone, not on how it was cut into chunks.
"""

import re
import struct
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from i2t.hardware.reskin.quantization import NO_GRID, Grid, learn
from i2t.types import CHIPS


class Format(StrEnum):
    """What a board sends."""

    BINARY = "binary"
    TEXT = "text"
    TEXT_GLUED = "text-glued"


@dataclass(frozen=True)
class Limits:
    """What can be true of a frame. `full_scale` is the range of the chip (MLX90393); a board of known gain has a
    smaller one, 2^15 of its steps.
    """

    coldest: float = -40.0  # degrees Celsius
    hottest: float = 85.0
    full_scale: float = 50e3  # uT
    least: float = 0.1  # uT; the finest step is 0.15, so nothing but zero lies below
    jump: float = 100.0  # uT, from one frame to the next, in each channel: 15 standard deviations at rest
    warming: float = 2.0  # K, from one frame to the next
    run: int = 3  # candidates in a row that are believed without a frame before them


class Frame(NamedTuple):
    """One sample of all chips."""

    end: int  # bytes of the stream up to and with this frame
    reading: np.ndarray  # (15,) uT, in the board's order
    temperature: np.ndarray  # (5,) degrees Celsius


class Decoder(NamedTuple):
    """Where decoding stands. `bytes == taken + skipped + len(rest)` at all times."""

    form: Format = Format.BINARY
    limits: Limits = Limits()
    rest: bytes = b""  # not decided yet
    last: np.ndarray | None = None  # (5, 4) t, x, y, z of the last frame
    early: tuple[np.ndarray, ...] = ()  # the first frames, until the grid is learned
    grid: Grid | None = None
    off: int = 0  # candidates in a row that only the grid excluded
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


BINARY = struct.Struct("<20f2s")
LEARNED = 128  # frames from which the grid is learned
DOUBTED = 64  # candidates in a row off the grid, after which it is not believed any more
LONGEST = 400  # bytes of a line of text; 20 numbers of at most 9 characters, separators and an end are 220
END = b"\r\n"
TINY = 1e-3  # degrees; the sensor's step is 1/45 and its zero is not at 0, so nothing but zero lies below

_NUMBER = rb"(-?\d{1,6}\.\d\d)"
_LINES = {
    Format.TEXT: re.compile(rb"\n?" + rb"\t".join([_NUMBER] * 20) + rb"\t?\r?"),
    Format.TEXT_GLUED: re.compile(rb"\n?" + rb"\t".join([_NUMBER] * 4) * CHIPS + rb"\t?\r?"),
}


def decoders(limits: Limits | None = None) -> tuple[Decoder, ...]:
    """One decoder for each format, for `decode_any`."""
    return tuple(Decoder(form, limits or Limits()) for form in Format)


def decode_any(candidates: tuple[Decoder, ...], chunk: bytes) -> tuple[tuple[Decoder, ...], list[Frame]]:
    """As `decode`, for a board whose format is not known: the first to find a frame is kept."""
    found = [decode(decoder, chunk) for decoder in candidates]
    hits = [(frames[0].end, i) for i, (_, frames) in enumerate(found) if frames]
    if not hits:
        return tuple(decoder for decoder, _ in found), []
    decoder, frames = found[min(hits)[1]]
    return (decoder,), frames


def decode(decoder: Decoder, chunk: bytes) -> tuple[Decoder, list[Frame]]:
    """Take the next bytes of the stream; returns the new state and the frames that are certain by now."""
    form, limits, _, last, early, grid, off, count, taken, _, gap, gaps, lost = decoder
    data, start = decoder.rest + chunk, decoder.taken + decoder.skipped
    frames: list[Frame] = []
    at = done = 0  # candidates are tried from `at`; bytes before `done` are in frames or in none
    while True:
        begin, end = _window(form, data, at)
        gap, done = gap + begin - done, begin
        if end is None:
            break
        values = _values(form, data[begin:end], limits)
        if values is not None and grid is not None and not grid.holds(values):
            off += _near(last, values, limits)
            grid, values = (NO_GRID, values) if off > DOUBTED else (grid, None)
        sure = values is not None and (_near(last, values, limits) or _begins_run(form, data, begin, end, limits))
        if sure is None:
            break
        if values is None or not sure:
            at = begin + 1
            continue
        if gap and count:
            gaps, lost = gaps + 1, lost + max(1, round(gap / (end - begin)))
        frames.append(Frame(start + end, values[:, 1:].ravel(), values[:, 0]))
        last, gap, off, at, done, taken, count = values, 0, 0, end, end, taken + end - begin, count + 1
        if form == Format.BINARY and grid is None:
            early = (*early, values)
            if len(early) == LEARNED:
                grid, early = learn(np.stack(early)), ()
    skipped = start + done - taken
    return (
        Decoder(form, limits, data[done:], last, early, grid, off, count, taken, skipped, gap, gaps, lost),
        frames,
    )


def encode(reading: np.ndarray, temperature: np.ndarray, form: Format = Format.BINARY) -> bytes:
    """A frame as a board sends it: reading (15,) in uT, temperature (5,) in degrees Celsius."""
    field = np.reshape(reading, (CHIPS, 3))
    if form == Format.BINARY:
        return np.column_stack([temperature, field]).astype("<f4").tobytes() + END
    if form == Format.TEXT:
        chips = np.column_stack([field, temperature])
        return b"".join(b"%.2f\t" % value for value in chips.ravel()) + END
    chips = np.column_stack([temperature, field])
    return b"".join(b"\t".join(b"%.2f" % value for value in chip) for chip in chips) + END


def diagnose(data: bytes, limits: Limits | None = None) -> str:
    """Why these bytes, which gave no frame, gave none: half a sentence."""
    limits = limits or Limits()
    if not data:
        return "the board sends nothing; check its cable and that its sketch runs"
    ends = [found.start() for found in re.finditer(END, data)]
    paired = [end for end in ends if end + BINARY.size in ends]
    if paired:  # two line ends in the distance of a frame
        *values, _ = BINARY.unpack_from(data, paired[0] + len(END))
        table = np.array(values).reshape(CHIPS, 4)
        bad = [chip for chip in range(CHIPS) if not _plausible(table[chip : chip + 1], limits)]
        if bad:
            celsius, *field = table[bad[0]]
            return (
                f"frames come, but chip {bad[0]} reads {celsius:.4g} degrees and"
                f" ({', '.join(f'{value:.4g}' for value in field)}) uT, which cannot be; check its soldering, or the"
                " limits if the board's gain is unusual"
            )
        return "frames come, but they jump or fit two alignments; keep the skin still while it connects"
    if sum(byte in b"-.0123456789\t\r\n " for byte in data) > 0.95 * len(data):
        lines = data.split(END)[1:-1]
        numbers = [len(re.findall(_NUMBER, line)) for line in lines]
        if numbers:
            return f"its lines hold {max(set(numbers), key=numbers.count)} plausible numbers, not 20 of one known order"
    return f"{len(data)} bytes came that are no frames; check the baud rate and that this port is the skin's"


def _window(form: Format, data: bytes, at: int) -> tuple[int, int | None]:
    """The next stretch from `at` on that may be a candidate, or where to look again when more bytes have come. A
    window of text begins with the end of the line before it.
    """
    if form == Format.BINARY:
        end = data.find(END, at + BINARY.size - len(END))
        if end < 0:
            return max(at, len(data) - BINARY.size + 1), None
        return end + len(END) - BINARY.size, end + len(END)
    while (begin := data.find(b"\n", at)) >= 0:
        end = data.find(b"\n", begin + 1, begin + LONGEST)
        if end >= 0:
            return begin, end
        if len(data) < begin + LONGEST:
            return begin, None
        at = begin + 1
    return len(data), None


def _adjoining(form: Format, data: bytes, end: int) -> int | None:
    """Where the window that begins at `end` ends; `end` if there is none, None if more bytes must come."""
    if form == Format.BINARY:
        return end + BINARY.size if len(data) >= end + BINARY.size else None
    found = data.find(b"\n", end + 1, end + LONGEST)
    if found >= 0:
        return found
    return end if len(data) >= end + LONGEST else None


def _begins_run(form: Format, data: bytes, begin: int, end: int, limits: Limits) -> bool | None:
    """Whether a run of candidates begins here that no other overlaps; None if more bytes must come."""
    values, stop = _values(form, data[begin:end], limits), end
    for _ in range(limits.run - 1):
        following = _adjoining(form, data, stop)
        if following is None:
            return None
        after = _values(form, data[stop:following], limits)
        if values is None or after is None or not _near(values, after, limits):
            return False
        values, stop = after, following
    if form != Format.BINARY:  # lines cannot overlap
        return True
    rival = begin
    while (rival := data.find(END, rival + 1, stop)) >= 0:
        first = rival + len(END) - BINARY.size
        if (
            first > begin
            and (first - begin) % BINARY.size
            and _values(form, data[first : first + BINARY.size], limits) is not None
        ):
            return False
    return True


def _values(form: Format, window: bytes, limits: Limits) -> np.ndarray | None:
    """(5, 4) t, x, y, z of a window, if they are plausible."""
    if form == Format.BINARY:
        *numbers, end = BINARY.unpack(window)
        if end != END:
            return None
        table = np.array(numbers).reshape(CHIPS, 4)
    else:
        line = _LINES[form].fullmatch(window)
        if line is None:
            return None
        table = np.array([float(number) for number in line.groups()]).reshape(CHIPS, 4)
        if form == Format.TEXT:
            table = np.roll(table, 1, axis=1)
    return table if _plausible(table, limits) else None


def _plausible(table: np.ndarray, limits: Limits) -> bool:
    """Whether temperatures and fields (n, 4) lie within the limits; NaN does not."""
    celsius, field = table[:, 0], np.abs(table[:, 1:])
    size = np.abs(celsius)
    return bool(
        np.all((celsius >= limits.coldest) & (celsius <= limits.hottest) & ((size == 0) | (size >= TINY)))
        and np.all((field <= limits.full_scale) & ((field == 0) | (field >= limits.least)))
    )


def _near(last: np.ndarray | None, values: np.ndarray, limits: Limits) -> bool:
    """Whether a frame may follow another."""
    if last is None:
        return False
    change = np.abs(values - last)
    return bool(np.all(change[:, 0] <= limits.warming) and np.all(change[:, 1:] <= limits.jump))
