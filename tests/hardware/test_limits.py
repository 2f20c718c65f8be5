"""The table of safety limits: complete and sound, with defaults within their ranges, and each limit tried."""

import re
import signal
import subprocess
import sys
import time
from concurrent.futures import Future
from dataclasses import fields, replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from helpers.closed_form import HEIGHT, make

from i2t.errors import DeviceError
from i2t.hardware.contract import refuse
from i2t.hardware.limits import SAFETY, SafetyLimits, range_of
from i2t.hardware.motion_limits import MotionLimits
from i2t.hardware.poses import pose_from_vector, translated_along_z
from i2t.hardware.rig import Rig
from i2t.hardware.rig_checks import compare_tool
from i2t.hardware.touch_off import fit_plane
from i2t.hardware.ur import rtde_worker
from i2t.hardware.ur.rtde_link import ControllerState, RtdeConnection

ROOT = Path(__file__).parents[2]
STIFFNESS = 10e3  # N/m, of the plane
WORKER_LIMITS = RtdeConnection("192.0.2.1", SAFETY.state_timeout_s, SAFETY.watchdog_rate_hz).worker_limits


def test_each_limit_is_positive_and_has_a_unit_a_purpose_and_a_test():
    for limit in fields(SafetyLimits):
        values = np.atleast_1d(getattr(SAFETY, limit.name))
        assert np.isfinite(values).all()
        assert values[-1] > 0
        assert len(values) == 1 or values[0] < values[1]
        assert limit.metadata["unit"]
        assert limit.metadata["protects"].split()[0] in {
            "refuses", "stops", "reports", "ends", "is", "ignores", "converts", "lets",
        }  # fmt: skip
        file, test = limit.metadata["tried"].split("::")
        assert re.search(rf"^def {test}\(", (ROOT / file).read_text(), re.M), f"{limit.name}: no test {test} in {file}"


def test_the_defaults_are_within_their_ranges_and_nan_is_not():
    rig = Rig()
    for name in ("speed", "acceleration", "force", "torque", "approach_distance", "stiffness"):
        low, high, _ = range_of(name)
        assert low <= getattr(rig.limits, name) <= high
        refuse(ValueError, [(lambda name=name: MotionLimits((0, 0, 0), (1, 1, 1), **{name: np.nan}), (), name)])
    for name, value in (("state_timeout", SAFETY.state_timeout_s), ("watchdog_rate", SAFETY.watchdog_rate_hz)):
        low, high, _ = range_of(name)
        assert low <= value <= high


def turned(degrees, z=0.0):
    """A pose turned about x and shifted along z."""
    return pose_from_vector([0.0, 0.0, z, np.radians(degrees), 0.0, 0.0])


# What a rig may ask for


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda x: {"mass": SAFETY.mass_range[1] * x}, "tool.mass is"),
        (lambda x: {"looking_distance": SAFETY.looking_distance_range[0] / x}, "looking_distance is"),
        (lambda x: {"looking_distance": SAFETY.looking_distance_range[1] * x}, "looking_distance is"),
        (lambda x: {"T_flange_tool": turned(0, SAFETY.max_tool_offset_m * x)}, "T_flange_tool"),
        (lambda x: {"T_tool_camera": turned(0, -SAFETY.max_tool_offset_m * x)}, "T_tool_camera"),
        (lambda x: {"centre": (0.0, 0.0, SAFETY.max_tool_offset_m * x)}, "tool.centre is"),
        (lambda x: {"T_tool_camera": turned(SAFETY.max_camera_tilt_deg * x, -0.1)}, "turns the camera's axis"),
        (lambda x: {"limits": MotionLimits((0, 0, 0), (1, 1, SAFETY.max_reach_m * x))}, "upper is"),
    ],
)
def test_a_rig_just_beyond_a_limit_is_refused(change, message):
    replace(Rig(), **change(0.999))
    with pytest.raises(ValueError, match=message):
        replace(Rig(), **change(1.001))


def test_a_pendant_just_beyond_a_limit_is_refused():
    rig = turned(0, 0.1)
    shift, degrees = SAFETY.max_tcp_shift_m, SAFETY.max_tcp_rotation_deg
    assert not compare_tool(rig, turned(0.99 * degrees, 0.1 + 0.99 * shift))
    assert "5 mm and 0 degrees" in compare_tool(rig, turned(0, 0.1 + 1.01 * shift))
    assert "0 mm and 3 degrees" in compare_tool(rig, turned(1.01 * degrees, 0.1))


def test_a_touch_off_too_far_from_the_rig_is_refused():
    def touches(z=0.0, degrees=0.0):
        return [pose_from_vector([0.0, 0.0, z, np.pi + np.radians(degrees), 0.0, 0.0])] * 4

    max_shift, max_tilt = SAFETY.touch_off_max_shift_m, np.degrees(SAFETY.touch_off_max_tilt_rad)
    fit_plane(touches(0.99 * max_shift, 0.99 * max_tilt), 0.0)
    refuse(ValueError, [(fit_plane, (touches(1.02 * max_shift), 0.0), "5.1 mm and 0.0 degrees")])
    refuse(ValueError, [(fit_plane, (touches(0.0, 1.01 * max_tilt), 0.0), "0.0 mm and 4.0 degrees")])


# Motions, of an arm in virtual time


def test_a_retreat_that_presses_harder_is_stopped():
    arm = make(stiffness=STIFFNESS).arm
    arm.lab.robot.position = np.array([0.4, 0.0, HEIGHT + 1e-3])
    arm.approach(5e-3, 2e-3, force=15.0)
    pressed = arm.state()
    force = np.linalg.norm(pressed.wrench[:3])
    assert force > arm.limits.trip_force
    with pytest.raises(DeviceError, match="met something"):
        arm.go(translated_along_z(pressed.T_b_t, 5e-3), 5e-3)
    limit = SAFETY.max_retreat_growth * force
    assert limit < STIFFNESS * (HEIGHT - arm.state().T_b_t[2, 3]) < limit + 3.0  # N, of a brake 30 ms late
    arm.go(translated_along_z(pressed.T_b_t, -5e-3), 5e-3)  # out of the contact


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (turned(0, 0.99 * SAFETY.goal_tolerance_m), ""),
        (turned(0.99 * np.degrees(SAFETY.goal_tolerance_rad)), ""),
        (turned(0, 1.1 * SAFETY.goal_tolerance_m), r"1\.1 mm and 0\.0 degrees off its goal"),
        (turned(1.1 * np.degrees(SAFETY.goal_tolerance_rad)), r"0\.0 mm and 0\.6 degrees off its goal"),
    ],
)
def test_a_motion_that_ends_off_its_goal_is_reported(error, message):
    arm = make().arm
    driver_method = arm.begin_line
    arm.begin_line = lambda goal, *speeds: driver_method(goal @ error, *speeds)
    goal = translated_along_z(arm.state().T_b_t, 0.02)
    if not message:
        arm.go(goal, 0.05)
        return
    with pytest.raises(DeviceError, match=message):
        arm.go(goal, 0.05)


def test_an_arm_that_does_not_begin_a_motion_is_reported_after_the_start_timeout():
    arm = make().arm
    driver_method, home = arm.begin_line, arm.state().T_b_t

    def duration(distance, done):
        """Measure how long (s) a motion lasts if the arm makes only the share `done` of it."""
        arm.begin_line = lambda *line: driver_method(translated_along_z(home, done * distance), *line[1:])
        arm.lab.robot.position = home[:3, 3].copy()
        start = arm.clock.now()
        if done and distance > SAFETY.goal_tolerance_m:
            with pytest.raises(DeviceError, match="off its goal"):
                arm.go(translated_along_z(home, distance), 0.2)
        else:
            arm.go(translated_along_z(home, distance), 0.2)
        return arm.clock.now() - start

    timeout, progress = SAFETY.start_timeout_s, SAFETY.min_start_progress
    assert duration(2 * SAFETY.min_motion, 0.0) >= timeout  # not begun
    assert duration(0.5 * SAFETY.min_motion, 0.0) < timeout  # too short to wait for
    assert duration(0.02, 0.9 * progress) >= timeout
    assert duration(0.02, 1.1 * progress) < timeout


def test_an_arm_that_does_not_stand_after_a_brake_is_reported():
    arm = make().arm
    driver_method = arm.read_state
    arm.read_state = lambda: driver_method()._replace(moving=True)
    start = arm.clock.now()
    with pytest.raises(DeviceError, match="was not seen to stop within 1 s"):
        arm.stop()
    assert 0 <= arm.clock.now() - start - SAFETY.stop_timeout_s < 0.1


@pytest.mark.parametrize(
    ("slider", "share"),
    [
        pytest.param(1.0, 1.0, id="full speed"),
        pytest.param(None, SAFETY.min_speed_share, id="unknown slider"),
        pytest.param(0.0, SAFETY.paused_speed_share, id="paused", marks=pytest.mark.full),
    ],
)
@pytest.mark.parametrize(("distance", "degrees"), [(0.02, 0.0), (0.0, 8.0)], ids=["translation", "rotation"])
def test_a_motion_that_takes_too_long_is_stopped(slider, share, distance, degrees):
    arm = make().arm
    driver_method, start = arm.read_state, arm.state().T_b_t
    arm.can_be_paused, arm.poll_s = True, 0.1
    arm.begin_line = lambda *line: setattr(arm, "read_state", lambda: driver_method()._replace(moving=True))
    if slider is not None:
        arm.speed_share = lambda: slider
    begun = arm.clock.now()
    with pytest.raises(DeviceError, match="took too long"):
        arm.go(start @ turned(degrees, distance), 0.1, 0.5)
    length = max(distance, SAFETY.rotation_lever_m * np.radians(degrees))
    longest = SAFETY.duration_factor * (length / 0.1 + 0.1 / 0.5) + SAFETY.duration_margin_s
    braking = SAFETY.stop_timeout_s + 0.3  # s, because the arm goes on reporting a motion
    assert longest / share < arm.clock.now() - begun < longest / share + braking + 2 * arm.poll_s


# The connection with a UR controller


def test_a_controller_that_does_not_take_a_command_is_reported(monkeypatch):
    connection = RtdeConnection("192.0.2.1", SAFETY.state_timeout_s, SAFETY.watchdog_rate_hz)
    monkeypatch.setattr(connection, "newest", lambda timeout: None)  # states arrive, the answer does not
    start = time.monotonic()
    with pytest.raises(DeviceError, match="does not take commands"):
        connection._wait(Future(), SAFETY.command_timeout_s)
    assert SAFETY.command_timeout_s <= time.monotonic() - start < 2 * SAFETY.command_timeout_s


def test_heartbeats_are_sent_once_a_period_and_only_while_states_arrive():
    connection, channel = RtdeConnection("192.0.2.1", SAFETY.state_timeout_s, SAFETY.watchdog_rate_hz), Mock()
    state = make().arm.read_state()

    def heartbeats(age=0.0, *, program=True):
        connection._state = ControllerState(state._replace(time=time.monotonic() - age), 1.0, program)
        connection._send_heartbeat(channel)
        return channel.send.call_count

    assert heartbeats() == 1
    time.sleep(1.1 * SAFETY.heartbeat_period_s)
    assert heartbeats() == 2
    connection._heartbeat_time = time.monotonic() + 1.0  # a busy machine is not a fault
    assert heartbeats() == 2  # sooner than a period
    time.sleep(1.1 * SAFETY.heartbeat_period_s)
    assert heartbeats(1.1 * SAFETY.state_timeout_s) == 2  # the state is too old
    assert heartbeats(program=False) == 2
    assert 1 / SAFETY.watchdog_rate_hz > 2 * SAFETY.heartbeat_period_s


LIBRARY = {  # answers of the part of ur_rtde that a state needs
    "getTimestamp": 1.0, "getSafetyStatusBits": 1, "getRuntimeState": rtde_worker.PLAYING, "operationId": 0,
    "isAsyncOperationRunning": False, "getTargetSpeedFraction": 1.0,
    **{f"getActual{name}": [0.0] * 6 for name in ("TCPPose", "TCPSpeed", "TCPForce", "Q")},
}  # fmt: skip


def library_and_worker(**answers):
    """A client library with other answers, and the worker that uses it."""
    library = Mock(**{f"{name}.return_value": value for name, value in (LIBRARY | answers).items()})
    library.getAsyncOperationProgressEx.return_value = library
    return library, rtde_worker.Worker(Mock(), library, library, WORKER_LIMITS)


def test_a_tool_stands_when_it_is_slow_and_the_state_is_later_than_the_brake():
    for share, moving in ((0.99, False), (1.01, True)):
        _, worker = library_and_worker(getActualTCPSpeed=[0, 0, share * SAFETY.standing_speed, 0, 0, 0])
        assert worker.read_state(1.0)["moving"] == moving
    library, worker = library_and_worker()
    worker.send_new_state()
    worker.brake()
    library.stopL.assert_called_once_with(SAFETY.braking_m_s2, True)
    assert worker.read_state(1.0 + 0.9 * SAFETY.brake_settling_s)["moving"]
    assert not worker.read_state(1.0 + 1.1 * SAFETY.brake_settling_s)["moving"]


def test_the_process_of_a_library_that_hangs_ends():
    code = (
        "import time; from unittest.mock import Mock; from i2t.hardware.ur import rtde_worker\n"
        "library = Mock(**{'getRuntimeState.return_value': rtde_worker.PLAYING})\n"
        "library.stopScript = lambda: time.sleep(60)\n"
        f"limits = rtde_worker.{WORKER_LIMITS!r}\n"
        "rtde_worker.Worker(Mock(), library, library, limits).end_program()\n"
    )
    start = time.monotonic()
    ended = subprocess.run([sys.executable, "-c", code], check=False, timeout=40, cwd=ROOT)
    assert ended.returncode == -signal.SIGALRM
    assert time.monotonic() - start >= SAFETY.worker_exit_timeout_s
