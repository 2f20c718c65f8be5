"""The log of one touch while it is made: events, samples and states, in memory and, against a kill, in a raw file.

A raw file has a line of JSON for each entry: first what it is, with the number of chips of each skin (that at the tool
has an empty name), then `["event", [s, text]]`, `["skin NAME", rows]` and `["arm", row]`. A file that was cut off ends
with its last whole line.
"""

import errno
import json
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

RAW_FILE_KIND, RAW_FILE_VERSION = "i2t raw", 4


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
        file: Open for writing, unbuffered.
        clock: That dates events.
        chips: Number of chips of each skin, by its name.

    Raises:
        StorageError: The file cannot be written.
    """

    def __init__(self, file: BinaryIO, clock: Clock, chips: Mapping[str, int]) -> None:
        self._file, self._clock = file, clock
        # of each skin, by sample number: time, 3 chips readings, temperatures
        self.readings: dict[str, dict[int, Float[Array, " k"]]] = {name: {} for name in chips}
        self.states: list[ArmState] = []
        self.events: list[tuple[float, str]] = []
        self._write({"touch": RAW_FILE_KIND, "version": RAW_FILE_VERSION, "chips": dict(chips)})

    def samples(self, samples: Samples, skin: str = "") -> None:
        """Keep and write samples, as in `TouchLog.samples`."""
        rows = np.column_stack([samples.number, samples.time, samples.reading, samples.temperature])
        self.readings[skin] |= {int(row[0]): row[1:] for row in rows}
        self._write([f"skin {skin}".strip(), rows.tolist()])

    def state(self, state: ArmState) -> None:
        """Keep and write a state of the arm, as in `TouchLog.state`."""
        self.states.append(state)
        row = np.concatenate([[state.time], state.T_b_t.ravel(), state.joints, state.velocity, state.wrench])
        self._write(["arm", row.tolist()])

    def event(self, text: str) -> None:
        """Keep and write what happened now, as in `TouchLog.event`."""
        now = self._clock.now()
        self.events.append((now, text))
        self._write(["event", [now, text]])

    def _write(self, entry: Any) -> None:
        try:
            self._file.write(json.dumps(entry).encode() + b"\n")
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
        DataError: The file is of another kind, or damaged.
    """
    header, *lines = read_bytes(path).split(b"\n")
    chips = _chips(path, header)
    for number, line in enumerate(lines[:-1], start=2):
        try:
            kind, values = json.loads(line)
            if kind == "event":
                when, text = values
                yield kind, [float(when), str(text)]
            elif kind == "arm":
                yield kind, np.array(values, float).reshape(-1)
            else:
                yield kind, np.array(values, float).reshape(len(values), 2 + 4 * chips[kind])
        except (ValueError, LookupError, TypeError, RecursionError, OverflowError) as error:
            raise DataError(f"{path}: line {number} is damaged ({error}); what stands before it is whole") from error


def _chips(path: str | Path, header: bytes) -> dict[str, int]:
    """Number of chips of each kind of entry of a skin, by a raw file's header."""
    try:
        about = json.loads(header)
        if about["touch"] == RAW_FILE_KIND and about["version"] < RAW_FILE_VERSION:
            raise DataError(f"{path}: was written by an earlier version of i2t; read it with that version's read_raw")
        chips = {f"skin {name}".strip(): int(count) for name, count in about["chips"].items()}
        if about["touch"] == RAW_FILE_KIND and all(1 <= count <= MAX_CHIPS for count in chips.values()):
            return chips
    except DataError:
        raise
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError, OverflowError):
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
