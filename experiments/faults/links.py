"""The link to a controller that breaks in a motion: a lost control connection, and a controller that freezes.

With the drivers' defaults (`i2t.hardware.ur.config`), which are those of a lab, and with other watchdog rates. On a
computer that is busy with other work the driver may stop the arm before the fault; such trials are counted apart.
"""

import signal
import subprocess
import time
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np

from experiments.faults.arm import status
from experiments.faults.rows import FaultCounts, FaultRow, worst
from experiments.faults.trials import Trial, TrialStore
from i2t.emulators import ur_controller
from i2t.emulators.ur_program import PLAYING
from i2t.errors import DeviceError
from i2t.hardware.rig import Rig
from i2t.hardware.ur.config import UrConfig
from i2t.hardware.ur.driver import UrArm

WATCHDOG_RATES_HZ = (10.0, 2.0, 5.0, 25.0)  # the default, and others, in turn
FROZEN_S = 1.0
WATCHED_S = 1.0  # after the arm stood, in which it must not move again
STOP_GOAL_S = 0.2
TRAVEL_M = 0.15
ENDED_S = 10.0  # until a call that was in the motion must have returned
BRAKING_S = 0.03  # from 40 mm/s at 2 m/s^2, and a tick


def links(sizes: FaultCounts, trials: TrialStore) -> list[FaultRow]:
    """Try both faults, equally often."""
    kinds = {"lost control connection": _drop, "frozen controller": _freeze}
    made = trials.run(2 * sizes.links, lambda number: _trial(number, list(kinds)[number % 2]))
    rows = []
    for kind in kinds:
        found = [trial for trial in made if trial["kind"] == kind]
        tried = [trial for trial in found if not trial["busy"]]
        if not tried:
            rows.append(
                FaultRow("links", kind, f"{len(found)} motions", "none came to the fault", "0 motions after", False)
            )
            continue
        moved, crashed = (sum(trial[what] for trial in tried) for what in ("moved", "crashed"))
        rates = []
        late = 0
        for rate in sorted({trial["rate"] for trial in tried}):
            stood = [trial["stood"] for trial in tried if trial["rate"] == rate]
            late += sum(seconds > max(STOP_GOAL_S, 1 / rate + STOP_GOAL_S) for seconds in stood)
            rates.append(f"{rate:g} Hz {worst(stood)} of {len(stood)}")
        said = (
            f"{moved} motions after the loss, {crashed} crashes of this process; stands after, on the controller's "
            f"clock: {'; '.join(rates)}; {len(found) - len(tried)} stopped before by a busy computer"
        )
        goal = "0 motions, 0 crashes, within 0.2 s at 10 Hz"
        rows.append(
            FaultRow("links", kind, f"{len(tried)} motions", said, goal, not moved and not crashed and not late)
        )
    return rows


def _trial(number: int, kind: str) -> Trial | None:
    rate = WATCHDOG_RATES_HZ[number // 2 % len(WATCHDOG_RATES_HZ)]
    host, rig, rng = ur_controller.loopback(number), Rig(), np.random.default_rng((number, 7))
    timeout = max(UrConfig.state_timeout, 1 / rate)
    with ur_controller.process(host) as process:
        arm = UrArm(host, rig.limits, state_timeout=timeout, watchdog_rate=rate)
        try:
            arm.connect()
        except DeviceError:
            return None
        try:
            with ThreadPoolExecutor(1) as executor:
                motion = executor.submit(_go_down, arm)
                time.sleep(float(rng.uniform(0.2, 1.0)))
                busy = motion.done() or not status(host)["moving"]
                begun = 0.0 if busy else (_drop if kind.startswith("lost") else _freeze)(host, process)
                error = _error_of(motion)
            after = _watch(host)
        finally:
            arm.close()
    crashed = error is not None and not isinstance(error, DeviceError)
    stood = max(0.0, after["stood"] - begun)
    return {"kind": kind, "rate": rate, "busy": busy, "stood": stood, "moved": after["again"], "crashed": crashed,
            "sentence": str(error)[:120]}  # fmt: skip


def _error_of(motion: "Future[None]") -> BaseException | None:
    """Error that ended a motion; one that is not over in time counts as a crash, which is a missed goal."""
    try:
        return motion.exception(ENDED_S)
    except TimeoutError:
        return TimeoutError(f"the motion was not over {ENDED_S:g} s after the fault")


def _go_down(arm: UrArm) -> None:
    goal = arm.state(1.0).T_b_t.copy()
    goal[2, 3] -= TRAVEL_M
    arm.go(goal)


def _drop(host: str, process: "subprocess.Popen[str]") -> float:
    """The controller's clock (s) at which its control connection was closed."""
    clock = float(status(host)["clock"])
    ur_controller.ask(host, "drop-control")
    return clock


def _freeze(host: str, process: "subprocess.Popen[str]") -> float:
    """The controller's clock (s) at which it stood still for a second."""
    clock = float(status(host)["clock"])
    process.send_signal(signal.SIGSTOP)
    time.sleep(FROZEN_S)
    process.send_signal(signal.SIGCONT)
    return clock


def _watch(host: str) -> Trial:
    """Watch when the arm stands, and whether it moves again or its program runs on."""
    end = time.monotonic() + 5.0
    while status(host)["moving"] and time.monotonic() < end:
        time.sleep(0.02)
    first = status(host)
    time.sleep(WATCHED_S)
    last = status(host)
    again = last["stood"] > first["stood"] or last["moving"] or last["runtime"] == PLAYING or last["uploads"] > 1
    return {"stood": first["stood"] if not first["moving"] else float("inf"), "again": bool(again)}
