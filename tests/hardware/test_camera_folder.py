"""A folder of recorded views as a camera."""

import numpy as np
import pytest
import tifffile
from PIL import Image

from i2t.depth.camera import Camera
from i2t.errors import DeviceError
from i2t.hardware import camera_folder
from i2t.hardware.camera_folder import RecordedDepthCamera
from i2t.hardware.protocols import View

CAMERA = Camera(6, 4, 60.0, 61.0, 2.5, 1.5, "brown_conrady", (0.1, -0.02, 1e-3))
DEPTH = np.where(np.eye(4, 6) > 0, np.nan, 0.1 + 1e-3 * np.arange(24).reshape(4, 6)).astype(np.float32)
COLOUR = np.arange(72, dtype=np.uint8).reshape(4, 6, 3)


@pytest.fixture
def views(tmp_path):
    kept = [View(0.0, DEPTH + 0.1 * number, COLOUR + number) for number in range(3)]
    assert len(list(camera_folder.save_views(tmp_path / "views", CAMERA, kept))) == 3
    return tmp_path / "views"


def test_what_is_kept_comes_back_in_order(views):
    with RecordedDepthCamera(views) as camera:
        assert camera.camera == CAMERA
        for number in range(3):
            view = camera.capture()
            np.testing.assert_allclose(view.depth, DEPTH + 0.1 * number, atol=camera_folder.DEPTH_UNIT_M / 2 + 1e-7)
            np.testing.assert_array_equal(view.colour, COLOUR + number)
        with pytest.raises(DeviceError, match="has given all its views"):
            camera.capture()
    with RecordedDepthCamera(views, loop=True) as camera:
        assert camera.capture().depth[0, 1] == [camera.capture() for _ in range(3)][-1].depth[0, 1]


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
    for camera, why in (
        (RecordedDepthCamera(tmp_path / "nowhere"), r"camera.toml cannot be read .*; name a folder of views"),
    ):
        with pytest.raises(DeviceError, match=why):
            camera.connect()
    colour, depth = views / "colour" / "000001.png", views / "depth" / "000001.png"
    with RecordedDepthCamera(views) as camera:
        camera.capture()
        for damage, why in (
            (lambda: colour.write_bytes(b"\x89PNG"), r"cannot give 000001.png: .*; restore"),
            (colour.unlink, r"cannot give 000001.png: No such file"),
            (lambda: Image.fromarray(COLOUR[:2]).save(colour), "aligned to each other"),
            (lambda: Image.fromarray(np.ones((5, 6), np.uint16)).save(depth), r"has the shape \(5, 6\) where the"),
            (depth.unlink, r"cannot give 000001.png: there is no such file"),
        ):
            damage()
            with pytest.raises(DeviceError, match=why):
                camera.capture()


def test_a_description_that_is_none(views):
    file = views / "camera.toml"
    text = file.read_text()
    for old, new, why in (
        ("scale = 0.0001\n", "", "'scale' is missing"),
        ("width", "breadth", "unknown key breadth"),
        ("fx = 60.0", "fx = -1.0", "focal lengths"),
        ("fx = 60.0", "fx =", "is not TOML"),
    ):
        file.write_text(text.replace(old, new))
        with pytest.raises(DeviceError, match=f"^{file}[^\n]*{why}[^\n]*$"):
            RecordedDepthCamera(views).connect()
