"""What is told of a touch while it is made, in memory and, against everything that may happen, in a raw file.

A raw file begins with a line of JSON; entries follow, each a letter (e an event, s samples, a a state of the arm), its
size (uint32) and its bytes, little-endian. A file that was cut off ends with its last whole entry.
"""

import errno
import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from i2t.errors import DataError, DeviceError
from i2t.hardware.clock import Clock
from i2t.hardware.protocols import ArmState, Samples
from i2t.types import CHIPS, READINGS, Array

RAW = json.dumps({"touch": "i2t raw", "version": 1}).encode() + b"\n"
ENTRY = struct.Struct("<cI")


class Lost(DeviceError):
    """What was recorded cannot be kept: the disk is full or not ours, or the clock was set."""


class Tape:
    """What is told of a touch while it is made, in memory and in a file."""

    def __init__(self, file: BinaryIO, clock: Clock) -> None:
        self._file, self._clock = file, clock
        self.readings: dict[int, Array] = {}  # by the sample's number: time, 15 values, 5 temperatures
        self.states: list[ArmState] = []
        self.events: list[tuple[float, str]] = []

    def samples(self, samples: Samples) -> None:
        """Of the skin; the same sample may come twice."""
        rows = np.column_stack([samples.number, samples.time, samples.reading, samples.temperature])
        self.readings |= {int(row[0]): row[1:] for row in rows}
        self._write(b"s", rows.astype("<f8").tobytes())

    def state(self, state: ArmState) -> None:
        """Of the arm."""
        self.states.append(state)
        row = np.concatenate([[state.time], state.T_b_t.ravel(), state.joints, state.velocity, state.wrench])
        self._write(b"a", row.astype("<f8").tobytes())

    def event(self, text: str) -> None:
        """What happened now."""
        now = self._clock.now()
        self.events.append((now, text))
        self._write(b"e", json.dumps([now, text]).encode())

    def _write(self, kind: bytes, payload: bytes) -> None:
        try:
            self._file.write(ENTRY.pack(kind, len(payload)) + payload)
        except (OSError, ValueError) as error:
            raise lost(Path(self._file.name), error) from error


def read_raw(path: str | Path) -> Iterator[tuple[str, Any]]:
    """Entries of a raw file: ("event", [s, text]), ("skin", (n, 22): number, s, 15 uT, 5 C) and ("arm", (35,): s, 16 of
    T_b_t, 6 joints, 6 velocities, 6 of the wrench). It ends with the last whole one. Raises DataError.
    """
    data = Path(path).read_bytes()
    if not data.startswith(RAW):
        raise DataError(f"{path}: is no raw file of a touch; give one from .interrupted")
    at = len(RAW)
    while at + ENTRY.size <= len(data):
        kind, size = ENTRY.unpack_from(data, at)
        at += ENTRY.size
        if at + size > len(data):
            return
        payload = data[at : at + size]
        at += size
        if kind == b"e":
            yield "event", json.loads(payload)
        elif kind == b"s":
            yield "skin", np.frombuffer(payload, "<f8").reshape(-1, 2 + READINGS + CHIPS)
        elif kind == b"a":
            yield "arm", np.frombuffer(payload, "<f8")


def lost(path: Path, error: Exception) -> Lost:
    """What became of a file, in a sentence."""
    code = getattr(error, "errno", None)
    remedy = {
        errno.ENOSPC: "the disk is full: free some space",
        errno.EDQUOT: "your quota is used up: free some space",
        errno.EFBIG: "files may not grow so large here",
        errno.EROFS: "it may only be read: choose another folder",
        errno.EACCES: "it may not be written: choose another folder",
        errno.EPERM: "it may not be written: choose another folder",
    }.get(code or 0, f"{getattr(error, 'strerror', None) or error}: choose another folder")
    return Lost(f"{path}: {remedy}, and go on where it stopped")
