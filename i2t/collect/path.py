"""Path of the tool for a touch, and its check: all goals are compared with the box before the first motion.

A goal outside the box is refused, and never moved inside. Frames: W world, B robot base, T tool; metres.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from i2t.collect.settings import TouchSettings
from i2t.collect.touch import Site, UnreachableError
from i2t.hardware.collision import fastest_speed
from i2t.hardware.limits import SAFETY
from i2t.hardware.motion_limits import format_position
from i2t.hardware.poses import translated_along_z
from i2t.hardware.rig import Rig
from i2t.types import Array


@dataclass(frozen=True)
class TouchPath:
    """Poses that the tool moves to in each touch, the path between them, and checks that the arm can follow it.

    Args:
        rig: The rig, with the arm's limits.
        settings: Distances, speeds and limits of a touch.
        top: Height (m) of the object's highest point in W.
        why_unreachable: The arm's own check of poses (`i2t.hardware.protocols.PlanningArm`), if it has one.
    """

    rig: Rig
    settings: TouchSettings
    top: float
    why_unreachable: Callable[[Sequence[Array]], str] | None = None

    def poses(self, site: Site) -> tuple[Array, Array, Array, Array]:
        """Compute the poses at which the touch of a site looks, prepares, slows down and ends at the latest.

        Args:
            site: The site to touch.

        Returns:
            Four `(4, 4)` poses T_b_t (m) of the tool in the robot's base, in that order.
        """
        T_w_look = np.array(site.T_w_t)
        T_t_c = self.rig.T_tool_camera
        axis = site.T_w_t[:3, :3] @ T_t_c[:3, 2]
        T_w_look[:3, 3] -= self.rig.looking_distance * axis + site.T_w_t[:3, :3] @ T_t_c[:3, 3]
        along = (-self.settings.prepare, -self.settings.near, self.settings.overtravel)
        to_base = self.rig.T_base_world
        prepare, near, end = (to_base @ translated_along_z(site.T_w_t, z) for z in along)
        return to_base @ T_w_look, prepare, near, end

    def check(self, site: Site) -> None:
        """Refuse an unreachable site before any motion.

        Args:
            site: The site to touch.

        Raises:
            UnreachableError: If a pose of its touch, or the path to it, is outside the arm's box, or the arm cannot
                reach it.
        """
        if why := self.explain_unreachable(site):
            raise UnreachableError(why)

    def explain_unreachable(self, site: Site, looks: bool = True) -> str:
        """Explain why a site cannot be reached.

        Args:
            site: The site to touch.
            looks: Whether the camera is to look at the site before it is touched.

        Returns:
            A sentence, or the empty string if the site can be reached.

        Raises:
            UnreachableError: If no site can be reached, because the transfer height above the object is outside the
                box.
        """
        look, prepare, near, end = self.poses(site)
        goals = {"look": look} if looks else {}
        for name, goal in (goals | {"prepare": prepare, "slow down": near, "end": end}).items():
            if not self.rig.limits.contains(goal[:3, 3]):
                return (
                    f"to {name} at site {site.number} the tool would be at {format_position(goal[:3, 3])} m, outside "
                    "the box"
                )
        # The lines of a touch: down to look, up, across, down to prepare, to the end.
        height = self.transfer_height()
        above_look, above = (_raised_to(pose, height) for pose in (look, prepare))
        lines = (*((above_look, look, above_look) if looks else ()), above, prepare, end)
        refused = "" if self.why_unreachable is None else self.why_unreachable(lines)
        return f"site {site.number}: {refused}" if refused else ""

    def check_settings(self) -> None:
        """Refuse settings that the arm's limits forbid, before any motion.

        Raises:
            ValueError: If a speed, force, torque or approach exceeds its limit.
            UnreachableError: If the transfer height above the object is outside the box.
        """
        settings, limits = self.settings, self.rig.limits
        for name, limit, unit in (
            *((name, limits.speed, "m/s") for name in ("speed", "approach", "press", "retreat")),
            ("acceleration", limits.acceleration, "m/s^2"),
        ):
            value = getattr(settings, name)
            if not value <= limit:
                raise ValueError(f"{name} is {value:g} {unit}, above the rig's limit, {limit:g}; lower it")
        for distance in (settings.prepare - settings.near, settings.near + settings.overtravel):
            if distance > 0:
                limits.check_approach(distance, settings.force, settings.torque)
        for name in ("approach", "press"):
            self._check_stops(name, getattr(settings, name))
        self.transfer_height()

    def _check_stops(self, name: str, speed: float) -> None:
        """Refuse a guarded motion whose overrun exceeds the rig's force limit after a stop at the settings' force."""
        limits, force = self.rig.limits, self.settings.force
        final_force = limits.collision_force(speed, force)
        if not final_force <= limits.force:
            allowed = fastest_speed(limits.force - force, limits.stiffness, braking=SAFETY.braking_m_s2)
            raise ValueError(
                f"{name} is {speed:g} m/s: a motion that is stopped at {force:g} N would end at {final_force:.0f} N "
                f"(at {limits.stiffness / 1e3:g} N/mm), above the rig's limit, {limits.force:g} N; give {allowed:.2g} "
                "m/s or less, or lower settings.force"
            )

    @property
    def free_speed(self) -> float:
        """Speed (m/s) in the air: as requested, but no faster than what can be stopped within the force limit."""
        return min(self.settings.speed, self.rig.limits.free_speed)

    @property
    def retreat_speed(self) -> float:
        """Speed (m/s) of retreats: as requested, but no faster than what can be stopped within the force limit."""
        return min(self.settings.retreat, self.rig.limits.free_speed)

    def transfer_height(self) -> float:
        """Compute the height at which the tool moves between sites: `clearance` above the object's highest point.

        Returns:
            Height (m) of the tool's origin in the robot's base.

        Raises:
            UnreachableError: If the box ends below that height.
        """
        low, high = self.rig.limits.lower[2], self.rig.limits.upper[2]
        height = self.top - self.rig.T_world_base[2, 3] + self.settings.clearance
        if not height <= high:
            raise UnreachableError(
                f"between sites the tool would move at {height:.3f} m in the base, "
                f"{1e3 * self.settings.clearance:.0f} mm above the object, but the box ends at {high:.3f} m; raise the "
                "box, or lower settings.clearance"
            )
        return float(max(height, low))


def _raised_to(T_b_t: Array, height: float) -> Array:
    """Raise a pose to a height (m in the base), unless it is already above it."""
    raised = np.array(T_b_t)
    raised[2, 3] = max(raised[2, 3], height)
    return raised
