"""Force at which a press at 1 N ends when this computer stalls for seconds, or the skin dies: bounded, and measured.

The bound is that of `i2t.hardware.collision`: k (v T + v^2 / 2 a), with T the time until the controller's watchdog runs
dry (or until the skin counts as silent) and 40 ms. A stall is SIGSTOP, either of the program alone, or of the process
that speaks with the controller as well. Defaults are those of a lab.
"""

import contextlib
import os
import signal
import subprocess
import sys
import time
from typing import Any

import numpy as np

from experiments.faults.arm import status
from experiments.faults.plane_sites import HEIGHT_M, site
from experiments.faults.rows import FaultCounts, FaultRow
from experiments.faults.simulated import NullRecorder, make_procedure
from experiments.faults.trials import Trial, TrialStore
from i2t.collect.path import TouchPath
from i2t.collect.settings import TouchSettings
from i2t.emulators import ur_controller
from i2t.errors import DeviceError
from i2t.hardware.rig import Rig
from i2t.hardware.ur.config import UrConfig

PLANE_M, STIFFNESS_N_M = 0.298, 10e3  # of the emulated plane, 2 mm below the tool's first pose
STALL_S = (1.0, 5.0)
PRESSED_N = 1.0
STALL_POLL_S = 5e-3

PRESSER = f"""
import sys
from i2t.collect.settings import TouchSettings
from i2t.hardware.rig import Rig
from i2t.hardware.ur.driver import UrArm
settings = TouchSettings()
with UrArm(sys.argv[1], Rig().limits) as arm:
    arm.zero_wrench()
    print(arm.connection._process.pid, flush=True)
    pressed = []
    def look(state):
        if not pressed and -state.wrench[2] > {PRESSED_N}:
            pressed.append(True)
            print("pressed", flush=True)
    arm.approach(0.01, settings.press, look, settings.force, settings.torque, settings.acceleration)
print("through", flush=True)
"""


def stalls(sizes: FaultCounts, trials: TrialStore) -> list[FaultRow]:
    """Stalls of the computer in an emulated press, and skins that die in a simulated one."""
    path = TouchPath(Rig(), TouchSettings(), HEIGHT_M)
    bounds = path.press_bounds(1 / UrConfig.watchdog_rate)
    made = [trial for trial in trials.run(sizes.stalls, _stall) if trial["pressed"]]
    rows = []
    for whole in (False, True):
        found = [trial for trial in made if trial["whole"] == whole]
        if not found:
            continue
        gains = [trial["peak"] - trial["force"] for trial in found]
        moved = sum(trial["moved"] for trial in found)
        what = "stall of the program and of the arm's process" if whole else "stall of the program alone"
        said = f"gained median {np.median(gains):.2f} N, at most {max(gains):.2f} N; moved afterwards {moved}"
        goal = f"<= {bounds.stall:.1f} N more, 0 motions"
        rows.append(
            FaultRow(
                "stalls",
                f"{what}, 1 to 5 s",
                f"{len(found)} presses",
                said,
                goal,
                max(gains) <= bounds.stall and not moved,
            )
        )
    ends = np.array([_dying_skin(number) for number in range(sizes.stalls)])
    gains = ends[:, 1] - ends[:, 0]
    most = ends[:, 1].max()
    said = f"gained median {np.median(gains):.2f} N, at most {gains.max():.2f} N; ended at {most:.2f} N at most"
    goal = f"<= {bounds.silence:.1f} N more"
    rows.append(
        FaultRow(
            "stalls",
            "skin dies in a press at 1 N",
            f"{len(ends)} simulated presses",
            said,
            goal,
            bool(gains.max() <= bounds.silence),
        )
    )
    return rows


def _stall(number: int) -> Trial | None:
    """One stall in a press; `pressed` is False where a busy computer ended the press before."""
    rng, whole = np.random.default_rng((number, 9)), bool(number % 2)
    host = ur_controller.loopback(number)
    with (
        ur_controller.process(host, "--plane", str(PLANE_M), "--stiffness", str(STIFFNESS_N_M)),
        subprocess.Popen(
            [sys.executable, "-c", PRESSER, host], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        ) as child,
    ):
        assert child.stdout is not None
        worker = child.stdout.readline().strip()
        pressed = child.stdout.readline().strip() == "pressed"
        if not worker.isdecimal():
            return None
        stopped = [child.pid, *([int(worker)] if whole else [])] if pressed else []
        for pid in stopped:
            os.kill(pid, signal.SIGSTOP)
        force = _pushed(host)
        peak, end = force, time.monotonic() + float(rng.uniform(*STALL_S))
        while pressed and time.monotonic() < end:
            peak = max(peak, _pushed(host))
            time.sleep(STALL_POLL_S)
        before = status(host)
        for pid in stopped:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGCONT)
        time.sleep(0.5)
        after = status(host)
        child.kill()
    moved = after["moving"] or after["pose"] != before["pose"]
    return {"whole": whole, "pressed": pressed, "force": force, "peak": peak, "moved": bool(moved)}


def _pushed(host: str) -> float:
    """N, with which the emulated plane pushes back now."""
    return STIFFNESS_N_M * max(0.0, PLANE_M - float(status(host)["pose"][2]))


class _KillingRecorder(NullRecorder):
    """Makes a simulated skin fall silent once it is pressed by some force."""

    def __init__(self, skin: Any) -> None:
        super().__init__()
        self._skin, self.force = skin, 0.0

    def state(self, state: Any) -> None:
        """Silence the skin once the arm presses."""
        super().state(state)
        force = STIFFNESS_N_M * (HEIGHT_M - self.positions[-1][2])
        if force >= PRESSED_N and not self.force:
            self.force, self._skin.silent = force, True


def _dying_skin(number: int) -> tuple[float, float]:
    """Force (N) at which a simulated skin fell silent in a press, and at which the press ended."""
    rng = np.random.default_rng((number, 11))
    procedure, _ = make_procedure(gain=np.zeros(15), latency=float(rng.uniform(0, 0.03)), seed=number)
    recorder = _KillingRecorder(procedure.skin)
    with contextlib.suppress(DeviceError):
        procedure.touch(site(number), recorder)
    lowest = procedure.arm.state().T_b_t[2, 3]
    return recorder.force, STIFFNESS_N_M * (HEIGHT_M - lowest)
