"""A lab in closed form: a springy plane, a skin that changes in proportion to force, time that costs nothing."""

from dataclasses import replace

import numpy as np
from helpers.spring_plane import SpringPlane

from i2t.collect.procedure import Procedure
from i2t.collect.recorder import SessionInfo, SkinInfo
from i2t.collect.settings import TouchSettings
from i2t.collect.touch import TOOL, SeenPatch, Site, SkinOnTool
from i2t.depth.camera import Camera
from i2t.emulators.in_process import SimulatedArm, SimulatedLab, SimulatedSkin, VirtualClock
from i2t.errors import NotConnectedError
from i2t.geometry import transform
from i2t.hardware.base import DeviceBase
from i2t.hardware.protocols import CameraFeatures, View
from i2t.hardware.rig import Rig
from i2t.patches.dimensions import PATCH_PIXELS, VIEW_PIXELS
from i2t.simulation.touches import SimulationErrors
from i2t.skin import boards
from i2t.skin.noise import Noise

HEIGHT = 0.03  # m, of the plane
WALL = 1.7e9  # Unix time at which a test begins
BOARD = boards.reskin_board()
GAIN = np.linspace(-9, 12, BOARD.num_readings)  # uT/N
DOWN = np.diag([1.0, -1.0, -1.0])
QUIET = SimulationErrors.error_free()
NOISY = SimulationErrors.error_free().__class__(
    **{**vars(SimulationErrors.error_free()), "noise": Noise(), "force": 0.1}
)


class Eye(DeviceBase):
    """A camera that sees the plane."""

    camera = Camera(16, 12, 10.0, 10.0, 7.5, 5.5)

    def __init__(self, clock):
        self.clock, self.trouble, self.connects = clock, None, 0
        self.features = CameraFeatures("eye", "simulated", 0.0, 30.0)

    def connect(self):
        self.connects += 1

    def close(self):
        pass

    def capture(self, timeout=2.0):
        if self.trouble is not None:
            raise self.trouble
        if not self.connects:
            raise NotConnectedError("eye is not connected")
        return View(self.clock.now(), np.full((12, 16), 0.104, np.float32), np.zeros((12, 16, 3), np.uint8))


def extract_patch(view, camera, T_w_c, T_w_t, nearest=None, visible_share=1.0):
    at = T_w_t[2, 3] - HEIGHT if nearest is None else nearest
    view = np.zeros((VIEW_PIXELS, VIEW_PIXELS), np.float32)
    return SeenPatch(np.zeros((PATCH_PIXELS, PATCH_PIXELS), np.float32), view, at, visible_share)


def site(number, x=0.0, y=0.0, height=HEIGHT, turned=DOWN):
    return Site(number, transform(turned, np.array([x, y, height])))


def listed(*sites):
    """Choose these sites, one after the other."""
    return lambda history: sites[len(history)] if len(history) < len(sites) else None


def make(
    stiffness=10e3, gain=GAIN, errors=QUIET, settings=None, clock=None, latency=0.03, seed=0, board=BOARD, rig=None
):
    """A procedure whose devices are connected. Its rig says that the mount gives, so that motions in the air are quick,
    which saves the tests' time.
    """
    clock = clock or VirtualClock(WALL)
    lab = SimulatedLab(SpringPlane(HEIGHT, stiffness, gain, errors, board), clock, seed=seed)
    rig = rig or replace(Rig(), limits=replace(Rig().limits, stiffness=1e3))
    arm, skin, eye = SimulatedArm(lab, rig.limits, latency), SimulatedSkin(lab), Eye(clock)
    for device in (arm, skin, eye):
        device.connect()
    return Procedure(
        arm, [SkinOnTool(TOOL, skin, board)], eye, rig, extract_patch, HEIGHT, settings or TouchSettings(), clock
    )


def names(procedure):
    rig, pads = procedure.rig, {each.name: SkinInfo(each.pad or "pad", each.board) for each in procedure.skins}
    return SessionInfo("plane", "session", "simulated", rig.T_world_base, rig.T_world_object, Eye.camera, pads)
