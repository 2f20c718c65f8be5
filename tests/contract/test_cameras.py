"""What every depth camera must do, whoever made it."""

import time
from collections.abc import Callable, Iterator

import jax
import numpy as np
import pytest

from i2t.depth.camera import Camera
from i2t.emulators.in_process import SimulatedCamera
from i2t.emulators.scene import Scene
from i2t.errors import NotConnectedError
from i2t.hardware import camera_folder
from i2t.hardware.camera_folder import RecordedDepthCamera
from i2t.hardware.clock import MonotonicClock
from i2t.hardware.protocols import DepthCamera, View
from i2t.hardware.realsense import RealSense
from i2t.objects import catalogue
from i2t.simulation.touches import Errors
from i2t.skin.pad import nominal_pad

CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
DEPTH = np.where(np.arange(64) < 3, np.nan, 0.1 + 1e-3 * np.arange(48)[:, None]).astype(np.float32)
COLOUR = np.full((48, 64, 3), 90, np.uint8)
PATIENCE = 20.0  # s that a loaded machine may need


@pytest.fixture(scope="module", params=["replay", "folder", "simulated"])
def make(request, tmp_path_factory) -> Iterator[Callable[[], DepthCamera]]:
    """Cameras of one kind that have not been connected."""
    path = tmp_path_factory.mktemp("camera") / "views"
    views = [View(0.0, DEPTH, COLOUR)] * 10
    if request.param == "replay":
        pytest.importorskip("pyrealsense2", reason="pyrealsense2 is not installed")
        from i2t.emulators import realsense_file

        realsense_file.write(path.with_suffix(".db3"), CAMERA, views)
        yield lambda: RealSense(file=path.with_suffix(".db3"), size=(64, 48), model="D405")
    elif request.param == "folder":
        list(camera_folder.keep(path, CAMERA, views))
        yield lambda: RecordedDepthCamera(path)
    else:
        errors = Errors.none()
        scene = Scene(catalogue.make_object("square").mesh, np.eye(4), jax.jit(nominal_pad)(), errors)
        above = np.diag([1.0, -1.0, -1.0, 1.0])
        above[2, 3] = 0.13
        yield lambda: SimulatedCamera(scene, CAMERA, np.eye(4), lambda: above, MonotonicClock())


def test_features_are_known_before_connecting(make, request):
    features = make().features
    assert features.source == request.node.callspec.id
    assert 0 <= features.nearest < 0.104
    assert features.rate > 1


def test_it_says_when_it_is_not_connected(make):
    camera = make()
    with pytest.raises(NotConnectedError):
        camera.capture()
    camera.close()


def test_views_are_whole_in_metres_and_in_order(make):
    with make() as camera:
        assert isinstance(camera, DepthCamera)
        assert camera.camera == CAMERA
        before = time.monotonic()
        for _ in range(3):
            view = camera.capture(PATIENCE)
            assert before < view.time <= time.monotonic()
            before = view.time
            assert view.depth.shape == (48, 64)
            assert view.depth.dtype == np.float32
            measured = np.isfinite(view.depth)
            assert 0.9 < measured.mean() <= 1
            assert 0.09 < view.depth[measured].min() <= view.depth[measured].max() < 0.2
            assert np.isnan(view.depth[~measured]).all()
            assert view.colour is not None
            assert view.colour.shape == (48, 64, 3)
            assert view.colour.dtype == np.uint8


def test_it_can_be_closed_twice_and_connected_again(make):
    camera = make()
    with camera:
        camera.capture(PATIENCE)
    camera.close()
    with pytest.raises(NotConnectedError):
        camera.capture()
    with camera:
        camera.capture(PATIENCE)
