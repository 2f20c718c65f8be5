"""Motions that i2t guards itself: a watch that judges states, and arms that disregard requests."""

import signal
import threading
import time
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from helpers.closed_form import HEIGHT, make

from i2t.collect.settings import TouchSettings
from i2t.emulators.in_process import SimulatedArm, SimulatedLab, VirtualClock
from i2t.errors import DeviceError, MotionStoppedError
from i2t.hardware.clock import MonotonicClock
from i2t.hardware.contract import refuse
from i2t.hardware.guarded import MotionWatch, free_limits
from i2t.hardware.limits import SAFETY
from i2t.hardware.motion_limits import MotionLimits
from i2t.hardware.poses import translated_along_z
from i2t.hardware.protocols import ArmState
from tests.faults.closed_form import ForeignArm, MemoryLog

STIFFNESS = 10e3  # N/m, of the plane
NUMBERS = np.array([np.nan, np.inf, -np.inf, 1e6])


def foreign(stiffness=STIFFNESS, **settings):
    """A procedure with a foreign arm just above a plane, whose skin measures nothing."""
    settings = TouchSettings(prepare=2e-3, near=5e-4, settle=0.0, ambient=2, **settings)
    procedure = make(stiffness=stiffness, gain=np.zeros(15), settings=settings)
    procedure.arm.lab.robot.position = np.array([0.4, 0.0, HEIGHT + 3e-3])
    arm = ForeignArm(procedure.arm.lab, procedure.rig.limits)
    arm.connect()
    procedure.arm = arm
    return procedure, arm


def press(procedure, log=None):
    """The outcome of a press from the tool's present pose."""
    return procedure.press(log or MemoryLog()).result


def pushed(procedure, stiffness=STIFFNESS):
    """Force (N) with which the plane pushes back now."""
    return stiffness * max(0.0, HEIGHT - procedure.arm.read_state().T_b_t[2, 3])


@pytest.mark.parametrize("seed", range(3))
def test_the_force_limit_is_kept_where_the_arm_ignores_it(seed):
    rng = np.random.default_rng(seed)
    stiffness = float(np.exp(rng.uniform(*np.log([1e3, 1e4]))))
    procedure, _ = foreign(stiffness, force=float(rng.uniform(1, 8)))
    result, settings, force = press(procedure), procedure.settings, pushed(procedure, stiffness)
    assert result.reason == "force"
    # A look is 7.5 ms, and this arm 30 ms late.
    assert settings.force < force < settings.force + stiffness * (settings.press * 40e-3 + 1e-5)


def test_the_torque_limit_is_kept_where_the_arm_ignores_it():
    procedure, arm = foreign()
    arm.lie = lambda state: state._replace(wrench=state.wrench + pushed(procedure) * np.eye(6)[4])
    procedure.settings = replace(procedure.settings, torque=2.0)
    assert press(procedure).reason == "torque"
    assert pushed(procedure) < 4.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"too_far": 0.03}, r"moved .* mm instead of 6.5 mm"),
        ({"hasty": 20.0}, r"moves at .* instead of 0.002 m/s"),
        ({"asks": False}, "did not evaluate its stop condition"),
    ],
)
def test_an_arm_that_overshoots_or_ignores_its_stop_condition_ends_the_touch(change, message):
    procedure, arm = foreign()
    arm.lab.robot.position[2] += 0.1
    vars(arm).update(change)
    with pytest.raises(DeviceError, match=message):
        press(procedure)
    assert not arm.read_state().moving


def forged(name, value):
    """Replace one number of a state; for the pose, also one of its rotation."""

    def lie(state, first):
        wrong = np.array(getattr(state, name), float)
        wrong[..., -1] = value
        return state._replace(**{name: wrong})

    return lie


LIES = {  # what becomes of a state, by the first of which that is so
    **{f"{name} {value:g}": forged(name, value) for name in ("T_b_t", "velocity", "wrench") for value in NUMBERS},
    **{f"joints {value:g}": forged("joints", value) for value in NUMBERS[:3]},
    "old": lambda state, first: state._replace(time=state.time - 5.0),
    "of no time": lambda state, first: state._replace(time=np.nan),
    "of the future": lambda state, first: state._replace(time=np.inf),
    "not safe": lambda state, first: state._replace(safe=False),
    "frozen": lambda state, first: first,
    "frozen pose": lambda state, first: state._replace(T_b_t=first.T_b_t, moving=True),
}


@pytest.mark.parametrize("lie", LIES)
@pytest.mark.parametrize("own", [True, False], ids=["its own approach", "guarded by polling"])
def test_an_impossible_state_ends_a_press(lie, own):
    """The states are NaN, infinite, frozen and absurd values of every number that stops or allows a motion."""
    procedure, arm = foreign()
    if not own:
        procedure.arm = arm = SimulatedArm(arm.lab, arm.limits)
        arm.connect()
        driver_method = arm.read_state
        arm.lie = lambda state: state
        arm.read_state = lambda: arm.lie(driver_method())
    log, begun, ended = MemoryLog(), [], ""
    keep = log.state

    def state(heard):
        keep(heard)
        if not begun and pushed(procedure) > 1.0:
            begun.append(heard)
            arm.lie = partial(LIES[lie], first=heard)

    log.state = state
    try:
        ended = press(procedure, log).reason
    except DeviceError as error:
        ended = str(error)
    assert begun
    assert arm.lab.robot.motion is None
    force = STIFFNESS * (HEIGHT - arm.lab.robot.position[2])
    assert ended in ("force", "torque") or (ended.count(". ") == 0 and " " in ended)  # a limit, or one sentence
    if lie == "frozen pose":  # which leaves it to the force
        assert force < 8.0 * 1.1
        return
    assert force < 1.0 + STIFFNESS * 2e-3 * (
        (SAFETY.max_state_age_s if lie == "frozen" else 0.0) + 0.06
    )  # N: at once, or too old


@pytest.mark.parametrize(
    ("lie", "message"),
    [
        (lambda state, first: state, "met something"),
        (LIES["not safe"], "protective"),
        (LIES["velocity 1e+06"], "turns at"),
    ],
)
def test_reading_states_alone_stops_a_faulty_motion_for_good(lie, message):
    procedure = make(stiffness=STIFFNESS)
    arm, driver_method = procedure.arm, procedure.arm.read_state
    arm.lab.robot.position = np.array([0.4, 0.0, HEIGHT + 3e-3])
    goal = translated_along_z(arm.state().T_b_t, 0.02)
    arm.move(goal, 0.04)
    arm.clock.sleep(0.05)
    arm.read_state = lambda: lie(driver_method(), first=None)

    def ask():
        while arm.state().moving:
            arm.clock.sleep(arm.poll_s)

    with pytest.raises(DeviceError, match=message):
        ask()
    arm.clock.sleep(0.1)
    assert not driver_method().moving
    assert pushed(procedure) < arm.limits.force
    if message == "protective":
        with pytest.raises(DeviceError, match=message):
            arm.move(goal, 0.04)
        assert arm.lab.robot.motion is None


def test_motions_are_watched_with_two_readers_a_failed_brake_or_a_late_start():
    arm = slow_arm()
    driver_method, line, brake = arm.read_state, arm.begin_line, arm.brake
    arm.begin_line = lambda *way: threading.Timer(0.2, line, way).start()
    with arm:
        home, looking = arm.state().T_b_t, threading.Event()

        def look():
            while not looking.is_set():
                arm.state()

        watcher = threading.Thread(target=look)
        watcher.start()
        arm.move(translated_along_z(home, 5e-3), 0.05)
        time.sleep(0.8)
        looking.set()
        watcher.join()
        assert not np.allclose(arm.state().T_b_t, home)  # nobody took states of two threads for old ones
        calls = []
        arm.brake = lambda: calls.append(None) or (brake() if len(calls) > 1 else driver_method(None))
        arm.move(home, 0.02)
        assert not arm.state().moving or arm.lab.robot.motion is None  # before it has begun
        time.sleep(0.3)
        arm.read_state = lambda: driver_method()._replace(wrench=np.full(6, 100.0))
        with pytest.raises(DeviceError, match="met something"):
            arm.state()
        assert len(calls) > 1
        assert arm.lab.robot.motion is None


def test_a_motion_does_not_start_after_a_stop_request():
    with slow_arm() as arm:
        driver_method = arm.begin_line

        def stopped_before(*line):
            arm._stops += 1  # as a signal does, which waits for no lock
            driver_method(*line)

        arm.begin_line = stopped_before
        with pytest.raises(MotionStoppedError, match="by request"):
            arm.move(translated_along_z(arm.state().T_b_t, 0.05), 0.02)
        assert arm.lab.robot.motion is None


BOUNDS = {"distance": 0.01, "speed": 0.1, "force": 8.0, "torque": 2.0}
START = ArmState(0.0, make().arm.read_state().T_b_t, np.zeros(6), np.zeros(6), np.zeros(6), moving=True, safe=True)


def at(time, z=0.0, **changes):
    """A state so many seconds and millimetres after the start."""
    T_b_t = START.T_b_t.copy()
    T_b_t[2, 3] -= 1e-3 * z
    return START._replace(**{"time": time, "T_b_t": T_b_t, **changes})


@pytest.mark.parametrize(
    ("states", "message"),
    [
        ([at(0.1, 1.0, wrench=np.full(6, np.nan))], "wrench is .*, which is not finite"),
        ([at(0.1, 1.0, joints=np.full(6, np.inf))], "joints is .*, which is not finite"),
        ([at(0.1, 1.0), at(0.05, 2.0)], "no new states"),
        ([at(0.1 - 2 * SAFETY.max_state_age_s, 1.0)], "no new states"),
        ([at(0.1 + 2 * SAFETY.max_state_age_s, 1.0)], "no new states"),
        ([at(np.nan, 1.0)], "no new states"),
        ([at(0.1, 1.0, safe=False)], "protective or emergency stop"),
        ([at(0.1, 400.0)], "outside its box"),
        ([at(0.1, 14.0)], r"moved 14 mm instead of 10 mm"),
        ([at(0.1, 1.0, velocity=np.array([0, 0, -0.2, 0, 0, 0]))], "moves at 0.2 m/s instead of 0.1 m/s"),
        ([at(0.1, 1.0, velocity=np.array([0, 0, 0, 0, 0, 20.0]))], "turns at 20 rad/s"),
        ([at(0.1 * n, 1.0) for n in range(1, 34)], "its pose does not change"),
    ],
)
def test_each_fault_of_a_state_is_reported(states, message):
    clock = VirtualClock(0.0)
    watch = MotionWatch(make().arm, make().rig.limits, START, **BOUNDS, clock=clock)

    def judge():
        for state in states:
            clock.sleep(0.1)
            assert watch(state) is None

    with pytest.raises(DeviceError, match=message):
        judge()


@pytest.mark.parametrize(("force", "torque", "above"), [(8, 2, None), (8.1, 2.1, "force"), (0, 2.1, "torque")])
def test_force_before_torque_is_what_is_above_its_limit(force, torque, above):
    watch = MotionWatch(make().arm, make().rig.limits, START, **BOUNDS, clock=VirtualClock(0.0))
    assert watch(at(0.0, 1.0, wrench=np.array([0, force, 0, 0, 0, torque]))) == above


def slow_arm(**broken):
    """An arm in real time, half a metre from any obstacle, with some methods replaced."""
    arm = SimulatedArm(SimulatedLab(make().arm.lab.scene, MonotonicClock()), make().rig.limits)
    for name, method in broken.items():
        setattr(arm, name, method)
    return arm


def test_an_approach_whose_stop_condition_hangs_is_braked_meanwhile():
    with slow_arm() as arm:
        stood = []

        def hang(state):
            time.sleep(4 * SAFETY.max_state_age_s)
            stood.append(not arm.read_state().moving)

        with pytest.raises(DeviceError, match=r"was not watched .*: this computer is too busy: close other") as error:
            arm.approach(0.05, 0.02, hang)
        assert not isinstance(error.value, MotionStoppedError)  # which would take a person for the cause
        assert stood == [True]


@pytest.mark.parametrize("lag", [0.0, 0.15])
def test_an_arm_that_starts_late_is_awaited_and_one_that_never_starts_fails(lag):
    with slow_arm() as arm:
        driver_method, begun = arm.begin_line, threading.Timer
        arm.begin_line = lambda *line: begun(lag, driver_method, line).start()
        home = arm.state().T_b_t
        arm.go(translated_along_z(home, 0.01), 0.05)
        assert not arm.state().moving
        arm.begin_line = lambda *line: None
        with pytest.raises(DeviceError, match=r"ended 10\.0 mm and 0\.0 degrees off its goal"):
            arm.go(home, 0.05)


def test_a_line_that_was_sent_is_taken_back_where_its_answer_fails_or_the_arm_is_closed():
    arm = slow_arm()
    driver_method = arm.begin_line

    def sent(*line):
        driver_method(*line)
        raise TimeoutError("no answer")

    with arm:
        arm.begin_line = sent
        with pytest.raises(DeviceError, match="no answer"):
            arm.move(translated_along_z(arm.state().T_b_t, 0.05), 0.02)
        assert arm.lab.robot.motion is None
        arm.begin_line = driver_method
        state, looks = arm.state, []

        def closing(*timeout):
            looks.append(None)
            if len(looks) == 2:  # the last before the line
                arm.close()
                arm._open = True
            return state(*timeout)

        arm.state = closing
        with pytest.raises(MotionStoppedError, match="by request"):
            arm.move(translated_along_z(state().T_b_t, 0.05), 0.02)
        assert arm.lab.robot.motion is None


def test_a_second_ctrl_c_does_not_prevent_the_stop_of_the_arm():
    arm = slow_arm()
    arm.connect()
    arm.move(translated_along_z(arm.state().T_b_t, 0.05), 0.02)
    brake, before = arm.brake, signal.signal(signal.SIGINT, signal.default_int_handler)
    arm.brake = lambda: signal.raise_signal(signal.SIGINT) or brake()
    try:
        arm.__exit__(None, None, None)
    finally:
        signal.signal(signal.SIGINT, before)
    assert arm.lab.robot.motion is None


@pytest.mark.parametrize("name", ["read_state", "begin_line", "brake", "zero_sensor", "open_link"])
def test_an_error_of_the_library_is_one_sentence_and_the_arm_stands(name):
    calls = []

    def fail(*_):
        calls.append(name)
        if len(calls) < 3:
            raise OSError(104, "Connection reset by peer")
        return getattr(SimulatedArm, name)(arm, *_)

    arm = slow_arm()
    arm.connect()
    setattr(arm, name, fail)

    def use():
        if name == "open_link":
            arm.connect()
        arm.zero_wrench()
        arm.approach(0.05, 0.02, lambda state: state.T_b_t[2, 3] < 0.29)

    with pytest.raises(DeviceError, match=r"the simulated arm failed \(.*reset by peer\); check its connection"):
        use()
    assert arm.lab.robot.motion is None


def test_no_free_motion_begins_with_a_non_finite_or_excessive_force():
    limits = MotionLimits((0.2, -0.3, 0.1), (0.6, 0.3, 0.5))
    assert free_limits(limits, np.zeros(6)) == (limits.trip_force, limits.torque)
    assert free_limits(limits, np.array([0, 0, 40.0, 0, 0, 0]))[0] == pytest.approx(44.0)
    wrenches = (np.where(np.arange(6) == place, value, 0.0) for place in (2, 5) for value in NUMBERS)
    refuse(DeviceError, [(free_limits, (limits, wrench), "before it moves") for wrench in wrenches])
