"""The UR driver and the real client library against the emulated controller, each in a process of its own.

Times are judged on the controller's clock, so that a slow machine does not matter. What all arms must do is in
tests/contract.
"""

import contextlib
import io
import itertools
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from functools import partial
from unittest.mock import Mock

import numpy as np
import pytest
from helpers.waiting import eventually

from i2t.emulators import robot_motion, ur_controller
from i2t.emulators.ur_controller import TICK, ask
from i2t.errors import DeviceError, DeviceTimeoutError
from i2t.hardware.contract import refuse
from i2t.hardware.limits import SAFETY
from i2t.hardware.motion_limits import MotionLimits
from i2t.hardware.poses import pose_from_vector
from i2t.hardware.ur import access, driver, rtde_worker
from i2t.hardware.ur.driver import UrArm

LIMITS = MotionLimits((0.2, -0.3, 0.1), (0.6, 0.3, 0.5), approach_distance=0.3)
STATE_TIMEOUT, WATCHDOG_RATE = 0.5, 4.0  # s, Hz: a machine that is busy with other tests is not a fault
numbers = itertools.count()
pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="needs the addresses 127.x.y.z, which only Linux gives")


def pose(x, y, z, rx=np.pi, ry=0.0, rz=0.0):
    return pose_from_vector([x, y, z, rx, ry, rz])


def status(host):
    return json.loads(ask(host, "status"))


@contextlib.contextmanager
def emulators():
    """Start emulated controllers that end with the block; yields a function that starts one and returns its address."""
    pytest.importorskip("rtde_control", reason="ur_rtde is not installed (there are wheels for Python 3.10 to 3.12)")

    def begin(*options):
        host = ur_controller.loopback(next(numbers))
        begin.newest = stack.enter_context(ur_controller.process(host, *options))
        return host

    with contextlib.ExitStack() as stack:
        yield begin


@pytest.fixture
def start():
    """`emulators` for one test."""
    with emulators() as begin:
        yield begin


def connected(host, **options):
    return UrArm(host, LIMITS, **{"state_timeout": STATE_TIMEOUT, "watchdog_rate": WATCHDOG_RATE, **options})


# Pure parts


def test_a_line_takes_the_time_of_a_trapezoid_and_a_stop_its_distance():
    length, speed, a = 0.1, 0.1, 0.5
    robot = robot_motion.Robot(np.zeros(6), robot_motion.plane(0.0, 0.0), 0.0)
    robot.line_to(np.array([length, 0, 0, 0, 0, 0.1]), speed, a)
    ticks = 0
    while robot.motion is not None:
        robot.step(TICK)
        ticks += 1
    # One tick at each change of acceleration, and a last stretch at less than a TICK's worth of speed.
    assert ticks * TICK == pytest.approx(length / speed + speed / a, abs=4 * TICK)
    np.testing.assert_allclose(robot.pose, [length, 0, 0, 0, 0, 0.1], atol=1e-12)
    assert robot.max_speed <= speed * (1 + 1e-9)
    robot.line_to(robot.pose - [length, 0, 0, 0, 0, 0], speed, a)
    while robot.speed < speed:
        robot.step(TICK)
    before = robot.position[0]
    robot.stop(a)
    while robot.motion is not None:
        robot.step(TICK)
    assert before - robot.position[0] == pytest.approx(speed**2 / (2 * a), abs=speed * TICK)


def test_timeouts_too_long_to_protect_are_refused():
    options = {"watchdog_rate": 0.01}, {"watchdog_rate": 200.0}, {"state_timeout": 60.0}
    refuse(ValueError, [(partial(connected, **option), ("127.0.0.1",), "is outside") for option in options])


# The lock, and the process of the client library


def test_the_lock_is_in_the_users_own_folder_and_follows_no_link(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    take = access.take_lock, ("192.0.2.1",)
    with access.take_lock("192.0.2.1"):
        (file,) = (tmp_path / "i2t").iterdir()
        assert file.read_text() == str(os.getpid())
        refuse(DeviceError, [(*take, f"in use by process {os.getpid()}")])
    access.take_lock("192.0.2.1").close()
    target = tmp_path / "precious"
    target.write_text("what nobody may truncate")
    file.unlink()
    file.symlink_to(target)
    refuse(DeviceError, [(*take, "cannot be opened")])
    assert target.read_text() == "what nobody may truncate"
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert access.lock_folder() == tmp_path / ".cache" / "i2t"
    monkeypatch.setitem(sys.modules, "fcntl", None)  # where there are no locks the arm is refused
    refuse(DeviceError, [(*take, "Linux or macOS")])


LIBRARY = {  # answers of the part of ur_rtde that a motion needs
    "getTimestamp": 1.0, "getSafetyStatusBits": 1, "getRuntimeState": rtde_worker.PLAYING, "operationId": 0,
    "isAsyncOperationRunning": False, "getTargetSpeedFraction": 1.0, "isConnected": True,
    **{f"getActual{what}": [0.0] * 6 for what in ("TCPPose", "TCPSpeed", "TCPForce", "Q")},
}  # fmt: skip


def test_motions_require_a_running_watchdog():
    ours, theirs = (rtde_worker.Channel(end) for end in socket.socketpair())
    library = Mock(**{f"{name}.return_value": value for name, value in LIBRARY.items()})
    library.getAsyncOperationProgressEx.return_value = library
    limits = rtde_worker.WorkerLimits(
        watchdog_rate=4.0,
        state_timeout=STATE_TIMEOUT,
        braking=2.0,
        standing_speed=1e-3,
        brake_settling=0.05,
        start_timeout=0.5,
        exit_timeout=2,
    )
    worker = rtde_worker.Worker(theirs, library, library, limits)
    worker.send_new_state()
    motion = {"pose": [0.0] * 6, "speed": 0.1, "acceleration": 0.1, "force": 1.0, "torque": 1.0}
    heartbeat, move = {"heartbeat": True}, {"command": "move", "id": 1, "arguments": motion}

    def sent():
        names = (name for name, *_ in library.mock_calls)
        return [name for name in names if name in ("moveL", "kickWatchdog", "setWatchdog")]

    def error(*messages):
        worker.process(list(messages))
        return [message["error"] for message in ours.receive(1.0) if "answer" in message][-1]

    assert error(move) == "its watchdog is not being fed"
    assert error(heartbeat, move) == "its watchdog is not being fed"  # nor set
    assert error({"command": "set_watchdog", "id": 2, "arguments": {}}) is None
    time.sleep(2 / limits.watchdog_rate)
    assert error(move) == "its watchdog is not being fed"
    assert "moveL" not in sent()
    assert error(heartbeat, move) is None
    assert sent() == ["kickWatchdog", "setWatchdog", "kickWatchdog", "moveL"]
    ours.close()
    theirs.close()


def test_the_process_keeps_its_connections_and_can_make_no_other():
    code = (
        "import socket; from i2t.hardware.ur import rtde_worker as worker\n"
        "ours, theirs = (worker.Channel(end) for end in socket.socketpair())\n"
        "worker.forbid_new_connections()\n"
        "ours.send({'ready': True})\n"
        "assert theirs.receive(1.0) == [{'ready': True}]\n"
        "try: socket.socket()\n"
        "except OSError: print('none')\n"
    )
    assert subprocess.run([sys.executable, "-c", code], check=True, capture_output=True).stdout == b"none\n"


# Motion

STIFFNESS, PLANE, SPEED = 5000.0, 0.295, 0.02  # N/m, m, m/s: what an approach meets
BEGIN = pose(0.4, 0.0, 0.3)


@pytest.fixture(scope="module")
def touching():
    """Address of an emulated controller whose tool stands 5 mm above a plane, and its connected arm."""
    with emulators() as begin:
        host = begin("--plane", str(PLANE), str(STIFFNESS))
        with connected(host) as arm:
            yield host, arm


@pytest.fixture
def above(touching):
    """The arm of `touching`, with the tool back at its start."""
    host, arm = touching
    ask(host, "wrench 0 0 0 0 0 0")
    for attempt in range(4):  # a busy machine does not feed the watchdog while the arm is left alone
        with contextlib.suppress(*([DeviceError] if attempt < 3 else [])):
            if attempt:
                arm.connect()
            arm.go(BEGIN, 0.1)
            break
    return host, arm


def test_a_motion_ends_at_its_goal_within_the_requested_speed_and_the_slider_s(start):
    host = start()
    ask(host, "wrench 0.5 -1 2 0 0 0")
    with connected(host, payload=(0.3, (0.0, 0.0, 0.05)), tool=pose(0, 0, 0.1, 0)) as arm:
        begun = status(host)
        assert begun["payload"] == 0.3
        assert begun["watchdog"] == 1 / WATCHDOG_RATE
        wrench = arm.state(STATE_TIMEOUT).wrench
        np.testing.assert_allclose(wrench[:3], [0.5, 1, -2], atol=1e-12)  # tool axes: half a turn on x
        arm.zero_wrench()
        goal = pose(0.42, 0.04, 0.27, 3.0, 0.2, 0.1)
        state = arm.go(goal, 0.1, 0.5)
        np.testing.assert_allclose(state.T_b_t, goal, atol=1e-6)
        np.testing.assert_allclose(state.wrench, 0, atol=1e-12)
        after = status(host)
        np.testing.assert_allclose(pose_from_vector(after["pose"]), goal, atol=1e-6)
        assert 0.09 < after["fastest"] <= 0.1 * (1 + 1e-9)
    assert status(host)["runtime"] == ur_controller.STOPPED
    host = start()
    ask(host, "speed 0.5")
    with connected(host) as arm:
        arm.go(pose(0.4, 0.03, 0.3), 0.2)
        assert 0.09 < status(host)["fastest"] <= 0.1 * (1 + 1e-9)


def test_goals_beyond_the_limits_are_refused_before_anything_is_sent(above):
    host, arm = above
    commands = status(host)["commands"]
    goals = (arm.go, (pose(0.7, 0.0, 0.3),), "outside the box"), (arm.move, (pose(np.nan, 0.0, 0.3),), "finite")
    refuse(ValueError, [*goals, (arm.approach, (0.25,), "outside the box")])
    assert status(host)["commands"] == commands


def test_an_approach_ends_on_force(above):
    _, arm = above
    begun = arm.state(STATE_TIMEOUT).T_b_t
    done = arm.approach(0.02, SPEED, force=4.0)
    assert (done.reason, done.state.moving) == ("force", False)
    np.testing.assert_allclose(done.distance, begun[2, 3] - done.state.T_b_t[2, 3], atol=1e-9)  # straight down
    reached = STIFFNESS * (PLANE - done.state.T_b_t[2, 3])
    # What was felt before the trigger is below the limit; after it the arm goes on for at most what news (8 ms), a
    # look (10 ms) and a command (two handshakes) take, and brakes. A busy machine adds to it: 20 ms in 100.
    assert 4.0 < reached < 4.0 + STIFFNESS * (SPEED * 0.12 + SPEED**2 / (2 * SAFETY.braking_m_s2))


def test_an_approach_ends_on_torque(above):
    host, arm = above

    def push(state):
        if state.T_b_t[2, 3] < 0.2995:
            ask(host, "wrench 0 0 0 0 6 0")

    done = arm.approach(0.02, 0.002, push, torque=5.0)
    assert (done.reason, done.state.moving) == ("torque", False)
    np.testing.assert_allclose(done.state.wrench[3:], [0, -6, 0], atol=1e-9)  # tool axes


def test_a_motion_that_meets_something_is_stopped_and_may_back_out(above):
    _, arm = above
    with pytest.raises(DeviceError, match="met something on its way"):
        arm.go(pose(0.4, 0, 0.28), 0.05)  # 30 N at 289 mm
    assert LIMITS.trip_force < np.linalg.norm(arm.state(STATE_TIMEOUT).wrench[:3]) < LIMITS.force
    arm.go(BEGIN, 0.1)


def test_a_force_above_its_limit_at_the_goal_is_reported_but_not_kept(above):
    host, arm = above
    force = STIFFNESS * 5e-4
    done = arm.approach(5.5e-3, 0.005, lambda state: None, force=0.999 * force)
    assert (done.reason, done.state.moving) == ("force", False)
    ask(host, "wrench 0 0 7 0 0 0")  # in the base
    eventually(lambda: arm.state(STATE_TIMEOUT).wrench[2] < -force - 6.0)
    arm.zero_wrench()
    eventually(lambda: abs(arm.state(STATE_TIMEOUT).wrench[2]) < 1e-6)
    ask(host, "wrench 0 0 0 0 0 0")
    arm.go(BEGIN, 0.1)
    arm.zero_wrench()


def test_a_paused_motion_is_awaited(above):
    host, arm = above
    ask(host, "speed 0")
    threading.Timer(4.0, ask, (host, "speed 1")).start()  # s; at full speed it may take 2.8
    np.testing.assert_allclose(arm.go(pose(0.4, 0.02, 0.3), 0.1).T_b_t[1, 3], 0.02, atol=1e-6)


def test_an_unwatched_approach_is_stopped(above):
    host, arm = above
    with pytest.raises(DeviceError, match="was not watched"):
        arm.approach(0.02, 0.002, lambda state: time.sleep(3 * STATE_TIMEOUT))
    assert not status(host)["moving"]


def test_stop_from_another_thread(above):
    host, arm = above
    stopped = []
    message, _ = in_motion(arm, host, lambda: stopped.append((arm.stop(5.0), status(host)["moving"])))
    assert re.search("MotionStoppedError: .*by request", message)
    assert stopped == [(None, False)]


# Faults


@contextlib.contextmanager
def amid(host, speed, fault):
    """Do something once the arm moves faster than `speed` (m/s); yield a list that then holds its status."""
    began = []

    def act():
        eventually(lambda: np.linalg.norm(status(host)["twist"]) > speed)
        began.append(status(host))
        fault()

    thread = threading.Thread(target=act)
    thread.start()
    try:
        yield began
    finally:
        thread.join()


def in_motion(arm, host, fault) -> tuple[str, float]:
    """Do something in the middle of a motion of 0.05 m/s; return the error that ended it, and the position along y."""
    with amid(host, 0.04, fault) as began, pytest.raises(DeviceError) as caught:
        arm.go(pose(0.4, 0.25, 0.3), 0.05)
    assert str(caught.value).count(". ") == 0  # one sentence
    return f"{type(caught.value).__name__}: {caught.value}", began[0]["pose"][1]


NO_NEWS = "No state arrived from|sent its last state"
BROKEN = f"TimeoutError: .*({NO_NEWS}|The connection to the controller .* broke)"


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("stall", BROKEN),
        ("stall-control", BROKEN),
        ("drop-control", BROKEN),
        ("drop-state", BROKEN),
        (signal.SIGSEGV, "TimeoutError: .*SIGSEGV"),
        (signal.SIGKILL, "TimeoutError: .*SIGKILL"),
        (signal.SIGSTOP, f"TimeoutError: .*({NO_NEWS})"),
        ("kill-program", "program on the controller"),
    ],
    ids=["stall", "stall-control", "drop-control", "drop-state", "SIGSEGV", "SIGKILL", "SIGSTOP", "kill-program"],
)
def test_a_fault_in_a_motion_stops_the_arm_until_it_is_reconnected(above, fault, message):
    """The controller's streams and program, and a client library that crashes or hangs."""
    host, arm = above
    worker, uploads = arm.connection._process.pid, status(host)["uploads"]
    fail = (lambda: ask(host, fault)) if isinstance(fault, str) else (lambda: os.kill(worker, fault))
    error, began = in_motion(arm, host, fail)
    assert re.search(message, error)
    eventually(lambda: not status(host)["moving"])
    time.sleep(2 / WATCHDOG_RATE)
    stood = status(host)
    assert (stood["runtime"], stood["uploads"]) == (ur_controller.STOPPED, uploads)
    assert stood["pose"][1] - began < 0.05 * (STATE_TIMEOUT + 1.0)  # m: noticed within a second of the timeout
    refuse(DeviceError, [(arm.move, (BEGIN,), "")])
    ask(host, "resume")
    arm.connect()
    assert not arm.state(STATE_TIMEOUT).moving  # and nothing is sent again
    assert status(host)["watchdog"] == 1 / WATCHDOG_RATE
    arm.go(BEGIN, 0.2)


@pytest.mark.parametrize(
    "forged",
    [
        "actual_TCP_force nan", "actual_TCP_force inf", "actual_TCP_force 1e6",
        "actual_TCP_pose nan", "actual_TCP_pose inf", "actual_TCP_pose 9", "actual_TCP_pose 0.4 0 0.3 0 0 nan",
        "actual_TCP_speed nan", "actual_q nan",
        "timestamp nan", "timestamp inf", "timestamp -1", "timestamp 1",
        "target_speed_fraction nan", "target_speed_fraction inf",
    ],
)  # fmt: skip
@pytest.mark.parametrize("guarded", [False, True], ids=["go", "approach"])
def test_an_impossible_state_stops_the_arm(above, forged, guarded):
    """The states are NaN, infinite, frozen and absurd values of every number on which a motion depends."""
    host, arm = above
    message = ""
    ask(host, "plane 0 0")
    try:
        with amid(host, 0.018, lambda: ask(host, f"forge {forged}")) as began:
            ended = arm.approach(0.15, SPEED, force=8.0).reason if guarded else arm.go(pose(0.4, 0.25, 0.3), SPEED)
            assert ended == "force"
    except DeviceError as error:
        message = str(error)
    finally:
        ask(host, "forge")
        ask(host, f"plane {PLANE} {STIFFNESS}")
    assert message.count(". ") == 0  # one sentence
    eventually(lambda: not status(host)["moving"])
    assert status(host)["stood"] - began[0]["clock"] < STATE_TIMEOUT + 1.0  # s: noticed within a second of the timeout


def test_a_killed_controller_is_noticed(start):
    host = start()
    with connected(host) as arm:
        # Whichever comes first: news that does not come, or the client library that meets the end of its stream.
        assert re.search(BROKEN, in_motion(arm, host, start.newest.kill)[0])
        refuse(DeviceTimeoutError, [(arm.state, (), "")])
        refuse(DeviceError, [(arm.connect, (), "does not answer")])


@pytest.mark.parametrize("fault", ["stall", "stall-control"])
def test_a_controller_without_states_is_disconnected_even_at_rest(start, fault):
    """No state is requested and no motion is under way; the program on the controller still ends."""
    host = start()
    with connected(host) as arm:
        arm.state(STATE_TIMEOUT)
        assert status(host)["runtime"] == ur_controller.PLAYING
        ask(host, fault)
        eventually(lambda: status(host)["runtime"] == ur_controller.STOPPED)
        with pytest.raises(DeviceTimeoutError, match=f"{NO_NEWS}|silent"):
            arm.state(STATE_TIMEOUT)


def test_a_protective_stop_is_noticed_and_released_by_a_person(start):
    host = start()
    with connected(host) as arm:
        assert "protective" in in_motion(arm, host, lambda: ask(host, "protective"))[0]
        assert not arm.state(STATE_TIMEOUT).safe
        refuse(DeviceError, [(arm.move, (BEGIN,), "protective"), (arm.connect, (), "protective stop")])
        access.ask_dashboard(host, "unlock protective stop")
        arm.connect()
        arm.go(BEGIN, 0.2)


def test_a_pendant_with_another_tool_is_refused_and_connecting_again_leaves_no_descriptors_open(start):
    host = start()
    ask(host, "tcp 0 0 0.15 0 0 0")
    arm = connected(host, tool=pose(0, 0, 0.1, 0))
    refuse(DeviceError, [(arm.connect, (), "the TCP on the pendant is 50 mm and 0 degrees from the rig's")])
    ask(host, "tcp 0 0 0.101 0 0 0")
    arm.connect()
    assert not arm.state(STATE_TIMEOUT).moving
    before = os.listdir("/proc/self/fd")
    for _ in range(2):
        arm.connect()
    assert len(os.listdir("/proc/self/fd")) <= len(before)
    arm.close()


def test_control_is_refused_in_local_mode_to_a_second_client_and_by_a_mute_port(start, monkeypatch):
    host = start()
    arm = connected(host)
    ask(host, "local")
    refuse(DeviceError, [(arm.connect, (), "local mode")])
    ask(host, "remote")
    with arm:
        refuse(DeviceError, [(connected(host).connect, (), f"in use by process {os.getpid()}")])
        assert not arm.state(STATE_TIMEOUT).moving  # the first is not disturbed
        monkeypatch.setattr(driver, "take_lock", lambda host: io.StringIO())  # on another computer it is not seen
        refuse(DeviceError, [(connected(host).connect, (), "A program runs on the controller")])
    ask(host, "mute")
    refuse(DeviceError, [(arm.connect, (), "does not answer")])


VICTIM = f"""
import sys, time
from i2t.hardware.motion_limits import MotionLimits
from i2t.hardware.ur.driver import UrArm
from i2t.hardware.poses import pose_from_vector
assert "jax" not in sys.modules
with UrArm(sys.argv[1], {LIMITS!r}, state_timeout=2.0, watchdog_rate={WATCHDOG_RATE}) as arm:
    arm.move(pose_from_vector([0.4, 0.25, 0.3, {np.pi}, 0, 0]), 0.05)
    print("moving", flush=True)
    while arm.state(2.0).moving:
        time.sleep(0.01)
"""


@pytest.mark.parametrize(
    ("number", "codes", "later"),
    [
        (signal.SIGINT, (-2, 130), None),
        (signal.SIGKILL, (-9,), None),
        # An impatient person presses it again, while the arm brakes or its program is being ended.
        (signal.SIGINT, (-2, 130), 0.0),
        pytest.param(signal.SIGINT, (-2, 130), 0.02, marks=pytest.mark.full),
        pytest.param(signal.SIGTERM, (143,), None, marks=pytest.mark.full),
        pytest.param(signal.SIGHUP, (129,), None, marks=pytest.mark.full),
    ],
)
def test_the_arm_stands_when_its_process_is_ended(start, number, codes, later):
    host = start()
    with subprocess.Popen(
        [sys.executable, "-c", VICTIM, host], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as child:
        assert b"moving" in child.stdout.readline() or b"moving" in child.stdout.read(100)
        time.sleep(0.2)
        assert status(host)["moving"]
        child.send_signal(number)
        if later is not None:
            time.sleep(later)
            child.send_signal(number)
        child.wait(20)
    assert child.returncode in codes
    eventually(lambda: not status(host)["moving"])
    stood = status(host)
    assert 0 < stood["pose"][1] < 0.2
    assert stood["runtime"] == ur_controller.STOPPED
    if number == signal.SIGKILL:  # the watchdog's time, then braking from 0.05 m/s at 5 m/s^2, each to a tick
        assert stood["stood"] - stood["heard"] <= 1 / WATCHDOG_RATE + 0.05 / 5.0 + 3 * TICK
