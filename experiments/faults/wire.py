"""Boards on bad lines: frames delivered wrong, and frames lost although they came whole, for each format, kind of
damage, rate and signal.

Where a format has neither checksum nor counter, a changed value that differs from the true one by less than the noise
cannot be told from it by anybody. Wrong there is what is off by more than `NOTICEABLE_UT`, some five standard
deviations of the noise at rest; how many are off at all is stated as well. The first `SETTLING_FRAMES` of each stream,
in which the decoder learns what is usual, are counted apart.
"""

from collections.abc import Callable
from itertools import accumulate
from typing import NamedTuple

import numpy as np

from experiments.faults.rows import FaultCounts, FaultRow
from experiments.faults.skin import LineErrors
from i2t.emulators.reskin_board import NOISE_UT, STEPS_UT, Readings, corrupt
from i2t.hardware.reskin.frames import Decoder, Frame, decode
from i2t.hardware.reskin.layouts import Format, FrameLayout, encode

WIRE_LINES = tuple(
    LineErrors(substitute=substitute, drop=drop, goal=0.99)
    for substitute, drop in ((0.001, 0.0), (0.01, 0.0), (0.0, 0.001), (0.0, 0.01))
)
RATES_HZ = (10.0, 100.0, 400.0, 1000.0, 2000.0)
WRONG_SHARE = 1e-3
NOTICEABLE_UT = 20.0
SETTLING_FRAMES = 150
ROUNDING_UT = {Format.FRAMED_TEXT: 0.051, Format.TEXT: 0.0051, Format.TEXT_GLUED: 0.0051}
PLAIN_ROUNDING_UT = 1e-3
CHUNK_BYTES = 4096
FAST_HZ, FAST_UT = 60.0, 400.0
PRESS_HZ, STRONG_PRESS_UT = 0.7, 150.0
AVERAGED, FILTERED = 8, 0.3  # samples that one firmware averages; share of the new sample in another's filter


class SignalAt(NamedTuple):
    """A board's samples."""

    readings: np.ndarray  # (n, 15) uT
    temperatures: np.ndarray  # (n, 5) degrees Celsius


def _field(shape: Callable[[np.ndarray], np.ndarray], count: int, rate: float, seed: int) -> SignalAt:
    """Whole numbers of steps, with noise, of a field that comes and goes on all chips."""
    board, rng = Readings(0.0, 0.0, None, seed), np.random.default_rng(seed)
    rest, celsius = board.at(0.0)
    part = np.resize([1.0, -0.4, 0.7, 0.2, -0.9, 0.5, 0.8], 15)
    field = rest + shape(np.arange(count) / rate)[:, None] * part
    field = field + np.tile(NOISE_UT, 5) * rng.standard_normal((count, 15))
    warmth = celsius + np.round(0.1 * 45.2 * rng.standard_normal((count, 5))) / 45.2
    return SignalAt(np.round(field / np.tile(STEPS_UT, 5)) * np.tile(STEPS_UT, 5), warmth)


def _press(t: np.ndarray) -> np.ndarray:
    return STRONG_PRESS_UT * np.maximum(0.0, np.sin(2 * np.pi * PRESS_HZ * t)) ** 2


def _fast(t: np.ndarray) -> np.ndarray:
    return FAST_UT * np.sin(2 * np.pi * FAST_HZ * t + 0.3)


def _averaging(count: int, rate: float, seed: int) -> SignalAt:
    raw = _field(_press, AVERAGED * count, AVERAGED * rate, seed)
    return SignalAt(*(part.reshape(count, AVERAGED, -1).mean(1) for part in raw))


def _filtering(count: int, rate: float, seed: int) -> SignalAt:
    raw = _field(_press, count, rate, seed)
    smooth = list(accumulate(raw.readings, lambda before, new: before + FILTERED * (new - before)))
    return SignalAt(np.array(smooth), raw.temperatures)


def _zeroing(count: int, rate: float, seed: int) -> SignalAt:
    raw = _field(_press, count, rate, seed)
    return raw._replace(readings=raw.readings - raw.readings[:10].mean(0))


SIGNALS: dict[str, Callable[[int, float, int], SignalAt]] = {
    "presses": lambda count, rate, seed: _field(_press, count, rate, seed),
    "60 Hz of 400 uT": lambda count, rate, seed: _field(_fast, count, rate, seed),
    "averaging firmware": _averaging,
    "filtering firmware": _filtering,
    "zeroing firmware": _zeroing,
}


class LineResult(NamedTuple):
    """Frames that a decoder found on a line."""

    sent: int
    intact: int
    found: int
    lost: int  # of the intact
    errors: np.ndarray  # (found,) uT, of the value that is off most; infinite for a frame that nobody sent
    early: np.ndarray  # likewise, of the first frames, which are in none of the other numbers


def wire(sizes: FaultCounts) -> list[FaultRow]:
    """Every format on every line, over all rates and signals; and every signal, over all lines."""
    count = max(2 * SETTLING_FRAMES, sizes.frames // (len(RATES_HZ) * len(SIGNALS)))
    table = {
        (form, line, rate, signal): over_a_line(form, line, SIGNALS[signal](count, rate, i), seed=i)
        for form in Format
        for line in WIRE_LINES
        for i, (rate, signal) in enumerate((rate, signal) for rate in RATES_HZ for signal in SIGNALS)
    }
    rows: list[FaultRow] = []
    for form in Format:
        for line in WIRE_LINES:
            parts = [each for (a, b, _, _), each in table.items() if (a, b) == (form, line)]
            rows += _rows(form, f"{form}, {line}", parts)
    for signal in SIGNALS:
        parts = [each for (_, _, _, name), each in table.items() if name == signal]
        lost, intact = sum(each.lost for each in parts), sum(each.intact for each in parts)
        rows.append(FaultRow("wire", f"{signal}: whole but not delivered", f"{intact} frames",
                             f"{100 * lost / intact:.2f} %", "< 1 %", lost < 0.01 * intact))  # fmt: skip
    return rows


def over_a_line(form: Format, line: LineErrors, signal: SignalAt, *, seed: int) -> LineResult:
    """Send a signal over a line.

    Args:
        form: Of the frames.
        line: What it does to bytes.
        signal: What the board measures.
        seed: Of the damage.

    Returns:
        What arrives, compared with what was sent.
    """
    rng = np.random.default_rng(seed)
    whole = [encode(*sample, form, i) for i, sample in enumerate(zip(*signal, strict=True))]
    arrived = [corrupt(frame, line.substitute, line.drop, rng) for frame in whole]
    text = FrameLayout(form).is_text  # a line is taken once the next one begins, and ends before its line feed
    number = {end - text: i for i, end in enumerate(accumulate(map(len, arrived)))}
    found = _received(form, b"".join(arrived))
    intact = {i for i in range(SETTLING_FRAMES, len(whole)) if arrived[i] == whole[i]}
    pairs = [(number.get(frame.end), frame) for frame in found]
    errors = [np.inf if i is None else np.abs(frame.reading - signal.readings[i]).max() for i, frame in pairs]
    settled = np.array([i is None or i >= SETTLING_FRAMES for i, _ in pairs], bool)
    lost = len(intact - {i for i, _ in pairs})
    values = np.array(errors, float)
    return LineResult(len(whole), len(intact), int(settled.sum()), lost, values[settled], values[~settled])


def _rows(form: Format, what: str, parts: list[LineResult]) -> list[FaultRow]:
    errors = np.concatenate([each.errors for each in parts])
    lost, intact = sum(each.lost for each in parts), sum(each.intact for each in parts)
    rounding = ROUNDING_UT.get(form, PLAIN_ROUNDING_UT)
    off, noticeable = float(np.mean(errors > rounding)), float(np.mean(errors > NOTICEABLE_UT))
    wrong = off if FrameLayout(form).checked else noticeable
    early = np.concatenate([each.early for each in parts])
    said = (
        f"{100 * off:.3f} %, {100 * noticeable:.3f} % by over {NOTICEABLE_UT:g} uT "
        f"({100 * np.mean(early > NOTICEABLE_UT):.2f} % of {len(early)} among the first)"
    )
    return [
        FaultRow("wire", f"{what}: delivered wrong", f"{len(errors)} frames", said,
                 f"< {100 * WRONG_SHARE:g} %", wrong < WRONG_SHARE),
        FaultRow("wire", f"{what}: whole but not delivered", f"{intact} frames", f"{100 * lost / intact:.2f} %",
                 "< 1 %", lost < 0.01 * intact),
    ]  # fmt: skip


def _received(form: Format, data: bytes) -> list[Frame]:
    found: list[Frame] = []
    decoder = Decoder(FrameLayout(form))
    for at in range(0, len(data), CHUNK_BYTES):
        decoder, more = decode(decoder, data[at : at + CHUNK_BYTES])
        found += more
    return found
