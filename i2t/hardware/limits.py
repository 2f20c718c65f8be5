"""The safety limits of the hardware layer, in one table: value, unit, what the limit protects, and how it was tried.

WARNING: Do not change a limit to get past a refusal. Find the cause first.
WARNING: These limits replace neither the robot's own safety limits nor the emergency stop. Set both up first.
CAUTION: Compare so that NaN trips the limit: `not force <= limit`, never `force > limit`.

A rig's own limits (`i2t.hardware.motion_limits`) must lie within the ranges of this table. The module imports the
standard library only, because command lines read it before NumPy is loaded.
"""

import math
from dataclasses import dataclass, field, fields
from typing import Any

# Files of tests of the safety limits, and ids of tests that check several limits each.
_GUARDED_TESTS, _LIMITS_TESTS = "tests/hardware/test_guarded.py", "tests/hardware/test_limits.py"
_TOUCH_OFF_TESTS, _UR_TESTS = "tests/hardware/test_touch_off.py", "tests/hardware/test_ur.py"
_OWN_LIMIT_TEST = "tests/hardware/test_collision.py::test_a_rig_s_limit_that_makes_no_sense_is_refused"
_RIG_TEST = f"{_LIMITS_TESTS}::test_a_rig_just_beyond_a_limit_is_refused"
_PENDANT_TEST = f"{_LIMITS_TESTS}::test_a_pendant_just_beyond_a_limit_is_refused"
_COLLISION_TEST = "tests/hardware/test_collision.py::test_a_collision_in_free_motion_ends_within_the_force_limit"
_STATE_TEST = f"{_GUARDED_TESTS}::test_each_fault_of_a_state_is_reported"
_ARRIVAL_TEST = f"{_LIMITS_TESTS}::test_a_motion_that_ends_off_its_goal_is_reported"
_START_TEST = f"{_LIMITS_TESTS}::test_an_arm_that_does_not_begin_a_motion_is_reported_after_the_start_timeout"
_DURATION_TEST = f"{_LIMITS_TESTS}::test_a_motion_that_takes_too_long_is_stopped"
_TIMEOUTS_TEST = f"{_UR_TESTS}::test_timeouts_too_long_to_protect_are_refused"
_STANDSTILL_TEST = f"{_LIMITS_TESTS}::test_a_tool_stands_when_it_is_slow_and_the_state_is_later_than_the_brake"


def _limit(value: Any, unit: str, protects: str, tried: str) -> Any:
    return field(default=value, metadata={"unit": unit, "protects": protects, "tried": tried})


@dataclass(frozen=True)
class SafetyLimits:
    """Table of the safety limits; a range is a pair of the lowest and the highest value that is accepted.

    The metadata of each field are its unit, what it protects, and the test that checks it.
    """

    # What a rig may ask for
    speed_range: tuple[float, float] = _limit((1e-4, 1.0), "m/s", "refuses an implausible speed limit", _OWN_LIMIT_TEST)
    acceleration_range: tuple[float, float] = _limit(
        (1e-3, 5.0), "m/s^2", "refuses an implausible acceleration limit", _OWN_LIMIT_TEST
    )
    force_range: tuple[float, float] = _limit((1.0, 150.0), "N", "refuses an implausible force limit", _OWN_LIMIT_TEST)
    torque_range: tuple[float, float] = _limit(
        (0.05, 50.0), "Nm", "refuses an implausible torque limit", _OWN_LIMIT_TEST
    )
    approach_distance_range: tuple[float, float] = _limit(
        (1e-3, 0.5), "m", "refuses an implausible approach", _OWN_LIMIT_TEST
    )
    stiffness_range: tuple[float, float] = _limit(
        (500.0, 1e6), "N/m", "refuses an implausible contact stiffness", _OWN_LIMIT_TEST
    )
    mass_range: tuple[float, float] = _limit(
        (0.0, 20.0), "kg", "refuses a payload that the arm cannot carry", _RIG_TEST
    )
    looking_distance_range: tuple[float, float] = _limit(
        (0.02, 2.0), "m", "refuses an implausible camera distance", _RIG_TEST
    )
    max_reach_m: float = _limit(
        3.0, "m", "refuses a box beyond any supported arm, such as one in millimetres", _RIG_TEST
    )
    max_tool_offset_m: float = _limit(0.5, "m", "refuses a skin, camera or payload too far from the flange", _RIG_TEST)
    max_camera_tilt_deg: float = _limit(
        60, "degrees", "refuses a camera that cannot see what the tool will touch", _RIG_TEST
    )
    max_tcp_shift_m: float = _limit(5e-3, "m", "refuses a pendant whose TCP disagrees with the rig's", _PENDANT_TEST)
    max_tcp_rotation_deg: float = _limit(
        3.0, "degrees", "refuses a pendant whose TCP disagrees with the rig's", _PENDANT_TEST
    )

    # How hard a collision may be. A trip at a third of 30 N is twice the error of a UR's force sensor.
    reaction_time_s: float = _limit(0.04, "s", "is the assumed time from the trip to the brake", _COLLISION_TEST)
    braking_m_s2: float = _limit(
        2.0,
        "m/s^2",
        "is the deceleration of every stop except an emergency stop",
        f"{_UR_TESTS}::test_an_approach_ends_on_force",
    )
    free_trip_share: float = _limit(
        1 / 3, "of the force limit", "stops a free motion before the force limit", _COLLISION_TEST
    )
    max_start_load: float = _limit(
        2.0,
        "of force and torque limit",
        "refuses to move an overloaded arm",
        f"{_GUARDED_TESTS}::test_no_free_motion_begins_with_a_non_finite_or_excessive_force",
    )
    max_retreat_growth: float = _limit(
        1.1,
        "of the load at the start",
        "stops a retreat that presses harder",
        f"{_LIMITS_TESTS}::test_a_retreat_that_presses_harder_is_stopped",
    )

    # What every state of a motion must be. At 10 N/mm a press gains 5 N within the maximum age of a state.
    goal_tolerance_m: float = _limit(1e-3, "m", "reports a motion that ended off its goal", _ARRIVAL_TEST)
    goal_tolerance_rad: float = _limit(
        0.01, "rad", "reports a motion that ended with another orientation", _ARRIVAL_TEST
    )
    box_margin_m: float = _limit(5e-3, "m", "stops an arm whose tool has left its box", _STATE_TEST)
    travel_margin_m: float = _limit(3e-3, "m", "stops an arm that goes past its goal", _STATE_TEST)
    max_speed_ratio: float = _limit(1.5, "of the requested speed", "stops an arm that moves too fast", _STATE_TEST)
    speed_margin_m_s: float = _limit(0.02, "m/s", "is added to the maximum speed", _STATE_TEST)
    max_angular_speed_rad_s: float = _limit(
        10.0, "rad/s", "stops a tool that turns faster than any supported arm", _STATE_TEST
    )
    max_state_age_s: float = _limit(
        0.25, "s", "stops an arm whose states no longer arrive, or that is not watched", _STATE_TEST
    )
    stall_timeout_s: float = _limit(
        3.0, "s", "stops an arm that reports a motion while its pose stands still", _STATE_TEST
    )
    start_timeout_s: float = _limit(0.5, "s", "reports an arm that does not begin the requested motion", _START_TEST)
    min_start_progress: float = _limit(
        0.1, "of the way", "is the progress up to which a motion counts as not begun", _START_TEST
    )
    min_motion: float = _limit(1e-5, "m or rad", "is the longest motion whose start is not waited for", _START_TEST)
    stop_timeout_s: float = _limit(
        1.0,
        "s",
        "reports an arm that does not stand after a brake command",
        f"{_LIMITS_TESTS}::test_an_arm_that_does_not_stand_after_a_brake_is_reported",
    )
    duration_factor: float = _limit(
        2.0, "of the planned duration", "stops a motion that takes too long", _DURATION_TEST
    )
    duration_margin_s: float = _limit(2.0, "s", "is added to the maximum duration of a motion", _DURATION_TEST)
    rotation_lever_m: float = _limit(
        0.25, "m per rad", "converts a rotation to a length, for the maximum duration", _DURATION_TEST
    )
    min_speed_share: float = _limit(
        0.05, "of the requested speed", "is assumed if the setting of the speed slider is unknown", _DURATION_TEST
    )
    paused_speed_share: float = _limit(
        0.01, "of the requested speed", "lets a paused motion time out eventually", _DURATION_TEST
    )

    # The connection with a UR controller. Four seconds at 40 mm/s, the slowest watchdog, are 0.16 m.
    state_timeout_s: float = _limit(
        0.1,
        "s",
        "ends the control of an arm whose controller sends no states",
        f"{_UR_TESTS}::test_a_controller_without_states_is_disconnected_even_at_rest",
    )
    state_timeout_range: tuple[float, float] = _limit(
        (0.02, 5.0), "s", "refuses a timeout too long to protect", _TIMEOUTS_TEST
    )
    watchdog_rate_hz: float = _limit(
        10.0,
        "Hz",
        "ends the controller's program if this computer stalls or dies",
        f"{_UR_TESTS}::test_the_arm_stands_when_its_process_is_ended",
    )
    watchdog_rate_range: tuple[float, float] = _limit(
        (0.25, 50.0), "Hz", "refuses a watchdog too slow to protect", _TIMEOUTS_TEST
    )
    heartbeat_period_s: float = _limit(
        0.02,
        "s",
        "is the time between two heartbeats that feed the watchdog",
        f"{_LIMITS_TESTS}::test_heartbeats_are_sent_once_a_period_and_only_while_states_arrive",
    )
    command_timeout_s: float = _limit(
        2.0,
        "s",
        "reports a controller that does not accept commands",
        f"{_LIMITS_TESTS}::test_a_controller_that_does_not_take_a_command_is_reported",
    )
    standing_speed: float = _limit(
        1e-3, "m/s and rad/s", "is the speed below which the tool counts as standing", _STANDSTILL_TEST
    )
    brake_settling_s: float = _limit(
        0.05, "s", "ignores states from before a brake, which may report a standing arm", _STANDSTILL_TEST
    )
    worker_exit_timeout_s: int = _limit(
        2,
        "s",
        "ends the client library's process even if the library hangs",
        f"{_LIMITS_TESTS}::test_the_process_of_a_library_that_hangs_ends",
    )

    # Touch-off against a flat
    touch_off_force_n: float = _limit(
        2.0,
        "N",
        "stops a corner of the skin that presses on the flat",
        f"{_TOUCH_OFF_TESTS}::test_an_arm_finds_its_skin",
    )
    touch_off_overtravel_m: float = _limit(
        5e-3,
        "m",
        "stops an approach that meets no flat at the given height",
        f"{_TOUCH_OFF_TESTS}::test_presses_without_an_onset_and_a_missing_flat_are_reported",
    )
    touch_off_max_shift_m: float = _limit(
        5e-3,
        "m",
        "refuses a result too far from the rig",
        f"{_LIMITS_TESTS}::test_a_touch_off_too_far_from_the_rig_is_refused",
    )
    touch_off_max_tilt_rad: float = _limit(
        math.radians(4),
        "rad",
        "refuses a result too far from the rig",
        f"{_LIMITS_TESTS}::test_a_touch_off_too_far_from_the_rig_is_refused",
    )


SAFETY = SafetyLimits()  # safety limits of all arms, with the test that checks each


def range_of(name: str) -> tuple[float, float, str]:
    """Look up the accepted range of a setting in the table of safety limits.

    Args:
        name: Name of the setting, such as "speed" for the limit `speed_range`.

    Returns:
        The lowest value, the highest value, and their unit as text.
    """
    entry = next(entry for entry in fields(SafetyLimits) if entry.name == f"{name}_range")
    return *getattr(SAFETY, entry.name), entry.metadata["unit"]
