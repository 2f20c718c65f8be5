"""A thousand presses in closed form: late arms, noise that must not stop one, disks, clocks and cables."""

import contextlib
import os
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from experiments.faults.plane_camera import PlaneCamera, plane_patch
from experiments.faults.plane_sites import HEIGHT_M, site
from experiments.faults.rows import FaultCounts, FaultRow
from i2t import dataset
from i2t.collect.procedure import Procedure
from i2t.collect.recorder import Recorder, SessionInfo, touches_in
from i2t.collect.settings import TouchSettings
from i2t.collect.touch import Site, SiteOutcome
from i2t.depth.camera import Camera
from i2t.emulators.in_process import SimulatedArm, SimulatedLab, SimulatedSkin, VirtualClock
from i2t.emulators.scene import SpringPlane
from i2t.errors import DeviceError
from i2t.hardware.clock import Clock
from i2t.hardware.rig import Rig
from i2t.simulation.touches import SimulationErrors
from i2t.skin import boards
from i2t.types import Array, ReturnCode

WALL_TIME_S = 1.8e9  # Unix time at which simulated time begins
BOARD = boards.reskin_board()
GAIN_UT_PER_N = np.linspace(-9, 12, BOARD.num_readings)


class SettableClock:
    """A clock whose Unix time somebody sets."""

    def __init__(self, clock: Clock) -> None:
        self._clock, self.jump = clock, 0.0

    def now(self) -> float:
        """Monotonic time (s)."""
        return self._clock.now()

    def wall(self) -> float:
        """Unix time (s), set wrong by `jump`."""
        return self._clock.wall() + self.jump

    def sleep(self, seconds: float) -> None:
        """Wait."""
        self._clock.sleep(seconds)


class NullRecorder:
    """Recorder that keeps only the tool's positions."""

    def __init__(self) -> None:
        self.positions: list[Array] = []

    def begin(self, site: Site, attempt: int) -> "NullRecorder":
        """Begin a touch."""
        return self

    def save(self, touched: Any) -> None:
        """Keep nothing of a finished touch."""

    def abandon(self, reason: str) -> None:
        """Keep nothing of an abandoned touch."""

    def samples(self, samples: Any, skin: str = "") -> None:
        """Keep no samples."""

    def state(self, state: Any) -> None:
        """Keep the tool's position."""
        self.positions.append(state.T_b_t[:3, 3])

    def event(self, text: str) -> None:
        """Keep no events."""


def make_procedure(
    height: float = HEIGHT_M, stiffness: float = 10e3, gain: Array = GAIN_UT_PER_N, latency: float = 0.03, seed: int = 0
) -> tuple[Procedure, SettableClock]:
    """A procedure over a plane, its devices connected, and its clock."""
    clock, rig = SettableClock(VirtualClock(WALL_TIME_S)), Rig()
    scene = SpringPlane(height, stiffness, gain, SimulationErrors(), BOARD)
    inside = SimulatedLab(scene, clock, seed)
    arm, skin = SimulatedArm(inside, rig.limits, latency), SimulatedSkin(inside)
    lens = Camera(64, 36, 32.2, 32.2, 31.5, 17.5)
    eye = PlaneCamera(lens, height, lambda: arm.state().T_b_t @ rig.T_tool_camera, clock)
    for device in (arm, skin, eye):
        device.connect()
    return Procedure(arm, skin, eye, rig, BOARD, plane_patch, HEIGHT_M, TouchSettings(patience=1.0), clock), clock


def presses(sizes: FaultCounts) -> list[FaultRow]:
    """Force on late arms, and noise alone."""
    rng, over, outside = np.random.default_rng(0), [], 0
    for number in range(sizes.presses):
        stiffness = float(np.exp(rng.uniform(np.log(1e3), np.log(10e3))))
        procedure, _ = make_procedure(
            stiffness=stiffness, gain=np.zeros_like(GAIN_UT_PER_N), latency=rng.uniform(0, 0.06), seed=number
        )
        recorder = NullRecorder()
        touched = procedure.touch(site(number), recorder)
        outside += sum(not procedure.rig.limits.contains(position, 1e-6) for position in recorder.positions)
        over.append(stiffness * (HEIGHT_M - touched.T_w_t[2, 3]) - procedure.settings.force)
    procedure, _ = make_procedure(height=-1.0)
    codes = [procedure.touch(site(number), NullRecorder()).code for number in range(sizes.air)]
    stopped = sum(code == ReturnCode.SKIN for code in codes)
    said = f"median {np.median(over):+.2f} N, greatest {max(over):+.2f} N; outside the box {outside} times"
    return [
        FaultRow(
            "force",
            "past the 8 N limit, 1 to 10 N/mm, up to 60 ms late",
            f"{sizes.presses} simulated presses",
            said,
            "<= +2 N, never outside",
            max(over) <= 2.0 and outside == 0,
        ),
        FaultRow(
            "force",
            "false stops of the skin, in the air with real noise",
            f"{sizes.air} simulated presses",
            str(stopped),
            "< 1 in 1000",
            stopped * 1000 <= sizes.air and (sizes.air < 1000 or stopped == 0),
        ),
    ]


def disk(sizes: FaultCounts) -> list[FaultRow]:
    """Full and read-only disks, a clock that is set, a camera that is unplugged."""
    rows = []
    for name, harm in (
        ("full disk", _full),
        ("folder becomes read-only", _read_only),
        ("clock set back an hour", _clock),
        ("camera unplugged", _camera),
    ):
        lost = unreadable = acknowledged = ended = 0
        sentences = set()
        try:
            for trial in range(sizes.disk):
                count_acknowledged, folder_lost, bad, sentence = harm(trial)
                acknowledged, lost, unreadable = acknowledged + count_acknowledged, lost + folder_lost, unreadable + bad
                ended += bool(sentence)
                sentences.add(sentence)
        except PermissionError:
            rows.append(FaultRow("disk", name, "not run", "a disk can be made only by root", "0 lost", None))
            continue
        shown = min(sentences)[:110]
        said = (
            f"{lost} of {acknowledged} acknowledged touches lost, {unreadable} unreadable; ended {ended} times: "
            f'"{shown}"'
        )
        rows.append(
            FaultRow(
                "disk", name, f"{sizes.disk} times", said, "0 lost", lost + unreadable == 0 and ended == sizes.disk
            )
        )
    return rows


@contextlib.contextmanager
def _small_disk(size: str) -> Iterator[Path]:
    if os.name != "posix" or os.geteuid() != 0:
        raise PermissionError
    with tempfile.TemporaryDirectory() as folder:
        if subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", folder], check=False).returncode:
            raise PermissionError
        try:
            yield Path(folder)
        finally:
            subprocess.run(["umount", folder], check=False)


def count(folder: Path, acknowledged: list[str]) -> tuple[int, int]:
    """Numbers of acknowledged touches that are lost, and of files that cannot be read."""
    present = {path.name: path for path in touches_in(folder)}
    bad = 0
    for path in present.values():
        try:
            dataset.read_touch(path)
        except dataset.DataError:
            bad += 1
    return sum(name not in present for name in acknowledged), bad


def _session(
    folder: Path, procedure: Procedure, most: int, reserve: int = 0, each: Any = None
) -> tuple[list[str], str]:
    """The touches that were acknowledged, and what ended it early."""
    rig, acknowledged = procedure.rig, []
    info = SessionInfo(
        "plane",
        "pad",
        "run",
        "simulated",
        BOARD,
        rig.T_world_base,
        rig.T_world_object,
        procedure.camera.camera,
    )

    def choose(history: Any) -> Site | None:
        return site(len(history)) if len(history) < most else None

    try:
        with Recorder(folder, info, procedure.clock, reserve) as recorder:
            for outcome in procedure.run(choose, recorder):
                acknowledged.append(recorder.saved[-1].name)
                if each is not None:
                    each(outcome)
    except DeviceError as error:
        assert not procedure.arm.state().moving
        return acknowledged, str(error)
    return acknowledged, ""


def _full(trial: int) -> tuple[int, int, int, str]:
    with _small_disk(f"{1500 + 130 * trial}k") as folder:
        acknowledged, sentence = _session(folder / "data", make_procedure(seed=trial)[0], 50)
        return len(acknowledged), *count(folder / "data", acknowledged), sentence


def _read_only(trial: int) -> tuple[int, int, int, str]:
    with _small_disk("20m") as folder:

        def inject_fault(outcome: SiteOutcome) -> None:
            if outcome.site.number == 1:
                # A lazy remount would be refused while files are open for writing.
                subprocess.run(["mount", "--bind", folder, folder], check=True)
                subprocess.run(["mount", "-o", "remount,bind,ro", folder], check=True)

        try:
            acknowledged, sentence = _session(folder / "data", make_procedure(seed=trial)[0], 4, each=inject_fault)
            return len(acknowledged), *count(folder / "data", acknowledged), sentence
        finally:
            subprocess.run(["umount", folder], check=False)


def _clock(trial: int) -> tuple[int, int, int, str]:
    procedure, clock = make_procedure(seed=trial)

    def inject_fault(outcome: SiteOutcome) -> None:
        clock.jump = -3600.0 if outcome.site.number == 1 else 0.0

    with tempfile.TemporaryDirectory() as folder:
        acknowledged, sentence = _session(Path(folder), procedure, 4, each=inject_fault)
        return len(acknowledged), *count(Path(folder), acknowledged), sentence


def _camera(trial: int) -> tuple[int, int, int, str]:
    procedure, _ = make_procedure(seed=trial)
    eye: Any = procedure.camera

    def inject_fault(outcome: SiteOutcome) -> None:
        if outcome.site.number == 1:
            eye.trouble = DeviceError("the camera over a plane is gone; plug it in")

    with tempfile.TemporaryDirectory() as folder:
        acknowledged, sentence = _session(Path(folder), procedure, 4, each=inject_fault)
        return len(acknowledged), *count(Path(folder), acknowledged), sentence
