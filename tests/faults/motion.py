"""What breaks while an emulated arm moves or presses: controllers, connections, this computer, a skin that dies.

The bound of a press that goes on by itself is that of `i2t.hardware.collision`: k (v T + v^2 / 2 a), with T the time
until the controller's watchdog runs dry (or until the skin counts as silent) and 40 ms. On a computer that is busy with
other work the driver may stop the arm before the fault; such trials are not counted.
"""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import Any, TypeAlias

import numpy as np

from i2t.collect.settings import TouchSettings
from i2t.emulators import ur_controller
from i2t.emulators.in_process import SimulatedArm
from i2t.errors import DeviceError
from i2t.hardware.collision import overrun_force
from i2t.hardware.limits import SAFETY
from i2t.hardware.rig import Rig
from i2t.hardware.ur.driver import UrArm
from i2t.types import ReturnCode
from tests.faults.closed_form import (
    HEIGHT_M,
    STIFFNESS_N_M,
    ForeignArm,
    MemoryLog,
    make_procedure,
    make_scene,
    site,
)
from tests.faults.table import NOTICED, Fault, Measure, Trial

Harm: TypeAlias = Callable[[str, "subprocess.Popen[str]"], Any]  # of a controller, by its address and process

SETTINGS, LIMITS = TouchSettings(), Rig().limits
REACTION_S, STATE_TIMEOUT_S, WATCHDOG_RATE_HZ = SAFETY.reaction_time_s, SAFETY.state_timeout_s, SAFETY.watchdog_rate_hz
OVERRUN = partial(overrun_force, SETTINGS.press, LIMITS.stiffness, braking=SAFETY.braking_m_s2)
TRAVEL_M, BREAKING_SPEED_M_S = 0.15, 0.1  # of a motion in which something breaks
FROZEN_S = 1.0
STOP_GOAL_S = 0.2
WATCHED_S = 1.0  # after the arm stood, in which it must not move again
ENDED_S = 10.0  # until a call that was in the motion must have returned
OVER_GOAL_N = 2.0  # past the force limit of a press
GAP_M, PRESSES_AT_ONCE = 0.5e-3, 25  # before the surface where a press begins; presses of one emulated arm
PLANE_M = 0.298  # of the emulated plane, 2 mm below the tool's first pose
STALL_S, STALL_POLL_S = (1.0, 5.0), 5e-3
PRESSED_N = 1.0  # at which a press meets its fault
BLIND_RANGE_N = (1.0, 7.5)  # likewise, for one whose force must not be far past its limit then

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


def status(host: str) -> dict[str, Any]:
    """State that an emulated controller reports."""
    return dict(json.loads(ur_controller.ask(host, "status")))


def _ask(line: str) -> Harm:
    """Harm by a line of the controller's fault port."""
    return lambda host, process: ur_controller.ask(host, line)


def _freeze(host: str, process: "subprocess.Popen[str]") -> None:
    process.send_signal(signal.SIGSTOP)
    time.sleep(FROZEN_S)
    process.send_signal(signal.SIGCONT)


def break_in_motion(harm: Harm, number: int, rate: float, watched: bool = True) -> Trial | None:
    """Break something in the middle of a motion.

    Args:
        harm: Fault to inject.
        number: Number of the trial.
        rate: Hz, of the watchdog.
        watched: Whether the controller can be asked afterwards.

    Returns:
        Seconds until it was noticed, and until the arm stood on the controller's clock; whether it moved again or this
        process crashed; what the error said. None where a computer that was busy had ended the motion before.
    """
    host, rng = ur_controller.loopback(number), np.random.default_rng((number, 7))
    with ur_controller.process(host) as process:
        arm = UrArm(host, LIMITS, state_timeout=max(STATE_TIMEOUT_S, 1 / rate), watchdog_rate=rate)
        with contextlib.suppress(DeviceError):
            arm.connect()
            with contextlib.closing(arm), ThreadPoolExecutor(1) as executor:
                motion = executor.submit(_go_down, arm, TRAVEL_M)
                time.sleep(float(rng.uniform(0.2, 1.0)))
                before = status(host)
                if motion.done() or not before["moving"]:
                    return None
                begun = time.monotonic()
                harm(host, process)
                error = _error_of(motion)
                noticed = time.monotonic() - begun
                crashed = not isinstance(error, DeviceError)
                after = watch(host, before["clock"]) if watched else {}
                said = str(error).split(":")[0].split(" at 127")[0]
                return {"noticed": noticed, "crashed": crashed, "said": said, **after}
    return None


def _go_down(arm: UrArm, travel: float) -> None:
    goal = arm.state(1.0).T_b_t.copy()
    goal[2, 3] -= travel
    arm.go(goal, BREAKING_SPEED_M_S)


def _error_of(motion: "Future[None]") -> BaseException | None:
    """Error that ended a motion; one that is not over in time counts as a crash."""
    try:
        return motion.exception(ENDED_S)
    except TimeoutError:
        return TimeoutError(f"the motion was not over {ENDED_S:g} s after the fault")


def watch(host: str, clock: float) -> Trial:
    """When the arm stood since a time of the controller's clock, and whether it moves again or its program runs on."""
    end = time.monotonic() + 5.0
    while status(host)["moving"] and time.monotonic() < end:
        time.sleep(0.02)
    first = status(host)
    time.sleep(WATCHED_S)
    last = status(host)
    again = last["stood"] > first["stood"] or last["moving"] or last["runtime"] == ur_controller.PLAYING
    stood = np.inf if first["moving"] else max(0.0, first["stood"] - clock)
    return {"stands after": float(stood), "moved again": bool(again or last["uploads"] > 1)}


def second_client(number: int) -> Trial:
    """A second client while the first one's arm moves: it is refused, and the motion ends where it should."""
    host = ur_controller.loopback(number + 50)
    with (
        ur_controller.process(host),
        UrArm(host, LIMITS, state_timeout=0.5, watchdog_rate=4.0) as arm,
        ThreadPoolExecutor(1) as executor,
    ):
        motion = executor.submit(_go_down, arm, 0.03)
        time.sleep(0.1)
        accepted = False
        with contextlib.suppress(DeviceError):
            UrArm(host, LIMITS).connect()
            accepted = True
        return {"accepted": accepted, "disturbed": _error_of(motion) is not None}


def emulated_presses(number: int) -> Trial:
    """Force past its limit, of presses on soft and stiff planes: the worst of some."""
    rng, over = np.random.default_rng((number, 3)), []
    host, height = ur_controller.loopback(number), 0.05
    pose = ("0.4", "0.0", str(height + GAP_M), str(np.pi), "0", "0")
    with (
        ur_controller.process(host, "--pose", *pose, "--noise", "0.1"),
        UrArm(host, LIMITS, state_timeout=2.0, watchdog_rate=1.0) as arm,
    ):
        start = arm.state(1.0).T_b_t
        for _ in range(PRESSES_AT_ONCE):
            stiffness = float(np.exp(rng.uniform(np.log(1e3), np.log(10e3))))
            ur_controller.ask(host, f"plane {height} {stiffness}")
            arm.zero_wrench()
            pressed = arm.approach(
                GAP_M + 0.02, SETTINGS.press, None, SETTINGS.force, SETTINGS.torque, SETTINGS.acceleration
            )
            over.append(stiffness * max(0.0, height - pressed.state.T_b_t[2, 3]) - SETTINGS.force)
            arm.go(start, SETTINGS.retreat, SETTINGS.acceleration)
    return {"over": max(over)}


def blind_press(fault: str, number: int) -> Trial | None:
    """A press whose controller, at some force, no longer says how hard it pushes, or no longer answers.

    Args:
        fault: Line of the controller's fault port.
        number: Number of the trial.

    Returns:
        Newtons past the limit, and the rest as of `watch`; None where a busy computer ended the press before.
    """
    host, begin = ur_controller.loopback(number), float(np.random.default_rng((number, 17)).uniform(*BLIND_RANGE_N))
    with (
        ur_controller.process(host, "--plane", str(PLANE_M), str(STIFFNESS_N_M)),
        UrArm(host, LIMITS) as arm,
        ThreadPoolExecutor(1) as executor,
    ):
        arm.zero_wrench()
        bounds = SETTINGS.force, SETTINGS.torque, SETTINGS.acceleration
        press = executor.submit(arm.approach, 0.01, SETTINGS.press, None, *bounds)
        while not (press.done() or _pushed(host) > begin):
            time.sleep(STALL_POLL_S)
        if press.done():
            return None
        before = status(host)
        ur_controller.ask(host, fault)
        said = str(press.exception(ENDED_S)).split(":")[0].split(" at 127")[0]
        return {**watch(host, before["clock"]), "over": _pushed(host) - SETTINGS.force, "said": said}


def simulated_press(make_arm: type[SimulatedArm], number: int) -> Trial:
    """Force past its limit on an arm that is late, and whether the tool left its box."""
    rng, no_skin = np.random.default_rng((number, 3)), np.zeros(15)
    stiffness, latency = float(np.exp(rng.uniform(np.log(1.5e3), np.log(10e3)))), float(rng.uniform(0, 0.06))
    procedure = make_procedure(make_scene(HEIGHT_M, stiffness, no_skin), latency, number, make_arm)
    recorder = MemoryLog()
    touched = procedure.touch(site(number), recorder)
    outside = sum(not LIMITS.contains(position, 1e-6) for position in recorder.positions)
    return {"over": stiffness * (HEIGHT_M - touched.T_w_t[2, 3]) - SETTINGS.force, "outside its box": outside}


def press_in_the_air(number: int) -> Trial:
    """A press that meets nothing, which noise must not stop."""
    touched = make_procedure(make_scene(height=-1.0), seed=number).touch(site(number), MemoryLog())
    return {"stopped": touched.code == ReturnCode.SKIN, "presses": 1}


def stalled_press(whole: bool, number: int) -> Trial | None:
    """Force that a press gains while this computer stalls: the program alone, or the arm's process as well.

    Args:
        whole: Whether the process that speaks with the controller stalls too.
        number: Number of the trial.

    Returns:
        Newtons gained, and whether the arm moved afterwards; None where a busy computer ended the press before.
    """
    rng, host = np.random.default_rng((number, 9)), ur_controller.loopback(number)
    plane = ("--plane", str(PLANE_M), str(STIFFNESS_N_M))
    words = [sys.executable, "-c", PRESSER, host]
    with (
        ur_controller.process(host, *plane),
        subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as child,
    ):
        assert child.stdout is not None
        worker = child.stdout.readline().strip()
        if child.stdout.readline().strip() != "pressed":
            return None
        stopped = [child.pid, *([int(worker)] if whole else [])]
        for pid in stopped:
            os.kill(pid, signal.SIGSTOP)
        force = peak = _pushed(host)
        end = time.monotonic() + float(rng.uniform(*STALL_S))
        while time.monotonic() < end:
            peak = max(peak, _pushed(host))
            time.sleep(STALL_POLL_S)
        before = status(host)
        for pid in stopped:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGCONT)
        time.sleep(0.5)
        after = status(host)
        child.kill()
    return {"gained": peak - force, "moved again": bool(after["moving"] or after["pose"] != before["pose"])}


def _pushed(host: str) -> float:
    """N, with which the emulated plane pushes back now."""
    return STIFFNESS_N_M * max(0.0, PLANE_M - float(status(host)["pose"][2]))


class _KillingLog(MemoryLog):
    """Makes a simulated skin fall silent once it is pressed by some force."""

    def __init__(self, skin: Any) -> None:
        super().__init__()
        self._skin, self.force = skin, 0.0

    def state(self, state: Any) -> None:
        """Silence the skin once the arm presses."""
        super().state(state)
        force = STIFFNESS_N_M * (HEIGHT_M - state.T_b_t[2, 3])
        if force >= PRESSED_N and not self.force:
            self.force, self._skin.silent = force, True


def dying_skin(number: int) -> Trial:
    """Force that a simulated press gains after its skin fell silent."""
    latency = float(np.random.default_rng((number, 11)).uniform(0, 0.03))
    procedure = make_procedure(make_scene(gain=np.zeros(15)), latency, number)
    recorder = _KillingLog(procedure.skins[0].skin)
    with contextlib.suppress(DeviceError):
        procedure.touch(site(number), recorder)
    ended = STIFFNESS_N_M * (HEIGHT_M - procedure.arm.state().T_b_t[2, 3])
    return {"ended at": ended, "gained": ended - recorder.force}


def _stands(rate: float) -> Measure:
    """How soon an arm must stand, whose watchdog runs at a rate (Hz)."""
    return Measure("stands after", max(STOP_GOAL_S, 1 / rate + STOP_GOAL_S), "s")


NEVER, CRASHED = Measure("moved again", 0), Measure("crashed", 0)
OVER = Measure("over", OVER_GOAL_N, "N")
STALL = (Measure("gained", OVERRUN(delay=REACTION_S + 1 / WATCHDOG_RATE_HZ), "N"), NEVER)
HARMS: dict[str, Harm] = {
    "stream stalled": _ask("stall"),
    "all ports mute": _ask("mute"),
    "protective stop": _ask("protective"),
    "program ended (pendant, lost script)": _ask("kill-program"),
}
BOXED = (OVER, Measure("outside its box", 0))
STANDS = (Measure("stands after", STOP_GOAL_S, "s"), NEVER)
TENTH_N = 0.1 * SETTINGS.force
UNHEARD_N = OVERRUN(delay=REACTION_S + STATE_TIMEOUT_S)  # without states no force is felt
BLINDNESS = {
    "its force is no number": ("forge actual_TCP_force nan", TENTH_N),
    "its force is infinite": ("forge actual_TCP_force inf", TENTH_N),
    "its tool is nowhere": ("forge actual_TCP_pose nan", TENTH_N),
    "its control stream stalls alone": ("stall-control", TENTH_N),
    "its clock stands still": ("forge timestamp 1", UNHEARD_N),
}
BROKEN_LINKS: dict[str, Harm] = {"control connection lost": _ask("drop-control"), "controller frozen": _freeze}
MOTION_FAULTS = (
    Fault("arm", "controller killed", partial(break_in_motion, lambda _, process: process.kill(), rate=10.0,
          watched=False), 20, (NOTICED, CRASHED)),
    *(Fault("arm", name, partial(break_in_motion, harm, rate=10.0), 20, (NOTICED, _stands(10.0), NEVER, CRASHED))
      for name, harm in HARMS.items()),
    *(Fault("arm", name, partial(break_in_motion, _ask(line), rate=10.0), 20, (NOTICED, *STANDS, CRASHED))
      for name, (line, _) in BLINDNESS.items()),
    Fault("arm", "second client", second_client, 20, (Measure("accepted", 0), Measure("disturbed", 0))),
    *(Fault("links", f"{name}, watchdog at {rate:g} Hz", partial(break_in_motion, harm, rate=rate), 50,
            (_stands(rate), NEVER, CRASHED)) for name, harm in BROKEN_LINKS.items() for rate in (10.0, 2.0, 5.0, 25.0)),
    Fault("force", f"past the limit, {PRESSES_AT_ONCE} emulated presses", emulated_presses, 20, (OVER,)),
    *(Fault("force", f"a press: {name}", partial(blind_press, line), 20, (Measure("over", most, "N"), *STANDS))
      for name, (line, most) in BLINDNESS.items()),
    Fault("presses", "past the limit, simulated, up to 60 ms late", partial(simulated_press, SimulatedArm), 500, BOXED),
    Fault("presses", "an arm that ignores its force limit, likewise", partial(simulated_press, ForeignArm), 100, BOXED),
    Fault("presses", "noise in the air", press_in_the_air, 1000, (Measure("stopped", 1e-3, of="presses"),)),
    Fault("stalls", "the program, 1 to 5 s, in a press", partial(stalled_press, False), 50, STALL),
    Fault("stalls", "the program and the arm's process", partial(stalled_press, True), 50, STALL),
    Fault("stalls", "skin dies in a press, simulated", dying_skin, 100,
          (Measure("gained", OVERRUN(delay=REACTION_S + SETTINGS.silence), "N"), Measure("ended at", unit="N"))),
)  # fmt: skip
