"""What breaks between a skin's board and its driver: a long stream, flipped bits, silence, an unplugged cable, a chip
that dies and a board that freezes.

Other effects of bad lines on the bytes are tested in tests/hardware/test_frames.py.
"""

import math
import tempfile
import time
from functools import partial
from pathlib import Path

import numpy as np

from i2t.emulators.reskin_board import Readings, run_board
from i2t.errors import DeviceError
from i2t.hardware.reskin.driver import ReSkin
from i2t.hardware.reskin.frames import RUN_LENGTH, Decoder, decode
from i2t.hardware.reskin.layouts import Format, FrameLayout, encode
from i2t.hardware.skin_health import HealthConfig, frozen_sentence
from tests.faults.table import NOTICED, Fault, Measure, Trial

PATIENCE_S = 10.0
STREAM_FRAMES = 5000  # of a stream whose bits are flipped
FAULT_S, FAULT_SAMPLES, DEAD_CHIP = 0.6, 480, 2  # samples of twice that time
LOSS_SHARE = 1e-3  # goal: samples lost


def long_stream(rate: float, seconds: float, number: int) -> Trial:
    """Count the samples of a stream over a pseudo-terminal that arrive and that are lost before the reader.

    Args:
        rate: Hz.
        seconds: Duration of the stream, s.
        number: Number of the trial.

    Returns:
        Samples, with those that were lost.
    """
    with run_board("--rate", str(rate), "--seed", str(number)) as (port, _), ReSkin(port, rate=rate) as device:
        first, newest = device.counters.samples, int(device.latest().number[-1])
        end, start, read = time.monotonic() + seconds, newest, 0
        while time.monotonic() < end:
            time.sleep(0.05)
            fresh = device.since(newest)
            read += len(fresh.number)
            newest = int(fresh.number[-1]) if len(fresh.number) else newest
        counters = device.counters
    lost = counters.lost + (newest - start - read)
    return {"lost": lost, "samples": counters.samples - first + lost}


def flipped_bits(form: Format, share: float, number: int, count: int = STREAM_FRAMES) -> Trial:
    """A stream in which each bit is flipped with a probability, but for the frames with which it begins.

    Args:
        form: Format of the frames.
        share: Probability that a bit is flipped.
        number: Number of the trial.
        count: Number of frames that are sent.

    Returns:
        Frames that were delivered, those of them that are not as they were sent, and those that came whole.
    """
    readings, rng = Readings(1.0, 0.0, number), np.random.default_rng((number, 7))
    sent = [np.frombuffer(encode(*readings.at(0.0), form, i), np.uint8) for i in range(count)]
    flips = np.packbits(rng.random((count, 8 * len(sent[0]))) < share, axis=1)
    flips[:RUN_LENGTH] = 0
    damaged = np.asarray((flips != 0).any(1))
    _, found = decode(Decoder(FrameLayout(form)), (np.stack(sent) ^ flips).tobytes())
    ends, size = np.array([frame.end for frame in found]), len(sent[0])
    wrong = (ends % size != 0) | damaged[ends // size - 1]
    return {"wrong": int(wrong.sum()), "delivered": len(found), "whole": int((~damaged).sum())}


def dead_chip(number: int) -> Trial:
    """A chip that sends zeros from a moment on: missing (NaN) from its first zeros, and the others never."""
    words = ("--fail", str(DEAD_CHIP), "--fail-after", str(FAULT_S), "--seed", str(number))
    with run_board(*words) as (port, _), ReSkin(port) as device:
        by_chip = device.read(FAULT_SAMPLES, PATIENCE_S).reading.reshape(-1, 5, 3)
    gone = np.isnan(by_chip).all(2)
    since = int(np.argmax(gone[:, DEAD_CHIP])) if gone[:, DEAD_CHIP].any() else len(gone)
    expected = np.zeros_like(gone)
    expected[since:, DEAD_CHIP] = True
    wrong = (gone != expected).any(1) | (by_chip == 0).all(2).any(1)
    return {"wrong": int(wrong.sum()), "samples": len(gone), "unnoticed": since == len(gone)}


def frozen_board(number: int) -> Trial:
    """A board that sends the same values from a moment on, judged by each 24 successive samples."""
    with run_board("--freeze-after", str(FAULT_S), "--seed", str(number)) as (port, _), ReSkin(port) as device:
        samples = device.read(FAULT_SAMPLES, PATIENCE_S)
    reading, at = samples.reading, samples.time
    still = int(np.flatnonzero((np.diff(reading, axis=0) != 0).any(1))[-1]) + 1  # the first of those that are all alike
    length = HealthConfig.min_samples
    ends = range(length, len(reading) + 1)
    said = [end for end in ends if frozen_sentence(reading[end - length : end])]
    false = sum(end < still + length for end in said)
    return {"noticed": at[said[0] - 1] - at[still] if said else float("inf"), "false": false, "looks": len(ends)}


def silent_board(number: int) -> Trial:
    """A board that falls silent."""
    with run_board("--silent-after", "0.6", "--seed", str(number)) as (port, _), ReSkin(port) as device:
        return {"noticed": _noticed(device)}


def unplugged_board(number: int) -> Trial:
    """A board that is unplugged, and plugged in again."""
    with tempfile.TemporaryDirectory() as folder:
        words = ("--unplug-after", "0.6", "--replug-after", "1.4", "--link", str(Path(folder) / "skin"))
        with run_board(*words, "--seed", str(number)) as (port, _), ReSkin(port) as device:
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


LOST = (Measure("lost", LOSS_SHARE, of="samples"),)
SKIN_FAULTS = (
    Fault("skin", "a minute at 400 Hz", partial(long_stream, 400.0, 60.0), 10, LOST),
    Fault("skin", "ten seconds at 1000 Hz", partial(long_stream, 1000.0, 10.0), 20, LOST),
    *(
        Fault("skin", f"{100 * share:g} % of bits flipped, {form} frames", partial(flipped_bits, form, share), 20,
              (Measure("wrong", 0.0 if form == Format.CRC else math.inf, of="delivered"),))
        for share in (0.001, 0.01)
        for form in (Format.FRAMED, Format.CRC)
    ),
    Fault("skin", "chip that dies", dead_chip, 20, (Measure("wrong", 0, of="samples"), Measure("unnoticed", 0))),
    Fault("skin", "board that freezes", frozen_board, 20, (NOTICED, Measure("false", 0, of="looks"))),
    Fault("skin", "silence", silent_board, 20, (NOTICED,)),
    Fault("skin", "unplugged cable", unplugged_board, 20, (NOTICED, Measure("not back", 0))),
)  # fmt: skip
