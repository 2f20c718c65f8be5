"""Views and their surroundings are shifted and clipped in the same way by renderers and cameras."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

import i2t
from i2t.contact.pressure import predict_pressures
from i2t.depth.camera import Camera
from i2t.depth.patches import view_from_depth
from i2t.geometry import contact_frame, inverse
from i2t.patches.dimensions import PAD_WINDOW, PATCH_PIXELS, REACH, VIEW_PIXELS
from i2t.patches.views import SAME_SURFACE_M, centre, view_of_heights, view_of_noisy_heights
from i2t.rendering.render import prepare_surface, render_heights, render_patch, render_view, stack_surfaces
from i2t.skin.contact import solve_force
from i2t.skin.pad import nominal_pad

ROUNDING = 1e-6  # m


def box(size, at) -> trimesh.Trimesh:
    return trimesh.creation.box(
        np.multiply(size, 1e-3), trimesh.transformations.translation_matrix(np.multiply(at, 1e-3))
    )


def things() -> dict[str, trimesh.Trimesh]:
    """Objects with protruding surroundings, which are nearer than the patch's nearest point."""
    table = box((60, 60, 10), (0, 0, -5))
    ring = trimesh.creation.torus(14e-3, 3e-3, major_sections=32, minor_sections=12)
    ring.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (0, 1, 0), (0, 0, 0)))
    ring.apply_translation((12e-3, 0, 0))
    prongs = [box((2, 2, 14), (x, y, 7)) for x in (-11, 0, 11) for y in (-10, 10)]
    on_table = {
        "handle": [ring],
        "rim": [trimesh.creation.annulus(9e-3, 12e-3, 9e-3, sections=32)],
        "step": [box((20, 60, 12), (19.2, 0, 6))],
        "prongs": prongs,
        "ledge": [box((5, 60, 3), (11.5, 0, 1.5))],
        "table": [],
    }
    # Overlapping closed bodies: a ray sees their union.
    return {name: trimesh.util.concatenate([table, *bodies]) for name, bodies in on_table.items()}


# One size class, and so one compilation.
STACK = stack_surfaces([prepare_surface(mesh) for mesh in things().values()])
THINGS = {name: jax.tree.map(lambda leaf, i=i: leaf[i], STACK) for i, name in enumerate(things())}
HIGH = ("handle", "rim", "step", "prongs")
look = jax.jit(render_view)


@jax.jit
def look_at_all(T):
    return jax.vmap(lambda thing: (render_view(thing, T), render_patch(thing, T)))(STACK)


# Tops of the table between what stands out, a little turned and moved; z is the table's.
POSES = st.tuples(*[st.floats(-3e-3, 3e-3)] * 2, st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(0, 2 * np.pi))


def pose(drawn) -> np.ndarray:
    x, y, nx, ny, spin = drawn
    normal = np.array([nx, ny, 1.0])
    return np.asarray(contact_frame(np.array([x, y, 0.0]), normal / np.linalg.norm(normal), spin), np.float32)


@settings(max_examples=20, deadline=None)
@given(drawn=POSES)
def test_the_middle_of_a_view_is_the_patch_whatever_surrounds_it(drawn):
    view, patch = jax.device_get(look_at_all(pose(drawn)))
    np.testing.assert_array_equal(centre(view.depth, PATCH_PIXELS), view.patch.depth)
    np.testing.assert_allclose(view.patch.nearest, patch.nearest, atol=ROUNDING)
    # A ray that grazes an edge may fall on either side of it.
    assert (np.abs(view.patch.depth - patch.depth) > ROUNDING).mean() < 2e-3
    assert view.depth.max() <= REACH


FLAT = np.asarray(contact_frame(jnp.zeros(3), jnp.array([0.0, 0, 1])))
ALONG = (np.arange(VIEW_PIXELS) + 0.5 - VIEW_PIXELS / 2) * 17e-3 / PATCH_PIXELS  # m, x of the pixels


def test_protruding_surroundings_have_negative_depths():
    depth, up = np.asarray(look(THINGS["ledge"], FLAT).depth), np.abs(ALONG - 11.5e-3) < 2.5e-3
    np.testing.assert_allclose(depth[:, up], -3e-3, atol=ROUNDING)
    np.testing.assert_allclose(depth[:, ~up], 0, atol=ROUNDING)
    np.testing.assert_allclose(np.asarray(look(THINGS["step"], FLAT).depth)[:, ALONG > 9.3e-3], -12e-3, atol=ROUNDING)


def test_a_wall_protrudes_and_a_camera_s_noise_does_not():
    z = jnp.zeros((VIEW_PIXELS, VIEW_PIXELS)).at[:, :3].set(-0.9 * SAME_SURFACE_M).at[:, -3:].set(-2e-3)
    depth = np.asarray(view_of_noisy_heights(z).depth)
    assert not depth[:, :-3].any()
    np.testing.assert_allclose(depth[:, -3:], -2e-3, atol=ROUNDING)
    exact = np.asarray(view_of_heights(z, jnp.zeros(())).depth)
    np.testing.assert_allclose(exact[:, :3], -0.9 * SAME_SURFACE_M, atol=ROUNDING)


def test_nearest_is_a_surface_and_not_a_pixel():
    look = jax.jit(view_of_noisy_heights)
    view = np.full((72, 72), 10e-3, np.float32)
    view[:, 30:33] = 2e-3  # a thin plate: three columns, about 1 mm
    patch, depth = look(view.copy())
    assert abs(patch.nearest - 2e-3) < ROUNDING
    view[40, 50] = -5e-3  # one wrong pixel
    assert abs(look(view.copy()).patch.nearest - 2e-3) < ROUNDING
    view[40, 50] = 10e-3
    view[:, 70:] = -20e-3  # a high wall beside the patch neither hides nor moves it
    beside, walled = look(view.copy())
    np.testing.assert_array_equal(beside.depth, patch.depth)
    np.testing.assert_array_equal(walled[:, :70], depth[:, :70])
    np.testing.assert_allclose(walled[:, 70:], -22e-3, atol=ROUNDING)  # it protrudes, so its depth is negative
    view[20, 5] = -40e-3  # one wrong pixel there is no surface either
    np.testing.assert_allclose(look(view.copy()).depth[20, 5], -22e-3, atol=ROUNDING)
    # Nothing at all, and a tip alone, which a larger surface beside the patch does not hide.
    view = np.full((72, 72), np.inf, np.float32)
    patch, depth = look(view.copy())
    assert np.isposinf(patch.nearest)
    assert (np.asarray(depth) == np.float32(REACH)).all()
    view[35:37, 35:37] = 1e-3
    for beside in (np.inf, 4e-3):
        view[:, :8] = beside
        patch, depth = look(view.copy())
        assert abs(patch.nearest - 1e-3) < ROUNDING
        assert (np.asarray(patch.depth) == 0).sum() == 4
        assert (np.asarray(patch.depth) == np.float32(REACH)).sum() == 48 * 48 - 4
    np.testing.assert_allclose(depth[:, :8], 3e-3, atol=ROUNDING)


def test_a_depth_image_and_the_mesh_show_one_view():
    """A camera above a step sees the same view as the renderer, including the surroundings."""
    camera = Camera(240, 240, fx=300.0, fy=300.0, cx=119.5, cy=119.5)
    T_w_c = FLAT.copy()
    T_w_c[2, 3] = 0.1
    x = (np.broadcast_to(np.arange(240), (240, 240)) - camera.cx) / camera.fx  # T's axes: x along columns, y along rows
    # A plane at 0.1 m and, where the ray meets it, a step 3 mm nearer at tool x > 9.2 mm.
    depth = np.where(x * 0.097 > 9.2e-3, 0.097, 0.1).astype(np.float32)
    seen = view_from_depth(depth, camera, T_w_c, FLAT)
    depth = np.asarray(seen.view.depth)[10:-10]
    np.testing.assert_allclose(depth[:, ALONG > 10e-3], -3e-3, atol=1e-5)
    np.testing.assert_allclose(depth[:, ALONG < 8e-3], 0, atol=1e-5)
    np.testing.assert_array_equal(centre(np.asarray(seen.view.depth), PATCH_PIXELS), seen.view.patch.depth)
    assert np.asarray(seen.known_mask).mean() > 0.95


@pytest.fixture(scope="module")
def nominal():
    return i2t.load_predictor("nominal")


@pytest.fixture(scope="module")
def crowded():
    """Poses on the table, with protruding surroundings under the skin's rim."""
    drawn = [(0, 0, 0, 0, 0.0), (2e-4, -2e-4, 0, 0, np.pi / 2), (-2e-4, 0, 0.01, 0, np.pi), (0, 2e-4, 0, -0.01, 0.02)]
    return np.stack([pose(place) for place in drawn])


@pytest.mark.full
@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("name", HIGH)
def test_a_touch_alone_is_the_same_as_in_a_batch(nominal, crowded, name):
    many = nominal.predict_touch(THINGS[name], crowded, force=1.0)
    for pose, mean in zip(crowded, many.mean, strict=True):
        np.testing.assert_allclose(nominal.predict_touch(THINGS[name], pose, force=1.0).mean, mean, atol=0.02)
    assert np.ptp(many.mean, axis=0).max() > 0.1  # and no two of them are one flat face


@partial(jax.jit, static_argnames="cfg")
def pressed(thing, poses, cfg):
    """Compute the force (N) on cells of 1 mm of presses with 1 N."""

    def one(T):
        z = render_heights(thing, inverse(T), PAD_WINDOW, cfg.grid.cells)
        newtons = solve_force(nominal_pad(), jnp.minimum(z - jnp.min(z), 8e-3), 1.0, cfg.grid).pressure
        return (newtons * cfg.grid.spacing**2).reshape(20, 2, 20, 2).sum((1, 3))

    return jax.vmap(one)(poses)


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_the_pressure_is_that_of_a_press_at_the_same_pose(nominal, crowded):
    """Protruding surroundings under the skin are met first and carry the load, as in the simulation."""
    cfg, newton = replace(nominal.pressure, smooth=False, tilt=0.0), np.ones(len(crowded), np.float32)
    for name in HIGH:
        seen = nominal.render_touches(THINGS[name], crowded)
        predicted = np.asarray(predict_pressures(cfg, seen.view, newton, np.nan * newton).pressure)
        true = np.asarray(pressed(THINGS[name], jnp.asarray(crowded), cfg))
        shared = np.minimum(predicted, true).sum((1, 2)) / true.sum((1, 2))
        assert (shared > 0.7).all(), f"{name}: only {shared.min():.0%} of the load lies where the skin is met"


def test_views_are_checked_one_by_one_and_protruding_surroundings_are_reported(nominal, crowded):
    patches = np.zeros((5, PATCH_PIXELS, PATCH_PIXELS), np.float32)
    views = np.zeros((5, VIEW_PIXELS, VIEW_PIXELS), np.float32)
    views[3, 20:] = 3e-3
    with pytest.raises(ValueError, match=r"differs from the patch in its middle \(touch 3\)"):
        nominal.predict(patches, force=1.0, view=views)
    with pytest.raises(ValueError, match="differs from the patch in its middle, or"):
        nominal.predict(patches[3], force=1.0, view=views[3])
    with pytest.warns(UserWarning, match="stands out by 12 mm next to the patch"):
        nominal.render_touches(THINGS["step"], crowded[0])
    nominal.render_touches(THINGS["table"], crowded[0])  # without a warning, which would be an error
