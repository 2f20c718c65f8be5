"""A folder of recorded views as a camera."""

import time

import numpy as np
import pytest
import tifffile
from PIL import Image

from i2t.depth.camera import Camera
from i2t.errors import DeviceError, DeviceTimeoutError, NotConnectedError
from i2t.hardware import camera_folder
from i2t.hardware.camera_folder import RecordedDepthCamera
from i2t.hardware.protocols import DepthCamera, View

CAMERA = Camera(6, 4, 60.0, 61.0, 2.5, 1.5, "brown_conrady", (0.1, -0.02, 1e-3))
DEPTH = np.where(np.eye(4, 6) > 0, np.nan, 0.1 + 1e-3 * np.arange(24).reshape(4, 6)).astype(np.float32)
COLOUR = np.arange(72, dtype=np.uint8).reshape(4, 6, 3)


@pytest.fixture
def views(tmp_path):
    kept = [View(0.0, DEPTH + 0.1 * number, COLOUR + number) for number in range(3)]
    assert len(list(camera_folder.save_views(tmp_path / "views", CAMERA, kept))) == 3
    return tmp_path / "views"


def test_what_is_kept_comes_back_in_order(views):
    camera = RecordedDepthCamera(views, rate=1000.0)
    assert camera.features.source == "folder"
    with pytest.raises(NotConnectedError):
        _ = camera.camera
    with camera:
        assert isinstance(camera, DepthCamera)
        assert camera.camera == CAMERA
        before = -np.inf
        for number in range(3):
            view = camera.capture()
            np.testing.assert_allclose(view.depth, DEPTH + 0.1 * number, atol=camera_folder.DEPTH_UNIT_M / 2 + 1e-7)
            np.testing.assert_array_equal(view.colour, COLOUR + number)
            assert before < view.time <= time.monotonic()
            before = view.time
        with pytest.raises(DeviceError, match="has given all its views"):
            camera.capture()
    with RecordedDepthCamera(views, first=2, loop=True, rate=1000.0) as camera:
        assert camera.capture().depth[0, 1] == camera.capture().depth[0, 1]
    with RecordedDepthCamera(views, rate=0.1) as camera:
        camera.capture()
        with pytest.raises(DeviceTimeoutError):
            camera.capture(0.01)
    with pytest.raises(NotConnectedError):
        camera.capture()


def test_other_peoples_formats(tmp_path):
    (tmp_path / "depth").mkdir()
    lens = 'width = 6\nheight = 4\nfx = 60.0\nfy = 61\ncx = 2.5\ncy = 1.5\nscale = "mm"\nnearest = 0.05\n'
    (tmp_path / "camera.toml").write_text(lens)
    tifffile.imwrite(tmp_path / "depth" / "experiment_1_depth_1.tif", np.full((4, 6), 104, np.uint16))
    with RecordedDepthCamera(tmp_path) as camera:
        assert camera.features.nearest == 0.05
        view = camera.capture()
    np.testing.assert_allclose(view.depth, 0.104, rtol=1e-6)
    assert view.colour is None


def test_what_is_missing_or_damaged_is_named(views, tmp_path):
    with pytest.raises(DeviceError, match=r"camera.toml cannot be read .*; name a folder of views"):
        RecordedDepthCamera(tmp_path / "nowhere").connect()
    with pytest.raises(DeviceError, match="holds 3 views, and number 3"):
        RecordedDepthCamera(views, first=3).connect()
    with RecordedDepthCamera(views, rate=1000.0) as camera:
        (views / "depth" / "000000.png").unlink()
        with pytest.raises(DeviceError, match=r"cannot give 000000.png: there is no such file"):
            camera.capture()
    with RecordedDepthCamera(views, rate=1000.0) as camera:
        (views / "colour" / "000001.png").write_bytes(b"\x89PNG")
        with pytest.raises(DeviceError, match=r"cannot give 000001.png: .*; restore"):
            camera.capture()
        (views / "colour" / "000001.png").unlink()
        with pytest.raises(DeviceError, match=r"cannot give 000001.png: No such file"):
            camera.capture()
        Image.fromarray(COLOUR[:2]).save(views / "colour" / "000001.png")
        with pytest.raises(DeviceError, match="aligned to each other"):
            camera.capture()
        Image.fromarray(np.ones((5, 6), np.uint16)).save(views / "depth" / "000001.png")
        with pytest.raises(DeviceError, match=r"has the shape \(5, 6\) where the camera's image is \(4, 6\)"):
            camera.capture()


@pytest.mark.parametrize(
    ("old", "new", "why"),
    [
        ("scale = 0.0001\n", "", "'scale' is missing"),
        ("width", "breadth", "unknown key breadth"),
        ("fx = 60.0", "fx = -1.0", "focal lengths"),
        ("fx = 60.0", "fx =", "is not TOML"),
        ("width = 6\n", "", "width"),
    ],
)
def test_a_description_that_is_none(views, old, new, why):
    file = views / "camera.toml"
    file.write_text(file.read_text().replace(old, new))
    with pytest.raises(DeviceError, match=why) as caught:
        RecordedDepthCamera(views).connect()
    assert str(caught.value).startswith(str(file))
    assert "\n" not in str(caught.value)
