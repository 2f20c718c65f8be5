"""The log of one touch while it is made: events, samples and states, in memory and, against a kill, in a raw file.

A raw file begins with a line of JSON that holds the board's number of chips, and those of further skins by their names;
entries follow, each a letter (e an event, s samples, k samples of a further skin, a a state of the arm), its size
(uint32) and its bytes, little-endian. A file that was cut off ends with its last whole entry.
"""

import errno
import json
import struct
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from i2t.errors import DataError, DeviceError
from i2t.files import read_bytes
from i2t.hardware.clock import Clock
from i2t.hardware.protocols import ArmState, Samples
from i2t.skin.boards import MAX_CHIPS
from i2t.types import Array

RAW_FILE_KIND = "i2t raw"
CHIPS_OF_VERSION_1 = 5  # files of version 1 do not say how many chips their board has
ENTRY_HEADER = struct.Struct("<cI")


class StorageError(DeviceError):
    """Recorded data cannot be kept: the disk is full or not ours, or the clock was set."""


@runtime_checkable
class TouchLog(Protocol):
    """Log that takes measurements and events while a touch is made."""

    def samples(self, samples: Samples, skin: str = "") -> None:
        """Keep samples of a skin; the same sample may come twice.

        Args:
            samples: As the skin gave them.
            skin: Name of a further skin; empty for the one at the tool, the only one of most labs.

        Raises:
            DeviceError: They could not be written.
        """

    def state(self, state: ArmState) -> None:
        """Keep a state of the arm.

        Args:
            state: As the arm gave it.

        Raises:
            DeviceError: It could not be written.
        """

    def event(self, text: str) -> None:
        """Keep what happened now.

        Args:
            text: A few words.

        Raises:
            DeviceError: It could not be written.
        """


class EventLog:
    """The log of a touch (`TouchLog`), in memory and in a file.

    Args:
        file: Open for writing, unbuffered; its header is written by this.
        clock: That dates events.
        chips: Number of the board's chips.
        carried: Those of further skins, by their names.

    Raises:
        StorageError: The file cannot be written.
    """

    def __init__(self, file: BinaryIO, clock: Clock, chips: int, carried: Mapping[str, int] | None = None) -> None:
        self._file, self._clock = file, clock
        carried = dict(carried or {})
        # of each skin, "" for the one at the tool, by sample number: time, 3 chips readings, temperatures
        self.readings: dict[str, dict[int, Float[Array, " k"]]] = {name: {} for name in ("", *carried)}
        self.states: list[ArmState] = []
        self.events: list[tuple[float, str]] = []
        about = {"touch": RAW_FILE_KIND, "version": 2, "chips": chips}
        self._put(json.dumps(about | ({"version": 3, "skins": carried} if carried else {})).encode() + b"\n")

    def samples(self, samples: Samples, skin: str = "") -> None:
        """Keep and write samples, as in `TouchLog.samples`."""
        rows = np.column_stack([samples.number, samples.time, samples.reading, samples.temperature])
        self.readings[skin] |= {int(row[0]): row[1:] for row in rows}
        values = rows.astype("<f8").tobytes()
        if skin:
            self._write(b"k", skin.encode() + b"\0" + values)
        else:
            self._write(b"s", values)

    def state(self, state: ArmState) -> None:
        """Keep and write a state of the arm, as in `TouchLog.state`."""
        self.states.append(state)
        row = np.concatenate([[state.time], state.T_b_t.ravel(), state.joints, state.velocity, state.wrench])
        self._write(b"a", row.astype("<f8").tobytes())

    def event(self, text: str) -> None:
        """Keep and write what happened now, as in `TouchLog.event`."""
        now = self._clock.now()
        self.events.append((now, text))
        self._write(b"e", json.dumps([now, text]).encode())

    def _write(self, kind: bytes, payload: bytes) -> None:
        self._put(ENTRY_HEADER.pack(kind, len(payload)) + payload)

    def _put(self, data: bytes) -> None:
        try:
            self._file.write(data)
        except (OSError, ValueError) as error:
            raise storage_error(Path(self._file.name), error) from error


def read_raw(path: str | Path) -> Iterator[tuple[str, Any]]:
    """Entries of a raw file, up to the last whole one.

    Args:
        path: Such as a file of `.interrupted`.

    Yields:
        ("event", [s, text]), ("skin", (n, 2 + 4 chips): number, s, readings in uT, temperatures in degrees Celsius),
        ("skin NAME", the same of a further skin) and ("arm", (29 + joints,): s, 16 of T_b_t, the joints, 6 of the
        velocity, 6 of the wrench).

    Raises:
        DataError: The file is of another kind.
    """
    data = read_bytes(path)
    header, _, _ = data.partition(b"\n")
    chips = _chips(Path(path), header)
    at = len(header) + 1
    while at + ENTRY_HEADER.size <= len(data):
        kind, size = ENTRY_HEADER.unpack_from(data, at)
        at += ENTRY_HEADER.size
        if at + size > len(data):
            return
        payload = data[at : at + size]
        at += size
        try:
            yield _entry(kind, payload, chips)
        except (ValueError, LookupError, TypeError, RecursionError) as error:
            raise DataError(
                f"{path}: its entry before byte {at} is damaged ({error}); what was read before is whole"
            ) from error


def _entry(kind: bytes, payload: bytes, chips: Mapping[str, int]) -> tuple[str, Any]:
    if kind == b"e":
        when, text = json.loads(payload)
        return "event", [float(when), str(text)]
    if kind == b"s":
        return "skin", np.frombuffer(payload, "<f8").reshape(-1, 2 + 4 * chips[""])
    if kind == b"k":
        name, _, values = payload.partition(b"\0")
        return f"skin {name.decode()}", np.frombuffer(values, "<f8").reshape(-1, 2 + 4 * chips[name.decode()])
    if kind == b"a":
        return "arm", np.frombuffer(payload, "<f8")
    raise ValueError(f"of the unknown kind {kind!r}")


def _chips(path: Path, header: bytes) -> dict[str, int]:
    """Number of chips of each skin by a raw file's header, of the one at the tool under ""."""
    try:
        about = json.loads(header)
        if about["touch"] == RAW_FILE_KIND:
            chips = {"": int(about["chips"]) if about["version"] > 1 else CHIPS_OF_VERSION_1}
            chips |= {str(name): int(count) for name, count in about.get("skins", {}).items()}
            if all(1 <= count <= MAX_CHIPS for count in chips.values()):
                return chips
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError, OverflowError):
        pass
    raise DataError(f"{path}: is no raw file of a touch; give one from .interrupted")


def storage_error(path: Path, error: Exception) -> StorageError:
    """Error about a file that cannot be written, in a sentence.

    Args:
        path: Of the file or folder.
        error: What the system said.

    Returns:
        The error to raise, with the remedy.
    """
    code = getattr(error, "errno", None)
    remedy = {
        errno.ENOSPC: "the disk is full: free some space",
        getattr(errno, "EDQUOT", None): "your quota is used up: free some space",
        errno.EFBIG: "files may not grow so large here",
        errno.EROFS: "it may only be read: choose another folder",
        errno.EACCES: "it may not be written: choose another folder",
        errno.EPERM: "it may not be written: choose another folder",
    }.get(code or 0, f"{getattr(error, 'strerror', None) or error}: choose another folder")
    return StorageError(f"{path}: {remedy}, and go on where it stopped")
