"""A lab in closed form: a springy plane, a skin that changes in proportion to force, time that costs nothing."""

import numpy as np

from i2t.collect.procedure import Procedure, Seen, Settings, Site
from i2t.collect.recorder import Names
from i2t.depth.camera import Camera
from i2t.emulators.in_process import Lab, SimulatedArm, SimulatedSkin, Virtual
from i2t.emulators.scene import Flat
from i2t.errors import NotConnectedError
from i2t.hardware.protocols import CameraFeatures, View
from i2t.hardware.rig import Rig
from i2t.simulation.touches import Errors
from i2t.skin import boards
from i2t.skin.noise import Noise
from i2t.types import PATCH_PIXELS, READINGS, WIDE_PIXELS

HEIGHT = 0.03  # m, of the plane
WALL = 1.7e9  # Unix time at which a test begins
GAIN = np.linspace(-9, 12, READINGS)  # uT/N
DOWN = np.diag([1.0, -1.0, -1.0])
QUIET = Errors.none()
NOISY = Errors.none().__class__(**{**vars(Errors.none()), "noise": Noise(), "force": 0.1})


class Eye:
    """A camera that sees the plane."""

    camera = Camera(16, 12, 10.0, 10.0, 7.5, 5.5)

    def __init__(self, clock):
        self.clock, self.features, self.trouble, self.connects = (
            clock,
            CameraFeatures("eye", "simulated", 0.0, 30.0),
            None,
            0,
        )

    def connect(self):
        self.connects += 1

    def close(self):
        pass

    def __enter__(self):
        self.connect()
        return self

    def __exit__(self, *error):
        self.close()

    def capture(self, timeout=2.0):
        if self.trouble is not None:
            raise self.trouble
        if not self.connects:
            raise NotConnectedError("eye is not connected")
        return View(self.clock.now(), np.full((12, 16), 0.104, np.float32), np.zeros((12, 16, 3), np.uint8))


def cut(view, camera, T_w_c, T_w_t, nearest=None, share=1.0):
    at = T_w_t[2, 3] - HEIGHT if nearest is None else nearest
    wide = np.zeros((WIDE_PIXELS, WIDE_PIXELS), np.float32)
    return Seen(np.zeros((PATCH_PIXELS, PATCH_PIXELS), np.float32), wide, at, share)


def site(number, x=0.0, y=0.0, height=HEIGHT, turned=DOWN):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turned, [x, y, height]
    return Site(number, pose)


def make(stiffness=10e3, gain=GAIN, errors=QUIET, settings=None, clock=None, latency=0.03, seed=0):
    """A procedure whose devices are connected."""
    clock = clock or Virtual(WALL)
    lab = Lab(Flat(HEIGHT, stiffness, gain, errors, boards.reskin_board()), clock, seed=seed)
    rig = Rig()
    arm, skin, eye = SimulatedArm(lab, rig.limits, latency), SimulatedSkin(lab), Eye(clock)
    for device in (arm, skin, eye):
        device.connect()
    return Procedure(arm, skin, eye, rig, boards.reskin_board(), cut, HEIGHT, settings or Settings(), clock)


def names(procedure):
    rig = procedure.rig
    return Names(
        "plane", "pad", "run", "simulated", boards.reskin_board(), rig.T_world_base, rig.T_world_object, Eye.camera, {}
    )
