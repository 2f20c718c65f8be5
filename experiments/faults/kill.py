"""`kill -9` at random moments of an emulated collection: what was acknowledged is there, and the arm stands."""

import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from experiments.faults.arm import status
from experiments.faults.rows import FaultRow, Sizes, worst
from experiments.faults.simulated import count
from i2t.collect.recorder import touches_in
from i2t.emulators import lab, ur_controller

MAX_TOUCHES = 2  # after which a collection is killed
MAX_DELAY_S = 6.0  # after those, at the latest: a touch takes five
MAX_ATTEMPTS = 5  # collections, to make the touches after the last kill
TOUCHES_AFTER = 5  # touches that are made after the last kill


def kill(sizes: Sizes) -> list[FaultRow]:
    """All of it, on emulators that run on as a lab would."""
    rng, moving, starts = np.random.default_rng(0), 0, 0
    acknowledged: list[str] = []
    stood: list[float] = []
    host = ur_controller.loopback(98)
    with tempfile.TemporaryDirectory() as folder:
        out, link = Path(folder) / "data", Path(folder) / "skin"
        with lab.started("--host", host, "--link", str(link), "--exact"):
            while len(stood) < sizes.kills and starts < 2 * sizes.kills + 3:
                starts += 1
                found = _killed(
                    host, str(link), out, int(rng.integers(0, MAX_TOUCHES + 1)), float(rng.uniform(0, MAX_DELAY_S))
                )
                if found is None:
                    continue
                names, seconds, moved = found
                acknowledged += names
                if seconds is not None:
                    stood.append(seconds)
                    moving += moved
            target = len(touches_in(out)) + TOUCHES_AFTER
            for _ in range(MAX_ATTEMPTS):  # a busy computer may end one by itself
                command = [*_command(host, str(link), out, target), "1"]
                end = subprocess.run(command, capture_output=True, text=True, check=False)
                if end.returncode == 0:
                    break
                time.sleep(0.5)
        present = touches_in(out)
        lost, unreadable = count(out, acknowledged)
        aside = len(list((out / ".interrupted").glob("*"))) if out.exists() else 0
    tried = f"{len(stood)} kills of {starts} collections"
    files = f"{unreadable} of {len(present)} files unreadable; {aside} raw files kept aside"
    said = f"{lost} of {len(acknowledged)} lost, {files}"
    complete = end.returncode == 0 and len(present) == target
    return [
        FaultRow("kill", "acknowledged touches", tried, said, "0 lost, 0 unreadable", lost + unreadable == 0),
        FaultRow(
            "kill",
            "resumed and completed",
            f"{len(present)} touches",
            "yes" if complete else end.stderr[-80:],
            "yes",
            complete,
        ),
        FaultRow(
            "kill",
            "arm stands after the kill",
            f"{moving} of {len(stood)} in motion",
            worst(stood),
            "< 200 ms",
            max(stood) < 0.2,
        ),
    ]


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
