"""A tool that moves in time: straight lines, stops, and what it touches.

Lines have a trapezoidal speed profile; speeds change by at most an acceleration. Where a motion also turns, a radian
counts as 0.25 m of path. Poses are six numbers as a UR robot has them, metres and a rotation vector in its base axes;
so are twists (m/s, rad/s) and wrenches (N, Nm), along the base's axes.
"""

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from i2t.geometry import so3_exp, so3_log

Array: TypeAlias = NDArray[np.float64]
Contact: TypeAlias = Callable[[Array, Array], Array]  # position (3,) and rotation (3, 3) of the tool -> wrench on it

ROTATION_LEVER_M = 0.25  # of path, that a radian counts as
STOP_DECELERATION = 5.0  # m/s^2, of a program that ends
ARRIVED_M = 1e-9


class LinearMotion(NamedTuple):
    """Straight motion from a pose to a pose, rotation about a fixed axis in proportion."""

    position: Array  # (3,) m, at the start
    rotation: Array  # (3, 3)
    displacement: Array  # (6,) to the end: m and rotation vector
    length: float  # m
    speed: float  # m/s
    acceleration: float  # m/s^2


class Braking(NamedTuple):
    """A motion that slows down to a stand."""

    deceleration: float  # m/s^2


def plane(height: float, stiffness: float) -> Contact:
    """A horizontal plane that pushes back like a spring, without friction, on the tool's origin.

    Args:
        height: m in the base.
        stiffness: N/m.

    Returns:
        The contact with it.
    """

    def wrench(position: Array, rotation: Array) -> Array:
        return np.array([0.0, 0.0, stiffness * max(0.0, height - position[2]), 0.0, 0.0, 0.0])

    return wrench


class Robot:
    """A tool that moves in time and touches.

    Args:
        pose: (6,) at the start.
        contact: What the tool touches.
        noise: N, standard deviation of the sensor's force on each axis.
    """

    def __init__(self, pose: Array, contact: Contact, noise: float) -> None:
        self.position, self.rotation, self.twist = pose[:3], so3_exp(pose[3:]), np.zeros(6)
        self.motion: LinearMotion | Braking | None = None
        self.travelled, self.speed = 0.0, 0.0  # m, m/s, along a line
        self.speed_fraction = 1.0  # that the slider leaves
        self.max_speed = 0.0  # m/s, the greatest so far
        self.contact, self.noise = contact, noise
        self.external_wrench, self.wrench_zero = np.zeros(6), np.zeros(6)  # from elsewhere; that reads as nothing
        self.rng = np.random.default_rng(0)

    @property
    def pose(self) -> Array:
        """(6,) metres and rotation vector."""
        return np.concatenate([self.position, so3_log(self.rotation)])

    def wrench(self) -> Array:
        """Wrench (6,) that is really on the tool."""
        return self.contact(self.position, self.rotation) + self.external_wrench

    def measured_wrench(self) -> Array:
        """Wrench (6,) that the sensor reports."""
        noise = self.noise * np.append(self.rng.standard_normal(3), np.zeros(3))
        return self.wrench() - self.wrench_zero + noise

    def zero_wrench(self) -> None:
        """Have the sensor report nothing for what it feels now."""
        self.wrench_zero = self.wrench()

    def line_to(self, pose: Array, speed: float, acceleration: float) -> None:
        """Start a straight motion from the present pose.

        Args:
            pose: (6,) at the end.
            speed: m/s.
            acceleration: m/s^2.
        """
        turn = so3_log(so3_exp(pose[3:]) @ self.rotation.T)
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

    def stop(self, deceleration: float = STOP_DECELERATION) -> None:
        """Slow down to a stand.

        Args:
            deceleration: m/s^2.
        """
        if self.motion is not None:
            self.motion = Braking(deceleration)

    def step(self, dt: float) -> None:
        """Advance in time.

        Args:
            dt: s.
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
        if self.travelled >= line.length - ARRIVED_M:
            self.travelled, self.speed, self.motion = line.length, 0.0, None
        part = self.travelled / line.length if line.length else 1.0
        self.twist = line.displacement * (self.speed / line.length if line.length else 0.0)
        self.position = line.position + part * line.displacement[:3]
        self.rotation = so3_exp(part * line.displacement[3:]) @ line.rotation

    def _brake(self, change: float, dt: float) -> None:
        """Go on more slowly, by a change of speed (m/s)."""
        speed = float(np.hypot(np.linalg.norm(self.twist[:3]), ROTATION_LEVER_M * np.linalg.norm(self.twist[3:])))
        self.twist = self.twist * (1 - change / speed) if speed > change else np.zeros(6)
        self.position = self.position + self.twist[:3] * dt
        self.rotation = so3_exp(self.twist[3:] * dt) @ self.rotation
        if not self.twist.any():
            self.motion = None
