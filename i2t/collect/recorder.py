"""Touches become files as they are made: one immutable file each, whole and on the disk before it is acknowledged.

While a touch is under way everything goes to a hidden raw file besides (`.under-way`), so that what was read survives
even `kill -9`; it is removed once the touch is kept, and moved to `.interrupted/` if it never was. `read_raw` reads
such a file up to its last whole entry.

Devices count seconds that never jump, files hold Unix time: both clocks are read when a touch begins, and their
difference dates everything in that touch. If the difference is another one at the end, somebody has set the clock: the
touch is kept, dated by the old one, and the session ends, since later files would sort before earlier ones.

A disk that is nearly full, a folder that may not be written and a clock that was set back are found before a touch
begins, with the arm standing away from the object. All trouble is a DeviceError of one sentence.
"""

import contextlib
import fcntl
import json
import os
import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from i2t import dataset
from i2t.collect.event_log import RAW, Lost, Tape, lost
from i2t.collect.procedure import Site, Touched
from i2t.dataset import Dataset, Image, Record, Series
from i2t.dataset.files import sync_folder
from i2t.depth.camera import Camera
from i2t.errors import DataError
from i2t.hardware.clock import Clock, Monotonic
from i2t.hardware.reskin.stream import CHANNELS
from i2t.types import CHIPS, PATCH_WINDOW, REACH, Array, Board, Touches

UNDER_WAY, INTERRUPTED, NOTES = ".under-way", ".interrupted", ".collection.json"
RESERVE = 50 * 2**20  # bytes that must be free before a touch begins: a hundred touches
JUMP = 0.5  # s, by which the clocks may drift apart during a touch
DEPTH_SCALE = 1e-4  # m, of a unit in depth images
POSE = tuple(f"T_w_t[{i},{j}]" for i in range(4) for j in range(4))


@dataclass(frozen=True)
class Names:
    """What the touches of a session have in common."""

    object: str
    pad: str
    run: str
    source: str  # simulated, real or mixed
    board: Board
    T_w_b: Array  # (4, 4)
    T_w_o: Array  # (4, 4)
    camera: Camera
    meta: Mapping[str, str] = field(default_factory=dict)


class Recorder:
    """Keeps the touches of one session in a folder, alone (`i2t.collect.procedure.Keeper`).

    Raises Lost where the folder cannot be used.
    """

    def __init__(self, folder: str | Path, names: Names, clock: Clock | None = None, reserve: int = RESERVE) -> None:
        self.folder, self.names = Path(folder), names
        self._clock, self._reserve = clock or Monotonic(), reserve
        self._tape: Tape | None = None
        self._raw: BinaryIO | None = None
        self._offset = 0.0  # Unix time less the devices'
        self._newest = 0.0  # Unix time of the newest touch
        self.kept: list[Path] = []
        self.bytes = 0
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self._lock = (self.folder / ".lock").open("w")
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self._lock.close()
            raise Lost(
                f"{self.folder} is being written by another collection; end that one, or choose another folder"
            ) from None
        except OSError as error:
            raise lost(self.folder, error) from error
        done = touches_in(self.folder)
        self._newest = written_at(done[-1]) if done else 0.0

    def close(self) -> None:
        """Let the folder go; raises nothing."""
        self._end_raw(keep=True)
        self._lock.close()

    def __enter__(self) -> "Recorder":
        return self

    def __exit__(self, *error: Any) -> None:
        self.close()

    def check(self) -> None:
        """Raise Lost where a touch could not be kept now."""
        try:
            free = shutil.disk_usage(self.folder).free
            probe = self.folder / ".probe"
            probe.write_bytes(b"x")
            probe.unlink()
        except OSError as error:
            raise lost(self.folder, error) from error
        if free < self._reserve:
            raise Lost(
                f"{self.folder}: only {free / 2**20:.0f} MiB are free where {self._reserve / 2**20:.0f} are wanted; "
                "free some space and go on"
            )
        if self._clock.wall() < self._newest:
            raise Lost(
                f"the computer's clock is {self._newest - self._clock.wall():.0f} s behind the newest touch in "
                f"{self.folder}; set it right and go on"
            )

    def begin(self, site: Site, attempt: int) -> Tape:
        """A touch begins."""
        self._end_raw(keep=True)
        self.check()
        self._offset = self._clock.wall() - self._clock.now()
        path = self.folder / UNDER_WAY
        try:
            self._raw = open(path, "wb", buffering=0)  # noqa: SIM115, closed when the touch ends
            self._raw.write(RAW)
        except OSError as error:
            raise lost(path, error) from error
        self._tape = Tape(self._raw, self._clock)
        self._tape.event(f"site {site.number}, attempt {attempt + 1}")
        return self._tape

    def keep(self, touched: Touched) -> None:
        """Write the touch; once this returns, it survives a kill or a power cut. Raises Lost, also (with the touch
        kept) where the clock was set meanwhile.
        """
        assert self._tape is not None
        jump = self._clock.wall() - self._clock.now() - self._offset
        if abs(jump) > JUMP:
            self._tape.event(f"the computer's clock jumped by {jump:.1f} s")
        at = max(self._clock.now() + self._offset, self._newest + 1e-6)
        try:
            path = dataset.write_touch(self.folder, self._record(touched, self._tape), at)
        except DataError as error:
            if isinstance(error.__cause__, OSError):
                raise lost(self.folder, error.__cause__) from error
            raise Lost(str(error)) from error
        self._newest = at
        self.kept.append(path)
        self.bytes += path.stat().st_size
        self._end_raw(keep=False)
        if abs(jump) > JUMP:
            raise Lost(f"the computer's clock jumped by {jump:.1f} s; the touch is kept: set it right and go on")

    def abandon(self, reason: str) -> None:
        """The touch was not made; what was read of it is kept aside."""
        if self._tape is not None:
            with contextlib.suppress(Lost):
                self._tape.event(reason)
        self._end_raw(keep=True)

    def _end_raw(self, keep: bool) -> None:
        if self._raw is not None:
            self._raw.close()
        self._raw = self._tape = None
        path = self.folder / UNDER_WAY
        try:
            if path.exists() and keep:
                aside = self.folder / INTERRUPTED
                aside.mkdir(exist_ok=True)
                stamp = datetime.fromtimestamp(path.stat().st_mtime, UTC)
                path.rename(aside / f"touch-{stamp:%Y%m%dT%H%M%S.%f}Z.raw")
            elif path.exists():
                path.unlink()
        except OSError:
            pass  # it is hidden, and in nobody's way

    def _record(self, touched: Touched, tape: Tape) -> Record:
        names, to_wall, view = self.names, self._offset, touched.view
        assert view is not None
        rows = np.array([tape.readings[number] for number in sorted(tape.readings)]).reshape(-1, 1 + 15 + CHIPS)
        states = sorted({state.time: state for state in tape.states}.values(), key=lambda state: state.time)
        times = np.array([state.time for state in states]) + to_wall
        poses = np.array([(names.T_w_b @ state.T_b_t).ravel() for state in states]).reshape(-1, 16)
        wrenches = np.array([state.wrench for state in states]).reshape(-1, 6)
        joints = np.array([state.joints for state in states]).reshape(-1, 6)
        chips = tuple(f"chip{i}" for i in range(CHIPS))
        axes = ("x", "y", "z")
        series = {
            "tactile": Series(rows[:, 0] + to_wall, rows[:, 1:16].astype(np.float32), CHANNELS, "uT"),
            "temperature": Series(rows[:, 0] + to_wall, rows[:, 16:].astype(np.float32), chips, "degrees Celsius"),
            "wrench": Series(
                times,
                wrenches,
                (*(f"force {x}" for x in axes), *(f"torque {x}" for x in axes)),
                "N, Nm; on the tool, tool axes",
            ),
            "pose": Series(times, poses, POSE, "1, m"),
            "joints": Series(times, joints, tuple(f"joint{i}" for i in range(6)), "rad"),
            "camera": Series(
                np.array([view.time + to_wall]),
                touched.T_w_c.reshape(1, 16),
                tuple(name.replace("w_t", "w_c") for name in POSE),
                "1, m",
            ),
            "ambient": Series(np.array([tape.events[0][0] + to_wall]), touched.ambient[None], CHANNELS, "uT"),
        }
        depth = np.clip(np.nan_to_num(view.depth / DEPTH_SCALE, posinf=0.0), 0, 65535)
        images = {"depth": Image(np.rint(depth).astype(np.uint16), DEPTH_SCALE, "m")}
        if view.colour is not None:
            images["colour"] = Image(view.colour)
        counters = {f"skin {name}": int(value) for name, value in touched.counters._asdict().items() if name != "rate"}
        return Record(
            touch=self._dataset(touched),
            images=images,
            series=series,
            events=tuple((time + to_wall, text) for time, text in tape.events),
            counters=counters | {"site": touched.site.number, "attempt": touched.attempt + 1},
        )

    def _dataset(self, touched: Touched) -> Dataset:
        names, seen = self.names, touched.seen
        assert seen is not None
        touches = Touches(
            patch=seen.patch[None],
            wide=seen.wide[None],
            nearest=np.array([seen.nearest]),
            reading=touched.reading[None],
            force=np.array([touched.force]),
            depth=np.array([touched.depth]),
            T_w_t=touched.T_w_t[None],
            T_w_o=names.T_w_o[None],
            object=np.zeros(1),
            pad=np.zeros(1),
            run=np.zeros(1),
            code=np.array([int(touched.code)]),
        )
        return Dataset(
            touches,
            (names.object,),
            (names.pad,),
            (names.run,),
            names.board,
            names.source,
            PATCH_WINDOW,
            REACH,
            {"made by": "i2t.collect.session", "camera": json.dumps(asdict(names.camera)), **names.meta},
        )


def touches_in(folder: Path) -> list[Path]:
    """The touches recorded in a folder, in the order of time."""
    return sorted(folder.glob("touch-*.h5"))


def written_at(path: Path) -> float:
    """The Unix time (s) in a touch's name. Raises DataError for another name."""
    try:
        return datetime.strptime(path.name[6:28] + "+0000", "%Y%m%dT%H%M%S.%f%z").timestamp()
    except ValueError as error:
        raise DataError(f"{path}: is no touch's name; move it out of the data set") from error


def site_of(path: Path) -> int:
    """Number of the site that a recorded touch was made at. Raises DataError."""
    counters = dataset.read_touch(path).counters
    if "site" not in counters:
        raise DataError(f"{path}: was not recorded by i2t.collect.session; give the collection a folder of its own")
    return counters["site"]


def write_notes(folder: Path, notes: Mapping[str, Any]) -> None:
    """Keep what a session must know when it is resumed, whole or not at all. Raises Lost."""
    temporary = folder / f"{NOTES}.tmp"
    try:
        with temporary.open("w") as file:
            json.dump(notes, file, indent=1)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(folder / NOTES)
        sync_folder(folder)
    except OSError as error:
        raise lost(folder / NOTES, error) from error


def read_notes(folder: Path) -> dict[str, Any] | None:
    """What `write_notes` kept, None if nothing. Raises DataError."""
    try:
        return dict(json.loads((folder / NOTES).read_text()))
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise DataError(f"{folder / NOTES}: cannot be read ({error}); choose another folder") from error
