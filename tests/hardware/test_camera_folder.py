"""A folder of views."""

import numpy as np
import pytest
import tifffile
from PIL import Image

from i2t.depth.camera import Camera
from i2t.hardware import camera_folder
from i2t.hardware.camera_folder import read_view
from i2t.hardware.protocols import View

CAMERA = Camera(6, 4, 60.0, 61.0, 2.5, 1.5, "brown_conrady", (0.1, -0.02, 1e-3))
DEPTH = np.where(np.eye(4, 6) > 0, np.nan, 0.1 + 1e-3 * np.arange(24).reshape(4, 6)).astype(np.float32)
COLOUR = np.arange(72, dtype=np.uint8).reshape(4, 6, 3)


@pytest.fixture
def views(tmp_path):
    kept = [View(0.0, DEPTH + 0.1 * number, COLOUR + number) for number in range(3)]
    assert len(list(camera_folder.save_views(tmp_path / "views", CAMERA, kept))) == 3
    return tmp_path / "views"


def test_the_first_view_that_was_kept_comes_back(views):
    camera, view = read_view(views)
    assert camera == CAMERA
    np.testing.assert_allclose(view.depth, DEPTH, atol=camera_folder.DEPTH_UNIT_M / 2 + 1e-7)
    np.testing.assert_array_equal(view.colour, COLOUR)


def test_other_peoples_formats(tmp_path):
    (tmp_path / "depth").mkdir()
    lens = 'width = 6\nheight = 4\nfx = 60.0\nfy = 61\ncx = 2.5\ncy = 1.5\nscale = "mm"\nnearest = 0.05\n'
    (tmp_path / "camera.toml").write_text(lens)
    tifffile.imwrite(tmp_path / "depth" / "experiment_1_depth_1.tif", np.full((4, 6), 104, np.uint16))
    view = read_view(tmp_path)[1]
    np.testing.assert_allclose(view.depth, 0.104, rtol=1e-6)
    assert view.colour is None


def test_what_is_missing_or_damaged_is_named_in_one_sentence(views, tmp_path):
    with pytest.raises((OSError, ValueError), match=r"camera.toml cannot be read .*; name a folder of views"):
        read_view(tmp_path / "nowhere")
    colour, depth, lens = views / "colour" / "000000.png", views / "depth" / "000000.png", views / "camera.toml"
    text = lens.read_text()
    for damage, why in (
        (lambda: colour.write_bytes(b"\x89PNG"), r"colour/000000.png"),
        (colour.unlink, r"No such file.*colour/000000.png"),
        (lambda: Image.fromarray(np.ones((5, 6), np.uint16)).save(depth), r"has the shape \(5, 6\) where the"),
        (lambda: [each.unlink() for each in depth.parent.iterdir()], "holds no views"),
        (lambda: lens.write_text(text.replace("scale = 0.0001\n", "")), f"^{lens}.*'scale' is missing"),
        (lambda: lens.write_text(f"breadth = 6\n{text}"), f"^{lens}.*unknown key breadth"),
        (lambda: lens.write_text(text.replace("fx = 60.0", "fx = -1.0")), f"^{lens}.*focal lengths"),
        (lambda: lens.write_text(text.replace("fx = 60.0", "fx =")), f"^{lens}.*is not TOML"),
    ):
        damage()
        with pytest.raises((OSError, ValueError), match=why) as error:
            read_view(views)
        assert "\n" not in str(error.value)
