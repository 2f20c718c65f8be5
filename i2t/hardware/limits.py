"""What no motion of an arm may exceed, and the refusal of what would, before a packet is sent.

Goals are (4, 4) T_b_t in metres, tool in robot base. The box holds the tool's origin: flange, elbow and cable are not
watched here, so set the robot's own safety limits on the pendant too.
"""

from dataclasses import dataclass

import numpy as np

from i2t.types import Array

RANGES = {  # the greatest that makes sense of an arm that carries a skin, and its unit
    "speed": (1.0, "m/s"),
    "acceleration": (5.0, "m/s^2"),
    "force": (150.0, "N"),
    "torque": (50.0, "Nm"),
    "travel": (0.5, "m"),
}
REACH = 3.0  # m: no arm that this is for reaches further


@dataclass(frozen=True)
class Limits:
    """Anything beyond is refused, or stops the arm. Raises ValueError for limits that are none."""

    lower: tuple[float, float, float]  # m, corner of the box for the tool's origin, base axes
    upper: tuple[float, float, float]  # m
    speed: float = 0.25  # m/s
    acceleration: float = 0.5  # m/s^2
    force: float = 30.0  # N, on any motion; an approach has its own, lower one
    torque: float = 10.0  # Nm
    travel: float = 0.1  # m, of one approach

    def __post_init__(self) -> None:
        for name in ("lower", "upper"):
            corner = np.asarray(getattr(self, name), float)
            if corner.shape != (3,) or not np.isfinite(corner).all() or np.abs(corner).max() > REACH:
                raise ValueError(f"{name} is {getattr(self, name)}; give x, y, z in m, each within {REACH:g} m")
            object.__setattr__(self, name, tuple(float(x) for x in corner))
        if not all(low < high for low, high in zip(self.lower, self.upper, strict=True)):
            raise ValueError(
                f"lower, {self.lower}, must lie below upper, {self.upper}, in x, y and z; move the corners"
            )
        for name, (most, unit) in RANGES.items():
            given = getattr(self, name)
            if not 0 < given <= most:
                raise ValueError(f"{name} is {given:g}; give {unit}, above 0 and at most {most:g}")

    def check(self, goal: Array, speed: float, acceleration: float) -> None:
        """Refuse (ValueError) a goal that is no pose or lies outside the box, and what is too fast."""
        pose = np.asarray(goal, float)
        if pose.shape != (4, 4) or not np.isfinite(pose).all() or not np.allclose(pose[3], [0, 0, 0, 1]):
            raise ValueError("A goal must be a finite (4, 4) transform of the tool in the robot's base.")
        turned, at = pose[:3, :3], pose[:3, 3]
        if not np.allclose(turned @ turned.T, np.eye(3), atol=1e-5) or np.linalg.det(turned) < 0:
            raise ValueError("A goal's rotation must be a rotation: orthonormal and right-handed.")
        if not self.hold(at):
            raise ValueError(
                f"The goal {place(at)} m is outside the box from {place(self.lower)} to {place(self.upper)} m."
            )
        for name, asked in (("speed", speed), ("acceleration", acceleration)):
            if not 0 < asked <= getattr(self, name):
                raise ValueError(f"The {name} {asked} is outside (0, {getattr(self, name)}], the arm's limit.")

    def check_approach(self, travel: float, force: float, torque: float) -> None:
        """Refuse (ValueError) an approach that goes too far or pushes too hard."""
        if not 0 < travel <= self.travel:
            raise ValueError(
                f"An approach of {travel} m is outside (0, {self.travel}], the arm's limit for its travel."
            )
        for name, asked in (("force", force), ("torque", torque)):
            if not 0 < asked <= getattr(self, name):
                raise ValueError(
                    f"An approach's {name} {asked} is outside (0, {getattr(self, name)}], the arm's limit."
                )

    def hold(self, at: Array, margin: float = 0.0) -> bool:
        """Whether a place (3,) in the base is in the box, or at most `margin` (m) beside it."""
        return bool(
            (np.asarray(at) >= np.array(self.lower) - margin).all()
            and (np.asarray(at) <= np.array(self.upper) + margin).all()
        )


def place(at: Array) -> str:
    """A place (3,) in m, for a sentence."""
    return "(" + ", ".join(f"{x:.3f}" for x in at) + ")"
