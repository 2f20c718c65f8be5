"""A tool that moves in time: straight lines, stops, and contact.

Lines have a trapezoidal speed profile with a bounded acceleration. In a motion that also turns, a radian counts as 0.25
m of path. Poses are six numbers as on a UR robot: metres and a rotation vector in its base axes. Twists (m/s, rad/s)
and wrenches (N, Nm) are along the base's axes as well.
"""

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from i2t.geometry import so3_exp, so3_log

Array: TypeAlias = NDArray[np.float64]
Contact: TypeAlias = Callable[[Array, Array], Array]  # position (3,) and rotation (3, 3) of the tool -> wrench on it

ROTATION_LEVER_M = 0.25  # m, length of path of the emulated arm that counts as a rotation by one radian


class LinearMotion(NamedTuple):
    """Straight motion of a simulated tool between two poses, rotating in proportion about a fixed axis.

    It has the pose at the start (m), the displacement (m, rad), the length of the path (m), the maximum speed (m/s) and
    the acceleration (m/s^2).
    """

    position: Array  # (3,) m, position of the tool at the start
    rotation: Array  # (3, 3) rotation of the tool at the start
    displacement: Array  # (6,) displacement from start to end: m and rotation vector (rad)
    length: float  # m, length of the path
    speed: float  # m/s, maximum speed
    acceleration: float  # m/s^2, acceleration at both ends


class Braking(NamedTuple):
    """Motion of a simulated tool that slows down to a standstill with a constant deceleration (m/s^2)."""

    deceleration: float  # m/s^2


def plane(height: float, stiffness: float) -> Contact:
    """Make the contact with a horizontal plane that pushes the tool's origin back like a spring, without friction.

    Args:
        height: Height (m) of the plane in the base.
        stiffness: Stiffness (N/m) of the spring.

    Returns:
        Function that computes the wrench (6,) on the tool, N and Nm in base axes, from its position and rotation.
    """

    def wrench(position: Array, rotation: Array) -> Array:
        return np.array([0.0, 0.0, stiffness * max(0.0, height - position[2]), 0.0, 0.0, 0.0])

    return wrench


class Robot:
    """A simulated robot tool, which moves along straight lines and feels the force of what it touches.

    Args:
        pose: `(6,)` pose of the tool in the base at the start: position (m) and rotation vector (rad).
        contact: Function that computes the wrench of contact at a position and rotation, such as `plane`.
        noise: Standard deviation (N) of the force sensor along each axis.
    """

    def __init__(self, pose: Array, contact: Contact, noise: float) -> None:
        self.position, self.rotation, self.twist = pose[:3], so3_exp(pose[3:]), np.zeros(6)
        self.motion: LinearMotion | Braking | None = None
        self.travelled, self.speed = 0.0, 0.0  # m, m/s, along a line
        self.speed_fraction = 1.0  # set by the speed slider
        self.max_speed = 0.0  # m/s, the maximum so far
        self.contact, self.noise = contact, noise
        self.external_wrench = np.zeros(6)  # added to the wrench of contact
        self.wrench_zero = np.zeros(6)  # wrench that the sensor reports as zero
        self.rng = np.random.default_rng(0)

    @property
    def pose(self) -> Array:
        """Pose (6,) of the tool in the base: position (m) and rotation vector (rad)."""
        return np.concatenate([self.position, so3_log(self.rotation)])

    def wrench(self) -> Array:
        """Compute the true wrench (6,) on the tool: N and Nm, in base axes."""
        return self.contact(self.position, self.rotation) + self.external_wrench

    def measured_wrench(self) -> Array:
        """Draw the wrench (6,) that the sensor reports, with noisy forces and minus its zero: N and Nm, base axes."""
        noise = self.noise * np.append(self.rng.standard_normal(3), np.zeros(3))
        return self.wrench() - self.wrench_zero + noise

    def zero_wrench(self) -> None:
        """Make the sensor report zero for the present wrench."""
        self.wrench_zero = self.wrench()

    def line_to(self, pose: Array, speed: float, acceleration: float) -> None:
        """Start a straight motion of the tool from its present pose.

        Args:
            pose: `(6,)` pose in the base at the end: position (m) and rotation vector (rad).
            speed: Speed (m/s) along the line.
            acceleration: Acceleration (m/s^2) at both ends.
        """
        turn = so3_log(so3_exp(pose[3:]) @ self.rotation.T)
        if np.linalg.norm(turn) <= 1e-9:  # rad; a rotation this small is only rounding
            turn = np.zeros(3)
        displacement = np.concatenate([pose[:3] - self.position, turn])
        length = max(float(np.linalg.norm(displacement[:3])), ROTATION_LEVER_M * float(np.linalg.norm(turn)))
        self.travelled = self.speed = 0.0
        self.motion = LinearMotion(
            position=self.position,
            rotation=self.rotation,
            displacement=displacement,
            length=length,
            speed=speed,
            acceleration=acceleration,
        )

    def stop(self, deceleration: float = 5.0) -> None:
        """Start slowing the tool down to a standstill.

        Args:
            deceleration: Deceleration (m/s^2), by default that with which a robot stops when its program ends.
        """
        if self.motion is not None:
            self.motion = Braking(deceleration)

    def step(self, dt: float) -> None:
        """Advance the tool's motion in time.

        Args:
            dt: Time step (s).
        """
        if isinstance(self.motion, LinearMotion):
            self._step_line(self.motion, dt)
        elif isinstance(self.motion, Braking):
            self._brake(self.motion.deceleration * dt, dt)
        self.max_speed = max(self.max_speed, float(np.linalg.norm(self.twist[:3])))

    def _step_line(self, line: LinearMotion, dt: float) -> None:
        left = line.length - self.travelled
        braking_speed = float(np.sqrt(2 * line.acceleration * left))
        self.speed = min(self.speed + line.acceleration * dt, line.speed * self.speed_fraction, braking_speed)
        self.travelled += self.speed * dt
        if self.travelled >= line.length - 1e-9:
            self.travelled, self.speed, self.motion = line.length, 0.0, None
        part = self.travelled / line.length if line.length else 1.0
        self.twist = line.displacement * (self.speed / line.length if line.length else 0.0)
        self.position = line.position + part * line.displacement[:3]
        if line.displacement[3:].any():
            self.rotation = so3_exp(part * line.displacement[3:]) @ line.rotation

    def _brake(self, change: float, dt: float) -> None:
        """Continue more slowly, with a given change of speed (m/s)."""
        speed = float(np.hypot(np.linalg.norm(self.twist[:3]), ROTATION_LEVER_M * np.linalg.norm(self.twist[3:])))
        self.twist = self.twist * (1 - change / speed) if speed > change else np.zeros(6)
        self.position = self.position + self.twist[:3] * dt
        if self.twist[3:].any():
            self.rotation = so3_exp(self.twist[3:] * dt) @ self.rotation
        if not self.twist.any():
            self.motion = None
