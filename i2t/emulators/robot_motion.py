"""A tool that moves in time: straight lines, constant speeds, stops, giving way to forces, and what it touches.

Lines have a trapezoidal speed profile; speeds change by at most an acceleration. Where a motion also turns, a radian
counts as 0.25 m of travel. Poses are six numbers as a UR robot has them, metres and a rotation vector in its base axes.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from i2t.geometry import so3_exp, so3_log

Array = NDArray[np.float64]

LEVER = 0.25  # m of travel that a radian counts as


def toward(current: Array, target: Array, most: float) -> Array:
    """Change a vector towards a target by at most a given length."""
    step = target - current
    length = float(np.linalg.norm(step))
    return target if length <= most else current + step * (most / length)


class Line(NamedTuple):
    """Straight motion from a pose to a pose, rotation about a fixed axis in proportion."""

    start: Array  # (3,) m
    turned: Array  # (3, 3)
    along: Array  # (6,) whole displacement and rotation vector, base axes
    length: float  # m
    speed: float  # m/s
    acceleration: float  # m/s^2


class Constant(NamedTuple):
    """Speed that is reached and kept; zero is a stop."""

    twist: Array  # (6,) m/s and rad/s, base axes
    acceleration: float  # m/s^2


class Compliant(NamedTuple):
    """Along chosen axes of a frame the tool moves until it pushes with the given wrench; the others stand still."""

    frame: Array  # (3, 3) axes of the task in the base
    chosen: Array  # (6,) 0 or 1
    wrench: Array  # (6,) N and Nm on the environment
    fastest: Array  # (6,) m/s and rad/s


Contact = Callable[
    [Array, Array], Array
]  # position (3,) and rotation (3, 3) of the tool -> wrench (6,) on it, base axes


def plane(height: float, stiffness: float) -> Contact:
    """A horizontal plane (m) that pushes back like a spring (N/m), without friction, on the tool's origin."""

    def wrench(position: Array, turned: Array) -> Array:
        return np.array([0.0, 0.0, stiffness * max(0.0, height - position[2]), 0.0, 0.0, 0.0])

    return wrench


class Robot:
    """A tool that moves in time and touches; `extra` is a wrench from elsewhere, `bias` what the sensor makes up."""

    def __init__(self, pose: Array, contact: Contact, bias: Array, noise: float) -> None:
        self.position, self.turned, self.twist = pose[:3], so3_exp(pose[3:]), np.zeros(6)
        self.motion: Line | Constant | Compliant | None = None
        self.travelled, self.rate, self.scaling, self.fastest = 0.0, 0.0, 1.0, 0.0
        self.contact, self.noise = contact, noise
        self.extra, self.zero, self.bias = np.zeros(6), np.zeros(6), bias
        self.random = np.random.default_rng(0)

    @property
    def pose(self) -> Array:
        """(6,) metres and rotation vector."""
        return np.concatenate([self.position, so3_log(self.turned)])

    def felt(self) -> Array:
        """Wrench (6,) that is really on the tool, N and Nm, base axes."""
        return self.contact(self.position, self.turned) + self.extra

    def told(self) -> Array:
        """Wrench (6,) that the sensor tells, zeroed and without its noise."""
        return self.felt() + self.bias - self.zero

    def measured(self) -> Array:
        """Wrench (6,) that the sensor tells."""
        return self.told() + self.noise * np.append(self.random.standard_normal(3), np.zeros(3))

    def line_to(self, pose: Array, speed: float, acceleration: float) -> None:
        """Start a straight motion from the present pose."""
        turn = so3_log(so3_exp(pose[3:]) @ self.turned.T)
        along = np.concatenate([pose[:3] - self.position, turn])
        length = max(float(np.linalg.norm(along[:3])), LEVER * float(np.linalg.norm(turn)))
        self.travelled = self.rate = 0.0
        self.motion = Line(self.position, self.turned, along, length, speed, acceleration)

    def stop(self, deceleration: float = 5.0) -> None:
        """Slow down to a stand."""
        if self.motion is not None:
            self.motion = Constant(np.zeros(6), deceleration)

    def step(self, dt: float) -> None:
        """Advance by a tick."""
        if isinstance(self.motion, Line):
            self._follow(self.motion, dt)
        elif isinstance(self.motion, Compliant):
            frame, chosen, wanted, most = self.motion
            both = np.kron(np.eye(2), frame)
            # Slow enough that a contact of 100 N/mm converges: the lag in one tick is a fifth of the way.
            pushed = (wanted + both.T @ self.told()) * 1e-3
            self.twist = both @ (chosen * np.clip(pushed, -most, most))
            self._drift(dt)
        elif self.motion is not None:
            target, a = self.motion
            scale = np.array([1.0, 1.0, 1.0, LEVER, LEVER, LEVER])
            self.twist = toward(self.twist * scale, self.scaling * target * scale, a * dt) / scale
            self._drift(dt)
            if not target.any() and not self.twist.any():
                self.motion = None
        self.fastest = max(self.fastest, float(np.linalg.norm(self.twist[:3])))

    def _drift(self, dt: float) -> None:
        self.position = self.position + self.twist[:3] * dt
        self.turned = so3_exp(self.twist[3:] * dt) @ self.turned

    def _follow(self, line: Line, dt: float) -> None:
        left = line.length - self.travelled
        brake = float(np.sqrt(2 * line.acceleration * left))
        self.rate = min(self.rate + line.acceleration * dt, line.speed * self.scaling, brake)
        self.travelled += self.rate * dt
        if self.travelled >= line.length - 1e-9:
            self.travelled, self.rate, self.motion = line.length, 0.0, None
        part = self.travelled / line.length if line.length else 1.0
        self.twist = line.along * (self.rate / line.length if line.length else 0.0)
        self.position = line.start + part * line.along[:3]
        self.turned = so3_exp(part * line.along[3:]) @ line.turned
