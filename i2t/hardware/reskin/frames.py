"""Bytes of a board to frames: pure functions on whatever part of the stream has come.

`i2t.hardware.reskin.layouts` says how frames look. The binary format has no header, counter or checksum, and CR LF also
occurs within its numbers (34.513 degrees is 98 0d 0a 42). So a *candidate* is a stretch of the right form whose values
are plausible, and a candidate is a *frame* if

    it adjoins the last frame, or has a checksum and is not the first, or
    it begins a run of `RUN_LENGTH` adjoining candidates which no other candidate overlaps.

Candidates are tried from the first byte after the last frame onwards, so a lost byte costs the frame it was in. What
may pass unseen is a changed value that is plausible, in a format without a checksum (USB has its own), or with an
exclusive or where two changes cancel. What is decided depends on the stream alone, not on how it was cut into chunks.

A chip that fails is missing (NaN). A frame in which every chip is missing is counted as empty and not delivered.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from i2t.hardware.reskin.layouts import (
    COUNTS,
    DEFAULT_CHIPS,
    LINE_END,
    Format,
    FrameLayout,
    FrameValues,
    parse,
    window,
)
from i2t.skin import boards

TEMPERATURE_RANGE_C = (-40.0, 85.0)
FIELD_RANGE_UT = (1e-5, 50e3)  # firmware that averages sends less than a step, but nothing below; the chip's end
RUN_LENGTH = 3  # candidates in a row that are believed without a frame before them
MIN_TEMPERATURE_SIZE = 1e-3  # degrees; the step is 1/45 and does not begin at 0, so nothing but zero lies below


class Frame(NamedTuple):
    """One sample of all chips; NaN for a chip that is missing."""

    end: int  # bytes of the stream up to and with this frame
    reading: Float[np.ndarray, " c"]  # uT, in the board's order
    temperature: Float[np.ndarray, " chips"]  # degrees Celsius; NaN where the board does not tell


class Decoder(NamedTuple):
    """State of decoding. `bytes == taken + skipped + len(rest)` at all times."""

    layout: FrameLayout = FrameLayout()
    rest: bytes = b""  # not decided yet
    sequence: int | None = None  # of the last frame's counter
    samples: int = 0  # frames that were delivered
    empty: int = 0  # besides, those without any chip
    missing: int = 0  # chips that were missing in the others
    taken: int = 0  # bytes in frames and empty ones
    skipped: int = 0  # bytes in none
    gap: int = 0  # of those, since the last frame
    gaps: int = 0  # places between frames where some are missing
    lost: int = 0  # frames that were there, by the counter, or by the bytes that are left

    @property
    def bytes(self) -> int:
        """Number of all bytes that came."""
        return self.taken + self.skipped + len(self.rest)


def decoders(chips: int = DEFAULT_CHIPS) -> tuple[Decoder, ...]:
    """One decoder for each format, for `decode_any`.

    Args:
        chips: How many the board has.

    Returns:
        Decoders at the beginning of a stream.
    """
    return tuple(Decoder(FrameLayout(form, chips)) for form in Format)


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
        begin, end = window(decoder.layout, data, search)
        decoder, done = decoder._replace(gap=decoder.gap + begin - done), begin
        if end is None:
            break
        values = _values(decoder.layout, data[begin:end])
        adjoins = decoder.taken > 0 and (decoder.gap == 0 or decoder.layout.checked)
        certain = values is not None and (adjoins or _begins_run(decoder.layout, data, begin, end))
        if certain is None:
            break
        if not certain or values is None:
            search = begin + 1
            continue
        decoder, delivered = _with_frame(decoder, values, end - begin)
        if delivered:
            frames.append(Frame(data_start + end, values.table[:, 1:].ravel(), values.table[:, 0]))
        search = done = end
    return decoder._replace(rest=data[done:], skipped=data_start + done - decoder.taken), frames


def known_trouble(data: bytes, chips: int) -> str:
    """Explain why these bytes gave no frame, if they say so themselves.

    Args:
        data: What a board has sent.
        chips: How many the board is taken to have.

    Returns:
        Half a sentence with the remedy; empty for rubbish.
    """
    if not data:
        return "the board sends nothing; check its cable and that its sketch runs"
    if any(decode(decoder, data)[0].empty for decoder in decoders(chips)):
        return "frames come, but no chip answers in any; check the cable between board and chips"
    others = [n for n in range(1, boards.MAX_CHIPS + 1) if n != chips and decode_any(decoders(n), data)[1]]
    if others:
        return f"frames of {others[0]} chips come, not of {chips}; say which board it is"
    layout = FrameLayout(Format.BINARY, chips)
    begin, end = window(layout, data, data.find(LINE_END) + len(LINE_END))
    if end is None or data[begin - len(LINE_END) : begin] != LINE_END:  # no two line ends in the distance of a frame
        return ""
    found = parse(layout, data[begin:end])
    for chip, values in enumerate([] if found is None else found.table):
        if not _plausible(values[None]):
            said = ", ".join(f"{value:.4g}" for value in values)
            return f"frames come, but chip {chip} reads {said} (degrees, uT), which cannot be; check its soldering"
    return "frames come, but never three in a row, or they fit two alignments; check its cable, and connect again"


def _begins_run(layout: FrameLayout, data: bytes, begin: int, end: int) -> bool | None:
    """Test whether a run of candidates begins here that no other overlaps; None if more bytes must come."""
    stop = end
    for _ in range(RUN_LENGTH - 1):
        next_begin, next_end = window(layout, data, stop)
        if next_begin != stop:
            return False
        if next_end is None:
            return None
        if _values(layout, data[stop:next_end]) is None:
            return False
        stop = next_end
    return layout.checked or not _has_rival(layout, data, begin, stop)  # those with a checksum cannot overlap


def _has_rival(layout: FrameLayout, data: bytes, begin: int, stop: int) -> bool:
    """Test whether a candidate in another alignment lies within a run, but for its first bytes."""
    end: int | None
    search = begin + 1
    while (found := window(layout, data[:stop], search))[1] is not None:
        first, end = found
        if (first - begin) % layout.size and _values(layout, data[first:end]) is not None:
            return True
        search = first + 1
    return False


def _with_frame(decoder: Decoder, values: FrameValues, size: int) -> tuple[Decoder, bool]:
    """Decoder after a frame of `size` bytes, and whether it holds any chip."""
    gone = np.isnan(values.table[:, 1:]).all(1)
    empty = bool(gone.all())
    lost = _lost(decoder, values.sequence, size) if decoder.taken else 0
    return decoder._replace(
        sequence=values.sequence,
        gaps=decoder.gaps + (lost > 0),
        lost=decoder.lost + lost,
        gap=0,
        taken=decoder.taken + size,
        samples=decoder.samples + (not empty),
        empty=decoder.empty + empty,
        missing=decoder.missing + (0 if empty else int(gone.sum())),
    ), not empty


def _lost(decoder: Decoder, count: int | None, size: int) -> int:
    """Number of frames missing before one: by the bytes, or by the counter, whose full turns follow from the bytes."""
    by_bytes = max(1, round(decoder.gap / size)) if decoder.gap else 0
    if count is None or decoder.sequence is None or count == decoder.sequence:
        return by_bytes
    counted = (count - decoder.sequence - 1) % COUNTS
    return counted + COUNTS * max(0, round((by_bytes - counted) / COUNTS))


def _values(layout: FrameLayout, stretch: bytes) -> FrameValues | None:
    """The values of a stretch, if they are plausible; NaN for what is missing."""
    said = parse(layout, stretch)
    if said is None or not _plausible(said.table):
        return None
    table = said.table
    table[:, 1:] = boards.without_silent_chips(table[:, 1:].reshape(1, -1)).reshape(-1, boards.AXES_OF_CHIP)
    if not layout.warm:
        table[:, 0] = np.nan
    return said


def _plausible(table: Float[np.ndarray, "chips 4"]) -> bool:
    """Test whether temperatures and fields lie within the limits; NaN does not."""
    celsius, field = table[:, 0], np.abs(table[:, 1:])
    (coldest, warmest), (least, most) = TEMPERATURE_RANGE_C, FIELD_RANGE_UT
    return bool(
        np.all((celsius >= coldest) & (celsius <= warmest))
        and np.all((celsius == 0) | (np.abs(celsius) >= MIN_TEMPERATURE_SIZE))
        and np.all((field <= most) & ((field == 0) | (field >= least)))
    )
