"""The safety limits of the hardware layer, in one table: value, unit, and what the limit protects.

WARNING: Do not change a limit to get past a refusal. Find the cause first.
WARNING: These limits replace neither the robot's own safety limits nor the emergency stop. Set both up first.
CAUTION: Compare so that NaN trips the limit: `not force <= limit`, never `force > limit`.

A rig's own limits (`i2t.hardware.motion_limits`) must lie within the ranges of this table. The module imports the
standard library only, because command lines read it before NumPy is loaded.
"""

import math
from dataclasses import dataclass, field, fields
from typing import Any


def _limit(value: Any, unit: str, protects: str) -> Any:
    return field(default=value, metadata={"unit": unit, "protects": protects})


@dataclass(frozen=True)
class SafetyLimits:
    """Table of the safety limits; a range is a pair of the lowest and the highest value that is accepted."""

    # What a rig may ask for
    speed_range: tuple[float, float] = _limit((1e-4, 1.0), "m/s", "refuses a rig with an absurd speed limit")
    acceleration_range: tuple[float, float] = _limit((1e-3, 5.0), "m/s^2", "refuses an absurd acceleration limit")
    force_range: tuple[float, float] = _limit((1.0, 150.0), "N", "refuses an absurd force limit")
    torque_range: tuple[float, float] = _limit((0.05, 50.0), "Nm", "refuses an absurd torque limit")
    approach_distance_range: tuple[float, float] = _limit((1e-3, 0.5), "m", "refuses an absurd length of an approach")
    stiffness_range: tuple[float, float] = _limit((500.0, 1e6), "N/m", "refuses an absurd contact stiffness")
    mass_range: tuple[float, float] = _limit((0.0, 20.0), "kg", "refuses a payload that the arm cannot carry")
    looking_distance_range: tuple[float, float] = _limit((0.02, 2.0), "m", "refuses an absurd distance of the camera")
    max_reach_m: float = _limit(3.0, "m", "refuses a box that no supported arm reaches, such as one in millimetres")
    max_tool_offset_m: float = _limit(0.5, "m", "refuses a skin, camera or payload too far from the flange")
    max_camera_tilt_deg: float = _limit(60, "degrees", "refuses a camera that cannot see what the tool will touch")
    max_tcp_shift_m: float = _limit(5e-3, "m", "refuses a pendant whose TCP disagrees with the rig's")
    max_tcp_rotation_deg: float = _limit(3.0, "degrees", "refuses a pendant whose TCP disagrees with the rig's")

    # How hard a collision may be. A trip at a third of 30 N is twice the error of a UR's force sensor.
    reaction_time_s: float = _limit(0.04, "s", "is the assumed time from the force to the brake")
    braking_m_s2: float = _limit(2.0, "m/s^2", "is the deceleration of every stop except an emergency stop")
    free_trip_share: float = _limit(1 / 3, "of the force limit", "stops a free motion before the force limit")
    max_start_load: float = _limit(2.0, "of force and torque limit", "refuses to move an overloaded arm")
    max_retreat_growth: float = _limit(1.1, "of the load at the start", "stops a retreat that presses harder")

    # What every state of a motion must be. At 10 N/mm a press gains 5 N within the maximum age of a state.
    goal_tolerance_m: float = _limit(1e-3, "m", "reports a motion that ended off its goal")
    goal_tolerance_rad: float = _limit(0.01, "rad", "reports a motion that ended with another orientation")
    box_margin_m: float = _limit(5e-3, "m", "stops an arm whose tool has left its box")
    travel_margin_m: float = _limit(3e-3, "m", "stops an arm that goes past its goal")
    max_speed_ratio: float = _limit(1.5, "of the requested speed", "stops an arm that moves too fast")
    speed_margin_m_s: float = _limit(0.02, "m/s", "is added to the maximum speed")
    max_angular_speed_rad_s: float = _limit(10.0, "rad/s", "stops a tool that turns faster than any supported arm")
    max_state_age_s: float = _limit(0.25, "s", "stops an arm whose states no longer arrive, or that is not watched")
    stall_timeout_s: float = _limit(3.0, "s", "stops an arm that reports a motion while its pose stands still")
    start_timeout_s: float = _limit(0.5, "s", "reports an arm that does not begin the requested motion")
    min_start_progress: float = _limit(0.1, "of the way", "is the progress that counts as a begun motion")
    min_motion: float = _limit(1e-5, "m or rad", "is the shortest motion that is waited for")
    stop_timeout_s: float = _limit(1.0, "s", "reports an arm that was told to brake and does not stand")
    duration_factor: float = _limit(2.0, "of the planned duration", "stops a motion that takes too long")
    duration_margin_s: float = _limit(2.0, "s", "is added to the maximum duration of a motion")
    rotation_lever_m: float = _limit(0.25, "m per rad", "converts a rotation to a path, for its maximum duration")
    min_speed_share: float = _limit(0.05, "of the requested speed", "is assumed for an unknown speed slider")
    paused_speed_share: float = _limit(0.01, "of the requested speed", "lets a paused motion time out in the end")

    # The connection with a UR controller. Four seconds at 40 mm/s, the slowest watchdog, are 0.16 m.
    state_timeout_s: float = _limit(0.1, "s", "gives up an arm whose controller is silent")
    state_timeout_range: tuple[float, float] = _limit((0.02, 5.0), "s", "refuses a timeout too long to protect")
    watchdog_rate_hz: float = _limit(10.0, "Hz", "ends the controller's program if this computer stalls or dies")
    watchdog_rate_range: tuple[float, float] = _limit((0.25, 50.0), "Hz", "refuses a watchdog too slow to protect")
    heartbeat_period_s: float = _limit(0.02, "s", "is the time between two heartbeats that feed the watchdog")
    command_timeout_s: float = _limit(2.0, "s", "reports a controller that does not take commands")
    standing_speed: float = _limit(1e-3, "m/s and rad/s", "is the speed below which the tool stands")
    brake_settling_s: float = _limit(0.05, "s", "ignores states from before a brake that say that the arm stands")
    worker_exit_timeout_s: int = _limit(2, "s", "ends the client library's process even if the library hangs")

    # Touch-off against a flat
    touch_off_force_n: float = _limit(2.0, "N", "stops a corner of the skin at the flat; it gives some N per mm")
    touch_off_overtravel_m: float = _limit(5e-3, "m", "stops an approach that finds no flat where it should be")
    touch_off_max_shift_m: float = _limit(5e-3, "m", "refuses a result too far from the rig")
    touch_off_max_tilt_rad: float = _limit(math.radians(4), "rad", "refuses a result too far from the rig")


SAFETY = SafetyLimits()


def range_of(name: str) -> tuple[float, float, str]:
    """Look up the range of a value.

    Args:
        name: Name of the value, such as "speed" for the limit `speed_range`.

    Returns:
        The lowest value, the highest value, and their unit.
    """
    entry = next(entry for entry in fields(SafetyLimits) if entry.name == f"{name}_range")
    return *getattr(SAFETY, entry.name), entry.metadata["unit"]
