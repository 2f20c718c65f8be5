"""Cameras of i2t meet the contract of all cameras: a recording of the SDK, a folder of views, the simulated one."""

from collections.abc import Callable

import jax
import numpy as np
import pytest

from i2t.depth.camera import Camera
from i2t.emulators.in_process import SimulatedCamera
from i2t.emulators.scene import ObjectScene
from i2t.hardware.clock import MonotonicClock
from i2t.hardware.contract import CameraContract
from i2t.hardware.protocols import DepthCamera, View
from i2t.hardware.realsense import RealSense
from i2t.objects import catalogue
from i2t.simulation.touches import SimulationErrors
from i2t.skin.pad import nominal_pad

CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
DEPTH = np.where(np.arange(64) < 3, np.nan, 0.1 + 1e-3 * np.arange(48)[:, None]).astype(np.float32)
VIEWS = [View(0.0, DEPTH, np.full((48, 64, 3), 90, np.uint8))] * 10


class TestRecordingOfTheSdk(CameraContract):
    @pytest.fixture
    def make(self, tmp_path) -> Callable[[], DepthCamera]:
        pytest.importorskip(
            "pyrealsense2", reason="pyrealsense2, or its libusb-1.0-0, is not installed", exc_type=ImportError
        )
        from helpers import realsense_file

        path = tmp_path / "views.db3"
        realsense_file.write(path, CAMERA, VIEWS)
        return lambda: RealSense(file=path, size=(64, 48))


@pytest.fixture(scope="module")
def scene() -> ObjectScene:
    return ObjectScene(
        catalogue.make_object("square").mesh, np.eye(4), jax.jit(nominal_pad)(), SimulationErrors.error_free()
    )


class TestSimulatedCamera(CameraContract):
    @pytest.fixture
    def make(self, scene) -> Callable[[], DepthCamera]:
        above = np.diag([1.0, -1.0, -1.0, 1.0])
        above[2, 3] = 0.13
        return lambda: SimulatedCamera(scene, CAMERA, np.eye(4), lambda: above, MonotonicClock())
