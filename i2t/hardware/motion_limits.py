"""Motion limits of a rig, checked before any command is sent to an arm.

Goals are (4, 4) T_b_t in metres, tool in robot base. The box is convex, so a straight motion between two poses inside
it stays inside.

WARNING: The box holds the tool's origin only. Flange, elbow and cable are not watched: set the robot's own safety
limits on the pendant too.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from i2t.hardware.collision import fastest_speed, overrun_force
from i2t.hardware.limits import SAFETY, range_of
from i2t.patches.dimensions import ARM_STIFFNESS_N_PER_M
from i2t.types import Array


@dataclass(frozen=True)
class MotionLimits:
    """Limits of an arm's motions, and the stiffness (N/m) with which the force of a collision is computed.

    They are the box of the tool's origin in the base (m), speed (m/s), acceleration (m/s^2), force (N), torque (Nm) and
    distance of an approach (m). A motion beyond them is refused or stopped.

    Raises ValueError for limits outside the ranges of `i2t.hardware.limits`.
    """

    lower: tuple[float, float, float]  # m, lower corner of the box for the tool's origin, in the base
    upper: tuple[float, float, float]  # m, upper corner of the box
    speed: float = 0.25  # m/s, maximum speed
    acceleration: float = 0.5  # m/s^2, maximum acceleration
    force: float = 30.0  # N, largest force in any motion; an approach has its own, lower limit
    torque: float = 10.0  # Nm, largest torque in any motion
    approach_distance: float = 0.1  # m, longest distance of an approach
    # N/m, stiffness of skin, arm and mount in series, from which the force of a collision is computed
    stiffness: float = ARM_STIFFNESS_N_PER_M

    def __post_init__(self) -> None:
        reach = SAFETY.max_reach_m
        for name in ("lower", "upper"):
            corner = np.asarray(getattr(self, name), float)
            if corner.shape != (3,) or not np.isfinite(corner).all() or np.abs(corner).max() > reach:
                raise ValueError(f"{name} is {getattr(self, name)}; give x, y, z in m, each within {reach:g} m")
            object.__setattr__(self, name, tuple(float(x) for x in corner))
        if not all(low < high for low, high in zip(self.lower, self.upper, strict=True)):
            raise ValueError(f"lower, {self.lower}, must lie below upper, {self.upper}, along x, y and z")
        for name in ("speed", "acceleration", "force", "torque", "approach_distance", "stiffness"):
            value, (low, high, unit) = getattr(self, name), range_of(name)
            if not low <= value <= high:
                raise ValueError(f"{name} is {value:g}; give {unit}, from {low:g} to {high:g}")

    @property
    def box(self) -> Float[Array, "2 3"]:
        """(2, 3) lower and upper corner, in the base in m, of the box that the tool's origin must stay in."""
        return np.array([self.lower, self.upper], float)

    @property
    def trip_force(self) -> float:
        """Force (N) at which a motion in the air is stopped, low enough that the overrun stays within `force`."""
        return SAFETY.free_trip_share * self.force

    @property
    def free_speed(self) -> float:
        """Highest speed (m/s) in the air at which a collision stays within `force` (`i2t.hardware.collision`)."""
        return min(self.speed, fastest_speed(self.force - self.trip_force, self.stiffness, braking=SAFETY.braking_m_s2))

    def collision_force(self, speed: float, trip: float) -> float:
        """Calculate the highest force of a collision: the force that stops the motion plus the overrun.

        Args:
            speed: Speed of the tool in m/s.
            trip: Force in N at which the motion is stopped.

        Returns:
            The force in N when the tool has come to a stop.
        """
        return trip + overrun_force(speed, self.stiffness, braking=SAFETY.braking_m_s2)

    def check(self, goal: Array, speed: float, acceleration: float) -> None:
        """Refuse a motion whose goal is invalid or outside the box, or whose speed or acceleration is too high.

        Args:
            goal: (4, 4) T_b_t in m.
            speed: Requested speed in m/s.
            acceleration: Requested acceleration in m/s^2.

        Raises:
            ValueError: The motion is beyond a limit, which the message names.
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
        """Fill in missing speed and acceleration of a motion, and refuse the motion as `check` does.

        Args:
            goal: (4, 4) T_b_t in m.
            speed: Requested speed in m/s, or None for `free_speed`.
            acceleration: Requested acceleration in m/s^2, or None for the largest allowed one.

        Returns:
            The speed in m/s and the acceleration in m/s^2.

        Raises:
            ValueError: The motion is beyond a limit, as in `check`.
        """
        speed = self.free_speed if speed is None else speed
        acceleration = self.acceleration if acceleration is None else acceleration
        self.check(goal, speed, acceleration)
        return speed, acceleration

    def check_approach(self, distance: float, force: float, torque: float) -> None:
        """Refuse an approach (a motion towards contact) that may go too far or press too hard.

        Args:
            distance: Distance in m after which the approach ends.
            force: Force in N that stops it.
            torque: Torque in Nm that stops it.

        Raises:
            ValueError: The approach is beyond a limit, which the message names.
        """
        self._check_below("An approach's {}", approach_distance=distance, force=force, torque=torque)

    def _check_below(self, subject: str, **requested: float) -> None:
        """Refuse values that are not above 0 and within the limit of the same name; NaN is refused."""
        for name, value in requested.items():
            if not 0 < value <= getattr(self, name):
                quantity = subject.format(name.removeprefix("approach_"))
                raise ValueError(f"{quantity} {value} is outside (0, {getattr(self, name)}], the rig's limit.")

    def contains(self, position: Array, margin: float = 0.0) -> bool:
        """Test whether a position of the tool is inside the allowed box.

        Args:
            position: (3,) position in the base, m.
            margin: Distance in m by which the position may lie outside.

        Returns:
            True if the position is inside the box, or outside by at most `margin` along each axis.
        """
        return bool(
            (np.asarray(position) >= np.array(self.lower) - margin).all()
            and (np.asarray(position) <= np.array(self.upper) + margin).all()
        )


def format_position(position: Array) -> str:
    """Format a position for a message.

    Args:
        position: (3,) position in m.

    Returns:
        The coordinates to the millimetre, such as "(0.400, 0.000, 0.300)".
    """
    return "(" + ", ".join(f"{x:.3f}" for x in position) + ")"
