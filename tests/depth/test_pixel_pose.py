"""Poses at pixels of depth images made by Embree, against poses on the mesh itself."""

import jax.numpy as jnp
import numpy as np
import pytest
from depth.test_patches import CAMERA, DOWN, beside, extract, image, plane, pose, scene, views

import i2t
from i2t.depth.distortion import deproject, project
from i2t.geometry import compose, inverse, log

LEVEL = pose(DOWN, (0, 0, 0.104))


def pixel_of(T_w_c: np.ndarray, point: np.ndarray) -> np.ndarray:
    """The pixel at which a point of W appears."""
    return np.asarray(project(CAMERA, jnp.asarray((point - T_w_c[:3, 3]) @ T_w_c[:3, :3])))


@pytest.mark.parametrize(("name", "tilt"), [("wedge", 0.0), ("star", 35.0), ("torus", 35.0)])
def test_the_pose_equals_the_pose_on_the_mesh(name, tilt):
    """`contact_pose` with the face's own normal, or with that of the torus whose facets the mesh has."""
    mesh, (T_w_c, _) = scene(name), views(tilt, beside(name))
    depth = image(mesh, T_w_c)
    pixel = np.round(pixel_of(T_w_c, beside(name))).astype(int)
    for roll in (0.0, 0.7):
        T_w_t = i2t.pose_at_pixel(depth, CAMERA, T_w_c, tuple(pixel), roll=roll)
        z = depth[pixel[1], pixel[0]]
        point = T_w_c[:3, :3] @ np.asarray(deproject(CAMERA, jnp.asarray(pixel, float), jnp.asarray(z))) + T_w_c[:3, 3]
        np.testing.assert_allclose(T_w_t[:3, 3], point, atol=1e-6)
        own = i2t.Mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces))
        outwards = point - np.append(24e-3 * point[:2] / np.linalg.norm(point[:2]), 0)  # from the circle of its tube
        normal = outwards / np.linalg.norm(outwards) if name == "torus" else None
        exact = i2t.contact_pose(own, point, normal=normal, roll=roll)
        apart = np.asarray(log(compose(inverse(exact), T_w_t)))
        assert np.linalg.norm(apart[:3]) < 1e-6
        assert np.degrees(np.linalg.norm(apart[3:])) < (1.5 if name == "torus" else 0.01)


def test_the_patch_at_the_pose_starts_at_the_tool():
    mesh, (T_w_c, _) = scene("dome"), views(20.0, beside("dome"))
    depth = image(mesh, T_w_c)
    T_w_t = i2t.pose_at_pixel(depth, CAMERA, T_w_c, pixel_of(T_w_c, beside("dome")))
    seen = extract(depth, CAMERA, T_w_c, T_w_t)
    assert abs(float(seen.patch.nearest)) < 0.1e-3
    assert np.asarray(seen.valid_mask).mean() > 0.9


def test_noise_is_averaged_and_holes_and_other_levels_are_ignored():
    """Noise of 0.2 mm on 280 pixels over 6 mm tilts a plane by half a degree; a step next to it does not."""
    depth = plane() + np.random.default_rng(0).normal(0, 0.2e-3, (360, 640)).astype(np.float32)
    depth[::3] = np.nan
    depth[:, 326:] = 0.12  # 16 mm further, from 2 mm beside the pixel on
    T = i2t.pose_at_pixel(depth, CAMERA, LEVEL, (320, 181))
    assert np.degrees(np.arccos(-T[2, 2])) < 2.0
    smooth = np.where(np.isnan(depth), np.nan, plane())
    smooth[:, 326:] = 0.12
    assert i2t.pose_at_pixel(smooth, CAMERA, LEVEL, (320, 181))[2, 2] == pytest.approx(-1, abs=1e-9)


def only(rows, columns) -> np.ndarray:
    """A plane of which only these pixels were measured."""
    depth = np.full_like(plane(), np.nan)
    depth[rows, columns] = plane()[rows, columns]
    return depth


RAGGED = plane() + np.random.default_rng(0).uniform(-3e-3, 3e-3, (360, 640)).astype(np.float32)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"pixel": (640, 180)}, "pixel: column 640, row 180 is outside the image of 640 x 360 pixels"),
        ({"roll": np.inf}, "roll: is inf; give radians"),
        ({"depth": np.where(only(180, 320) > 0, np.float32(65.535), plane())}, r"not measured \(it is 65.535\)"),
        ({"depth": only(0, 0)}, r"column 320, row 180 was not measured"),
        ({"depth": only(180, [320, 321])}, "only 2 measured pixels lie within 3 mm"),
        ({"depth": only(180, slice(None))}, "do not determine a plane"),
        ({"depth": RAGGED}, "do not determine a plane"),
        ({"depth": 1e3 * plane()}, "divide millimetres by 1000"),
    ],
)
def test_invalid_arguments_are_refused(changes, message):
    given = {"depth": plane(), "T_w_c": LEVEL, "pixel": (320, 180), **changes}
    named = {name: given.pop(name) for name in ("roll", "radius") if name in given}
    with pytest.raises(ValueError, match=message):
        i2t.pose_at_pixel(given["depth"], CAMERA, given["T_w_c"], given["pixel"], **named)
