"""Limits that no motion of an arm may exceed, checked before a packet is sent.

Goals are (4, 4) T_b_t in metres, tool in robot base. The box holds the tool's origin: flange, elbow and cable are not
watched here, so set the robot's own safety limits on the pendant too. The box is convex: a straight motion between two
poses inside it stays inside.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from i2t.hardware.collision import fastest_speed, overrun_force
from i2t.patches.dimensions import ARM_STIFFNESS_N_PER_M
from i2t.types import Array

LIMIT_RANGES = {  # the least and the greatest that make sense of an arm that carries a skin, and their unit
    "speed": (1e-4, 1.0, "m/s"),
    "acceleration": (1e-3, 5.0, "m/s^2"),
    "force": (1.0, 150.0, "N"),
    "torque": (0.05, 50.0, "Nm"),
    "approach_distance": (1e-3, 0.5, "m"),
    "stiffness": (500.0, 1e6, "N/m"),
}
MAX_REACH_M = 3.0  # no arm that this is for reaches further
BRAKING_M_S2 = 2.0  # deceleration of a stop that is not an emergency's
FREE_TRIP_SHARE = 1 / 3  # of the force limit, at which a free motion is stopped: of 30 N twice what a UR's sensor errs


@dataclass(frozen=True)
class MotionLimits:
    """Limits of motions: anything beyond is refused, or stops the arm. Raises ValueError for limits that are none."""

    lower: tuple[float, float, float]  # m, corner of the box for the tool's origin, base axes
    upper: tuple[float, float, float]  # m
    speed: float = 0.25  # m/s
    acceleration: float = 0.5  # m/s^2
    force: float = 30.0  # N, on any motion; an approach has its own, lower one
    torque: float = 10.0  # Nm
    approach_distance: float = 0.1  # m, of the longest approach
    stiffness: float = ARM_STIFFNESS_N_PER_M  # N/m, of skin, arm and mount in series: what a collision is reckoned with

    def __post_init__(self) -> None:
        for name in ("lower", "upper"):
            corner = np.asarray(getattr(self, name), float)
            if corner.shape != (3,) or not np.isfinite(corner).all() or np.abs(corner).max() > MAX_REACH_M:
                raise ValueError(f"{name} is {getattr(self, name)}; give x, y, z in m, each within {MAX_REACH_M:g} m")
            object.__setattr__(self, name, tuple(float(x) for x in corner))
        if not all(low < high for low, high in zip(self.lower, self.upper, strict=True)):
            raise ValueError(f"lower, {self.lower}, must lie below upper, {self.upper}, along x, y and z")
        for name, (least, most, unit) in LIMIT_RANGES.items():
            given = getattr(self, name)
            if not least <= given <= most:
                raise ValueError(f"{name} is {given:g}; give {unit}, from {least:g} to {most:g}")

    @property
    def box(self) -> Float[Array, "2 3"]:
        """(2, 3) m, lower and upper corner in the base."""
        return np.array([self.lower, self.upper], float)

    @property
    def trip_force(self) -> float:
        """Force (N) that stops a free motion, so that with what comes until it stands it stays within the limit."""
        return FREE_TRIP_SHARE * self.force

    @property
    def free_speed(self) -> float:
        """Speed (m/s) of the fastest free motion whose collision stays within the limit (`i2t.hardware.collision`)."""
        return min(self.speed, fastest_speed(self.force - self.trip_force, self.stiffness, braking=BRAKING_M_S2))

    def collision_force(self, speed: float, trip: float) -> float:
        """Greatest force of a collision.

        Args:
            speed: m/s.
            trip: N, at which the motion is stopped.

        Returns:
            N.
        """
        return trip + overrun_force(speed, self.stiffness, braking=BRAKING_M_S2)

    def check(self, goal: Array, speed: float, acceleration: float) -> None:
        """Refuse a goal that is no pose or lies outside the box, and a motion that is too fast.

        Args:
            goal: (4, 4) T_b_t in m.
            speed: m/s.
            acceleration: m/s^2.

        Raises:
            ValueError: One sentence that names what is beyond which limit.
        """
        pose = np.asarray(goal, float)
        if pose.shape != (4, 4) or not np.isfinite(pose).all() or not np.allclose(pose[3], [0, 0, 0, 1]):
            raise ValueError("A goal must be a finite (4, 4) transform of the tool in the robot's base.")
        rotation, position = pose[:3, :3], pose[:3, 3]
        if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-5) or np.linalg.det(rotation) < 0:
            raise ValueError("A goal's rotation must be a rotation: orthonormal and right-handed.")
        if not self.contains(position):
            box = f"{format_position(self.lower)} to {format_position(self.upper)} m"
            raise ValueError(f"The goal {format_position(position)} m is outside the box from {box}.")
        self._check_below("The {}", speed=speed, acceleration=acceleration)

    def checked(self, goal: Array, speed: float | None, acceleration: float | None) -> tuple[float, float]:
        """Speed and acceleration of a motion, the limits' own where none is given, once it is known to be allowed.

        Args:
            goal: (4, 4) T_b_t in m.
            speed: m/s, or None for `free_speed`.
            acceleration: m/s^2, or None for the limit.

        Returns:
            Speed (m/s) and acceleration (m/s^2).

        Raises:
            ValueError: As `check`.
        """
        speed = self.free_speed if speed is None else speed
        acceleration = self.acceleration if acceleration is None else acceleration
        self.check(goal, speed, acceleration)
        return speed, acceleration

    def check_approach(self, distance: float, force: float, torque: float) -> None:
        """Refuse an approach that goes too far or pushes too hard.

        Args:
            distance: m, that it may go.
            force: N, that stops it.
            torque: Nm, that stops it.

        Raises:
            ValueError: One sentence that names what is beyond which limit.
        """
        self._check_below("An approach's {}", approach_distance=distance, force=force, torque=torque)

    def _check_below(self, what: str, **asked: float) -> None:
        """Refuse what is not above 0 and within the limit of its name; NaN is not."""
        for name, value in asked.items():
            if not 0 < value <= getattr(self, name):
                named = what.format(name.removeprefix("approach_"))
                raise ValueError(f"{named} {value} is outside (0, {getattr(self, name)}], the rig's limit.")

    def contains(self, position: Array, margin: float = 0.0) -> bool:
        """Test whether the box holds a position.

        Args:
            position: (3,) m, in the base.
            margin: m, by which it may lie outside.

        Returns:
            True inside, or at most `margin` outside.
        """
        return bool(
            (np.asarray(position) >= np.array(self.lower) - margin).all()
            and (np.asarray(position) <= np.array(self.upper) + margin).all()
        )


def format_position(position: Array) -> str:
    """A position for a sentence.

    Args:
        position: (3,) m.

    Returns:
        Such as "(0.400, 0.000, 0.300)".
    """
    return "(" + ", ".join(f"{x:.3f}" for x in position) + ")"
