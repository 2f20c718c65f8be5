"""`kill -9` at random moments of an emulated collection: what was acknowledged is there, and the arm stands."""

import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

from experiments.faults.arm import status
from experiments.faults.rows import FaultCounts, FaultRow, worst
from experiments.faults.simulated import count
from i2t.collect.recorder import touches_in
from i2t.emulators import lab, ur_controller

MAX_TOUCHES = 2  # after which a collection is killed
MAX_DELAY_S = 6.0  # after those, at the latest: a touch takes five
MAX_ATTEMPTS = 5  # collections, to make the touches after the last kill
TOUCHES_AFTER = 5  # touches that are made after the last kill


class Kills(NamedTuple):
    """Results of killing collections, one after another, that write to one folder."""

    acknowledged: list[str]  # names of touches
    stood_after: list[float]  # s on the controller's clock, after each kill
    moving: int  # kills in the middle of a motion
    collections: int  # that were begun, also those that ended by themselves


class Completion(NamedTuple):
    """End of the collection after the last kill."""

    complete: bool  # it made the touches that it was to make
    sentence: str  # the last thing it said on the error stream


def kill(sizes: FaultCounts) -> list[FaultRow]:
    """Kill collections on emulators that run on as a lab would."""
    host = ur_controller.loopback(98)
    with tempfile.TemporaryDirectory() as folder:
        out, link = Path(folder) / "data", Path(folder) / "skin"
        with lab.started("--host", host, "--link", str(link), "--no-pose-error"):
            kills = _kill_repeatedly(sizes.kills, host, str(link), out)
            completion = _complete(host, str(link), out)
        present = len(touches_in(out))
        lost, unreadable = count(out, kills.acknowledged)
        aside = len(list((out / ".interrupted").glob("*"))) if out.exists() else 0
    tried = f"{len(kills.stood_after)} kills of {kills.collections} collections"
    files = f"{unreadable} of {present} files unreadable; {aside} raw files kept aside"
    said = f"{lost} of {len(kills.acknowledged)} lost, {files}"
    complete = "yes" if completion.complete else completion.sentence
    moving = f"{kills.moving} of {len(kills.stood_after)} in motion"
    stood = worst(kills.stood_after)
    return [
        FaultRow("kill", "acknowledged touches", tried, said, "0 lost, 0 unreadable", lost + unreadable == 0),
        FaultRow("kill", "resumed and completed", f"{present} touches", complete, "yes", completion.complete),
        FaultRow("kill", "arm stands after the kill", moving, stood, "< 200 ms", max(kills.stood_after) < 0.2),
    ]


def _kill_repeatedly(wanted: int, host: str, port: str, out: Path) -> Kills:
    """Begin collections and kill each at a random moment, until enough were killed at work."""
    rng = np.random.default_rng(0)
    acknowledged: list[str] = []
    stood_after: list[float] = []
    moving = collections = 0
    while len(stood_after) < wanted and collections < 2 * wanted + 3:
        collections += 1
        touches, delay = int(rng.integers(0, MAX_TOUCHES + 1)), float(rng.uniform(0, MAX_DELAY_S))
        found = _killed(host, port, out, touches, delay)
        if found is None:
            continue
        names, seconds, moved = found
        acknowledged += names
        if seconds is not None:
            stood_after.append(seconds)
            moving += moved
    return Kills(acknowledged, stood_after, moving, collections)


def _complete(host: str, port: str, out: Path) -> Completion:
    """Go on with the collection that was killed, until some more touches are there."""
    target = len(touches_in(out)) + TOUCHES_AFTER
    for _ in range(MAX_ATTEMPTS):  # a busy computer may end one by itself
        command = [*_command(host, port, out, target), "1"]
        end = subprocess.run(command, capture_output=True, text=True, check=False)
        if end.returncode == 0:
            break
        time.sleep(0.5)
    return Completion(end.returncode == 0 and len(touches_in(out)) == target, end.stderr[-80:])


def _command(host: str, port: str, out: Path, touches: int) -> list[str]:
    return [sys.executable, "-m", "experiments.faults.worker", host, port, str(out), str(touches)]


def _killed(host: str, port: str, out: Path, touches: int, after: float) -> tuple[list[str], float | None, bool] | None:
    """The touches that one collection acknowledged before it was killed, some seconds after the last of some touches;
    the seconds on the controller's clock until the arm stood (None if it had ended by itself), and whether it moved.
    None if it did not even begin.
    """
    with subprocess.Popen(
        _command(host, port, out, 100_000), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        if process.stdout.readline().strip() != "begun":
            process.wait()
            time.sleep(0.5)
            return None
        names = [name for _ in range(touches) if (name := process.stdout.readline().strip())]
        time.sleep(after)
        before = status(host)
        ended = process.poll() is not None
        process.kill()
        names += process.stdout.read().splitlines()
    end = time.monotonic() + 3.0
    while status(host)["moving"] and time.monotonic() < end:
        time.sleep(0.02)
    now = status(host)
    time.sleep(0.3)  # the watchdog ends the program
    if ended:
        return names, None, False
    seconds = max(0.0, now["stood"] - before["clock"]) if not now["moving"] else float("inf")
    return names, seconds, bool(before["moving"])
