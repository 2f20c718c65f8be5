"""What breaks on the way from a skin's board: cables, and bytes on bad lines, for each format, rate and signal.

Where a format has neither checksum nor counter, a changed value that differs from the true one by less than the noise
cannot be told from it by anybody. Wrong there is what is off by more than `NOTICEABLE_UT`, some five standard
deviations of the noise at rest; how many are off at all is stated as well. The first `SETTLING_FRAMES` of each stream,
in which the decoder learns what is usual, are not counted.
"""

import struct
import tempfile
import time
from collections.abc import Callable
from functools import partial
from itertools import accumulate
from pathlib import Path
from typing import NamedTuple

import numpy as np

from experiments.faults.table import Fault, Measure, Trial
from i2t.emulators.reskin_board import NOISE_UT, STEPS_UT, Readings, corrupt, started
from i2t.errors import DeviceError
from i2t.hardware.reskin.driver import ReSkin
from i2t.hardware.reskin.frames import Decoder, Frame, decode
from i2t.hardware.reskin.layouts import Format, FrameLayout, encode

PATIENCE_S, NOTICED_GOAL_S = 10.0, 0.5
STREAM_S = 60.0
LINES = {  # probabilities that a byte is changed, and that it is lost
    "0.1 % of bytes changed": (0.001, 0.0), "1 % of bytes changed": (0.01, 0.0),
    "0.1 % of bytes lost": (0.0, 0.001), "1 % of bytes lost": (0.0, 0.01),
}  # fmt: skip
RATES_HZ = (10.0, 100.0, 400.0, 1000.0, 2000.0)
FRAMES = 800  # of a stream
CRLF_TEMPERATURE_C = struct.unpack("<f", bytes.fromhex("980d0a42"))[0]  # holds a line's end
SKIPPED_BYTES = 40  # of the first frame, where the line is opened in the middle of it
WRONG_SHARE, LOST_SHARE, LOSS_SHARE = 1e-3, 0.01, 1e-3  # goals: frames delivered wrong, not delivered; samples lost
NOTICEABLE_UT = 20.0
SETTLING_FRAMES = 150
ROUNDING_UT = 1e-3
CHUNK_BYTES = 4096
FAST_HZ, FAST_UT = 60.0, 400.0
PRESS_HZ, STRONG_PRESS_UT = 0.7, 150.0
AVERAGED, FILTERED = 8, 0.3  # samples that one firmware averages; share of the new sample in another's filter


# Cables


def long_stream(number: int) -> Trial:
    """A minute at 400 Hz over a pseudo-terminal: samples that came, and that were lost on the way to the reader."""
    with started("--rate", "400", "--seed", str(number)) as (port, _), ReSkin(port) as device:
        first, newest = device.counters.samples, int(device.latest().number[-1])
        end, start, read = time.monotonic() + STREAM_S, newest, 0
        while time.monotonic() < end:
            time.sleep(0.05)
            fresh = device.since(newest)
            read += len(fresh.number)
            newest = int(fresh.number[-1]) if len(fresh.number) else newest
        counters = device.counters
    lost = counters.lost + counters.overflowed + (newest - start - read)
    return {"lost": lost, "samples": counters.samples - first + lost}


def silent_board(number: int) -> Trial:
    """A board that falls silent."""
    with started("--silent-after", "0.6", "--seed", str(number)) as (port, _), ReSkin(port) as device:
        return {"noticed": _noticed(device)}


def unplugged_board(number: int) -> Trial:
    """A board that is unplugged, and plugged in again."""
    with tempfile.TemporaryDirectory() as folder:
        words = ("--unplug-after", "0.6", "--replug-after", "1.4", "--link", str(Path(folder) / "skin"))
        with started(*words, "--seed", str(number)) as (port, _), ReSkin(port) as device:
            noticed, end = _noticed(device), time.monotonic() + PATIENCE_S
            while time.monotonic() < end:
                try:
                    device.connect()
                    device.read(5)
                    return {"noticed": noticed, "not back": 0}
                except DeviceError:
                    time.sleep(0.1)
    return {"noticed": noticed, "not back": 1}


def _noticed(device: ReSkin) -> float:
    """Seconds from the last sample to the error, for a loop that asks every 10 ms."""
    last = time.monotonic()
    end = last + PATIENCE_S
    while time.monotonic() < end:
        try:
            last = float(device.latest().time[-1])
        except DeviceError:
            return time.monotonic() - last
        time.sleep(0.01)
    return float("inf")


# Bytes


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
    "presses": partial(_field, _press), "60 Hz of 400 uT": partial(_field, _fast), "averaging firmware": _averaging,
    "filtering firmware": _filtering, "zeroing firmware": _zeroing,
}  # fmt: skip


def bad_line(form: Format, line: str, number: int) -> Trial:
    """A stream of one rate and signal over a bad line.

    Args:
        form: Of its frames.
        line: Of `LINES`.
        number: Of the trial, one of all rates and signals.

    Returns:
        Numbers of frames that came whole, that were found, that were whole and not found, and that were found wrong.
    """
    rate, signal = [(rate, signal) for rate in RATES_HZ for signal in SIGNALS.values()][number]
    return over_a_line(form, line, signal(FRAMES, rate, number), seed=number)


def line_ends_in_numbers(line: str, number: int) -> Trial:
    """A stream of a board whose temperature holds a line's end, opened in the middle of a frame."""
    signal = _field(_press, FRAMES, 400.0, number)
    temperatures = np.full_like(signal.temperatures, CRLF_TEMPERATURE_C)
    return over_a_line(
        Format.BINARY, line, signal._replace(temperatures=temperatures), seed=number, skipped=SKIPPED_BYTES
    )


def over_a_line(form: Format, line: str, signal: SignalAt, *, seed: int, skipped: int = 0) -> Trial:
    """Send a signal over a line.

    Args:
        form: Of the frames.
        line: Of `LINES`, what it does to bytes.
        signal: What the board measures.
        seed: Of the damage.
        skipped: Bytes of the first frame that were sent before the line was opened.

    Returns:
        What arrives, compared with what was sent. A frame that nobody sent is wrong.
    """
    rng = np.random.default_rng(seed)
    whole = [encode(*sample, form, i) for i, sample in enumerate(zip(*signal, strict=True))]
    arrived = [corrupt(frame, *LINES[line], rng) for frame in whole]
    arrived[0] = arrived[0][skipped:]
    layout = FrameLayout(form)
    number = {end: i for i, end in enumerate(accumulate(map(len, arrived)))}
    found = [(number.get(frame.end), frame) for frame in _received(form, b"".join(arrived))]
    intact = {i for i in range(SETTLING_FRAMES, len(whole)) if arrived[i] == whole[i]}
    errors = np.array([
        np.inf if i is None else np.abs(frame.reading - signal.readings[i]).max()
        for i, frame in found if i is None or i >= SETTLING_FRAMES
    ])  # fmt: skip
    off, noticeable = errors > ROUNDING_UT, errors > NOTICEABLE_UT
    return {
        "whole": len(intact), "found": len(errors), "not delivered": len(intact - {i for i, _ in found}),
        "wrong": int(np.sum(off if layout.checked else noticeable)), "off at all": int(off.sum()),
    }  # fmt: skip


def _received(form: Format, data: bytes) -> list[Frame]:
    found: list[Frame] = []
    decoder = Decoder(FrameLayout(form))
    for at in range(0, len(data), CHUNK_BYTES):
        decoder, more = decode(decoder, data[at : at + CHUNK_BYTES])
        found += more
    return found


NOTICED = Measure("noticed", NOTICED_GOAL_S, "s")
BYTES = (
    Measure("wrong", WRONG_SHARE, of="found"), Measure("off at all", of="found"),
    Measure("not delivered", LOST_SHARE, of="whole"),
)  # fmt: skip
SKIN_FAULTS = (
    Fault("skin", "a minute at 400 Hz", long_stream, 10, (Measure("lost", LOSS_SHARE, of="samples"),)),
    Fault("skin", "silence", silent_board, 20, (NOTICED,)),
    Fault("skin", "unplugged cable", unplugged_board, 20, (NOTICED, Measure("not back", 0))),
    *(Fault("wire", f"{form}, {line}", partial(bad_line, form, line), len(RATES_HZ) * len(SIGNALS), BYTES)
      for form in Format for line in LINES),
    *(Fault("wire", f"binary, from mid-frame, temperature of line ends, {line}", partial(line_ends_in_numbers, line),
            25, BYTES) for line in LINES),
)  # fmt: skip
