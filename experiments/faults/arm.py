"""The arm: what a controller can do in the middle of a motion, and how hard it presses."""

import json
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from experiments.faults.rows import FaultCounts, FaultRow, worst
from i2t.collect.settings import TouchSettings
from i2t.emulators import ur_controller
from i2t.errors import DeviceError
from i2t.hardware.rig import Rig
from i2t.hardware.ur.driver import UrArm

FAULTS = {  # commands to the emulator, None for its end
    "controller killed": None,
    "stream stalled": "stall",
    "all ports mute": "mute",
    "protective stop": "protective",
    "program ended (pendant, lost script)": "kill-program",
}
STATE_TIMEOUT_S = 0.1
PATIENCE_S = 10.0
GAP_M = 0.5e-3  # before the surface where a press begins


def arm(sizes: FaultCounts) -> list[FaultRow]:
    """Every fault in a motion: when it was noticed, and whether the arm stands."""
    rows = []
    for name, fault in FAULTS.items():
        noticed: list[float] = []
        stood, sentences, busy = 0, set(), 0
        while len(noticed) < sizes.arm and busy <= sizes.arm + 3:
            found = _fault(len(noticed) + busy, fault)
            if found is None:
                busy += 1
                continue
            seconds, sentence, stands = found
            noticed.append(seconds)
            sentences.add(sentence.split(":")[0].split(" at 127")[0])
            stood += stands
        known = "not to be known" if fault is None else f"stood in {stood} of {len(noticed)}"
        alarms = f"; {busy} false alarms of a busy computer before the fault" if busy else ""
        rows.append(
            FaultRow(
                "arm",
                f"{name}: noticed",
                f"{len(noticed)} motions",
                f'{worst(noticed or [np.inf])}; {known}{alarms}; "{min(sentences, default="")}"',
                "< 500 ms, and the arm stands",
                len(noticed) == sizes.arm and max(noticed) < 0.5 and (fault is None or stood == sizes.arm),
            )
        )
    return [*rows, _second(sizes.arm)]


def status(host: str) -> dict:
    """Status that the emulator reports."""
    return dict(json.loads(ur_controller.ask(host, "status")))


def _fault(trial: int, fault: str | None) -> tuple[float, str, bool] | None:
    """Seconds from a fault in the middle of a motion to its sentence, and whether the tool stands soon after; None if
    the motion had ended before, as it does where a busy computer cannot watch.
    """
    host, rig = ur_controller.loopback(trial), Rig()
    with (
        ur_controller.process(host) as process,
        UrArm(host, rig.limits, state_timeout=STATE_TIMEOUT_S, watchdog_rate=4.0) as device,
    ):
        with ThreadPoolExecutor(1) as executor:
            motion = executor.submit(_go_down, device)
            time.sleep(0.4)
            if motion.done():
                return None
            begun = time.monotonic()
            if fault is None:
                process.kill()
            else:
                ur_controller.ask(host, fault)
            error = motion.exception(PATIENCE_S)
            seconds = time.monotonic() - begun
        sentence = str(error) if isinstance(error, DeviceError) else f"no sentence, but {error!r}"
        if fault is None:
            return seconds, sentence, False
        time.sleep(0.3)
        return seconds, sentence, not status(host)["moving"]


def _go_down(device: UrArm) -> None:
    goal = device.state(1.0).T_b_t.copy()
    goal[2, 3] = 0.1
    device.go(goal, 0.1, 0.5)


def _second(trials: int) -> FaultRow:
    refused, unharmed = 0, 0
    for trial in range(trials):
        host, limits = ur_controller.loopback(trial + 50), Rig().limits
        with ur_controller.process(host), UrArm(host, limits, state_timeout=0.5, watchdog_rate=4.0) as device:
            goal = device.state(1.0).T_b_t.copy()
            goal[2, 3] -= 0.03
            with ThreadPoolExecutor(1) as executor:
                motion = executor.submit(device.go, goal, 0.05, 0.5)
                time.sleep(0.1)
                try:
                    UrArm(host, limits).connect()
                except DeviceError:
                    refused += 1
                unharmed += motion.exception(PATIENCE_S) is None
    said = f"refused {refused}, the first one's motion ended where it should {unharmed}"
    return FaultRow("arm", "second client", f"{trials} motions", said, "all", refused == unharmed == trials)


def force(sizes: FaultCounts) -> list[FaultRow]:
    """Overshoot of the force limit by emulated presses on soft and stiff objects."""
    settings, rig = TouchSettings(), Rig()
    rng = np.random.default_rng(0)
    peaks, reasons = [], []
    host, height = ur_controller.loopback(99), 0.05
    pose = ("0.4", "0.0", str(height + GAP_M), str(np.pi), "0", "0")
    with (
        ur_controller.process(host, "--pose", *pose, "--noise", "0.1") as _,
        UrArm(host, rig.limits, state_timeout=2.0, watchdog_rate=1.0) as device,
    ):
        start = device.state(1.0).T_b_t
        for _ in range(sizes.presses):
            stiffness = float(np.exp(rng.uniform(np.log(1e3), np.log(10e3))))
            ur_controller.ask(host, f"plane {height} {stiffness}")
            device.zero_wrench()
            pressed = device.approach(
                GAP_M + 0.02, settings.press, None, settings.force, settings.torque, settings.acceleration
            )
            reasons.append(pressed.reason)
            peaks.append(stiffness * max(0.0, height - pressed.state.T_b_t[2, 3]))
            device.go(start, settings.retreat, settings.acceleration)
    over = np.array(peaks) - settings.force
    derived = 10e3 * (settings.press * 0.06 + settings.press**2 / 4)
    said = f"median {np.median(over):+.2f} N, greatest {over.max():+.2f} N; {reasons.count('force')} by force"
    return [
        FaultRow(
            "force",
            "past the 8 N limit, 1 to 10 N/mm, noise 0.1 N",
            f"{sizes.presses} emulated presses",
            said,
            f"<= +2 N (derived at 10 N/mm, 60 ms: {derived:.1f})",
            bool(over.max() <= 2.0),
        )
    ]
