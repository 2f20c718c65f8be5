"""Derivatives of the renderer by pose and by corners: against central differences in float64, and finite where a ray
meets an edge, a corner, a face seen edge on, or nothing.
"""

from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from i2t.geometry import so3_exp, transform
from i2t.objects.catalogue import make_object
from i2t.patches.dimensions import PATCH_PIXELS, PATCH_WINDOW, REACH
from i2t.rendering.bvh import CLUSTER_SIZES, layout_clusters
from i2t.rendering.render import prepare_surface, render_patch, stack_surfaces
from i2t.types import Surface

STEP = 1e-6  # m and rad
# On one face the path of a pixel bends by STEP^2 slope^2 / (0.01 m and more) < 1e-10 m up to slopes of 1; where it
# bends more, the face, the reach or the nearest pixel changed. What is left of such kinks moves the quotient by at most
# BEND / (2 STEP).
BEND = 1e-10
THINGS = ("torus", "screwdriver", "dome")
PITCH = PATCH_WINDOW / PATCH_PIXELS


def poses(thing, count: int, seed: int) -> np.ndarray:
    """Tool poses T_w_t that look, tilted, from above onto random points of an object's upper faces."""
    rng = np.random.default_rng(seed)
    mesh = trimesh.Trimesh(thing.vertices, thing.faces, process=False)
    up = np.where(mesh.face_normals[:, 2] > 0.5, mesh.area_faces, 0)
    points, _ = trimesh.sample.sample_surface(mesh, count, face_weight=up, seed=seed)
    T = np.tile(np.eye(4), (count, 1, 1))
    tilt = Rotation.from_rotvec(rng.normal(0, 0.2, (count, 3)))
    T[:, :3, :3] = np.diag([1.0, -1.0, -1.0]) @ tilt.as_matrix()
    T[:, :3, 3] = points + rng.uniform(-2e-3, 2e-3, (count, 3))
    return T


def both(patch):
    return jnp.append(patch.depth.ravel(), patch.nearest)


def waves() -> tuple[np.ndarray, np.ndarray]:
    """Wave vectors (rad/m) and amplitudes of displacements that bend the meshes, by less than half of STEP: inside the
    slack of the boxes.
    """
    k, amplitude = np.random.default_rng(1).normal(size=(2, 3, 3))
    return 60 * k, amplitude / np.linalg.norm(amplitude, axis=1, keepdims=True) / 2


def look(surface: Surface, T, move):
    """Depths and nearest after a twist of the tool (move[:6]) and with bent meshes (move[6:])."""
    k, amplitude = waves()
    phase = jnp.einsum("fcj,wj->fcw", surface.triangles, k)
    bent = surface.triangles + jnp.einsum("fcw,w,wj->fcj", jnp.sin(phase), move[6:], amplitude)
    return both(render_patch(surface._replace(triangles=bent), T @ transform(so3_exp(move[:3]), move[3:6])))


@pytest.mark.full
def test_against_central_differences_by_pose_and_corners():
    """Corners that share a place move together, so the mesh stays whole. In the clusters of dense meshes, which have a
    way of their own; the other tests here are of the usual ones.
    """
    things = [make_object(name).mesh for name in THINGS]
    T = np.stack([poses(thing, 2, seed) for seed, thing in enumerate(things)])
    dense = [layout_clusters(prepare_surface(thing).triangles, CLUSTER_SIZES.dense, 32) for thing in things]
    with jax.enable_x64(True):
        surfaces = jax.tree.map(lambda a: jnp.asarray(a, jnp.float64), stack_surfaces(dense))

        @jax.jit
        @partial(jax.vmap, in_axes=(0, 0))
        @partial(jax.vmap, in_axes=(None, 0))
        def all_of_it(surface, T):
            def at(step, direction):
                return jax.jvp(partial(look, surface, T), (step * direction,), (direction,))

            return jax.vmap(jax.vmap(at, (None, 0)), (0, None))(STEP * jnp.arange(-1.0, 2.0), jnp.eye(9))

        value, slope = (np.moveaxis(np.asarray(a), 2, 0) for a in all_of_it(surfaces, T))
    (back, here, ahead), slope = value, slope[1]  # (things, poses, directions, pixels and nearest) each
    assert np.isfinite(slope).all()
    same = np.abs(ahead - 2 * here + back) < BEND
    assert same.mean() > 0.9
    quotient = (ahead - back) / (2 * STEP)
    np.testing.assert_allclose(slope[same], quotient[same], rtol=1e-3, atol=BEND / (2 * STEP))
    # The comparison is of something: tilts and bends change much of what is seen, by 1e-3 and more (m per rad or unit);
    # the rest of the pixels sees nothing, or what is too deep.
    moving = np.abs(quotient) > 1e-3
    assert (moving.mean((0, 1, 3))[[0, 1, 6, 7, 8]] > 0.2).all()
    # Moving the tool ahead brings all of the surface nearer and changes no shape: exact, whatever is seen.
    np.testing.assert_allclose(slope[..., 5, -1], -1, rtol=1e-9)
    np.testing.assert_allclose(slope[..., 5, :-1], 0, atol=1e-9)


def soup(*triangles) -> SimpleNamespace:
    return SimpleNamespace(vertices=np.reshape(triangles, (-1, 3)), faces=np.arange(3 * len(triangles)).reshape(-1, 3))


def hostile() -> dict[str, tuple[Surface, np.ndarray]]:
    """Scenes in which some ray meets a point without a derivative."""
    on = (np.arange(PATCH_PIXELS)[20] + 0.5) * PITCH - PATCH_WINDOW / 2  # x and y of a ray
    straight = np.eye(4)
    aside, on_ray, turned, edge_on = (straight.copy() for _ in range(4))
    aside[0, 3] = 0.2
    on_ray[:2, 3] = -on, -on
    turned[:3, :3] = Rotation.from_euler("z", 45, degrees=True).as_matrix()
    edge_on[:3, :3] = Rotation.from_euler("x", 90, degrees=True).as_matrix()
    tent = prepare_surface(
        soup(*[[[0, 0, 0], [0.03 * x, 0, 0.01], [0, 0.03 * y, 0.01]] for x in (-1, 1) for y in (-1, 1)])
    )
    sheet = prepare_surface(soup([[-0.04, -0.04, 0], [0.04, -0.04, 0], [0.04, 0.04, 0]]))
    sliver = prepare_surface(soup([[-0.04, on, 0], [0.04, on, 0], [0.04, on + 1e-9, 1e-3]]))
    degenerate = prepare_surface(soup([[0, 0, 0]] * 3, [[-0.01, 0, 0], [0, 0, 0], [0.01, 0, 0]], [[0, 0, 0.01]] * 3))
    box = prepare_surface(trimesh.creation.box((0.01, 0.01, 0.02)))
    near = np.array([[-0.04, -0.04, 0.001], [0, -0.04, 0.001], [0, 0.04, 0.001]])
    deep = prepare_surface(soup(near, np.add(near, [0.04, 0, 2 * REACH])))
    return {
        "a corner on a ray": (tent, on_ray),
        "edges along the diagonal": (sheet, straight),
        "edges along columns of rays": (tent, turned),
        "a face edge on": (sheet, edge_on),
        "walls edge on": (box, straight),
        "a sliver through rays": (sliver, straight),
        "faces of no area": (degenerate, straight),
        "a sheet too deep": (deep, straight),
        "nothing in the window": (box, aside),
        "the tool inside": (box, edge_on),
    }


@pytest.mark.full
def test_derivatives_are_finite_in_every_scene_and_reverse_mode_is_forward_mode_transposed():
    """Reverse mode, which training and optimisation use, is the same linear map by pose and by corners."""
    scenes = hostile()
    surfaces = stack_surfaces([surface for surface, _ in scenes.values()])
    T = np.stack([T for _, T in scenes.values()]).astype(np.float32)

    @jax.jit
    @jax.vmap
    def slopes(surface, T):
        corners = jnp.asarray(surface.triangles)
        value, forward = jax.linearize(lambda T, c: both(render_patch(surface._replace(triangles=c), T)), T, corners)
        pull = jax.linear_transpose(forward, T, corners)
        ends = jnp.stack([jnp.ones_like(value), jnp.zeros_like(value).at[-1].set(1)])  # all of it, and `nearest`
        return jax.vmap(forward, (0, None))(jnp.eye(16).reshape(16, 4, 4), 0 * corners), jax.vmap(pull)(ends)

    forward, (by_pose, by_corners) = jax.device_get(slopes(surfaces, T))
    finite = [np.isfinite(value).reshape(len(T), -1).all(1) for value in (forward, by_pose, by_corners)]
    assert dict(zip(scenes, np.all(finite, axis=0), strict=True)) == dict.fromkeys(scenes, True)
    # Some fifty roundings in each order of the chain rule; and a depth is a difference of heights that change by 1.
    rounding = np.finfo(np.float32).eps * (50 * np.abs(forward).sum(2) + 2 * PATCH_PIXELS**2)
    for i, expected in enumerate((forward.sum(2), forward[:, :, -1])):
        np.testing.assert_array_less(np.abs(by_pose[:, i].reshape(len(T), 16) - expected), rounding)
    # A window with nothing in it does not change.
    nothing = list(scenes).index("nothing in the window")
    assert not any(part[nothing].any() for part in (forward, by_pose, by_corners))
    # A far sheet, which reads the reach, moves nothing; the near one alone moves `nearest`.
    deep = list(scenes).index("a sheet too deep")
    far = (surfaces.triangles[deep, :, :, 2] > REACH).all(1)
    assert not by_corners[deep][:, far].any()
    assert by_corners[deep, 1, ..., 2].sum() == pytest.approx(1, abs=1e-5)
