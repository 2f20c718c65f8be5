"""Third-party arm, skin and depth camera for `i2t collect --arm acme --skin acme --camera acme`.

Each wraps its manufacturer's library, here `acme_sdk`, and converts its units to those of i2t.
"""

import time

import acme_sdk
import numpy as np

from i2t.depth.camera import Camera
from i2t.hardware.base import CameraBase
from i2t.hardware.guarded import PolledArm
from i2t.hardware.plugins import DeviceSetup
from i2t.hardware.poses import pose_from_vector, pose_to_vector
from i2t.hardware.protocols import ArmState, CameraFeatures, View
from i2t.hardware.skin_stream import Measurement, StreamedSkin
from i2t.skin.boards import grid_board
from i2t.types import Array

SOURCE = "simulated"  # "real" for real devices


class AcmeArm(PolledArm):
    """Acme's arm, within the rig's limits."""

    name, source = "Acme's arm", SOURCE

    def __init__(self, setup: DeviceSetup) -> None:
        super().__init__(setup.rig.limits)
        self.address = setup.address or "192.168.1.20"

    def open_link(self) -> None:
        """Connect."""
        self.robot = acme_sdk.Robot(self.address)

    def close_link(self) -> None:
        """Disconnect."""
        self.robot.disconnect()

    def read_state(self) -> ArmState:
        """Latest state in metres, radians and newtons, with the wrench in tool axes."""
        status = self.robot.status()
        T_b_t = pose_from_vector([*(1e-3 * status["position"]), *np.radians(status["rotation"])])
        velocity = np.array([*(1e-3 * status["velocity"]), *np.radians(status["turning"])])
        wrench = np.array([*status["force"], *status["torque"]])
        return ArmState(status["time"], T_b_t, status["joints"], velocity, wrench, status["busy"], not status["error"])

    def begin_line(self, T_b_t: Array, speed: float, acceleration: float) -> None:
        """Start a straight motion."""
        vector = np.array(pose_to_vector(T_b_t))
        self.robot.move_linear(1e3 * vector[:3], np.degrees(vector[3:]), 1e3 * speed, 1e3 * acceleration)

    def brake(self) -> None:
        """Brake, without waiting."""
        self.robot.halt()

    def zero_sensor(self) -> None:
        """Zero the force sensor."""
        self.robot.tare()


class AcmeSkin(StreamedSkin):
    """Acme's skin; `board` gives the positions of its four chips."""

    board = grid_board(2, 2)

    def __init__(self, setup: DeviceSetup) -> None:
        super().__init__("Acme's skin", self.board.num_chips, rate=400.0, source=SOURCE)
        self.port = setup.address or "/dev/ttyACM0"

    def open_link(self) -> acme_sdk.Board:
        """Open the port."""
        return acme_sdk.Board(self.port)

    def receive(self, link: acme_sdk.Board) -> list[Measurement]:
        """New samples, in microtesla."""
        return [Measurement(measured, 0.1 * milligauss, celsius) for measured, milligauss, celsius in link.samples()]

    def close_link(self, link: acme_sdk.Board) -> None:
        """Close the port."""
        link.shut()


class AcmeCamera(CameraBase):
    """Acme's camera, mounted on the arm."""

    def __init__(self, setup: DeviceSetup) -> None:
        super().__init__(CameraFeatures("Acme's camera", SOURCE, nearest=0.03, rate=30.0))
        self.serial = setup.address or ""
        self.eye: acme_sdk.DepthCamera | None = None

    def connect(self) -> None:
        """Switch the camera on, and read its intrinsics."""
        self.eye = acme_sdk.DepthCamera(self.serial)
        self._camera = Camera(*self.eye.intrinsics)

    def close(self) -> None:
        """Switch the camera off."""
        self.eye = None

    def capture(self, timeout: float = 2.0) -> View:
        """Capture a new view, in metres."""
        if self.eye is None:
            raise self._not_connected()
        depth, colour = self.eye.grab()
        return View(time.monotonic(), np.where(depth > 0, 1e-3 * depth, np.nan).astype(np.float32), colour)
