"""The skin: a stream over a pseudo-terminal, bad lines, silence and an unplugged cable."""

import struct
import tempfile
import time
from pathlib import Path

import numpy as np

from experiments.faults.rows import FaultRow, Sizes, worst
from i2t.emulators.reskin_board import Readings, corrupt, started
from i2t.errors import DeviceError, DeviceTimeoutError
from i2t.hardware.reskin.driver import ReSkin
from i2t.hardware.reskin.frames import Decoder, Frame, FrameLimits, decode
from i2t.hardware.reskin.layouts import Format, FrameLayout, encode

LINE_ERRORS = ((0.01, 0.0, 0.98), (0.0, 0.001, 0.95))  # bytes substituted, dropped; goal for intact frames
ERROR_SIZES_UT = (1.0, 10.0, 25.0)
CRLF_TEMPERATURE_C = struct.unpack("<f", bytes.fromhex("980d0a42"))[0]  # holds a line's end
PATIENCE_S = 10.0


def skin(sizes: Sizes) -> list[FaultRow]:
    """All of it."""
    rows = [_stream(sizes.stream)]
    for substitute, drop, goal in LINE_ERRORS:
        for temperature, skipped in ((None, 0), (CRLF_TEMPERATURE_C, 40)):
            rows += _line(sizes.frames, substitute, drop, goal, temperature, skipped)
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


def _line(
    count: int, substitute: float, drop: float, goal: float, temperature: float | None, skipped: int
) -> list[FaultRow]:
    """Frames through a bad line, beginning `skipped` bytes late."""
    rng, board = np.random.default_rng(0), Readings(1.0, 0.0, temperature, 0)
    truth, ends, good, data = [], [], [], b""
    for i in range(count):
        reading, celsius = board.at(0.0)
        whole = encode(reading, celsius, Format.BINARY)
        sent = corrupt(whole, substitute, drop, rng)[skipped if i == 0 else 0 :]
        truth.append(reading)
        good.append(sent == whole)
        data += sent
        ends.append(len(data))
    found: list[Frame] = []
    decoder = Decoder(FrameLayout(), FrameLimits())
    for at in range(0, len(data), 4096):
        decoder, more = decode(decoder, data[at : at + 4096])
        found += more
    at_end = {end: i for i, end in enumerate(ends)}
    intact = {end for end, same in zip(ends, good, strict=True) if same}
    delivered = {frame.end for frame in found}
    misaligned = sum(frame.end not in at_end for frame in found)
    errors = np.array(
        [np.abs(frame.reading - truth[at_end[frame.end]]).max() for frame in found if frame.end in at_end]
    )
    share = len(intact & delivered) / max(1, len(intact))
    what = f"{100 * substitute:g} % of bytes changed" if substitute else f"{100 * drop:g} % of bytes lost"
    if temperature is not None:
        what += f", from mid-frame at {temperature:.3f} C"
    tried = f"{count} frames ({len(intact)} intact)"
    rows = [
        FaultRow(
            "skin",
            f"{what}: intact frames delivered",
            tried,
            f"{100 * share:.2f} %",
            f">= {100 * goal:g} %",
            share >= goal,
        ),
        FaultRow("skin", f"{what}: misaligned frames accepted", tried, str(misaligned), "0", misaligned == 0),
    ]
    if substitute:
        rates = " / ".join(f"{100 * np.mean(errors > size):.3g}" for size in ERROR_SIZES_UT)
        sizes = " / ".join(f"{size:g}" for size in ERROR_SIZES_UT)
        rows.append(
            FaultRow(
                "skin",
                f"{what}: delivered with an error over {sizes} uT",
                f"{len(found)} frames",
                f"{rates} %",
                "stated",
                None,
            )
        )
    return rows


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
