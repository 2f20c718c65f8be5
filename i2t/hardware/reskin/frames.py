"""Decoding of a board's bytes into frames: pure functions of the part of the stream that has arrived.

`i2t.hardware.reskin.layouts` defines the frames. The binary format has no header, counter or checksum, and CR LF also
occurs inside its numbers (34.513 degrees is 98 0d 0a 42). So a *candidate* is a stretch of the right form whose values
are plausible, and a candidate is a *frame* if

    it adjoins the last frame, or has a checksum and is not the first, or
    it begins a run of `RUN_LENGTH` adjoining candidates that no other candidate overlaps.

Candidates are tried from the first byte after the last frame onwards, so a lost byte costs only the frame that it was
in. Two kinds of damage can pass unnoticed: a changed but plausible value in a format without a checksum (USB has its
own), and two changes that cancel in an exclusive or. The result depends on the stream only, not on its division into
chunks.

A chip that fails is missing (NaN). A frame in which every chip is missing is counted as empty and not delivered.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from i2t.hardware.reskin.layouts import (
    COUNTER_SIZE,
    DEFAULT_CHIPS,
    LINE_END,
    Format,
    FrameLayout,
    FrameValues,
    parse,
    window,
)
from i2t.skin import boards

# degrees C, range of a chip's temperatures; bytes of the stream that decode to others are not a frame
TEMPERATURE_RANGE_C = (-40.0, 85.0)
# uT, range of the magnitudes of a chip's non-zero values; bytes of the stream that decode to others are not a frame.
# Firmware that averages sends less than one step of the chip, and the chip's range ends at 5e4 uT.
FIELD_RANGE_UT = (1e-5, 50e3)
RUN_LENGTH = 3  # number of successive plausible candidates that are accepted as frames without a preceding frame


class Frame(NamedTuple):
    """One decoded frame of a board: its end in the stream (bytes), reading (uT) and temperatures (degrees Celsius).

    The reading of a missing chip is NaN.
    """

    end: int  # number of bytes of the stream up to the end of this frame
    reading: Float[np.ndarray, " c"]  # uT, in the board's order
    temperature: Float[np.ndarray, " chips"]  # degrees Celsius; NaN if the board does not report it


class Decoder(NamedTuple):
    """State of decoding a board's byte stream: layout, undecided bytes, and counts of frames, chips and bytes.

    `bytes == taken + skipped + len(rest)` at all times.
    """

    layout: FrameLayout = FrameLayout()
    rest: bytes = b""  # bytes that are not decided yet
    sequence: int | None = None  # value of the last frame's counter
    samples: int = 0  # number of delivered frames
    empty: int = 0  # number of frames in which no chip answered
    missing: int = 0  # number of missing chips in the delivered frames
    taken: int = 0  # number of bytes in frames, including empty ones
    skipped: int = 0  # number of bytes outside frames
    gap: int = 0  # number of bytes skipped since the last frame
    gaps: int = 0  # number of places between frames where frames are missing
    lost: int = 0  # number of missing frames, by the counter or by the bytes of their remains

    @property
    def bytes(self) -> int:
        """Number of all bytes of the stream that were passed to the decoder."""
        return self.taken + self.skipped + len(self.rest)


def decoders(chips: int = DEFAULT_CHIPS) -> tuple[Decoder, ...]:
    """Create one decoder for each frame format, for `decode_any`.

    Args:
        chips: Number of chips of the board.

    Returns:
        Decoders in the state at the beginning of a stream.
    """
    return tuple(Decoder(FrameLayout(form, chips)) for form in Format)


def decode_any(candidates: tuple[Decoder, ...], chunk: bytes) -> tuple[tuple[Decoder, ...], list[Frame]]:
    """Decode the next bytes of a board's stream whose frame format is unknown.

    Args:
        candidates: Decoders that may fit.
        chunk: Next bytes of the stream.

    Returns:
        The decoders that may still fit (only one from the first frame on), and the frames that were decoded.
    """
    results = [decode(decoder, chunk) for decoder in candidates]
    hits = [(frames[0].end, i) for i, (_, frames) in enumerate(results) if frames]
    if not hits:
        return tuple(decoder for decoder, _ in results), []
    decoder, frames = results[min(hits)[1]]
    return (decoder,), frames


def decode(decoder: Decoder, chunk: bytes) -> tuple[Decoder, list[Frame]]:
    """Decode the next bytes of a board's stream.

    Args:
        decoder: State of decoding before these bytes.
        chunk: Next bytes of the stream.

    Returns:
        The state after these bytes, and the frames that have become certain.
    """
    data = decoder.rest + chunk
    data_start = decoder.taken + decoder.skipped  # position of `data` in the stream
    frames: list[Frame] = []
    search = 0  # the search for candidates starts here
    done = 0  # earlier bytes are decided
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


def recognised_problem(data: bytes, chips: int) -> str:
    """Explain why the bytes that a board sent hold no valid frame, if they show a known problem.

    Args:
        data: Bytes that a board has sent.
        chips: Number of chips that the board should have.

    Returns:
        A clause with the remedy; empty for unrecognised bytes.
    """
    if not data:
        return "the board sends nothing; check its cable and that its sketch runs"
    if any(decode(decoder, data)[0].empty for decoder in decoders(chips)):
        return "frames arrive, but no chip answers in any; check the cable between board and chips"
    others = [n for n in range(1, boards.MAX_CHIPS + 1) if n != chips and decode_any(decoders(n), data)[1]]
    if others:
        return f"frames of {others[0]} chips arrive, not of {chips}; name the right board"
    layout = FrameLayout(Format.BINARY, chips)
    begin, end = window(layout, data, data.find(LINE_END) + len(LINE_END))
    if end is None or data[begin - len(LINE_END) : begin] != LINE_END:  # no two line ends at the distance of a frame
        return ""
    frame = parse(layout, data[begin:end])
    for chip, values in enumerate([] if frame is None else frame.table):
        if not _plausible(values[None]):
            numbers = ", ".join(f"{value:.4g}" for value in values)
            return f"frames arrive, but chip {chip} reads {numbers} (degrees, uT): impossible; check its soldering"
    return "frames arrive, but never three in a row, or in two alignments; check the board's cable, and connect again"


def _begins_run(layout: FrameLayout, data: bytes, begin: int, end: int) -> bool | None:
    """Test whether an unambiguous run of candidates begins here; None if that takes more bytes."""
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
    return layout.checked or not _has_rival(layout, data, begin, stop)  # candidates with a checksum cannot overlap


def _has_rival(layout: FrameLayout, data: bytes, begin: int, stop: int) -> bool:
    """Test whether a candidate in another alignment lies within a run, after its first byte."""
    search = begin + 1
    while True:
        first, end = window(layout, data[:stop], search)
        if end is None:
            return False
        if (first - begin) % layout.size and _values(layout, data[first:end]) is not None:
            return True
        search = first + 1


def _with_frame(decoder: Decoder, values: FrameValues, size: int) -> tuple[Decoder, bool]:
    """Update a decoder by a frame of `size` bytes; return it, and whether the frame holds any chip."""
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
    """Count the frames missing before a frame: by the bytes, or by the counter, whose overflows the bytes reveal."""
    by_bytes = max(1, round(decoder.gap / size)) if decoder.gap else 0
    if count is None or decoder.sequence is None or count == decoder.sequence:
        return by_bytes
    counted = (count - decoder.sequence - 1) % COUNTER_SIZE
    return counted + COUNTER_SIZE * max(0, round((by_bytes - counted) / COUNTER_SIZE))


def _values(layout: FrameLayout, stretch: bytes) -> FrameValues | None:
    """Parse a stretch; None if its values are implausible, NaN for missing values."""
    values = parse(layout, stretch)
    if values is None or not _plausible(values.table):
        return None
    table = values.table
    table[:, 1:] = boards.without_silent_chips(table[:, 1:].reshape(1, -1)).reshape(-1, boards.AXES_OF_CHIP)
    if not layout.has_temperature:
        table[:, 0] = np.nan
    return values


def _plausible(table: Float[np.ndarray, "chips 4"]) -> bool:
    """Test whether temperatures and fields are within their ranges; NaN is not."""
    celsius, field = table[:, 0], np.abs(table[:, 1:])
    (coldest, warmest), (weakest, strongest) = TEMPERATURE_RANGE_C, FIELD_RANGE_UT
    # The step of a temperature is 1/45 degrees and does not begin at 0, so only zero itself lies below 1e-3.
    return bool(
        np.all((celsius >= coldest) & (celsius <= warmest))
        and np.all((celsius == 0) | (np.abs(celsius) >= 1e-3))
        and np.all((field <= strongest) & ((field == 0) | (field >= weakest)))
    )
