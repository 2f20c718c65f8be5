"""The skin: a stream over a pseudo-terminal, bad lines, silence and an unplugged cable."""

import struct
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

from experiments.faults.rows import FaultCounts, FaultRow, worst
from i2t.emulators.reskin_board import Readings, corrupt, started
from i2t.errors import DeviceError, DeviceTimeoutError
from i2t.hardware.reskin.driver import ReSkin
from i2t.hardware.reskin.frames import Decoder, Frame, decode
from i2t.hardware.reskin.layouts import Format, FrameLayout, encode

ERROR_SIZES_UT = (1.0, 10.0, 25.0)
CRLF_TEMPERATURE_C = struct.unpack("<f", bytes.fromhex("980d0a42"))[0]  # holds a line's end
PATIENCE_S = 10.0
SKIPPED_BYTES = 40  # of the first frame, where the line is opened in the middle of it
BYTES_AT_ONCE = 4096  # that the decoder is given


class LineErrors(NamedTuple):
    """Changes of bytes on a bad line, and the share of intact frames that a decoder should still deliver."""

    substitute: float  # share of bytes that become others
    drop: float  # share that is lost
    goal: float

    def __str__(self) -> str:
        if self.substitute:
            return f"{100 * self.substitute:g} % of bytes changed"
        return f"{100 * self.drop:g} % of bytes lost"


BAD_LINES = (LineErrors(substitute=0.01, drop=0.0, goal=0.98), LineErrors(substitute=0.0, drop=0.001, goal=0.95))


class SentFrames(NamedTuple):
    """Frames sent into a bad line, and the bytes that came out of it."""

    readings: list[np.ndarray]  # uT, of each frame
    ends: list[int]  # byte of `data` behind each frame
    intact: list[bool]  # whether all bytes of a frame came through
    data: bytes


def skin(sizes: FaultCounts) -> list[FaultRow]:
    """Try the skin's stream, bad lines and silence."""
    rows = [_stream(sizes.stream)]
    for line in BAD_LINES:
        for temperature in (None, CRLF_TEMPERATURE_C):
            rows += _line(sizes.frames, line, temperature)
    return rows + _gone(sizes.silences)


def _stream(seconds: float) -> FaultRow:
    with started("--rate", "400") as (port, _), ReSkin(port) as device:
        first, newest = device.counters.samples, int(device.latest().number[-1])
        begun = time.monotonic()
        start, numbers = newest, 0
        while time.monotonic() - begun < seconds:
            time.sleep(0.05)
            fresh = device.since(newest)
            numbers += len(fresh.number)
            newest = int(fresh.number[-1]) if len(fresh.number) else newest
        took, counters = time.monotonic() - begun, device.counters
    came = counters.samples - first
    lost = counters.lost + counters.overflowed + (newest - start - numbers)
    share = lost / max(1, came + lost)
    said = f"{came} samples, {came / took:.1f} Hz, {lost} lost ({100 * share:.4f} %)"
    return FaultRow("skin", "400 Hz over a pseudo-terminal", f"{seconds:g} s", said, "< 0.1 % lost", share < 1e-3)


def _line(count: int, line: LineErrors, temperature: float | None) -> list[FaultRow]:
    """Frames through a bad line; of a board whose temperature reads as the end of a line, opened in mid-frame."""
    sent = _send(count, line, temperature)
    found = _received(sent.data)
    frame_at = {end: i for i, end in enumerate(sent.ends)}  # by the byte at which it ends
    intact = {end for end, same in zip(sent.ends, sent.intact, strict=True) if same}
    share = len(intact & {frame.end for frame in found}) / max(1, len(intact))
    misaligned = sum(frame.end not in frame_at for frame in found)
    what = str(line) if temperature is None else f"{line}, from mid-frame at {temperature:.3f} C"
    tried, delivered, goal = (
        f"{count} frames ({len(intact)} intact)",
        f"{100 * share:.2f} %",
        f">= {100 * line.goal:g} %",
    )
    rows = [
        FaultRow("skin", f"{what}: intact frames delivered", tried, delivered, goal, share >= line.goal),
        FaultRow("skin", f"{what}: misaligned frames accepted", tried, str(misaligned), "0", misaligned == 0),
    ]
    if line.substitute:
        pairs = [(frame, sent.readings[frame_at[frame.end]]) for frame in found if frame.end in frame_at]
        errors = np.array([np.abs(frame.reading - reading).max() for frame, reading in pairs])
        rates = " / ".join(f"{100 * np.mean(errors > size):.3g}" for size in ERROR_SIZES_UT)
        sizes = " / ".join(f"{size:g}" for size in ERROR_SIZES_UT)
        wrong = f"{what}: delivered with an error over {sizes} uT"
        rows.append(FaultRow("skin", wrong, f"{len(found)} frames", f"{rates} %", "stated", None))
    return rows


def _send(count: int, line: LineErrors, temperature: float | None) -> SentFrames:
    """Frames of an emulated board through a bad line."""
    rng, board = np.random.default_rng(0), Readings(1.0, 0.0, temperature, 0)
    sent = SentFrames([], [], [], b"")
    data = bytearray()
    for i in range(count):
        reading, celsius = board.at(0.0)
        whole = encode(reading, celsius, Format.BINARY)
        skipped = SKIPPED_BYTES if i == 0 and temperature is not None else 0
        arrived = corrupt(whole, line.substitute, line.drop, rng)[skipped:]
        data += arrived
        sent.readings.append(reading)
        sent.ends.append(len(data))
        sent.intact.append(arrived == whole)
    return sent._replace(data=bytes(data))


def _received(data: bytes) -> list[Frame]:
    """Frames that the driver's decoder makes of a stream that comes in pieces."""
    found: list[Frame] = []
    decoder = Decoder(FrameLayout())
    for at in range(0, len(data), BYTES_AT_ONCE):
        decoder, more = decode(decoder, data[at : at + BYTES_AT_ONCE])
        found += more
    return found


def _gone(trials: int) -> list[FaultRow]:
    silent, unplugged, back = [], [], 0
    for i in range(trials):
        with started("--silent-after", "0.6", "--seed", str(i)) as (port, _), ReSkin(port) as device:
            silent.append(_noticed(device))
        with tempfile.TemporaryDirectory() as folder:
            link = str(Path(folder) / "skin")
            faults = ("--unplug-after", "0.6", "--replug-after", "1.4", "--link", link)
            with started(*faults, "--seed", str(i)) as (port, _), ReSkin(port) as device:
                unplugged.append(_noticed(device))
                end = time.monotonic() + PATIENCE_S
                while time.monotonic() < end:
                    try:
                        device.connect()
                        device.read(5)
                        back += 1
                        break
                    except DeviceError:
                        time.sleep(0.1)
    tried = f"{trials} times"
    return [
        FaultRow("skin", "silence noticed", tried, worst(silent), "< 500 ms", max(silent) < 0.5),
        FaultRow("skin", "unplugged cable noticed", tried, worst(unplugged), "< 500 ms", max(unplugged) < 0.5),
        FaultRow("skin", "connected again when plugged in", tried, f"{back} of {trials}", "all", back == trials),
    ]


def _noticed(device: ReSkin) -> float:
    """Seconds from the last sample to the error, for a loop that asks every 10 ms."""
    last = time.monotonic()
    end = last + PATIENCE_S
    while time.monotonic() < end:
        try:
            last = float(device.latest().time[-1])
        except (DeviceTimeoutError, DeviceError):
            return time.monotonic() - last
        time.sleep(0.01)
    return float("inf")
