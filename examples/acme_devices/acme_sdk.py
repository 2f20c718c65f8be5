"""An invented manufacturer's library, independent of i2t, with millimetres, degrees and blocking calls.

i2t's simulated lab stands in for Acme's devices, so that the example runs anywhere. Nothing in this file is needed for
devices of your own.
"""

import time
from functools import lru_cache
from typing import Any

import jax
import numpy as np
from scipy.spatial.transform import Rotation

from i2t.emulators.in_process import SimulatedArm, SimulatedCamera, SimulatedLab, SimulatedSkin
from i2t.emulators.scene import ObjectScene
from i2t.hardware.clock import MonotonicClock
from i2t.hardware.rig import Rig
from i2t.objects.catalogue import make_object
from i2t.simulation.touches import SimulationErrors
from i2t.skin.boards import grid_board
from i2t.skin.pad import nominal_pad


@lru_cache(1)
def _lab() -> tuple[SimulatedLab, Rig]:
    """Create the simulated lab, with a hexagon on the table."""
    rig = Rig()
    pad = jax.jit(lambda: nominal_pad(board=grid_board(2, 2)))()
    scene = ObjectScene(make_object("hexagon").mesh, rig.T_base_world @ rig.T_world_object, pad, SimulationErrors())
    return SimulatedLab(scene, MonotonicClock()), rig


class Robot:
    """Acme's robot at an address."""

    def __init__(self, address: str) -> None:
        lab, rig = _lab()
        self._arm = SimulatedArm(lab, rig.limits, latency=0.0)

    def status(self) -> dict[str, Any]:
        """Time (s), tool position (mm), rotation vector (degrees), speeds, force (N), torque (Nm), and flags."""
        state = self._arm.read_state()
        turn = Rotation.from_matrix(state.T_b_t[:3, :3]).as_rotvec(degrees=True)
        return {
            "time": state.time, "position": 1e3 * state.T_b_t[:3, 3], "rotation": turn, "joints": np.zeros(6),
            "velocity": 1e3 * state.velocity[:3], "turning": np.degrees(state.velocity[3:]),
            "force": state.wrench[:3], "torque": state.wrench[3:], "busy": state.moving, "error": not state.safe,
        }  # fmt: skip

    def move_linear(self, position: Any, rotation: Any, speed: float, acceleration: float) -> None:
        """Begin a straight motion to a position (mm) and rotation vector (degrees), at mm/s and mm/s^2."""
        T_b_t = np.eye(4)
        T_b_t[:3, 3] = 1e-3 * np.asarray(position)
        T_b_t[:3, :3] = Rotation.from_rotvec(rotation, degrees=True).as_matrix()
        self._arm.begin_line(T_b_t, 1e-3 * speed, 1e-3 * acceleration)

    def halt(self) -> None:
        """Brake."""
        self._arm.brake()

    def tare(self) -> None:
        """Zero the force sensor."""
        self._arm.zero_sensor()

    def disconnect(self) -> None:
        """End the connection."""


class Board:
    """Acme's skin on a serial port."""

    def __init__(self, port: str) -> None:
        self._skin = SimulatedSkin(_lab()[0])
        self._skin.connect()
        self._number = int(self._skin.latest().number[-1])

    def samples(self) -> list[tuple[float, Any, Any]]:
        """Samples that come within 20 ms: time (s), field (milligauss), temperatures (degrees Celsius)."""
        until, newer = time.monotonic() + 0.02, self._skin.since(self._number)
        while not len(newer.number) and time.monotonic() < until:
            time.sleep(1e-3)
            newer = self._skin.since(self._number)
        self._number = max([self._number, *newer.number.tolist()])
        return list(zip(newer.time.tolist(), 10 * newer.reading, newer.temperature, strict=True))

    def shut(self) -> None:
        """Close the port."""
        self._skin.close()


class DepthCamera:
    """Acme's depth camera, mounted on the robot."""

    def __init__(self, serial: str) -> None:
        lab, rig = _lab()
        self._eye = SimulatedCamera(
            lab.scene,
            rig.camera,
            rig.T_tool_camera,
            lambda: SimulatedArm(lab, rig.limits).read_state().T_b_t,
            lab.clock,
        )
        self._eye.connect()
        self.intrinsics = (
            rig.camera.width,
            rig.camera.height,
            rig.camera.fx,
            rig.camera.fy,
            rig.camera.cx,
            rig.camera.cy,
        )

    def grab(self) -> tuple[Any, Any]:
        """Depth (mm, 0 in unmeasured pixels) and colours of a new image."""
        view = self._eye.capture()
        return np.nan_to_num(1e3 * view.depth), view.colour
