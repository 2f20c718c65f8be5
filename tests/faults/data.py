"""What breaks while touches are written: disks, clocks, cameras, and the collection itself, which is killed.

What was acknowledged must be there and be readable, whatever happens.
"""

import contextlib
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from i2t import dataset
from i2t.collect.procedure import Procedure
from i2t.collect.recorder import Recorder, list_touches
from i2t.collect.touch import SiteOutcome
from i2t.emulators import reskin_board, ur_controller
from i2t.errors import DataError, DeviceError
from tests.faults.closed_form import make_procedure, session_info, site
from tests.faults.motion import status, watch
from tests.faults.table import Fault, Measure, Trial

AfterTouch: TypeAlias = Callable[[SiteOutcome], None]  # does harm after the second touch

PLANE = ("--plane", "0.03", "5000")
MAX_TOUCHES, MAX_DELAY_S = 2, 6.0  # after which a collection is killed: a touch takes five seconds
SIGNALS_APART_S = 0.2  # as long as a person takes to press Ctrl-C again
RESERVE_BYTES = 0  # that a disk must have free
MAX_ATTEMPTS = 3  # collections that go on after a kill: a busy computer may end one by itself
STAND_GOAL_S = 0.2
WATCHDOG_HZ = "10"  # a lab's


def lost_touches(folder: Path, acknowledged: list[str]) -> Trial:
    """Numbers of acknowledged touches, of those that are lost, and of files that cannot be read."""
    present = {path.name: path for path in list_touches(folder)}
    bad = 0
    for path in present.values():
        try:
            dataset.read_touch(path)
        except DataError:
            bad += 1
    lost = sum(name not in present for name in acknowledged)
    return {"acknowledged": len(acknowledged), "lost": lost, "unreadable": bad}


def _session(folder: Path, procedure: Procedure, most: int, harm: AfterTouch | None = None) -> Trial:
    """Touches over the plane until they are enough, or something has ended them; the arm must stand then."""
    acknowledged, said = [], ""
    info = session_info(procedure.rig, procedure.camera.camera)
    try:
        with Recorder(folder, info, procedure.clock, RESERVE_BYTES) as recorder:
            for outcome in procedure.run(lambda history: site(len(history)) if len(history) < most else None, recorder):
                acknowledged.append(recorder.saved[-1].name)
                if harm is not None and outcome.site.number == 1:
                    harm(outcome)
    except DeviceError as error:
        said = str(error).split(": ", 1)[-1]
    moving = procedure.arm.state().moving
    return {**lost_touches(folder, acknowledged), "moving": moving, "not ended": not said, "said": said}


@contextlib.contextmanager
def _small_disk(size: str) -> Iterator[Path]:
    """A disk of its own, which only root can make."""
    with tempfile.TemporaryDirectory() as folder:
        if subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", folder], check=False).returncode:
            raise PermissionError
        try:
            yield Path(folder)
        finally:
            subprocess.run(["umount", folder], check=False)


def full_disk(number: int) -> Trial | None:
    """A disk that is full after some touches."""
    with contextlib.suppress(PermissionError), _small_disk(f"{1500 + 60 * number}k") as folder:
        return _session(folder / "data", make_procedure(seed=number), 50)
    return None


def read_only(number: int) -> Trial | None:
    """A folder that becomes read-only."""
    with contextlib.suppress(PermissionError), _small_disk("20m") as folder:

        def harm(outcome: SiteOutcome) -> None:
            # A lazy remount would be refused while files are open for writing.
            subprocess.run(["mount", "--bind", folder, folder], check=True)
            subprocess.run(["mount", "-o", "remount,bind,ro", folder], check=True)

        try:
            return _session(folder / "data", make_procedure(seed=number), 4, harm)
        finally:
            subprocess.run(["umount", folder], check=False)
    return None


def clock_set_back(number: int) -> Trial:
    """A clock that somebody sets back by an hour."""
    procedure = make_procedure(seed=number)
    with tempfile.TemporaryDirectory() as folder:
        return _session(Path(folder), procedure, 4, lambda _: setattr(procedure.clock, "jump", -3600.0))


def camera_unplugged(number: int) -> Trial:
    """A camera that gives no views any more."""
    procedure = make_procedure(seed=number)

    def gone(timeout: float = 2.0) -> Any:
        raise DeviceError("the simulated camera is gone; plug it in")

    with tempfile.TemporaryDirectory() as folder:
        return _session(Path(folder), procedure, 4, lambda _: setattr(procedure.camera, "capture", gone))


def killed_collection(signals: Sequence[int], number: int) -> Trial | None:
    """A collection that is ended by signals at a random moment, and goes on afterwards in the same folder.

    Args:
        signals: Signals that it is sent, 0.2 s apart.
        number: Number of the trial.

    Returns:
        Touches acknowledged and lost, seconds on the controller's clock until the arm stood, whether it said more than
        one line, and whether the next collection made a touch more. None where it ended by itself, or did not begin.
    """
    rng, host = np.random.default_rng((number, 13)), ur_controller.loopback(number)
    touches, delay = int(rng.integers(0, MAX_TOUCHES + 1)), float(rng.uniform(0, MAX_DELAY_S))
    with (
        tempfile.TemporaryDirectory() as folder,
        ur_controller.process(host, *PLANE),
        reskin_board.run_board() as (port, _),
    ):
        out = Path(folder) / "data"
        words = [sys.executable, "-m", "tests.faults.worker", host, port, str(out)]
        with subprocess.Popen(
            [*words, "1000", WATCHDOG_HZ], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        ) as child:
            assert child.stdout is not None
            assert child.stderr is not None
            begun = child.stdout.readline().strip() == "begun"
            acknowledged = [name for _ in range(touches) if (name := child.stdout.readline().strip())]
            time.sleep(delay)
            before, ended = status(host), child.poll() is not None
            for place, each in enumerate(signals):
                time.sleep(SIGNALS_APART_S if place else 0)
                child.send_signal(each)
            acknowledged += child.stdout.read().splitlines()
            lines = child.stderr.read().splitlines()
        if ended or not begun:
            return None
        stands = watch(host, before["clock"])["stands after"]
        found = lost_touches(out, acknowledged)
        wanted = len(list_touches(out)) + 1
        again = any(
            subprocess.run([*words, str(wanted), "1"], capture_output=True, check=False).returncode == 0
            for _ in range(MAX_ATTEMPTS)
        )
        incomplete = not again or len(list_touches(out)) != wanted
    said = "killed in a motion" if before["moving"] else "killed at rest"
    rambling = len([*filter(None, lines)]) > 1
    return {**found, "stands after": stands, "incomplete": incomplete, "rambling": rambling, "said": said}


KEPT = (Measure("lost", 0, of="acknowledged"), Measure("unreadable", 0))
ENDED = (*KEPT, Measure("moving", 0), Measure("not ended", 0))
DATA_FAULTS = (
    Fault("disk", "full disk", full_disk, 20, ENDED),
    Fault("disk", "folder becomes read-only", read_only, 20, ENDED),
    Fault("disk", "clock set back an hour", clock_set_back, 20, ENDED),
    Fault("disk", "camera unplugged", camera_unplugged, 20, ENDED),
    *(
        Fault("kill", f"{name} of an emulated collection", partial(killed_collection, signals), count,
              (*KEPT, Measure("stands after", STAND_GOAL_S, "s"), Measure("incomplete", 0), Measure("rambling", 0)))
        for name, signals, count in (
            ("kill -9", (signal.SIGKILL,), 200), ("SIGHUP", (signal.SIGHUP,), 20),
            ("Ctrl-C twice", (signal.SIGINT, signal.SIGINT), 20),
        )
    ),
)  # fmt: skip
