"""A simulated lab in closed form: a springy plane, a skin that changes in proportion to force, virtual time."""

from collections.abc import Callable
from io import BytesIO
from typing import Any

import numpy as np

from i2t.collect.procedure import Procedure
from i2t.collect.recorder import EventLog, SessionInfo, SkinInfo
from i2t.collect.settings import TouchSettings
from i2t.collect.touch import TOOL, SeenPatch, Site, SkinOnTool
from i2t.depth.camera import Camera
from i2t.emulators.in_process import SimulatedArm, SimulatedCamera, SimulatedLab, SimulatedSkin, VirtualClock
from i2t.hardware.clock import MonotonicClock
from i2t.hardware.poses import translated_along_z
from i2t.hardware.protocols import ApproachResult, ArmState, View
from i2t.hardware.rig import Rig
from i2t.patches.dimensions import PATCH_PIXELS, VIEW_PIXELS
from i2t.simulation.touches import SimulationErrors
from i2t.skin import boards
from i2t.types import Array
from tests.helpers.spring_plane import SpringPlane

HEIGHT_M, STIFFNESS_N_M = 0.03, 10e3  # of the plane
WALL_TIME_S = 1.8e9  # Unix time at which simulated time begins
BOARD = boards.reskin_board()
GAIN_UT_PER_N = np.linspace(-9, 12, BOARD.num_readings)
LENS = Camera(64, 36, 32.2, 32.2, 31.5, 17.5)


class SettableClock(VirtualClock):
    """A clock whose Unix time is set wrong by `jump` (s)."""

    jump = 0.0

    def wall(self) -> float:
        """Unix time (s)."""
        return super().wall() + self.jump


class MemoryLog(EventLog):
    """Log of a touch that no file keeps."""

    def __init__(self) -> None:
        super().__init__(BytesIO(), MonotonicClock())

    @property
    def positions(self) -> list[Array]:
        """Where the tool was (m, in the base), state by state."""
        return [state.T_b_t[:3, 3] for state in self.states]


class ForeignArm(SimulatedArm):
    """An arm whose `approach` is its maker's own and believes itself: it checks neither limits nor states.

    States are what `lie` makes of them, and a press goes `too_far` (m), `hasty` times as fast as asked.
    """

    asks, too_far, hasty = True, 0.0, 1.0

    def lie(self, state: ArmState) -> ArmState:
        """What it says of a state."""
        return state

    def state(self, timeout: float | None = None) -> ArmState:
        """The newest state, whatever it is."""
        return self.lie(self.read_state())

    def approach(
        self,
        distance: float,
        speed: float = 0.005,
        stop_condition: Callable[[ArmState], Any] | None = None,
        *_: float,
        acceleration: float = 0.2,
        **ignored: float,
    ) -> ApproachResult:
        """Move along tool z until the distance is over, or the stop condition says so; force and torque are ignored."""
        start, answer = self.read_state().T_b_t, None
        self.begin_line(translated_along_z(start, distance + self.too_far), self.hasty * speed, acceleration)
        try:
            while self.read_state().moving and not answer:
                self.clock.sleep(self.poll_s)
                answer = stop_condition(self.state()) if stop_condition is not None and self.asks else None
        finally:
            self.brake()
            while self.read_state().moving:
                self.clock.sleep(self.poll_s)
        state = self.state()
        moved = float(np.linalg.norm(state.T_b_t[:3, 3] - start[:3, 3]))
        return ApproachResult("condition" if answer else "distance", answer, state, state, moved)


def site(number: int) -> Site:
    """One of 121 sites on the plane, 2 mm apart, over and over.

    Args:
        number: Number of the site, from 0.

    Returns:
        The site.
    """
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[:3, 3] = 2e-3 * (number % 11 - 5), 2e-3 * (number // 11 % 11 - 5), HEIGHT_M
    return Site(number, pose)


def plane_patch(view: View, camera: Camera, T_w_c: Array, T_w_t: Array) -> SeenPatch:
    """The patch of a plane that the tool faces: flat, and as far away as the middle of the view says.

    Args:
        view: View of the plane.
        camera: Camera that took the view.
        T_w_c: (4, 4) from where.
        T_w_t: (4, 4) the tool.

    Returns:
        The patch.
    """
    row, column = round(camera.cy), round(camera.cx)
    middle = view.depth[max(0, row - 8) : row + 9, max(0, column - 8) : column + 9]
    point = T_w_c[:3, 3] + float(np.nanmean(middle)) * T_w_c[:3, 2]
    nearest = float((point - T_w_t[:3, 3]) @ T_w_t[:3, 2])
    flat = np.zeros((VIEW_PIXELS, VIEW_PIXELS), np.float32)
    return SeenPatch(flat[:PATCH_PIXELS, :PATCH_PIXELS], flat, nearest, float(np.isfinite(middle).mean()))


def make_scene(height: float = HEIGHT_M, stiffness: float = STIFFNESS_N_M, gain: Array = GAIN_UT_PER_N) -> SpringPlane:
    """The plane, with the errors of a lab."""
    return SpringPlane(height, stiffness, gain, SimulationErrors(), BOARD)


def make_procedure(
    scene: SpringPlane | None = None, latency: float = 0.03, seed: int = 0, make_arm: type[SimulatedArm] = SimulatedArm
) -> Procedure:
    """A procedure over a plane whose devices are connected; its clock is a `SettableClock`."""
    scene, clock, rig = scene or make_scene(), SettableClock(WALL_TIME_S), Rig()
    lab = SimulatedLab(scene, clock, seed)
    arm, skin = make_arm(lab, rig.limits, latency), SimulatedSkin(lab)
    camera = SimulatedCamera(scene, LENS, rig.T_tool_camera, lambda: arm.state().T_b_t, clock, seed)
    for device in (arm, skin, camera):
        device.connect()
    settings = TouchSettings(patience=1.0)
    return Procedure(arm, [SkinOnTool(TOOL, skin, BOARD)], camera, rig, plane_patch, HEIGHT_M, settings, clock)


def session_info(rig: Rig, lens: Camera, source: str = "simulated") -> SessionInfo:
    """Names of a session over the plane."""
    skins = {TOOL: SkinInfo(source, BOARD)}
    return SessionInfo("plane", "session", "simulated", rig.T_world_base, rig.T_world_object, lens, skins)
