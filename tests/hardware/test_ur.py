"""The UR driver and the real client library against the emulated controller, each in a process of its own.

Times are judged on the controller's clock where they can be, so that a slow machine does not matter; what is asked of
this machine's clock has seconds to spare.
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
from typing import ClassVar

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from i2t import geometry
from i2t.emulators import robot_motion, rtde_protocol, ur_controller, ur_server
from i2t.emulators.ur_controller import TICK, ask
from i2t.errors import DeviceError, DeviceTimeoutError, MotionStoppedError, NotConnectedError
from i2t.hardware.limits import MotionLimits
from i2t.hardware.protocols import Arm
from i2t.hardware.ur import access, driver, rtde_worker
from i2t.hardware.ur.driver import UrArm
from i2t.hardware.ur.poses import from_ur, to_ur
from i2t.hardware.ur.rtde_worker import BRAKE_MPS2

LIMITS = MotionLimits((0.2, -0.3, 0.1), (0.6, 0.3, 0.5), approach_distance=0.3)
STATE_TIMEOUT, WATCHDOG_RATE = 0.5, 4.0  # s, Hz: a machine that is busy with other tests is not a fault
numbers = itertools.count()


def pose(x, y, z, rx=np.pi, ry=0.0, rz=0.0):
    return from_ur([x, y, z, rx, ry, rz])


def status(host):
    return json.loads(ask(host, "status"))


def eventually(condition, seconds=10.0):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


@contextlib.contextmanager
def emulators():
    """Start emulated controllers that end with the block; what is yielded starts one and returns its address."""
    pytest.importorskip("rtde_control", reason="ur_rtde is not installed (there are wheels for Python 3.10 to 3.12)")
    if sys.platform != "linux":
        pytest.skip("needs the addresses 127.x.y.z, which only Linux gives without asking")
    running = {}

    def begin(*options):
        host = ur_controller.loopback(next(numbers))
        running[host] = stack.enter_context(ur_controller.process(host, *options))
        return host

    begin.kill = lambda host: running[host].kill()
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


@given(st.lists(st.tuples(st.sampled_from(list(b"VUOS")), st.binary(max_size=40)), max_size=6), st.data())
@settings(max_examples=50, deadline=None)
def test_packets_survive_any_cut(packets, data):
    stream = b"".join(rtde_protocol.packet(kind, body) for kind, body in packets)
    cut = data.draw(st.integers(0, len(stream)))
    first, rest = rtde_protocol.split(stream[:cut])
    second, rest = rtde_protocol.split(rest + stream[cut:])
    assert first + second == packets
    assert rest == b""


def test_values_come_back_and_hostile_bytes_are_refused():
    wanted = rtde_protocol.recipe(
        "input_int_register_0,input_double_register_1,external_force_torque,", rtde_protocol.INPUT_TYPES
    )
    values = [-7, 0.25, (1.0, 2.0, 3.0, 4.0, 5.0, 6.0)]
    ((kind, body),), _ = rtde_protocol.split(rtde_protocol.encode(3, wanted.layout, values))
    assert kind == rtde_protocol.DATA
    assert rtde_protocol.decode(body, {3: wanted}) == dict(zip(wanted.names, values, strict=True))
    assert not rtde_protocol.recipe("actual_joy", rtde_protocol.OUTPUT_TYPES).known
    for bad in (b"", b"\x04", body[:-1], body + b"\0"):
        with pytest.raises(ValueError, match="data packet"):
            rtde_protocol.decode(bad, {3: wanted})
    with pytest.raises(ValueError, match="bytes long"):
        rtde_protocol.split(b"\x00\x01U")


def test_rotations_agree_with_scipy():
    vectors = np.random.default_rng(0).normal(size=(200, 3))
    vectors *= (np.linspace(0, np.pi, 200) / np.linalg.norm(vectors, axis=1))[:, None]  # none to a half turn
    for vector in vectors:
        matrix = geometry.so3_exp(vector)
        np.testing.assert_allclose(matrix, Rotation.from_rotvec(vector).as_matrix(), atol=1e-14)
        # At half a turn both signs are the same rotation.
        np.testing.assert_allclose(geometry.so3_exp(geometry.so3_log(matrix)), matrix, atol=1e-12)
        np.testing.assert_allclose(from_ur(to_ur(from_ur([0, 0, 0, *vector])))[:3, :3], matrix, atol=1e-12)


@pytest.mark.parametrize(("length", "speed", "a"), [(0.1, 0.1, 0.5), (0.05, 0.02, 0.2)])
def test_a_line_takes_the_time_of_a_trapezoid_and_a_stop_its_distance(length, speed, a):
    robot = robot_motion.Robot(np.zeros(6), robot_motion.plane(0.0, 0.0), np.zeros(6), 0.0)
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


def test_a_motion_waits_until_it_is_known_what_lies_ahead():
    class Contact:
        busy = True

        def __call__(self, position, turned):
            return np.zeros(6)

    robot = robot_motion.Robot(np.zeros(6), Contact(), np.zeros(6), 0.0)
    controller = ur_controller.Controller(robot, 5.0, 150.0)
    robot.line_to(np.array([0.1, 0, 0, 0, 0, 0]), 0.1, 0.5)
    for _ in range(5):
        controller.step()
    assert robot.position[0] == 0
    assert controller.clock == pytest.approx(5 * TICK)
    Contact.busy = False
    controller.step()
    assert robot.position[0] > 0


def test_limits_and_an_arm_say_what_they_are_before_connecting():
    pytest.importorskip("rtde_control", reason="ur_rtde is not installed (there are wheels for Python 3.10 to 3.12)")
    with pytest.raises(ValueError, match="must lie below"):
        MotionLimits((0.0, 0.0, 0.0), (1.0, 0.0, 1.0))
    with pytest.raises(ValueError, match="speed is 0; give m/s"):
        MotionLimits((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), speed=0.0)
    arm = connected("127.0.0.1")
    assert isinstance(arm, Arm)
    assert arm.features.source == "emulated"
    assert UrArm("192.0.2.1", LIMITS).features.source == "real"
    np.testing.assert_array_equal(arm.features.box, [LIMITS.lower, LIMITS.upper])
    with pytest.raises(NotConnectedError):
        arm.state()
    arm.close()
    with pytest.raises(DeviceError, match="does not answer"):
        arm.connect()


@pytest.mark.parametrize("option", [{"watchdog_rate": 0.01}, {"watchdog_rate": 200.0}, {"state_timeout": 60.0}])
def test_timeouts_that_protect_nobody_are_refused(option):
    with pytest.raises(ValueError, match="is outside"):
        connected("127.0.0.1", **option)


# The lock


def test_the_lock_is_in_the_users_own_folder(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    with access.take_lock("192.0.2.1"):
        (file,) = (tmp_path / "i2t").iterdir()
        assert file.read_text() == str(os.getpid())
        with pytest.raises(DeviceError, match=f"in use by process {os.getpid()}"):
            access.take_lock("192.0.2.1")
    access.take_lock("192.0.2.1").close()
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert access.lock_folder() == tmp_path / ".cache" / "i2t"


def test_the_lock_does_not_follow_a_symbolic_link(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    target = tmp_path / "precious"
    target.write_text("what nobody may truncate")
    (tmp_path / "i2t").mkdir()
    (tmp_path / "i2t" / "ur-192.0.2.1.lock").symlink_to(target)
    with pytest.raises(DeviceError, match="cannot be opened"):
        access.take_lock("192.0.2.1")
    assert target.read_text() == "what nobody may truncate"


def test_where_there_are_no_locks_the_arm_is_refused(monkeypatch):
    monkeypatch.setitem(sys.modules, "fcntl", None)
    with pytest.raises(DeviceError, match="Linux or macOS"):
        access.take_lock("192.0.2.1")


# The process of the client library


class Library:
    """The part of ur_rtde that a motion needs, without a controller."""

    sent: ClassVar[list[str]] = []

    def __getattr__(self, name):
        values = {
            "getTimestamp": 1.0, "getSafetyStatusBits": 1, "getRuntimeState": rtde_worker.PLAYING, "operationId": 0,
            "isAsyncOperationRunning": False, "getTargetSpeedFraction": 1.0, "isConnected": True,
        }  # fmt: skip
        if name == "getAsyncOperationProgressEx":
            return lambda: self
        if name in ("moveL", "kickWatchdog", "setWatchdog"):
            return lambda *_: self.sent.append(name) or True
        return lambda *_: values.get(name, [0.0] * 6)


def test_a_motion_is_made_under_a_fed_watchdog_only():
    ours, theirs = (rtde_worker.Channel(end) for end in socket.socketpair())
    library = Library()
    library.sent.clear()
    worker = rtde_worker.Worker(theirs, library, library, watchdog_rate=10.0)
    worker.observe()
    motion = {"motion": 1, "pose": [0.0] * 6, "speed": 0.1, "acceleration": 0.1, "force": 1.0, "torque": 1.0}
    heartbeat, move = {"heartbeat": True}, {"command": "move", "id": 1, "arguments": motion}

    def error(*messages):
        worker.process(list(messages))
        return [message["error"] for message in ours.receive(1.0) if "answer" in message][-1]

    assert error(move) == "its watchdog is not being fed"
    assert error(heartbeat, move) == "its watchdog is not being fed"  # nor set
    assert error({"command": "set_watchdog", "id": 2, "arguments": {}}) is None
    time.sleep(2 / worker.watchdog_rate)
    assert error(move) == "its watchdog is not being fed"
    assert "moveL" not in library.sent
    assert error(heartbeat, move) is None
    assert library.sent == ["kickWatchdog", "setWatchdog", "kickWatchdog", "moveL"]
    ours.close()
    theirs.close()


def test_the_process_keeps_its_connections_and_can_make_no_other():
    code = (
        "import socket; from i2t.hardware.ur import rtde_worker as worker\n"
        "one, other = (worker.Channel(end) for end in socket.socketpair())\n"
        "worker.forbid_new_connections()\n"
        "one.send({'ready': True})\n"
        "assert other.receive(1.0) == [{'ready': True}]\n"
        "try: socket.socket()\n"
        "except OSError: print('none')\n"
    )
    assert subprocess.run([sys.executable, "-c", code], check=True, capture_output=True).stdout == b"none\n"


# Motion

STIFFNESS, PLANE, SPEED = 5000.0, 0.295, 0.02  # N/m, m, m/s: what an approach meets


@pytest.fixture(scope="module")
def touching():
    """Address of an emulated controller whose tool stands 5 mm above a plane, and its connected arm."""
    with emulators() as begin:
        host = begin("--plane", str(PLANE), "--stiffness", str(STIFFNESS))
        with connected(host) as arm:
            yield host, arm


@pytest.fixture
def above(touching):
    """The same, with the tool back where it began."""
    host, arm = touching
    ask(host, "wrench 0 0 0 0 0 0")
    arm.go(pose(0.4, 0.0, 0.3), 0.1)
    return host, arm


def test_a_motion_ends_at_its_goal_no_faster_than_asked(start):
    host = start("--bias", "0.5", "-1", "2")
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
        np.testing.assert_allclose(from_ur(after["pose"]), goal, atol=1e-6)
        assert 0.09 < after["fastest"] <= 0.1 * (1 + 1e-9)
    assert status(host)["runtime"] == ur_controller.STOPPED
    arm.close()


def test_a_motion_returns_at_once_and_is_replaced_by_the_next(above):
    _, arm = above
    sent = arm.move(pose(0.42, 0.0, 0.3), 0.2)
    assert arm.state(STATE_TIMEOUT).moving
    np.testing.assert_allclose(sent, pose(0.42, 0.0, 0.3), atol=1e-12)
    arm.move(pose(0.42, 0.04, 0.3), 0.2)
    eventually(lambda: not arm.state(STATE_TIMEOUT).moving)
    np.testing.assert_allclose(arm.state(STATE_TIMEOUT).T_b_t[:3, 3], [0.42, 0.04, 0.3], atol=1e-6)


@pytest.mark.parametrize(
    ("goal", "options", "why"),
    [
        (pose(0.4, 0.0, 0.05), {}, "outside the box"),
        (pose(0.7, 0.0, 0.3), {}, "outside the box"),
        (pose(np.nan, 0.0, 0.3), {}, "finite"),
        (pose(0.4, 0.0, 0.3) * [[-1], [1], [1], [1]], {}, "rotation"),
        (pose(0.4, 0.0, 0.3), {"speed": 0.3}, "speed"),
        (pose(0.4, 0.0, 0.3), {"speed": 0.1, "acceleration": 2.0}, "acceleration"),
    ],
    ids=["low", "far", "nan", "mirrored", "fast", "jerky"],
)
def test_a_motion_beyond_the_limits_is_refused_before_anything_is_sent(touching, goal, options, why):
    host, arm = touching
    commands = status(host)["commands"]
    for ask_for in (arm.go, arm.move):
        with pytest.raises(ValueError, match=why):
            ask_for(goal, **options)
    assert status(host)["commands"] == commands


def test_an_approach_beyond_the_limits_is_refused_before_anything_is_sent(above):
    host, arm = above
    commands = status(host)["commands"]
    with pytest.raises(ValueError, match="outside the box"):
        arm.approach(0.25)
    with pytest.raises(ValueError, match="limit for the approach distance"):
        arm.approach(0.31)
    with pytest.raises(ValueError, match=r"force 50\.0 is outside"):
        arm.approach(0.01, force=50.0)
    assert status(host)["commands"] == commands


def test_the_slider_is_respected(start):
    host = start("--after", "0", "speed 0.5")
    with connected(host) as arm:
        arm.go(pose(0.4, 0.03, 0.3), 0.2)
        assert 0.09 < status(host)["fastest"] <= 0.1 * (1 + 1e-9)


def test_an_approach_ends_on_force(above):
    _, arm = above
    done = arm.approach(0.02, SPEED, force=4.0)
    assert done.reason == "force"
    reached = STIFFNESS * (PLANE - done.state.T_b_t[2, 3])
    assert np.linalg.norm(done.trigger.wrench[:3]) > 4.0
    assert done.trigger.wrench[2] < 0  # pushes the tool back
    np.testing.assert_allclose(done.state.wrench[2], -reached, atol=1e-9)
    # What was felt before the trigger is below the limit; after it the arm goes on for at most what news (8 ms), a
    # look (10 ms) and a command (two handshakes) take, and brakes. A busy machine adds to it: 20 ms in 100.
    assert 4.0 < reached < 4.0 + STIFFNESS * (SPEED * 0.12 + SPEED**2 / (2 * BRAKE_MPS2))


def test_a_motion_that_meets_something_is_stopped_and_may_back_out(above):
    _, arm = above
    with pytest.raises(DeviceError, match="met something on its way"):
        arm.go(pose(0.4, 0, 0.28), 0.05)  # 30 N at 289 mm
    assert LIMITS.trip_force < np.linalg.norm(arm.state(STATE_TIMEOUT).wrench[:3]) < LIMITS.force
    arm.go(pose(0.4, 0.0, 0.3), 0.1)


def test_an_approach_ends_on_its_stop_condition(above):
    _, arm = above
    done = arm.approach(0.02, SPEED, stop_condition=lambda state: state.T_b_t[2, 3] < 0.298 and "skin")
    assert (done.reason, done.answer) == ("condition", "skin")
    assert 0.002 <= done.distance < 0.005


def test_an_approach_ends_on_torque(above):
    host, arm = above

    def push(state):
        if state.T_b_t[2, 3] < 0.2995:
            ask(host, "wrench 0 0 0 0 6 0")

    done = arm.approach(0.02, 0.002, push, torque=5.0)
    assert done.reason == "torque"
    np.testing.assert_allclose(done.state.wrench[3:], [0, -6, 0], atol=1e-9)  # tool axes


def test_an_approach_ends_at_its_distance(above):
    _, arm = above
    done = arm.approach(0.003, SPEED)
    assert (done.reason, done.answer) == ("distance", None)
    assert done.distance == pytest.approx(0.003, abs=1e-6)


def test_an_approach_that_nobody_watches_is_stopped(above):
    host, arm = above

    def hang(state):
        time.sleep(3 * STATE_TIMEOUT)

    with pytest.raises(DeviceError, match="Nobody watched"):
        arm.approach(0.02, 0.002, hang)
    assert not status(host)["moving"]


def test_an_approach_whose_stop_condition_fails_is_stopped(above):
    host, arm = above

    def fail(state):
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        arm.approach(0.02, 0.002, fail)
    assert not status(host)["moving"]


@pytest.mark.full
def test_commands_reach_the_emulator_late(start):
    late = 0.15
    host = start("--latency", str(late))
    with connected(host) as arm:
        begun = status(host)["clock"]
        arm.move(pose(0.4, 0.01, 0.3), 0.05)  # returns once the program has taken it
        eventually(lambda: arm.state(STATE_TIMEOUT).moving)
        assert status(host)["clock"] - begun >= late


def test_stop_from_another_thread(start):
    host = start()
    with connected(host) as arm:
        stopped = []
        thread = threading.Timer(0.2, lambda: stopped.append((arm.stop(5.0), status(host))))
        thread.start()
        with pytest.raises(MotionStoppedError, match="by request"):
            arm.go(pose(0.4, 0.25, 0.3), 0.05)
        thread.join()
        assert not stopped[0][1]["moving"]
        assert 0 < stopped[0][1]["pose"][1] < 0.2
        arm.stop()  # at rest it changes nothing
        arm.go(pose(0.4, 0.0, 0.3), 0.2)  # and the arm can be used again


@pytest.mark.full
def test_the_client_alone_touches_and_pushes(start):
    from rtde_control import RTDEControlInterface

    host = start("--plane", "0.298", "--stiffness", "5000")
    control = RTDEControlInterface(host)
    assert control.moveUntilContact([0, 0, -0.02, 0, 0, 0], [0] * 6, 0.5)
    # Back to the last tick before the contact.
    assert 0.298 <= status(host)["pose"][2] < 0.298 + 0.02 * TICK + 1e-9
    assert control.forceMode([0.0] * 6, [0, 0, 1, 0, 0, 0], [0, 0, -4.0, 0, 0, 0], 2, [0.05] * 6)
    eventually(lambda: status(host)["force"][2] == pytest.approx(4.0, abs=1e-3))
    assert control.forceModeStop()
    control.stopScript()
    control.disconnect()


# Faults


def in_motion(arm, host, fault):
    """Do something in the middle of a motion; the error that ends it, and how long that took (s)."""
    began = []

    def act():
        eventually(lambda: np.linalg.norm(status(host)["twist"]) > 0.04)
        began.append(time.monotonic())
        fault()

    thread = threading.Thread(target=act)
    thread.start()
    with pytest.raises(DeviceError) as caught:
        arm.go(pose(0.4, 0.25, 0.3), 0.05)
    seconds = time.monotonic() - began[0]
    thread.join()
    assert str(caught.value).count(". ") == 0  # one sentence
    return caught.value, seconds


def test_a_killed_controller_is_noticed(start):
    host = start()
    with connected(host) as arm:
        error, seconds = in_motion(arm, host, lambda: start.kill(host))
        assert isinstance(error, DeviceTimeoutError)
        # Whichever comes first: news that does not come, or the client library that meets the end of its stream.
        assert re.search("No news from the controller|The connection to the controller .* broke", str(error))
        assert seconds < STATE_TIMEOUT + 1.0
        with pytest.raises(DeviceTimeoutError):
            arm.state()
        with pytest.raises(DeviceError, match="does not answer"):
            arm.connect()


@pytest.mark.full
def test_a_stalled_stream_is_noticed_and_the_controller_stops_by_itself(start):
    host = start()
    with connected(host) as arm:
        error, seconds = in_motion(arm, host, lambda: ask(host, "stall"))
        assert isinstance(error, DeviceTimeoutError)
        assert seconds < STATE_TIMEOUT + 1.0
        eventually(lambda: not status(host)["moving"])
        stood = status(host)
        assert stood["runtime"] == ur_controller.STOPPED
        assert stood["pose"][1] < 0.2
        ask(host, "resume")
        arm.connect()
        arm.go(pose(0.4, 0.0, 0.3), 0.2)


def test_a_controller_that_sends_no_states_is_fed_no_longer(start):
    """With the arm at rest and nobody asking, the watchdog alone ends the program."""
    host = start()
    with connected(host) as arm:
        arm.state(STATE_TIMEOUT)
        assert status(host)["runtime"] == ur_controller.PLAYING
        ask(host, "stall")
        eventually(lambda: status(host)["runtime"] == ur_controller.STOPPED)
        said = status(host)
        assert said["clock"] - said["heard"] >= 1 / WATCHDOG_RATE


@pytest.mark.parametrize("connection", ["control", "state"])
def test_a_connection_lost_alone_is_never_made_again_by_itself(start, connection):
    host = start()
    with connected(host) as arm:
        error, seconds = in_motion(arm, host, lambda: ask(host, f"drop-{connection}"))
        assert isinstance(error, DeviceTimeoutError)
        assert re.search("The connection to the controller .* broke|No news from the controller", str(error))
        assert seconds < STATE_TIMEOUT + 1.0
        eventually(lambda: not status(host)["moving"])
        time.sleep(2 / WATCHDOG_RATE)
        stood = status(host)
        assert (stood["runtime"], stood["uploads"]) == (ur_controller.STOPPED, 1)
        with pytest.raises(DeviceTimeoutError):
            arm.move(pose(0.4, 0.0, 0.3))
        arm.connect()
        assert status(host)["watchdog"] == 1 / WATCHDOG_RATE
        arm.go(pose(0.4, 0.0, 0.3), 0.2)


@pytest.mark.parametrize("number", [signal.SIGSEGV, signal.SIGKILL, signal.SIGSTOP], ids=lambda number: number.name)
def test_a_client_library_that_crashes_or_hangs_stops_the_arm_and_nothing_else(start, number):
    host = start()
    with connected(host) as arm:
        worker = arm.connection._process.pid
        error, seconds = in_motion(arm, host, lambda: os.kill(worker, number))
        assert isinstance(error, DeviceTimeoutError)
        assert ("No news" if number == signal.SIGSTOP else number.name) in str(error)
        assert seconds < STATE_TIMEOUT + 1.0
        eventually(lambda: not status(host)["moving"])
        assert status(host)["runtime"] == ur_controller.STOPPED
        arm.connect()
        assert not arm.state(STATE_TIMEOUT).moving


def test_a_lost_program_is_noticed(start):
    host = start()
    with connected(host) as arm:
        error, seconds = in_motion(arm, host, lambda: ask(host, "kill-program"))
        assert "program on the controller" in str(error)
        assert seconds < 1.0
        arm.connect()
        assert not arm.state(STATE_TIMEOUT).moving  # and nothing is sent again
        arm.go(pose(0.4, 0.0, 0.3), 0.2)


def test_a_protective_stop_is_noticed_and_released_by_a_person(start):
    delay = 3.0
    host = start("--unlock-delay", str(delay))
    with connected(host) as arm:
        error, seconds = in_motion(arm, host, lambda: ask(host, "protective"))
        assert "protective" in str(error)
        assert seconds < 1.0
        assert not arm.state(STATE_TIMEOUT).safe
        with pytest.raises(DeviceError, match="protective"):
            arm.move(pose(0.4, 0.0, 0.3))
        with pytest.raises(DeviceError, match="protective stop"):
            arm.connect()
        with pytest.raises(DeviceError, match="cannot be released"):
            arm.recover()
        time.sleep(delay)
        arm.recover()
        arm.go(pose(0.4, 0.0, 0.3), 0.2)


def test_connecting_again_leaves_no_descriptors_open(start):
    host = start()
    arm = connected(host)
    arm.connect()
    before = os.listdir("/proc/self/fd")
    for _ in range(2):
        arm.connect()
    assert len(os.listdir("/proc/self/fd")) <= len(before)
    arm.close()


@pytest.mark.full
def test_a_pendant_with_another_tool_is_refused(start):
    host = start()
    ask(host, "tcp 0 0 0.15 0 0 0")
    refused = pytest.raises(DeviceError, match="the TCP on the pendant is 50 mm and 0 degrees from the rig's")
    with refused, connected(host, tool=pose(0, 0, 0.1, 0)):
        pass
    ask(host, "tcp 0 0 0.101 0 0 0")
    with connected(host, tool=pose(0, 0, 0.1, 0)) as arm:
        assert not arm.state(STATE_TIMEOUT).moving


def test_control_is_refused_in_local_mode_to_a_second_client_and_by_a_mute_port(start, monkeypatch):
    host = start()
    arm = connected(host)
    ask(host, "local")
    with pytest.raises(DeviceError, match="local mode"):
        arm.connect()
    ask(host, "remote")
    with arm:
        second = connected(host)
        with pytest.raises(DeviceError, match=f"in use by process {os.getpid()}"):
            second.connect()
        second.close()
        assert not arm.state(STATE_TIMEOUT).moving  # the first is not disturbed
        another = connected(host)
        monkeypatch.setattr(driver, "take_lock", lambda host: io.StringIO())  # on another computer it is not seen
        with pytest.raises(DeviceError, match="A program runs on the controller"):
            another.connect()
    ask(host, "mute")
    with pytest.raises(DeviceError, match="does not answer"):
        arm.connect()


VICTIM = f"""
import sys, time
from i2t.hardware.limits import MotionLimits
from i2t.hardware.ur.driver import UrArm
from i2t.hardware.ur.poses import from_ur
assert "jax" not in sys.modules
with UrArm(sys.argv[1], {LIMITS!r}, state_timeout=2.0, watchdog_rate={WATCHDOG_RATE}) as arm:
    arm.move(from_ur([0.4, 0.25, 0.3, {np.pi}, 0, 0]), 0.05)
    print("moving", flush=True)
    while arm.state(2.0).moving:
        time.sleep(0.01)
"""


@pytest.mark.parametrize(
    "number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGKILL], ids=lambda number: number.name
)
def test_the_arm_stands_when_its_process_is_ended(start, number):
    host = start()
    with subprocess.Popen(
        [sys.executable, "-c", VICTIM, host], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as child:
        assert b"moving" in child.stdout.readline() or b"moving" in child.stdout.read(100)
        time.sleep(0.2)
        assert status(host)["moving"]
        child.send_signal(number)
        child.wait(20)
    assert (
        child.returncode
        in {signal.SIGINT: (-2, 130), signal.SIGTERM: (143,), signal.SIGHUP: (129,), signal.SIGKILL: (-9,)}[number]
    )
    eventually(lambda: not status(host)["moving"])
    stood = status(host)
    assert 0 < stood["pose"][1] < 0.2
    assert stood["runtime"] == ur_controller.STOPPED
    if number == signal.SIGKILL:  # the watchdog's time, then braking from 0.05 m/s at 5 m/s^2, each to a tick
        assert stood["stood"] - stood["heard"] <= 1 / WATCHDOG_RATE + 0.05 / 5.0 + 3 * TICK


@pytest.mark.parametrize("later", [0.0, 0.02, 0.2])
def test_a_second_ctrl_c_keeps_the_arm_from_nothing(start, later):
    """An impatient person presses it again, while the arm brakes or its program is being ended."""
    host = start()
    with subprocess.Popen(
        [sys.executable, "-c", VICTIM, host], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as child:
        assert b"moving" in child.stdout.readline() or b"moving" in child.stdout.read(100)
        child.send_signal(signal.SIGINT)
        time.sleep(later)
        child.send_signal(signal.SIGINT)
        child.wait(20)
    assert child.returncode in (-2, 130)
    eventually(lambda: not status(host)["moving"])
    stood = status(host)
    assert stood["runtime"] == ur_controller.STOPPED
    time.sleep(0.3)
    assert status(host)["pose"] == stood["pose"]


def test_the_emulator_survives_hostile_clients(start):
    host = start()
    random = np.random.default_rng(0)
    for port in (ur_server.RTDE_PORT, ur_server.DASHBOARD_PORT, ur_server.SCRIPT_PORT, ur_server.FAULT_PORT):
        for body in (b"", b"\0", random.bytes(60), b"\n".join(random.bytes(9) for _ in range(5)), b"\xff\n"):
            for kind in b"VvOISPUM?":
                with socket.create_connection((host, port), 5.0) as client:
                    client.sendall(rtde_protocol.packet(kind, body) if port == ur_server.RTDE_PORT else body)
    with connected(host) as arm:
        arm.go(pose(0.4, 0.01, 0.3), 0.2)


@pytest.mark.full
def test_an_emulator_that_cannot_start_says_so(start):
    host = start()
    with socket.socket() as taken:
        taken.bind((host, 0))
    with pytest.raises(RuntimeError, match="did not start"), ur_controller.process(host):
        pass
