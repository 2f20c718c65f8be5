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


def test_formats_of_other_libraries(tmp_path):
    (tmp_path / "depth").mkdir()
    lens = 'width = 6\nheight = 4\nfx = 60.0\nfy = 61\ncx = 2.5\ncy = 1.5\nscale = "mm"\nnearest = 0.05\n'
    (tmp_path / "camera.toml").write_text(lens)
    tifffile.imwrite(tmp_path / "depth" / "experiment_1_depth_1.tif", np.full((4, 6), 104, np.uint16))
    view = read_view(tmp_path)[1]
    np.testing.assert_allclose(view.depth, 0.104, rtol=1e-6)
    assert view.colour is None


def test_missing_or_damaged_files_are_named_in_one_sentence(views, tmp_path):
    with pytest.raises((OSError, ValueError), match=r"camera.toml cannot be read .*; name a folder of views"):
        read_view(tmp_path / "nowhere")
    colour, depth, lens = views / "colour" / "000000.png", views / "depth" / "000000.png", views / "camera.toml"
    text = lens.read_text()
    for damage, why in (
        (lambda: colour.write_bytes(b"\x89PNG"), r"colour/000000.png"),
        (colour.unlink, r"No such file.*colour/000000.png"),
        (lambda: Image.fromarray(np.ones((5, 6), np.uint16)).save(depth), r"has the shape \(5, 6\) where the"),
        (lambda: [file.unlink() for file in depth.parent.iterdir()], "holds no views"),
        (lambda: lens.write_text(text.replace("scale = 0.0001\n", "")), f"^{lens}.*'scale' is missing"),
        (lambda: lens.write_text(f"breadth = 6\n{text}"), f"^{lens}.*unknown key breadth"),
        (lambda: lens.write_text(text.replace("fx = 60.0", "fx = -1.0")), f"^{lens}.*focal lengths"),
        (lambda: lens.write_text(text.replace("fx = 60.0", "fx =")), f"^{lens}.*is not TOML"),
    ):
        damage()
        with pytest.raises((OSError, ValueError), match=why) as error:
            read_view(views)
        assert "\n" not in str(error.value)


PLAIN = "width = 640\nheight = 360\nfx = 391.2\nfy = 390.8\ncx = 324.7\ncy = 183.1\n"
COEFFICIENTS = "[-0.0565, 0.0682, 0.00037, 0.00069, -0.0218]"
MATRIX = "[391.2, 0.0, 324.7, 0.0, 390.8, 183.1, 0.0, 0.0, 1.0]"
ROS = f'image_width = 640\nimage_height = 360\nK = {MATRIX}\nD = {COEFFICIENTS}\ndistortion_model = "plumb_bob"\n'
PROJECTION = MATRIX.replace("324.7,", "324.7, 0.0,").replace("183.1,", "183.1, 0.0,").replace("1.0]", "1.0, 0.0]")


def lens_of(folder, text):
    folder.mkdir(exist_ok=True)
    (folder / "camera.toml").write_text(text)
    return camera_folder.read_lens(folder, {})[0]


def test_a_lens_by_the_names_of_ros_opencv_and_librealsense_is_the_same(tmp_path):
    expected = lens_of(tmp_path, f'{PLAIN}model = "brown_conrady"\ncoefficients = {COEFFICIENTS}\n')
    by_columns = "[[391.2, 0.0, 0.0], [0.0, 390.8, 0.0], [324.7, 183.1, 1.0]]"  # as Open3D writes a matrix
    whole = "{x_offset = 0, y_offset = 0, width = 640, height = 360, do_rectify = false}"
    for text in (
        ROS,
        ROS.replace("K =", "k =").replace("D =", "d ="),
        f"{ROS}P = {PROJECTION}\nR = [1, 0, 0, 0, 1, 0, 0, 0, 1]\nbinning_x = 0\nroi = {whole}\n",
        ROS.replace(MATRIX, by_columns).replace("K =", "intrinsic_matrix ="),
        f'image_width = 640\nimage_height = 360\ncamera_name = "a"\ndistortion_model = "plumb_bob"\n'
        f"camera_matrix = {{rows = 3, cols = 3, data = {MATRIX}}}\n"
        f"distortion_coefficients = {{rows = 1, cols = 5, data = {COEFFICIENTS}}}\n",
        PLAIN.replace("cx", "ppx").replace("cy", "ppy")
        + f'model = "distortion.brown_conrady"\ncoeffs = {COEFFICIENTS}\n',
    ):
        assert lens_of(tmp_path, text) == expected


def test_a_lens_that_is_given_twice_or_is_of_another_image_is_refused(tmp_path):
    for text, why in (
        (f"{ROS}fx = 391.2\n", "K gives fx a second time"),
        (f"{ROS}d = {COEFFICIENTS}\n", "d gives coefficients a second time"),
        (ROS.replace("[391.2, 0.0,", "[391.2, 3.0,"), "K is .* without skew"),
        (ROS.replace("0.0, 0.0, 1.0]", "0.0]"), "K is .* give 9 numbers"),
        (ROS.replace(MATRIX, '"wide"'), "K is not a list of numbers"),
        (f"{ROS}P = {PROJECTION.replace('391.2', '350.0')}\n", "K and P are of two lenses"),
        (f"{ROS}R = [0, -1, 0, 1, 0, 0, 0, 0, 1]\n", "R rotates a rectified image"),
        (f"{ROS}binning_x = 2\n", "binning_x is 2"),
        (f"{ROS}roi = {{x_offset = 100}}\n", "roi is .*x_offset"),
        (ROS.replace("plumb_bob", "equidistant"), "fisheye lens"),
        (ROS.replace("-0.0218]", "-0.0218, 0.1, 0.0, 0.0]"), "8 coefficients"),
        (ROS.replace("640", "320").replace("360", "180"), "is the lens of an image of about 6[0-9]+ x 3[0-9]+ pixels"),
        (ROS.replace('distortion_model = "plumb_bob"\n', ""), "without a model"),
    ):
        with pytest.raises(ValueError, match=why) as error:
            lens_of(tmp_path, text)
        assert str(tmp_path / "camera.toml") in str(error.value)
        assert "\n" not in str(error.value)


def test_an_image_that_was_reduced_without_its_lens_is_named_with_the_factor(tmp_path):
    (tmp_path / "depth").mkdir()
    (tmp_path / "camera.toml").write_text(f'{PLAIN}scale = "mm"\n')
    Image.fromarray(np.full((180, 320), 300, np.uint16)).save(tmp_path / "depth" / "a.png")
    with pytest.raises(ValueError, match=r"depth/a.png: .*\(180, 320\).* divide width, .* by 2 .*camera.toml"):
        read_view(tmp_path)


def test_depths_beyond_16_bits_are_saved_as_holes(tmp_path):
    deep = np.where(np.eye(4, 6) > 0, np.float32([7.0] * 6), DEPTH)
    deep[0, 0] = np.inf
    list(camera_folder.save_views(tmp_path / "deep", CAMERA, [View(0.0, deep, None)]))
    np.testing.assert_array_equal(np.isnan(read_view(tmp_path / "deep")[1].depth), np.eye(4, 6) > 0)


def test_the_projection_alone_is_the_lens_of_a_rectified_image(tmp_path):
    size = "width = 640\nheight = 360\n"
    assert lens_of(tmp_path, f"{size}P = {PROJECTION}\n") == lens_of(tmp_path, PLAIN)
    assert lens_of(tmp_path, f"{PLAIN}P = {PROJECTION}\n") == lens_of(tmp_path, PLAIN)
    with pytest.raises(ValueError, match="P is of the rectified image and D of the raw image, and K is missing"):
        lens_of(tmp_path, f'{size}P = {PROJECTION}\nD = {COEFFICIENTS}\ndistortion_model = "plumb_bob"\n')
    with pytest.raises(ValueError, match="K and P are of two lenses"):
        lens_of(tmp_path, f"{PLAIN}P = {PROJECTION}\n".replace("fx = 391.2", "fx = 400.0"))


def test_yaml_and_json_are_named_with_what_to_do(tmp_path):
    (tmp_path / "camera_info.yaml").write_text("image_width: 640\n")
    with pytest.raises(ValueError, match=r"camera_info.yaml is not TOML: write its numbers to camera.toml"):
        camera_folder.read_lens(tmp_path, {})
    for text in ("image_width: 640\ncamera_matrix:\n  rows: 3\n", '{"width": 640}'):
        with pytest.raises(ValueError, match=r"camera.toml: is not TOML: write its numbers to camera.toml"):
            lens_of(tmp_path, text)


@pytest.mark.parametrize("scale", ["true", "[0.001]", '"0.001"'])
def test_an_invalid_scale_is_refused_with_the_name_of_the_description(views, scale):
    lens = views / "camera.toml"
    lens.write_text(lens.read_text().replace("scale = 0.0001", f"scale = {scale}"))
    with pytest.raises(ValueError, match=r"camera.toml: scale is .*; give metres per unit"):
        read_view(views)
