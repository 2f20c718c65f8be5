"""Framed boards on bad lines: what is delivered wrong, and what is lost although it came whole."""

from itertools import accumulate

import numpy as np

from experiments.faults.rows import FaultCounts, FaultRow
from experiments.faults.skin import LineErrors
from i2t.emulators.reskin_board import Readings, corrupt
from i2t.hardware.reskin.frames import Decoder, Frame, decode
from i2t.hardware.reskin.layouts import Format, FrameLayout, encode

WIRE_LINES = tuple(
    LineErrors(substitute=substitute, drop=drop, goal=0.99)
    for substitute, drop in ((0.001, 0.0), (0.01, 0.0), (0.0, 0.001), (0.0, 0.01))
)
WRONG_SHARE = 1e-3
ROUNDING_UT = {Format.FRAMED: 1e-3, Format.FRAMED_TEXT: 0.051}
LARGE_ERRORS_UT = (10.0, 25.0)
CHUNK_BYTES = 4096


def wire(sizes: FaultCounts) -> list[FaultRow]:
    """Both formats on each line."""
    return [row for form in ROUNDING_UT for line in WIRE_LINES for row in _damaged(sizes.frames, form, line)]


def _damaged(count: int, form: Format, line: LineErrors) -> list[FaultRow]:
    rng, board = np.random.default_rng(0), Readings(1.0, 0.0, None, 0)
    sent = [board.at(0.0) for _ in range(count)]
    whole = [encode(reading, celsius, form, i) for i, (reading, celsius) in enumerate(sent)]
    arrived = [corrupt(frame, line.substitute, line.drop, rng) for frame in whole]
    text = form == Format.FRAMED_TEXT  # a line is taken once the next one begins, and ends before its line feed
    number = {end - text: i for i, end in enumerate(accumulate(map(len, arrived)))}
    found = _received(form, b"".join(arrived))
    intact = {i for i, (a, b) in enumerate(zip(arrived, whole, strict=True)) if a == b}
    pairs = [(number.get(frame.end), frame) for frame in found]
    lost = 1 - len(intact & {i for i, _ in pairs}) / max(1, len(intact))
    errors = np.array([np.inf if i is None else np.abs(frame.reading - sent[i][0]).max() for i, frame in pairs])
    wrong = float(np.mean(errors > ROUNDING_UT[form]))
    large = ", ".join(f"{100 * np.mean(errors > size):.3f} % by over {size:g} uT" for size in LARGE_ERRORS_UT)
    goals = (wrong < WRONG_SHARE, lost < 1 - line.goal) if form == Format.FRAMED else (None, None)
    return [
        FaultRow("wire", f"{form}, {line}: delivered wrong", f"{len(found)} frames", f"{100 * wrong:.3f} %, {large}",
                 f"< {100 * WRONG_SHARE:g} %" if goals[0] is not None else "stated", goals[0]),
        FaultRow("wire", f"{form}, {line}: whole but not delivered", f"{len(intact)} frames", f"{100 * lost:.2f} %",
                 "< 1 %" if goals[1] is not None else "stated", goals[1]),
    ]  # fmt: skip


def _received(form: Format, data: bytes) -> list[Frame]:
    found: list[Frame] = []
    decoder = Decoder(FrameLayout(form))
    for at in range(0, len(data), CHUNK_BYTES):
        decoder, more = decode(decoder, data[at : at + CHUNK_BYTES])
        found += more
    return found
