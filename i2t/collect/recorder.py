"""Recorder of touches: each becomes one immutable file, complete and on the disk before it is acknowledged.

During a touch, everything also goes to a hidden raw file (`.under-way`), so that all readings survive even `kill -9`.
It is removed once the touch is saved, and moved to `.interrupted/` otherwise. `read_raw` reads such a file up to its
last complete entry. Each entry is a line of JSON that begins with its kind: `["event", [s, text]]`, `["skin NAME",
rows]` (without a name for the pressing skin) and `["arm", row]`.

Devices count seconds that never jump, and files hold Unix time. Both clocks are read when a touch begins, and their
difference dates everything in that touch. If the difference has changed at the end, the clock was set: the
touch is saved with the old difference, and the session ends, because later files would sort before earlier ones.

A nearly full disk, a folder without write permission and a clock that was set back are found before a touch begins,
while the arm is away from the object. Each problem is a DeviceError of one sentence.
"""

import contextlib
import json
import shutil
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Any, BinaryIO

import numpy as np
from jaxtyping import Float

from i2t import dataset
from i2t.collect.out_folder import MIN_FREE_BYTES, TOUCH_FILES
from i2t.collect.touch import TOOL, Site, SkinTouch, TouchResult
from i2t.dataset import Dataset, Image, Record, Series
from i2t.depth.camera import Camera, to_units
from i2t.errors import DataError, DeviceError
from i2t.files.reading import read_bytes
from i2t.files.writing import open_without_links, unwritable
from i2t.hardware.clock import Clock, MonotonicClock
from i2t.hardware.protocols import ArmState, Samples, View, channel_names
from i2t.patches.dimensions import PATCH_WINDOW, REACH
from i2t.types import Array, Board, Touches

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

INTERRUPTED = ".interrupted"  # folder of the raw files of touches that were not saved
# first line of the raw file of a touch, which is kept until the touch is saved
RAW_FILE_HEADER = b'{"touch": "i2t raw", "version": 4}'
POSE_CHANNELS = tuple(f"T_w_t[{i},{j}]" for i in range(4) for j in range(4))  # elements of the tool's pose in the world
# elements of the wrench on the tool
WRENCH_CHANNELS = (*(f"force {axis}" for axis in "xyz"), *(f"torque {axis}" for axis in "xyz"))


@dataclass(frozen=True)
class SkinInfo:
    """One skin on the tool as all touches of a session describe it: its name in the data set, its board and notes."""

    pad: str
    board: Board
    meta: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class SessionInfo:
    """What all touches of a session share: object, poses of robot base and object in W, camera, skins and notes."""

    object: str
    session: str
    source: str  # source of the touches: simulated, real or mixed
    T_w_b: Array  # (4, 4) pose of the robot's base in W, m
    T_w_o: Array  # (4, 4) pose of the object in W, m
    camera: Camera
    skins: Mapping[str, SkinInfo]  # by the names of the skins in a touch
    meta: Mapping[str, str] = field(default_factory=dict)


class StorageError(DeviceError):
    """Recorded data cannot be kept: the disk is full, the folder is not writable, or the clock was set."""


def _not_kept(path: Path, error: OSError) -> StorageError:
    return StorageError(f"{unwritable(path, error)}, and go on where it stopped")


class EventLog:
    """Log of one touch, in memory and in a raw file: the skins' samples by their number, the arm's states, and events
    with their times (s).

    Args:
        file: Raw file, open for unbuffered writing.
        clock: Clock that dates events.

    Raises:
        StorageError: If the file cannot be written.
    """

    def __init__(self, file: BinaryIO, clock: Clock) -> None:
        self._file, self._clock = file, clock
        # Time, 3 chips readings and temperatures of each skin, by the number of the sample.
        self.readings: dict[str, dict[int, Float[Array, " k"]]] = defaultdict(dict)
        self.states: list[ArmState] = []
        self.events: list[tuple[float, str]] = []
        self._put(RAW_FILE_HEADER)

    def samples(self, samples: Samples, skin: str = "") -> None:
        """Add samples of a skin to the log and its file; the log keeps a sample that comes twice only once.

        Args:
            samples: Samples as the skin returned them.
            skin: Name of a further skin; empty for the pressing one, the only one in most labs.

        Raises:
            StorageError: If the samples cannot be written to the file.
        """
        rows = np.column_stack([samples.number, samples.time, samples.reading, samples.temperature])
        self.readings[skin] |= {int(row[0]): row[1:] for row in rows}
        self._write([f"skin {skin}".strip(), rows.tolist()])

    def state(self, state: ArmState) -> None:
        """Add a state of the arm to the log and its file.

        Args:
            state: State as the arm returned it.

        Raises:
            StorageError: If the state cannot be written to the file.
        """
        self.states.append(state)
        row = np.concatenate([[state.time], state.T_b_t.ravel(), state.joints, state.velocity, state.wrench])
        self._write(["arm", row.tolist()])

    def event(self, text: str) -> None:
        """Add an event to the log and its file, with the present time.

        Args:
            text: Description of the event in a few words.

        Raises:
            StorageError: If the event cannot be written to the file.
        """
        now = self._clock.now()
        self.events.append((now, text))
        self._write(["event", [now, text]])

    def _write(self, entry: list[Any]) -> None:
        self._put(json.dumps(entry).encode())

    def _put(self, line: bytes) -> None:
        try:
            self._file.write(line + b"\n")
        except OSError as error:
            raise _not_kept(Path(self._file.name), error) from error


def read_raw(path: str | Path) -> Iterator[tuple[str, Any]]:
    """Read the entries of the raw file of an unsaved touch (`EventLog`), up to the last complete one.

    Args:
        path: Path of the raw file, usually in the folder `.interrupted`.

    Yields:
        ("event", [time in s, text]), ("skin", (n, 2 + 4 chips): number, time in s, readings in uT, temperatures in C),
        ("skin NAME", the same of a further skin) and ("arm", (29 + joints,): time in s, 16 of T_b_t (m), the joints
        (rad), 6 of the velocity (m/s, rad/s), 6 of the wrench (N, Nm)).

    Raises:
        DataError: If the file is of another kind, or damaged.
    """
    header, *lines = read_bytes(path).split(b"\n")
    if header != RAW_FILE_HEADER:
        raise DataError(
            f"{path}: is not a raw file of a touch, or was written by an earlier version of i2t, which can read it; "
            "give one from .interrupted"
        )
    for number, line in enumerate(lines[:-1], start=2):
        try:
            kind, entry = json.loads(line)
            yield kind, entry if kind == "event" else np.array(entry, float)
        except (ValueError, TypeError, RecursionError, OverflowError) as error:
            raise DataError(f"{path}: line {number} is damaged ({error}); the lines before it are intact") from error


class Recorder:
    """Writer of the touches of one session to a folder, which it locks against other collections.

    Args:
        folder: Folder of the touches; it is created if necessary.
        info: Metadata that the touches share.
        clock: Common clock of the devices.
        reserve: Number of bytes that must be free before a touch begins; by default the size of a hundred touches.

    Raises:
        StorageError: If the folder cannot be used.
    """

    def __init__(
        self, folder: str | Path, info: SessionInfo, clock: Clock | None = None, reserve: int = MIN_FREE_BYTES
    ) -> None:
        self.folder, self.info = Path(folder), info
        self._clock, self._reserve = clock or MonotonicClock(), reserve
        self._log: EventLog | None = None
        self._raw: BinaryIO | None = None
        self._raw_path = self.folder / ".under-way"
        self._offset = 0.0  # s, Unix time minus the devices' time
        self._newest = 0.0  # s, Unix time of the newest touch
        self.saved: list[Path] = []
        self.bytes = 0
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self._lock = open(self.folder / ".lock", "a", opener=open_without_links)  # noqa: SIM115
        except OSError as error:
            raise _not_kept(self.folder, error) from error
        try:
            _lock_file(self._lock)
        except OSError:
            self._lock.close()
            raise StorageError(
                f"{self.folder} is being written by another collection; end that one, or choose another folder"
            ) from None
        saved = list_touches(self.folder)
        self._newest = touch_time(saved[-1]) if saved else 0.0

    def close(self) -> None:
        """Release the lock on the folder; readings of an unsaved touch are kept. Raises no error."""
        self._end_raw(keep=True)
        self._lock.close()

    def __enter__(self) -> "Recorder":
        return self

    def __exit__(self, *error: Any) -> None:
        self.close()

    def check(self) -> None:
        """Raise StorageError if the folder is not writable or nearly full, or the clock is behind the newest touch."""
        try:
            free = shutil.disk_usage(self.folder).free
            probe = self.folder / ".probe"
            probe.write_bytes(b"x")
            probe.unlink()
        except OSError as error:
            raise _not_kept(self.folder, error) from error
        if free < self._reserve:
            raise StorageError(
                f"{self.folder}: only {free / 2**20:.0f} MiB are free, but {self._reserve / 2**20:.0f} are required; "
                "free some space and run the command again"
            )
        if self._clock.wall() < self._newest:
            raise StorageError(
                f"the computer's clock is {self._newest - self._clock.wall():.0f} s behind the newest touch in "
                f"{self.folder}; correct the clock and run the command again"
            )

    def begin(self, site: Site, attempt: int) -> EventLog:
        """Begin the record of a touch, after checking that it can be saved.

        Args:
            site: Site of the touch.
            attempt: Number of earlier attempts at this site, 0 for the first.

        Returns:
            A new log for the touch.

        Raises:
            StorageError: If `check` fails, or the raw file of the log cannot be created.
        """
        self._end_raw(keep=True)
        self.check()
        self._offset = self._clock.wall() - self._clock.now()
        path = self._raw_path
        try:
            self._raw = open(path, "wb", buffering=0, opener=open_without_links)  # noqa: SIM115, closed when the touch ends
        except OSError as error:
            raise _not_kept(path, error) from error
        self._log = EventLog(self._raw, self._clock)
        self._log.event(f"site {site.number}, attempt {attempt + 1}")
        return self._log

    def save(self, touch: TouchResult) -> None:
        """Write a finished touch to a file. Once this returns, the file survives a killed process or a power cut.

        Args:
            touch: The touch, with its view.

        Raises:
            StorageError: If the file cannot be written; or, after it was written, if the computer's clock was set
                during the touch.
        """
        assert self._log is not None
        jump = self._clock.wall() - self._clock.now() - self._offset
        jumped = abs(jump) > 0.5  # s, more than the drift during a touch
        if jumped:
            self._log.event(f"the computer's clock jumped by {jump:.1f} s")
        at = max(self._clock.now() + self._offset, self._newest + 1e-6)  # the names of two files differ
        try:
            path = dataset.write_touch(self.folder, _record(touch, self._log, self.info, self._offset), at)
        except DataError as error:
            raise StorageError(str(error)) from error
        self._newest = at
        self.saved.append(path)
        self.bytes += path.stat().st_size
        self._end_raw(keep=False)
        if jumped:
            raise StorageError(
                f"the computer's clock jumped by {jump:.1f} s; the touch is saved; correct the clock and run the "
                "command again"
            )

    def abandon(self, reason: str) -> None:
        """End the record of a touch that failed; its raw file is kept in the folder `.interrupted`.

        Args:
            reason: Why the touch failed, as a sentence for the log.
        """
        if self._log is not None:
            with contextlib.suppress(StorageError):
                self._log.event(reason)
        self._end_raw(keep=True)

    def _end_raw(self, keep: bool) -> None:
        if self._raw is not None:
            self._raw.close()
        self._raw = self._log = None
        path = self._raw_path
        try:
            if path.exists() and keep:
                kept = self.folder / INTERRUPTED
                kept.mkdir(exist_ok=True)
                stamp = datetime.fromtimestamp(path.stat().st_mtime, UTC)
                path.rename(kept / f"touch-{stamp:%Y%m%dT%H%M%S.%f}Z.raw")
            elif path.exists():
                path.unlink()
        except OSError:
            pass  # the raw file is hidden and does no harm


def _lock_file(file: IO[str]) -> None:
    """Lock a file until it is closed. Raise OSError if another process holds the lock."""
    if fcntl is not None:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return
    import msvcrt

    msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined, unused-ignore]


# What a file holds


def _record(touch: TouchResult, log: EventLog, info: SessionInfo, to_wall: float) -> Record:
    """Assemble the record of a touch; `to_wall` (s) converts the devices' time to Unix time."""
    view = touch.camera_view
    assert view is not None
    counters = {"site": touch.site.number, "attempt": touch.attempt + 1}
    sets: dict[str, Dataset] = {}
    series = _arm_series(log.states, info.T_w_b, to_wall)
    for name, about in info.skins.items():
        result, suffix = touch.skins[name], f" {name}" if name else ""
        own = _skin_series(result, log.readings[name], about.board.num_chips, log.events[0][0], to_wall)
        sets[name] = _one_row(result, info, about, samples=own["tactile"])
        series |= {f"{label}{suffix}": part for label, part in own.items()}
        counted = result.counters._asdict().items()
        counters |= {f"skin{suffix} {label}": int(value) for label, value in counted if label != "rate"}
        if name and result.seen is not None:
            counters[f"skin {name} seen percent"] = round(100 * result.seen.visible_share)
    place = tuple(name.replace("w_t", "w_c") for name in POSE_CHANNELS)
    series["camera"] = Series(np.array([view.time + to_wall]), touch.T_w_c.reshape(1, 16), place, "1, m")
    return Record(
        touch=sets.pop(TOOL),
        skins=sets,
        images=_images(view),
        series=series,
        events=tuple((time + to_wall, text) for time, text in log.events),
        counters=counters,
    )


def _images(view: View) -> dict[str, Image]:
    scale = 1e-4  # m, unit of depth images
    images = {"depth": Image(to_units(view.depth, scale), scale, "m")}
    if view.colour is not None:
        images["colour"] = Image(view.colour)
    return images


def _skin_series(
    touch: SkinTouch, readings: Mapping[int, Array], chips: int, began: float, to_wall: float
) -> dict[str, Series]:
    """Make the series of readings, temperatures, and the ambient reading."""
    rows = np.array([readings[number] for number in sorted(readings)]).reshape(-1, 1 + 4 * chips)
    time, values = rows[:, 0] + to_wall, rows[:, 1:].astype(np.float32)
    channels = channel_names(chips)
    return {
        "tactile": Series(time, values[:, : 3 * chips], channels, "uT"),
        "temperature": Series(time, values[:, 3 * chips :], tuple(f"chip{i}" for i in range(chips)), "degrees Celsius"),
        "ambient": Series(np.array([began + to_wall]), touch.ambient[None], channels, "uT"),
    }


def _arm_series(logged: list[ArmState], T_w_b: Array, to_wall: float) -> dict[str, Series]:
    """Make the series of wrench, pose and joints, with each state once, in the order of time."""
    states = sorted({state.time: state for state in logged}.values(), key=lambda state: state.time)
    time = np.array([state.time for state in states]) + to_wall
    poses = np.array([(T_w_b @ state.T_b_t).ravel() for state in states]).reshape(-1, 16)
    wrenches = np.array([state.wrench for state in states]).reshape(-1, 6)
    num_joints = len(states[0].joints) if states else 0
    joints = np.array([state.joints for state in states]).reshape(len(states), num_joints)
    return {
        "wrench": Series(time, wrenches, WRENCH_CHANNELS, "N, Nm; on the tool, tool axes"),
        "pose": Series(time, poses, POSE_CHANNELS, "1, m"),
        "joints": Series(time, joints, tuple(f"joint{i}" for i in range(num_joints)), "rad"),
    }


def _one_row(touch: SkinTouch, info: SessionInfo, about: SkinInfo, *, samples: Series) -> Dataset:
    """Make a data set of one row from the touch of one skin."""
    seen = touch.seen
    assert seen is not None
    touches = Touches(
        patch=seen.patch[None],
        view=seen.view[None],
        nearest=np.array([seen.nearest]),
        reading=touch.reading[None],
        force=np.array([touch.force]),
        travel=np.array([touch.travel]),
        T_w_t=touch.T_w_s[None],
        T_w_o=info.T_w_o[None],
        object=np.zeros(1),
        pad=np.zeros(1),
        session=np.zeros(1),
        code=np.array([int(touch.code)]),
        time=samples.time[-1:] if len(samples.time) else None,  # end of the press
    )
    made_by = {"made by": "i2t.collect.session", "camera": json.dumps(asdict(info.camera))}
    return Dataset(
        touches,
        objects=(info.object,),
        pads=(about.pad,),
        sessions=(info.session,),
        board=about.board,
        source=info.source,
        window=PATCH_WINDOW,
        reach=REACH,
        meta={**made_by, **info.meta, **about.meta},
    )


# A folder of touches


def list_touches(folder: Path) -> list[Path]:
    """List the files of the touches recorded in a folder, in the order of time.

    Args:
        folder: Folder that may hold touches.

    Returns:
        Paths of the files; the list may be empty.
    """
    return sorted(folder.glob(TOUCH_FILES))


def touch_time(path: Path) -> float:
    """Read the time at which a touch was saved from the name of its file.

    Args:
        path: Path of the file of a recorded touch.

    Returns:
        Unix time (s) at which the touch was saved.

    Raises:
        DataError: If the name is not that of a recorded touch.
    """
    try:
        return datetime.strptime(path.name[6:28] + "+0000", "%Y%m%dT%H%M%S.%f%z").timestamp()
    except ValueError as error:
        raise DataError(f"{path}: is not the name of a touch; move it out of the data set") from error


def site_number_of(path: Path) -> int:
    """Read the number of the site of a recorded touch.

    Args:
        path: Path of a recorded touch.

    Returns:
        The number of the site, as in `i2t.collect.site_plan`.

    Raises:
        DataError: If the file cannot be read, or was not recorded by a collection.
    """
    counters = dataset.read_touch(path).counters
    if "site" not in counters:
        raise DataError(f"{path}: was not recorded by i2t.collect.session; give the collection a folder of its own")
    return counters["site"]
