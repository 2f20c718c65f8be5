"""What every arm must do, whoever made it: the real driver before an emulated controller, and the simulated one."""

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from i2t.emulators import ur_controller
from i2t.emulators.in_process import Lab, SimulatedArm
from i2t.emulators.scene import Flat
from i2t.errors import DeviceError, NotConnectedError
from i2t.hardware.clock import MonotonicClock
from i2t.hardware.limits import MotionLimits
from i2t.hardware.protocols import Arm
from i2t.hardware.ur.driver import UrArm
from i2t.hardware.ur.poses import from_ur
from i2t.simulation.touches import SimulationErrors
from i2t.skin import boards

LIMITS = MotionLimits((0.2, -0.3, 0.1), (0.6, 0.3, 0.5))
FLOOR, STIFFNESS = 0.25, 5000.0  # m, N/m: a plane below the tool
KINDS = ("emulated", "simulated")
PATIENCE = 20.0  # s that a loaded machine may need


@contextmanager
def arms(kind: str) -> Iterator[Callable[[], Arm]]:
    """Arms of one kind that have not been connected; the tool stands at HOME."""
    if kind == "simulated":
        board = boards.reskin_board()
        lab = Lab(Flat(FLOOR, STIFFNESS, np.zeros(15), SimulationErrors.none(), board), MonotonicClock())
        yield lambda: SimulatedArm(lab, LIMITS)
        return
    pytest.importorskip("rtde_control", reason="ur_rtde is not installed (there are wheels for Python 3.10 to 3.12)")
    if sys.platform != "linux":
        pytest.skip("needs the addresses 127.x.y.z, which only Linux gives without asking")
    host = ur_controller.loopback(219)
    with ur_controller.process(host, "--plane", str(FLOOR), "--stiffness", str(STIFFNESS)):
        yield lambda: UrArm(host, LIMITS, state_timeout=3.0, watchdog_rate=0.3)


@pytest.fixture(params=KINDS)
def make(request) -> Iterator[Callable[[], Arm]]:
    """A new controller, or lab, for each test."""
    with arms(request.param) as made:
        yield made


@pytest.fixture(scope="module", params=KINDS)
def shared(request) -> Iterator[Arm]:
    """One connected arm of each kind, for what changes nothing."""
    with arms(request.param) as made, made() as arm:
        yield arm


def at(x: float, y: float, z: float) -> np.ndarray:
    return from_ur([x, y, z, np.pi, 0.0, 0.0])


HOME = at(0.4, 0.0, 0.3)


def at_rest(arm):
    """The state once the arm stands, and the greatest speed on the way (m/s)."""
    fastest, end = 0.0, time.monotonic() + PATIENCE
    while True:
        state = arm.state(3.0)
        fastest = max(fastest, float(np.linalg.norm(state.velocity[:3])))
        if not state.moving:
            return state, fastest
        assert time.monotonic() < end
        time.sleep(0.005)


def test_features_are_known_before_connecting(make, request):
    features = make().features
    assert features.source == request.node.callspec.id
    np.testing.assert_array_equal(features.box, [LIMITS.lower, LIMITS.upper])
    assert (features.speed, features.acceleration) == (LIMITS.speed, LIMITS.acceleration)
    assert features.rate >= 100


def test_it_is_an_arm_and_says_when_it_is_not_connected(make):
    arm = make()
    assert isinstance(arm, Arm)
    with pytest.raises(NotConnectedError):
        arm.state(3.0)
    with pytest.raises(NotConnectedError):
        arm.move(HOME, 0.1, 0.5)
    arm.close()


def test_it_moves_where_it_is_told_as_fast_as_it_may(make):
    goal = at(0.42, 0.03, 0.32)
    with make() as arm:
        before = arm.state(3.0)
        np.testing.assert_allclose(before.T_b_t, HOME, atol=1e-6)
        assert before.joints.shape == before.velocity.shape == before.wrench.shape == (6,)
        assert before.safe
        assert not before.moving
        sent = arm.move(goal, 0.1, 0.5)  # returns at once
        np.testing.assert_allclose(sent, goal, atol=1e-9)
        assert arm.state(3.0).moving
        after, fastest = at_rest(arm)
        np.testing.assert_allclose(after.T_b_t, goal, atol=1e-6)
        assert 0 < fastest <= 0.1 * (1 + 1e-6)
        assert before.time < after.time <= time.monotonic()
        arm.move(HOME, 0.1, 0.5)
        arm.move(goal, 0.1, 0.5)  # replaces it
        np.testing.assert_allclose(at_rest(arm)[0].T_b_t, goal, atol=1e-6)
        arm.move(HOME, 0.2, 0.5)
        at_rest(arm)


@pytest.mark.parametrize(
    ("goal", "speed", "acceleration", "why"),
    [
        (at(0.4, 0.0, 0.05), 0.1, 0.5, "outside the box"),
        (at(0.4, 0.31, 0.3), 0.1, 0.5, "outside the box"),
        (at(0.4, 0.0, np.nan), 0.1, 0.5, "finite"),
        (HOME * 2, 0.1, 0.5, "transform|rotation"),
        (at(0.41, 0.0, 0.3), 0.3, 0.5, "speed"),
        (at(0.41, 0.0, 0.3), 0.0, 0.5, "speed"),
        (at(0.41, 0.0, 0.3), 0.1, 0.6, "acceleration"),
    ],
    ids=["low", "aside", "nan", "scaled", "fast", "still", "jerky"],
)
def test_what_is_beyond_the_limits_is_refused_before_anything_moves(shared, goal, speed, acceleration, why):
    with pytest.raises(ValueError, match=why):
        shared.move(goal, speed, acceleration)
    state = shared.state(3.0)
    assert not state.moving
    np.testing.assert_allclose(state.T_b_t, HOME, atol=1e-6)


def test_it_stops_from_another_thread_and_can_go_on(make):
    with make() as arm:
        arm.move(at(0.4, 0.25, 0.3), 0.05, 0.5)
        errors: list[Exception] = []

        def stop() -> None:
            try:
                arm.stop(5.0)
            except Exception as error:
                errors.append(error)

        thread = threading.Thread(target=stop)
        thread.start()
        thread.join(PATIENCE)
        assert not errors
        stood = arm.state(3.0)
        assert not stood.moving
        assert stood.T_b_t[1, 3] < 0.2
        time.sleep(0.1)
        np.testing.assert_allclose(arm.state(3.0).T_b_t, stood.T_b_t, atol=1e-6)
        arm.stop(1.0)  # at rest it changes nothing
        arm.move(HOME, 0.2, 0.5)
        np.testing.assert_allclose(at_rest(arm)[0].T_b_t, HOME, atol=1e-6)


def test_what_it_touches_it_feels_and_zero_is_where_it_was_zeroed(make):
    with make() as arm:
        arm.zero_wrench(1.0)
        np.testing.assert_allclose(arm.state(3.0).wrench, 0, atol=1e-9)
        arm.move(at(0.4, 0.0, FLOOR - 1e-3), 0.05, 0.5)
        with pytest.raises(DeviceError, match="zeroed only while"):
            arm.zero_wrench(1.0)
        state, _ = at_rest(arm)
        # A plane pushes the tool back, against its z axis: 1 mm of a spring.
        np.testing.assert_allclose(state.wrench, [0, 0, -1e-3 * STIFFNESS, 0, 0, 0], atol=1e-3)
        arm.move(HOME, 0.1, 0.5)
        at_rest(arm)


def test_an_approach_ends_where_something_says_stop(make):
    with make() as arm:
        start = at(0.4, 0.0, FLOOR + 0.01)
        arm.go(start, 0.1, 0.5)
        arm.zero_wrench(3.0)
        commands = [((0.2, 0.02, None, 4.0, 4.0), "travel"), ((0.02, 0.02, None, 40.0, 4.0), "force")]
        for (*options, force, torque), why in commands:
            with pytest.raises(ValueError, match=why):
                arm.approach(*options, force=force, torque=torque)
        np.testing.assert_allclose(arm.state(3.0).T_b_t, start, atol=1e-6)

        done = arm.approach(0.03, 0.02, force=4.0)
        assert (done.reason, done.answer) == ("force", None)
        assert 4.0 < np.linalg.norm(done.trigger.wrench[:3]) <= np.linalg.norm(done.state.wrench[:3]) + 1e-9
        assert not done.state.moving
        # To 4 N it is 0.8 mm past the floor; what follows depends on the machine.
        assert 0.0108 < done.distance < 0.03
        arm.go(start, 0.1, 0.5)

        done = arm.approach(0.03, 0.02, lambda state: state.T_b_t[2, 3] < FLOOR + 0.006 and "skin", 4.0)
        assert (done.reason, done.answer) == ("condition", "skin")
        assert done.distance >= 0.004
        arm.go(start, 0.1, 0.5)

        done = arm.approach(0.005, 0.02, lambda state: None)
        assert (done.reason, done.answer) == ("distance", None)
        assert done.distance == pytest.approx(0.005, abs=1e-6)

        with pytest.raises(ZeroDivisionError):
            arm.approach(0.03, 0.002, lambda state: 1 / 0)
        assert not arm.state(3.0).moving
        arm.go(HOME, 0.1, 0.5)


def test_it_can_be_closed_twice_and_connected_again(make):
    arm = make()
    with arm:
        arm.move(at(0.4, 0.2, 0.3), 0.05, 0.5)
    arm.close()
    arm.close()
    with pytest.raises(DeviceError):
        arm.state(3.0)
    with arm:
        assert at_rest(arm)[0].T_b_t[1, 3] < 0.19  # closing stopped it
        arm.move(HOME, 0.2, 0.5)
        at_rest(arm)
