"""What breaks between a skin's board and its driver: a long stream, silence, an unplugged cable.

What bad lines do to the bytes is tested in tests/hardware/test_frames.py.
"""

import tempfile
import time
from pathlib import Path

from experiments.faults.table import NOTICED, Fault, Measure, Trial
from i2t.emulators.reskin_board import started
from i2t.errors import DeviceError
from i2t.hardware.reskin.driver import ReSkin

PATIENCE_S = 10.0
STREAM_S = 60.0
LOSS_SHARE = 1e-3  # goal: samples lost


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
    lost = counters.lost + (newest - start - read)
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


SKIN_FAULTS = (
    Fault("skin", "a minute at 400 Hz", long_stream, 10, (Measure("lost", LOSS_SHARE, of="samples"),)),
    Fault("skin", "silence", silent_board, 20, (NOTICED,)),
    Fault("skin", "unplugged cable", unplugged_board, 20, (NOTICED, Measure("not back", 0))),
)
