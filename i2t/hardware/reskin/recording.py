"""Recorded byte streams: what a serial board sent and when, and a recording played as if it were a port.

A file begins with a line of JSON (`{"stream": "i2t raw bytes", "version": 1}`); then every chunk that was read is its
time (float64, s, monotonic), its length (uint32) and its bytes, little-endian. A file that was cut off ends with its
last whole chunk.
"""

import json
import struct
import time
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from i2t.errors import DataError
from i2t.files import read_bytes

RECORDING_HEADER = json.dumps({"stream": "i2t raw bytes", "version": 1}).encode() + b"\n"
CHUNK = struct.Struct("<dI")
MAX_RECORDING_S = 1e7  # four months


def create(path: str | Path) -> BinaryIO:
    """Begin a recording.

    Args:
        path: Of the new file.

    Returns:
        The file, to be closed by the caller.

    Raises:
        OSError: It cannot be written; FileExistsError if there is one already.
    """
    file = open(path, "xb", buffering=0)  # noqa: SIM115, closed by its user; every chunk goes to the system at once
    try:
        file.write(RECORDING_HEADER)
    except OSError:
        file.close()
        raise
    return file


def append(file: BinaryIO, at: float, chunk: bytes) -> None:
    """Add a chunk to a recording.

    Args:
        file: From `create`.
        at: s, when the chunk came.
        chunk: Its bytes.

    Raises:
        OSError: The disk is full.
    """
    whole = CHUNK.pack(at, len(chunk)) + chunk
    if file.write(whole) != len(whole):
        raise OSError(28, "No space left on device")


def chunks(path: str | Path) -> Iterator[tuple[float, bytes]]:
    """Read a recording.

    Args:
        path: Of the file.

    Yields:
        Times (s, from zero) and bytes.

    Raises:
        OSError: The file cannot be read.
        DataError: It is no recording, or its times cannot be.
    """
    data = read_bytes(path)
    if not data.startswith(RECORDING_HEADER):
        raise DataError(f"{path}: is no recording; make one with python -m i2t.hardware.reskin --record FILE")
    at, first = len(RECORDING_HEADER), None
    while at + CHUNK.size <= len(data):
        when, size = CHUNK.unpack_from(data, at)
        at += CHUNK.size
        if at + size > len(data):
            return
        first = when if first is None else first
        if not 0 <= when - first <= MAX_RECORDING_S:
            raise DataError(
                f"{path}: says that its bytes before {at + size} came {when - first:.3g} s after the first; "
                "record it again"
            )
        yield when - first, data[at : at + size]
        at += size


class PlayedPort:
    """A recording with the face of a serial port; `read` raises EOFError once everything has been read.

    Args:
        path: Of the recording.
        timeout: s that `read` waits for a first byte.
    """

    def __init__(self, path: str | Path, timeout: float) -> None:
        self._chunks = list(chunks(path))
        self._timeout = timeout
        self._start: float | None = None
        self._next = 0
        self._ready = b""

    @property
    def in_waiting(self) -> int:
        """Number of bytes that have come by now."""
        now = time.monotonic()
        self._start = now if self._start is None else self._start
        while self._next < len(self._chunks) and self._due() <= now:
            self._ready += self._chunks[self._next][1]
            self._next += 1
        return len(self._ready)

    def read(self, size: int) -> bytes:
        """The next bytes; waits for the first of them as long as the timeout.

        Args:
            size: How many at most.

        Returns:
            The bytes; none where none came in time.

        Raises:
            EOFError: The recording is at its end.
        """
        if not self.in_waiting:
            if self._next == len(self._chunks):
                raise EOFError
            time.sleep(min(self._timeout, max(0.0, self._due() - time.monotonic())))
        size = min(size, self.in_waiting)
        chunk, self._ready = self._ready[:size], self._ready[size:]
        return chunk

    def close(self) -> None:
        """Do nothing: there is no port to give back."""

    def _due(self) -> float:
        return (self._start or 0.0) + self._chunks[self._next][0]
