"""Cameras, lenses and depth files: round trips, OpenCV and SciPy for the same lenses, and hostile files."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tifffile
from PIL import Image
from scipy.optimize import fsolve

from i2t.depth.camera import (
    COMMON_UNITS_M,
    MAX_DEPTH_M,
    Camera,
    Distortion,
    brown_conrady,
    check_view,
    fold_radius,
    invert_brown_conrady,
    measured_mask,
    metres_per_unit,
    read_depth,
    to_units,
)
from i2t.depth.distortion import deproject, pixel_rays, project

LENSES = {
    Distortion.NONE: (),
    Distortion.BROWN_CONRADY: (-0.12, 0.05, 1e-3, -8e-4, 0.02),
    Distortion.MODIFIED_BROWN_CONRADY: (-0.12, 0.05, 1e-3, -8e-4, 0.02),
    Distortion.INVERSE_BROWN_CONRADY: (0.14, -0.04, -1e-3, 8e-4, 0.01),
}
PIXEL = 1e-3  # float32 holds a column of 640 to 6e-5 pixels; a lens and back is some ten roundings


def camera(model: str = Distortion.NONE) -> Camera:
    return Camera(640, 360, 322.4, 322.1, 318.7, 181.2, model, LENSES[model])


def grid() -> np.ndarray:
    u, v = np.meshgrid(np.linspace(0, 639, 17), np.linspace(0, 359, 11))
    return np.stack([u, v], -1).reshape(-1, 2).astype(np.float32)


def brown(coefficients, x, y, modified: bool):
    """Brown-Conrady from its formula, in float64."""
    k1, k2, p1, p2, k3 = coefficients
    r2 = x**2 + y**2
    f = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    a, b = (x * f, y * f) if modified else (x, y)
    return x * f + 2 * p1 * a * b + p2 * (r2 + 2 * a**2), y * f + 2 * p2 * a * b + p1 * (r2 + 2 * b**2)


@pytest.mark.parametrize("model", list(LENSES))
def test_pixels_are_deprojected_and_projected_back(model):
    pixels, depth = grid(), np.linspace(0.1, 2, len(grid())).astype(np.float32)
    points = jax.jit(deproject, static_argnums=0)(camera(model), pixels, depth)
    np.testing.assert_allclose(points[:, 2], depth)
    back = jax.jit(project, static_argnums=0)(camera(model), points)
    np.testing.assert_allclose(back, pixels, atol=PIXEL)
    bent = np.abs(np.asarray(points[:, 0] / depth) - (pixels[:, 0] - 318.7) / 322.4).max()
    assert (bent > 0.01) == (model != Distortion.NONE)


@pytest.mark.parametrize("model", [m for m in LENSES if "brown" in m])
def test_brown_conrady_against_a_solver(model):
    """The direction that librealsense defines in closed form is the formula; the other solves it."""
    lens, pixels = camera(model), grid()
    x, y = ((pixels - [318.7, 181.2]) / [322.4, 322.1]).T
    if model == Distortion.INVERSE_BROWN_CONRADY:
        expected = np.stack(brown(lens.coefficients, x, y, False), -1)
    else:
        modified = model == Distortion.MODIFIED_BROWN_CONRADY
        solve = partial(brown, lens.coefficients, modified=modified)
        expected = np.array(
            [fsolve(lambda q, a=a, b=b: np.subtract(solve(*q), (a, b)), (a, b)) for a, b in zip(x, y, strict=True)]
        )
    points = deproject(lens, jnp.asarray(pixels), jnp.ones(len(pixels)))
    np.testing.assert_allclose(points[:, :2], expected, atol=PIXEL / 322)


def test_brown_conrady_against_opencv():
    cv2 = pytest.importorskip("cv2")
    points = np.concatenate([np.random.default_rng(0).uniform(-0.8, 0.8, (50, 2)), np.ones((50, 1))], 1)
    K = np.array([[322.4, 0, 318.7], [0, 322.1, 181.2], [0, 0, 1.0]])
    theirs, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, np.array(LENSES[Distortion.BROWN_CONRADY]))
    ours = project(camera(Distortion.BROWN_CONRADY), jnp.float32(points))
    np.testing.assert_allclose(ours, theirs[:, 0], atol=PIXEL)


def test_a_pinhole():
    x, y = pixel_rays(Camera(4, 3, 2.0, 2.0, 1.0, 1.0))
    np.testing.assert_allclose(x[0], [-0.5, 0, 0.5, 1])
    np.testing.assert_allclose(y[:, 0], [-0.5, 0, 0.5])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"fx": 0.0}, "focal"),
        ({"cx": float("nan")}, "finite"),
        ({"model": "plumb_bob", "coefficients": (0.1, 0.0, 0.0, 0.0, 0.0, 0.2)}, "6 coefficients .* rational model"),
        ({"coefficients": (0.1,)}, "coefficients are given without a model"),
        ({"model": "kannala_brandt4"}, "fisheye"),
        ({"model": "tangential"}, "not known; choose from none, modified_brown_conrady"),
        ({"fx": 0.47, "fy": 0.83}, "neither in millimetres"),
        ({"cx": 640.0}, "subtract from cx, cy what was cropped"),
        ({"cx": 180.0, "cy": 320.0}, "its two numbers were swapped"),
        ({"fy": 3000.0}, "differ by more than a factor of 2"),
        ({"fx": 6e5, "fy": 6e5}, "less than 1 degree"),
        # The lens of an image of 1280 x 720 pixels with one of 640 x 360, and of every second pixel, and of two thirds.
        ({"fx": 600.0, "fy": 600.0, "cx": 641.0, "cy": 358.0}, "about 1279 x 719 pixels: scale fx"),
        ({"fx": 150.0, "fy": 150.0, "cx": 161.0, "cy": 91.0}, "about 32[0-9] x 18[0-9] pixels: scale fx"),
        ({"fx": 450.0, "fy": 450.0, "cx": 480.0, "cy": 270.0}, "about 96[0-9] x 54[0-9] pixels: scale fx"),
    ],
)
def test_impossible_cameras(change, words):
    with pytest.raises(ValueError, match=words):
        Camera(**{"width": 640, "height": 360, "fx": 300.0, "fy": 300.0, "cx": 320.0, "cy": 180.0, **change})


def folding(k1: float, model: str = "brown_conrady") -> Camera:
    return Camera(640, 480, 400.0, 400.0, 319.5, 239.5, model, (k1, 0.0, 0.0, 0.0, 0.0))


@pytest.mark.parametrize("model", [Distortion.BROWN_CONRADY, Distortion.MODIFIED_BROWN_CONRADY])
def test_beyond_the_fold_of_a_lens_there_is_no_line_of_sight(model):
    """r + k r^3 is largest at r^2 = -1 / (3 k): points farther out in the image have no line of sight."""
    lens = folding(-0.18, model)
    u, v = np.meshgrid(np.arange(640), np.arange(480))
    radius = np.hypot(u - 319.5, v - 239.5) / 400
    fold = (1 / 0.54) ** 0.5
    x, y = np.asarray(pixel_rays(lens))
    away = np.abs(radius - fold * 2 / 3) > 1e-4
    assert 0 < np.isnan(x).mean() < 0.05  # so it is usable
    assert (np.isnan(x) == (radius > fold * 2 / 3))[away].all()
    seen = np.isfinite(x)
    assert np.hypot(x, y)[seen].max() < fold
    back = np.asarray(project(lens, jnp.stack([jnp.asarray(x), jnp.asarray(y), jnp.ones(x.shape)], -1)))
    np.testing.assert_allclose(back[seen], np.stack([u, v], -1)[seen], atol=0.02)
    assert np.isnan(project(lens, jnp.array([fold * 1.01, 0, 1.0]))).all()  # it would land within the image again


def test_rays_of_random_lenses_return_up_to_their_fold():
    rng = np.random.default_rng(0)
    for number in range(40):
        k, p = rng.normal(size=3) * [0.5, 0.5, 0.3], rng.normal(size=2) * 1e-3 * (number % 4 > 1)
        model = (Distortion.BROWN_CONRADY, Distortion.MODIFIED_BROWN_CONRADY)[number % 2]
        lens = Camera(640, 480, 2000.0, 2000.0, 319.5, 239.5, model, (k[0], k[1], *p, k[2]))
        radius, angle = (
            min(fold_radius(lens), 2.0) * rng.uniform(0, 0.7 if p.any() else 0.95, 200),
            rng.uniform(0, 2 * np.pi, 200),
        )
        x, y = radius * np.cos(angle), radius * np.sin(angle)
        np.testing.assert_allclose(invert_brown_conrady(lens, *brown_conrady(lens, x, y)), (x, y), atol=1e-4)


@pytest.mark.parametrize("model", ["brown_conrady", "modified_brown_conrady", "inverse_brown_conrady"])
def test_a_lens_that_folds_much_of_the_image_is_refused(model):
    with pytest.raises(ValueError, match=r"fold the image, so that \d+ % of its pixels have no line of sight"):
        folding(-0.8, model)
    assert folding(-0.1, model).coefficients[0] == -0.1


BROWN = (-0.0565, 0.0682, 0.00037, 0.00069, -0.0218)


@pytest.mark.parametrize(
    ("name", "coefficients"),
    [
        *((name, BROWN) for name in ("brown_conrady", "plumb_bob", "Brown Conrady", "distortion.brown_conrady",
                                     "RS2_DISTORTION_BROWN_CONRADY", "Plumb-Bob")),
        *((name, BROWN + (0.0,) * more) for name in ("rational_polynomial", "plumb_bob") for more in (0, 3, 7, 9)),
    ],
)  # fmt: skip
def test_a_lens_may_have_other_names_and_further_coefficients_of_zero(name, coefficients):
    given = Camera(640, 360, 391.2, 390.8, 324.7, 183.1, name, coefficients)
    assert given == Camera(640, 360, 391.2, 390.8, 324.7, 183.1, Distortion.BROWN_CONRADY, BROWN)
    assert Camera(640, 360, 391.2, 390.8, 324.7, 183.1, "radtan", BROWN[:4]).coefficients == (*BROWN[:4], 0.0)


@pytest.mark.parametrize("model", ["inverse_brown_conrady", "modified_brown_conrady", "none"])
def test_other_spellings_of_librealsense_names_are_the_same_models(model):
    for name in (f"distortion.{model}", model.replace("_", " ").title(), f"RS2_DISTORTION_{model.upper()}"):
        assert Camera(640, 360, 391.2, 390.8, 324.7, 183.1, name).model == model


def png(path, values):
    Image.fromarray(values).save(path)
    return path


def tif(path, values):
    tifffile.imwrite(path, values)
    return path


def test_depth_files_are_read_in_metres(tmp_path):
    stored = np.array([[0, 1000, 65535], [5, 104, 7]], np.uint16)
    expected = np.where((stored == 0) | (stored == 65535), np.nan, stored * 1e-3).astype(np.float32)
    for path in (png(tmp_path / "a.png", stored), tif(tmp_path / "a.tif", stored)):
        np.testing.assert_array_equal(read_depth(path, "mm"), expected)
        np.testing.assert_array_equal(read_depth(path, 1e-3), expected)
    floats = np.array([[np.nan, 0.5], [0, 1.25]], np.float32)
    np.testing.assert_array_equal(read_depth(tif(tmp_path / "b.tiff", floats), "m"), [[np.nan, 0.5], [np.nan, 1.25]])
    turned = (stored << 3) | (stored >> 13)  # left by three bits
    path = png(tmp_path / "c.png", turned)
    np.testing.assert_array_equal(read_depth(path, 1e-3, "rotated"), expected)


@pytest.mark.parametrize("hole", [0, 65535, np.nan, np.inf, -np.inf, -1.0, -0.3])
def test_holes_in_files_are_nan_for_every_marker(tmp_path, hole):
    at = np.zeros((6, 8), bool)
    at[2:5, 3:6] = True
    files = {tif(tmp_path / "a.tif", np.where(at, hole, 300.0).astype(np.float32)): "mm"}
    if hole in (0, 65535):
        stored = np.where(at, hole, 300).astype(np.uint16)
        files |= dict.fromkeys((png(tmp_path / "b.png", stored), tif(tmp_path / "c.tif", stored)), "mm")
        files[tif(tmp_path / "d.tif", stored.astype(np.int32))] = "mm"
    if hole == -1:
        files[tif(tmp_path / "e.tif", np.where(at, hole, 300).astype(np.int16))] = "mm"
    for path, unit in files.items():
        np.testing.assert_array_equal(np.isnan(read_depth(path, unit)), at)
        np.testing.assert_allclose(read_depth(path, unit)[~at], 0.3)


@pytest.mark.parametrize("unit", COMMON_UNITS_M)
def test_holes_in_arrays_are_recognised_in_every_common_unit(unit):
    """Users divide by 1000 or multiply by a unit, in single or in double precision."""
    stored = np.array([[0, 65535], [3000, 65534]], np.uint16)
    far = unit * 65534 < MAX_DEPTH_M
    for depth in (stored * unit, stored.astype(np.float32) * np.float32(unit), stored.astype(np.float32) / (1 / unit)):
        np.testing.assert_array_equal(measured_mask(depth), [[False, False], [True, far]])
        np.testing.assert_array_equal(measured_mask(jnp.float32(depth)), [[False, False], [True, far]])
    nothing = np.array([np.nan, np.inf, -np.inf, -1.0, 0.0, 1e10, 65504.0])
    assert not measured_mask(nothing).any()
    metres = np.array([[0.3, np.nan], [unit * 70000, 0.31]])
    np.testing.assert_array_equal(to_units(metres, unit), [[round(0.3 / unit), 0], [0, round(0.31 / unit)]])


@pytest.mark.parametrize("marker", [1023, 2047, 4095, 32767])
def test_a_full_scale_of_fewer_bits_far_from_all_other_values_is_refused(tmp_path, marker):
    stored = np.tile(np.uint16([300, 310, 640, 790]), (8, 1))
    stored[:3, 0] = marker
    with pytest.raises(ValueError, match=f"9 % of its pixels are {marker}, the largest value of .* raw disparity"):
        read_depth(png(tmp_path / "a.png", stored), "mm")
    stored[:3, 0] = marker - 1
    assert np.nanmax(read_depth(png(tmp_path / "b.png", stored), "mm")) > 1
    flat = np.full((8, 4), marker, np.uint16)  # a wall just there
    assert read_depth(png(tmp_path / "c.png", flat), "mm").min() > 1


def test_colour_and_palette_images_are_refused_as_depth(tmp_path):
    grey = np.arange(48, dtype=np.uint8).reshape(6, 8)
    for kind in ("P", "1", "RGB", "RGBA", "LA"):
        Image.fromarray(grey).convert(kind).save(tmp_path / f"{kind}.png")
        with pytest.raises(ValueError, match=r"single channel|16-bit"):
            read_depth(tmp_path / f"{kind}.png", "mm")


def test_hostile_files(tmp_path):
    good = np.full((4, 5), 300, np.uint16)
    for path, words in (
        (png(tmp_path / "b.png", good.astype(np.uint8)), "uint8"),
        (png(tmp_path / "d.png", 0 * good), "no pixel"),
        (tif(tmp_path / "g.tif", -good.astype(np.float32)), "negative"),
        (tif(tmp_path / "i.tif", good[:1]), "edge"),
        (tif(tmp_path / "k.tif", np.tile(good, (2, 1, 1))), "several images"),
        (tmp_path / "depth.exr", "PNG or TIF"),
    ):
        with pytest.raises(ValueError, match=words) as caught:
            read_depth(path, "mm")
        assert str(path) in str(caught.value)
    with pytest.raises(FileNotFoundError, match="no such file"):
        read_depth(tmp_path / "nothing.png", "mm")
    floats = tif(tmp_path / "j.tif", good.astype(np.float32))
    for path, arguments, words in (
        (floats, ("cm",), "scale"),
        (floats, (float("nan"),), "scale"),
        (floats, ("mm", "jpeg"), "encoding"),
        (floats, ("mm", "rotated"), "cannot be rotated"),
    ):
        with pytest.raises(ValueError, match=words):
            read_depth(path, *arguments)


def test_views_are_checked():
    lens, eye = Camera(5, 4, 10.0, 10.0, 2.0, 2.0), np.eye(4)
    depth = np.full((4, 5), 0.3, np.float32)
    check_view(depth, lens, eye, eye)
    far = depth + np.where(np.arange(5) > 0, 8.7, 0).astype(np.float32)
    far[0, 0] = 1e-3  # neither a flying pixel nor a wall far behind is a wrong unit
    check_view(far, lens, eye, eye)
    check_view(np.where(np.eye(4, 5) > 0, -1, depth).astype(np.float32), lens, eye, eye)  # holes
    few = np.where(np.arange(20).reshape(4, 5) > 0, np.float32(65.535), depth)
    check_view(few, lens, eye, eye)  # nearly all of it holes, which say nothing of the unit
    gone = np.eye(4)
    gone[0, 3] = np.nan
    for arguments, words in [
        ((depth.T, lens, eye, eye), "shape"),
        ((np.full((4, 5), np.nan, np.float32), lens, eye, eye), "no pixel"),
        ((-depth, lens, eye, eye), "negative; depth is along"),
        ((np.float32(65.535) + 0 * depth, lens, eye, eye), "no pixel"),
        ((depth[::2, ::2], replace(lens, width=6), eye, eye), "divide width, height, fx, fy, cx and cy by 2 where"),
        ((depth[1:], lens, eye, eye), "subtract what was cropped"),
        ((depth.T, lens, eye, eye), "rotate it back"),
        ((1e3 * depth, lens, eye, eye), "divide millimetres by 1000"),
        ((np.where(few > 1, 65535, 1e3 * depth), lens, eye, eye), "divide millimetres by 1000"),
        ((1e-3 * depth, lens, eye, eye), r"nearer than 0.0003 m, .* \(20 mm\)"),
        ((depth, lens, gone, eye), "T_w_c: .*holds NaN"),
        ((depth, lens, eye, np.zeros((4, 4))), "T_w_t: is not a rigid"),
        ((depth, lens, eye, np.diag([1.0, 1, -1, 1])), "mirrored"),
    ]:
        with pytest.raises(ValueError, match=words):
            check_view(*arguments)


def test_real_files(shared_data):
    """Both cameras' files hold plausible distances, and only with the right encoding."""
    f200 = shared_data / "apc_depth" / "frame-000007.depth.png"
    depth = read_depth(f200, 1e-4, "rotated")
    assert depth.shape == (480, 640)
    assert 0.2 < np.nanmedian(depth) < 0.8  # the range of the F200
    assert np.nanmedian(np.abs(np.diff(depth))) < 2e-3 < np.nanmedian(np.abs(np.diff(read_depth(f200, 1e-4))))
    xtion = read_depth(shared_data / "ycbvideo" / "000001-depth.png", 1e-4)
    assert 0.5 < np.nanmedian(xtion) < 1.2


@pytest.mark.parametrize("scale", [[1], 1j, True, None, "cm", np.nan, -1e-3, 0])
def test_an_invalid_scale_is_refused_by_the_files_name(scale):
    with pytest.raises(ValueError, match=r"a.png: scale is .*; give metres per unit"):
        metres_per_unit(scale, "a.png")
