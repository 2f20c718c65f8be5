"""Force of a collision: closed forms, and the motion of a simulated arm."""

import re
from dataclasses import replace

import numpy as np
import pytest
from helpers.closed_form import GAIN, HEIGHT, make

from i2t.collect.dry_run import energy_lines
from i2t.collect.path import TouchPath
from i2t.collect.settings import TouchSettings
from i2t.errors import DeviceError
from i2t.hardware.collision import fastest_speed, overrun_force
from i2t.hardware.limits import SAFETY, range_of
from i2t.hardware.motion_limits import MotionLimits
from i2t.hardware.poses import pose_from_vector
from i2t.hardware.rig import Rig


def test_the_fastest_speed_gains_just_the_force_and_without_delay_it_is_the_braking_distance():
    for force in (0.5, 8.0, 60.0):
        for stiffness in (1e3, 1e4):
            speed = fastest_speed(force, stiffness, braking=2.0)
            assert overrun_force(speed, stiffness, braking=2.0) == pytest.approx(force)
    assert fastest_speed(0.0, 1e4, braking=2.0) == fastest_speed(-1.0, 1e4, braking=2.0) == 0.0
    assert overrun_force(0.2, 1e4, braking=2.0, delay=0.0) == pytest.approx(1e4 * 0.2**2 / 4)
    assert overrun_force(0.2, 1e4, braking=1e12) == pytest.approx(1e4 * 0.2 * SAFETY.reaction_time_s)


def test_free_motion_is_as_fast_as_can_be_stopped_within_the_limit():
    limits = Rig().limits
    assert limits.free_speed == pytest.approx(0.040)
    assert limits.collision_force(limits.free_speed, limits.trip_force) == pytest.approx(limits.force)
    assert limits.collision_force(0.25, limits.force) > 200  # as it was without the bound
    soft = replace(limits, stiffness=1e3)
    assert soft.free_speed > 4 * limits.free_speed
    assert replace(soft, speed=0.1).free_speed == 0.1
    assert limits.checked(pose_from_vector([0.4, 0.0, 0.3, np.pi, 0.0, 0.0]), None, None)[0] == limits.free_speed


@pytest.mark.parametrize("stiffness", [10e3, 2e3])
def test_a_collision_in_free_motion_ends_within_the_force_limit(stiffness):
    """The tool hits an unexpected plane at the speed that is allowed in the air."""
    procedure = make(stiffness=stiffness, gain=0 * GAIN, rig=Rig())
    arm, limits = procedure.arm, procedure.rig.limits
    goal = np.array(arm.state().T_b_t)
    goal[2, 3] = HEIGHT + 0.015
    arm.go(goal, 0.25)
    arm.zero_wrench()
    goal[2, 3] = HEIGHT - 0.015
    with pytest.raises(DeviceError, match="met something"):
        arm.go(goal, procedure.path.free_speed)
    pressed = stiffness * (HEIGHT - arm.state().T_b_t[2, 3])
    assert limits.trip_force < pressed < limits.force


def test_speeds_of_a_touch_are_bounded_and_shown():
    path = TouchPath(Rig(), TouchSettings(), 0.03)
    assert (path.free_speed, path.retreat_speed) == (Rig().limits.free_speed,) * 2
    slow = TouchPath(Rig(), TouchSettings(speed=0.02, retreat=0.01), 0.03)
    assert (slow.free_speed, slow.retreat_speed) == (0.02, 0.01)
    free, press = energy_lines(path, 0.1)
    assert "40 mm/s (150 requested)" in free
    # k (v t + v^2 / 2 a) at 10 N/mm and 2 mm/s: 40 ms, 140 ms and 190 ms
    assert re.findall(r"([\d.]+) N\b(?!/)", press) == ["8.8", "2.8", "3.8"]


@pytest.mark.parametrize("name", ["speed", "acceleration", "force", "torque", "approach_distance", "stiffness"])
def test_a_rig_s_limit_that_makes_no_sense_is_refused(name):
    low, high, _ = range_of(name)
    for bad in (0.0, -1.0, low / 2, 2 * high, float("nan"), float("inf")):
        with pytest.raises(ValueError, match=f"{name} is "):
            MotionLimits((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), **{name: bad})
