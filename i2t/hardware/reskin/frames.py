"""Bytes of a board to frames: pure functions on whatever part of the stream has come.

`i2t.hardware.reskin.layouts` says how frames look. Three of the five formats have no header, counter or checksum, CR LF
also occurs within their numbers (34.513 degrees is 98 0d 0a 42), and a byte may be changed or lost. So a *candidate* is
a stretch of the right form whose values are plausible, and a candidate is a *frame* if

    its values are as usual, by what the board itself has sent so far (`i2t.hardware.reskin.expectation`), or
    the next candidate bears out what is unusual in it, or
    it begins a run of `run_length` adjoining candidates that no other candidate overlaps,

and with a counter and a checksum (`framed` alone)

    it lies within `max_jump` of the last frame in every channel, or
    its counter goes on from the last frame's by as many frames as their bytes are apart, or it begins a run.

Candidates are tried from the first byte after the last frame onwards, so a changed byte costs its own frame, a lost
byte the frame it was in, and a field that changes fast or for good nothing. In the binary formats values must also be
whole numbers of the converter's steps, from wherever they count, once these are known
(`i2t.hardware.reskin.quantization`). What may pass unseen is a changed value that lies within the noise; behind a
checksum, two changes that cancel. What is decided depends on the stream alone, not on how it was cut into chunks.

A chip that fails is missing (NaN). A frame in which every chip is missing is counted as empty and not delivered. A
converter of 16 bits begins again at its other end; a channel that jumps so is carried on.
"""

import re
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from i2t.hardware.reskin.expectation import Expectation, doubt, is_borne_out, learn
from i2t.hardware.reskin.expectation import begin as begin_expecting
from i2t.hardware.reskin.layouts import (
    COUNTS,
    DEFAULT_CHIPS,
    HEADER,
    LINE_END,
    Format,
    FrameLayout,
    FrameValues,
    adjoining,
    numbers_in,
    parse,
    window,
)
from i2t.hardware.reskin.quantization import ConverterSteps, learn_steps, wrap_offsets
from i2t.skin import boards

LEARNING_FRAMES = 128  # from which the converter's steps are learned
MAX_MISFITS = 64  # candidates in a row that the steps alone exclude, after which these are learned anew
TEXT_ROUNDING = 0.011  # uT, of two decimals, and of an origin that is known as well as that
MIN_TEMPERATURE_SIZE = 1e-3  # degrees; the step is 1/45 and does not begin at 0, so nothing but zero lies below
COUNT_SLACK = 3  # frames that may be lost as a whole while the counter is still believed
MAX_DAMAGED_VALUES = 2  # of a frame: a field moves more of them at once
NEXT_FRAMES = 6  # in which the next candidate must lie to bear out the one before


@dataclass(frozen=True)
class FrameLimits:
    """Limits of a plausible frame. `full_scale` is the range of the chip (MLX90393); a board of known gain has a
    smaller one, 2^15 of its steps.
    """

    min_temperature: float = -40.0  # degrees Celsius
    max_temperature: float = 85.0
    full_scale: float = 50e3  # uT
    min_field: float = 1e-5  # uT; firmware that averages or zeroes sends less than a step, but nothing below
    max_jump: float = 100.0  # uT, from one frame to the next, that says nothing behind a checksum
    max_warming: float = 2.0  # K, from one frame to the next
    run_length: int = 3  # candidates in a row that are believed without a frame before them


class Frame(NamedTuple):
    """One sample of all chips; NaN for a chip that is missing."""

    end: int  # bytes of the stream up to and with this frame
    reading: Float[np.ndarray, " c"]  # uT, in the board's order
    temperature: Float[np.ndarray, " chips"]  # degrees Celsius; NaN where the board does not tell


class Decoder(NamedTuple):
    """State of decoding. `bytes == taken + skipped + len(rest)` at all times."""

    layout: FrameLayout = FrameLayout()
    limits: FrameLimits = FrameLimits()
    rest: bytes = b""  # not decided yet
    last: np.ndarray | None = None  # (chips, 4) t, x, y, z of the last frame, or of the last where a chip was there
    expected: Expectation | None = None  # of the next frame, where there is no checksum
    sequence: int | None = None  # of the last frame's counter
    wrapped: np.ndarray | None = None  # (chips, 3) uT, by which channels are beyond the converter's end
    early: tuple[np.ndarray, ...] = ()  # the first frames, until the steps are learned
    steps: ConverterSteps | None = None
    misfits: int = 0  # candidates in a row that only the steps excluded
    frames: int = 0
    empty: int = 0  # besides, those without any chip
    missing: int = 0  # chips that were missing in the others
    wraps: int = 0  # times that a channel went over the converter's end
    taken: int = 0  # bytes in frames and empty ones
    skipped: int = 0  # bytes in none
    gap: int = 0  # of those, since the last frame
    gaps: int = 0  # places between frames where some are missing
    lost: int = 0  # frames that were there, by the counter, or by the bytes that are left

    @property
    def bytes(self) -> int:
        """Number of all bytes that came."""
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
        begin, end = window(decoder.layout, data, search)
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
        decoder, frame = _with_frame(decoder, values, data_start + end, end - begin)
        frames += [] if frame is None else [frame]
        search = done = end
    return decoder._replace(rest=data[done:], skipped=data_start + done - decoder.taken), frames


def diagnose(data: bytes, limits: FrameLimits | None = None, chips: int = DEFAULT_CHIPS) -> str:
    """Explain why these bytes gave no frame.

    Args:
        data: What a board has sent.
        limits: What can be true of a frame.
        chips: How many the board is taken to have.

    Returns:
        Half a sentence with the remedy.
    """
    rubbish = f"{len(data)} bytes came that are no frames; check the baud rate and that this port is the skin's"
    return known_trouble(data, limits or FrameLimits(), chips) or rubbish


def known_trouble(data: bytes, limits: FrameLimits, chips: int) -> str | None:
    """Explain why these bytes gave no frame, if they say so themselves.

    Args:
        data: What a board has sent.
        limits: What can be true of a frame.
        chips: How many the board is taken to have.

    Returns:
        Half a sentence with the remedy, None for rubbish.
    """
    if not data:
        return "the board sends nothing; check its cable and that its sketch runs"
    if any(decode(decoder, data)[0].empty for decoder in decoders(limits, chips)):
        return "frames come, but no chip answers in any; check the cable between board and chips"
    others = [n for n in range(1, boards.MAX_CHIPS + 1) if n != chips and decode_any(decoders(limits, n), data)[1]]
    if others:
        return f"frames of {others[0]} chips come, not of {chips}; say which board it is"
    binary, framed = FrameLayout(Format.BINARY, chips), FrameLayout(Format.FRAMED, chips)
    ends = {found.start() for found in re.finditer(LINE_END, data)}
    first = min((end for end in ends if end + binary.size in ends), default=None)
    if first is not None:  # two line ends in the distance of a frame
        stretch = data[first + len(LINE_END) : first + len(LINE_END) + binary.size]
        return _why_implausible(parse(binary, stretch), limits)
    heads = {found.start() for found in re.finditer(re.escape(HEADER), data)}
    first = min((head for head in heads if head + framed.size in heads), default=None)
    if first is not None:
        return _why_implausible(parse(framed, data[first : first + framed.size]), limits)
    if sum(byte in b"-.0123456789\t\r\n " for byte in data) > 0.95 * len(data):
        counts = [numbers_in(line) for line in data.split(LINE_END)[1:-1]]
        if counts:
            usual = max(set(counts), key=counts.count)
            return f"its lines hold {usual} plausible numbers, not {4 * chips} of one known order"
    return None


def _why_implausible(values: FrameValues | None, limits: FrameLimits) -> str:
    if values is None:
        return "frames come, but their checksums do not fit; check the cable and the baud rate"
    table = values.table
    for chip, (celsius, *field) in enumerate(table):
        if not _plausible(table[chip : chip + 1], limits):
            return (
                f"frames come, but chip {chip} reads {celsius:.4g} degrees and"
                f" ({', '.join(f'{value:.4g}' for value in field)}) uT, which cannot be; check its soldering, or the"
                " limits if the board's gain is unusual"
            )
    return "frames come, but they jump or fit two alignments; keep the skin still while it connects"


def _candidate(decoder: Decoder, stretch: bytes) -> tuple[Decoder, FrameValues | None]:
    """Values of a stretch, None if it is no candidate, and the decoder, which counts candidates that only the
    converter's steps exclude and forgets the steps after too many.
    """
    values = _values(decoder.layout, stretch, decoder.limits)
    if values is None or decoder.steps is None or decoder.steps.fit(values.table):
        return decoder, values
    misfits = decoder.misfits + 1
    if misfits > MAX_MISFITS:  # the board was zeroed anew, for instance
        return decoder._replace(steps=None, early=(), misfits=0), values
    return decoder._replace(misfits=misfits), None


def _is_frame(decoder: Decoder, values: FrameValues | None, data: bytes, begin: int, end: int) -> bool | None:
    """Test whether a candidate is a frame; None if more bytes must come."""
    if values is None:
        return False
    if decoder.last is None:
        return _begins_run(decoder, data, begin, end)
    if not decoder.layout.checked:
        return _is_expected(decoder, values.table, data, end)
    if _near(decoder.last, values.table, decoder.limits, decoder.steps):
        return True
    if _counts_on(decoder, values):
        return _is_no_spike(decoder, values.table, data, end)
    return _begins_run(decoder, data, begin, end)


def _counts_on(decoder: Decoder, values: FrameValues) -> bool:
    """Test whether the counter rose since the last frame by as many frames as there are bytes between the two."""
    if values.sequence is None or decoder.sequence is None:
        return False
    ahead = (values.sequence - decoder.sequence - 1 - round(decoder.gap / decoder.layout.size)) % COUNTS
    return ahead <= COUNT_SLACK


def _is_expected(decoder: Decoder, table: np.ndarray, data: bytes, end: int) -> bool | None:
    """Test whether values are as usual, or the next candidate confirms them; None if more bytes must come."""
    expected, limits = decoder.expected, decoder.limits
    assert expected is not None
    found = doubt(expected, _carried(decoder, table), _gap_frames(decoder, decoder.gap))
    if not found:
        return True
    # Before it is known how the field moves, one that moves many channels is true, unless it is back at once.
    moves = not expected.fitted and np.sum(found.values[:, 1:]) > MAX_DAMAGED_VALUES
    search, stop = end, end + NEXT_FRAMES * _longest(decoder.layout)
    while True:
        begin, following = window(decoder.layout, data, search)
        if following is None:
            return False if len(data) >= stop else None
        if following > stop:
            return False
        after = _values(decoder.layout, data[begin:following], limits)
        if after is not None:
            gap = _gap_frames(decoder, decoder.gap + begin - end) + 1
            later = _carried(decoder, after.table)
            return is_borne_out(expected, found, later, gap) or bool(moves and doubt(expected, later, gap))
        search = begin + 1


def _carried(decoder: Decoder, table: np.ndarray) -> np.ndarray:
    """Values of a frame, carried on beyond the converter's end where they follow the last frame there."""
    assert decoder.last is not None
    wrapped = np.zeros((len(table), 3)) if decoder.wrapped is None else decoder.wrapped
    onwards = table.copy()
    onwards[:, 1:] += wrapped + wrap_offsets(decoder.last[:, 1:], table[:, 1:], decoder.steps)
    return onwards


def _gap_frames(decoder: Decoder, gap: int) -> int:
    """Number of frames in so many bytes."""
    whole = decoder.frames + decoder.empty
    usual = decoder.taken / whole if whole else decoder.layout.size
    return max(1, round(gap / usual)) if gap > 0 else 0


def _longest(layout: FrameLayout) -> int:
    return layout.max_line_bytes if layout.is_text else layout.size


def _is_no_spike(decoder: Decoder, table: np.ndarray, data: bytes, end: int) -> bool | None:
    """Test whether the stretch behind a far-off candidate does not contradict it; None if more bytes must come. It does
    where it lies near the last frame and few values are far off: then changed bytes have cancelled in the checksum.
    """
    assert decoder.last is not None
    if np.sum(np.abs(table - decoder.last)[:, 1:] > decoder.limits.max_jump) > MAX_DAMAGED_VALUES:
        return True
    following = adjoining(decoder.layout, data, end)
    if following is None:
        return None
    after = _values(decoder.layout, data[end:following], decoder.limits)
    return after is None or not _near(decoder.last, after.table, decoder.limits, decoder.steps)


def _with_frame(decoder: Decoder, values: FrameValues, end: int, size: int) -> tuple[Decoder, Frame | None]:
    """Decoder after a frame of `size` bytes, and the frame, None if it is empty; frames lost before it follow from the
    counter or from the bytes in the gap.
    """
    table = values.table
    gone = np.isnan(table[:, 1:]).all(1)
    lost = _lost(decoder, values.sequence, size) if decoder.last is not None else 0
    offsets = np.zeros((len(table), 3)) if decoder.wrapped is None else decoder.wrapped
    if decoder.last is not None:
        more = wrap_offsets(decoder.last[:, 1:], table[:, 1:], decoder.steps)
        offsets, wraps = offsets + more, int(np.count_nonzero(more))
        known = np.where(np.isnan(table), decoder.last, table)
    else:
        wraps, known = 0, table
    decoder = decoder._replace(
        last=known,
        expected=_learned(decoder, table, offsets),
        sequence=values.sequence,
        wrapped=offsets,
        wraps=decoder.wraps + wraps,
        gaps=decoder.gaps + (lost > 0),
        lost=decoder.lost + lost,
        gap=0,
        misfits=0,
        taken=decoder.taken + size,
        frames=decoder.frames + (not gone.all()),
        empty=decoder.empty + bool(gone.all()),
        missing=decoder.missing + (0 if gone.all() else int(gone.sum())),
    )
    if gone.all():
        return decoder, None
    return _with_steps(decoder, table), Frame(end, (table[:, 1:] + offsets).ravel(), table[:, 0])


def _learned(decoder: Decoder, table: np.ndarray, offsets: np.ndarray) -> Expectation | None:
    """Expectation after one more frame, of a format without a checksum."""
    if decoder.layout.checked:
        return None
    carried = table.copy()
    carried[:, 1:] += offsets
    return (
        begin_expecting(carried)
        if decoder.expected is None
        else learn(decoder.expected, carried, _gap_frames(decoder, decoder.gap))
    )


def _lost(decoder: Decoder, count: int | None, size: int) -> int:
    """Number of frames missing before one: by the counter, whose full turns follow from the bytes."""
    by_bytes = max(1, round(decoder.gap / size)) if decoder.gap else 0
    if count is None or decoder.sequence is None or count == decoder.sequence:
        return by_bytes
    counted = (count - decoder.sequence - 1) % COUNTS
    return counted + COUNTS * max(0, round((by_bytes - counted) / COUNTS))


def _with_steps(decoder: Decoder, table: np.ndarray) -> Decoder:
    """The decoder, which learns the converter's steps from its first frames."""
    if decoder.steps is not None or decoder.layout.form == Format.FRAMED_TEXT:  # whose last digit is nearly a step
        return decoder
    early = (*decoder.early, table)
    if len(early) < LEARNING_FRAMES:
        return decoder._replace(early=early)
    rounding = TEXT_ROUNDING if decoder.layout.is_text else 0.0
    return decoder._replace(steps=learn_steps(np.stack(early), rounding), early=())


def _begins_run(decoder: Decoder, data: bytes, begin: int, end: int) -> bool | None:
    """Test whether a run of candidates begins here that no other overlaps; None if more bytes must come."""
    layout, limits = decoder.layout, decoder.limits
    values, stop = _values(layout, data[begin:end], limits), end
    for _ in range(limits.run_length - 1):
        following = adjoining(layout, data, stop)
        if following is None:
            return None
        after = _values(layout, data[stop:following], limits)
        if values is None or after is None or not _follows(decoder, values, after):
            return False
        values, stop = after, following
    return layout.form != Format.BINARY or not _has_rival(layout, data, begin, stop, limits)  # lines cannot overlap


def _follows(decoder: Decoder, before: FrameValues, after: FrameValues) -> bool:
    """Test whether a candidate goes on from another that ends where it begins: few values that jump are damage."""
    if before.sequence is not None and after.sequence is not None and (after.sequence - before.sequence) % COUNTS == 1:
        return True
    if _near(before.table, after.table, decoder.limits, None if decoder.layout.checked else decoder.steps):
        return True
    jumps = np.abs(after.table - before.table) > decoder.limits.max_jump
    return (
        int(np.sum(jumps[:, 1:])) > MAX_DAMAGED_VALUES
        and not (np.abs(after.table - before.table)[:, 0] > decoder.limits.max_warming).any()
    )


def _has_rival(layout: FrameLayout, data: bytes, begin: int, stop: int, limits: FrameLimits) -> bool:
    """Test whether a candidate in another alignment lies within a run, but for its first bytes."""
    size = layout.binary.size
    end = begin
    while (end := data.find(LINE_END, end + 1, stop)) >= 0:
        first = end + len(LINE_END) - size
        another = first > begin and (first - begin) % size
        if another and _values(layout, data[first : first + size], limits) is not None:
            return True
    return False


def _values(layout: FrameLayout, stretch: bytes, limits: FrameLimits) -> FrameValues | None:
    """The values of a stretch, if they are plausible; NaN for what is missing."""
    said = parse(layout, stretch)
    if said is None or not _plausible(said.table, limits):
        return None
    table = said.table
    table[~table[:, 1:].any(1), 1:] = np.nan
    if not layout.has_temperature:
        table[:, 0] = np.nan
    return said


def _plausible(table: Float[np.ndarray, "chips 4"], limits: FrameLimits) -> bool:
    """Test whether temperatures and fields lie within the limits; NaN does not."""
    celsius, field = table[:, 0], np.abs(table[:, 1:])
    size = np.abs(celsius)
    return bool(
        np.all((celsius >= limits.min_temperature) & (celsius <= limits.max_temperature))
        and np.all((size == 0) | (size >= MIN_TEMPERATURE_SIZE))
        and np.all((field <= limits.full_scale) & ((field == 0) | (field >= limits.min_field)))
    )


def _near(last: np.ndarray | None, table: np.ndarray, limits: FrameLimits, steps: ConverterSteps | None) -> bool:
    """Test whether a frame may follow another, in the channels that both have."""
    if last is None:
        return False
    change = np.abs(table - last)
    if (change[:, 0] > limits.max_warming).any():  # NaN is not
        return False
    if not (change[:, 1:] > limits.max_jump).any():
        return True
    onwards = table[:, 1:] + wrap_offsets(last[:, 1:], table[:, 1:], steps)
    return not bool((np.abs(onwards - last[:, 1:]) > limits.max_jump).any())
