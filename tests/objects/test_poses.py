"""Poses of a touching tool, against trimesh and the renderer."""

import subprocess
import sys

import jax
import numpy as np
import pytest
import trimesh

from i2t import geometry
from i2t.objects import Mesh, contact_pose, make_object, point_on_ray
from i2t.rendering.render import prepare_surface, render_patch

HEXAGON, DOME = make_object("hexagon").mesh, make_object("dome").mesh
TOP = np.array([5e-3, -4e-3, 30e-3])  # on the hexagon's top, more than half a window from its edges


def test_the_tool_stands_on_the_point_and_points_into_the_surface():
    """Random points of a round and a flat object are compared with trimesh's own samples and face normals."""
    for mesh in (HEXAGON, DOME):
        whole = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
        points, faces = trimesh.sample.sample_surface(whole, 20, seed=0)
        for point, normal in zip(points, whole.face_normals[faces], strict=True):
            T = contact_pose(mesh, point)
            assert geometry.is_rigid(T)
            np.testing.assert_array_equal(T[:3, 3], point)
            np.testing.assert_allclose(T[:3, 2], -normal, atol=1e-9)
            leaning = contact_pose(mesh, point, normal=[0.6, 0.0, 0.8])
            np.testing.assert_allclose(leaning[:3, 2], [-0.6, 0, -0.8], atol=1e-12)


def test_roll_turns_about_tool_z_from_the_objects_x():
    level = contact_pose(HEXAGON, TOP)
    np.testing.assert_allclose(level[:3, :3], np.diag([1.0, -1, -1]), atol=1e-12)
    for roll in (-2.0, 0.3, 1.5):
        turned = geometry.compose(geometry.inverse(level), contact_pose(HEXAGON, TOP, roll=roll))
        np.testing.assert_allclose(geometry.log(turned), [0, 0, 0, 0, 0, roll], atol=1e-12)


def test_a_patch_at_the_pose_begins_at_the_tool_and_is_flat():
    look = jax.jit(render_patch)
    surface = prepare_surface(HEXAGON)
    side = np.array([0, -30e-3 * np.cos(np.pi / 6), 15e-3])  # the middle of a face, 30 mm wide and high
    for point in (TOP, side):
        patch = look(surface, contact_pose(HEXAGON, point, roll=0.4).astype(np.float32))
        assert abs(patch.nearest) < 1e-6
        # Around the side's middle the window ends before the prism's edges.
        np.testing.assert_allclose(patch.depth, 0, atol=1e-6)


def test_invalid_arguments_are_refused():
    for change, message in (
        ({"point": (*TOP[:2], 32e-3)}, "point: lies 2 mm off the surface, where at most 1 mm are allowed"),
        ({"point": [0, np.nan, 0]}, "point: .* is not three finite numbers"),
        ({"normal": [0, 0, 2]}, "normal: .* is not a unit vector"),
        ({"roll": np.inf}, "roll: is inf; give radians"),
    ):
        with pytest.raises(ValueError, match=message):
            contact_pose(HEXAGON, **{"point": TOP, **change})
    point = HEXAGON.vertices.argmax(0)[2]
    flat = np.array([[point, point, point]], np.int32)  # a face without area gives no normal
    mesh = HEXAGON._replace(faces=np.concatenate([flat, HEXAGON.faces]))
    np.testing.assert_array_equal(contact_pose(mesh, TOP), contact_pose(HEXAGON, TOP))
    with pytest.raises(ValueError, match="no face has an area"):
        contact_pose(HEXAGON._replace(faces=flat), TOP)


def test_objects_and_data_sets_need_no_jax():
    code = """
import sys
import i2t.dataset, i2t.skin.boards
from i2t.objects import contact_pose, make_object

contact_pose(make_object("dome").mesh, (0, 0, 30e-3))
sys.exit("jax" in sys.modules or "jaxlib" in sys.modules)
"""
    subprocess.run([sys.executable, "-c", code], check=True)


def as_mesh(mesh: trimesh.Trimesh) -> Mesh:
    return Mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int32))


@pytest.mark.parametrize("overlap", [0.0, 2e-3])
def test_points_inside_several_bodies_are_refused(overlap):
    """The bodies touch or overlap; at their seam, the outer face counts."""
    left, right = (trimesh.creation.box((20e-3, 20e-3, 20e-3)) for _ in range(2))
    right.apply_translation([20e-3 - overlap, 0, 0])
    both = as_mesh(trimesh.util.concatenate([left, right]))
    with pytest.raises(ValueError, match="point: is inside the object, where no skin can touch it"):
        contact_pose(both, (10e-3, 1e-3, 2e-3))
    for x in (10e-3 - overlap, 9e-3, 10e-3, 15e-3):
        np.testing.assert_allclose(contact_pose(both, (x, 1e-3, 10e-3))[:3, 2], [0, 0, -1])
    contact_pose(as_mesh(left), (10e-3, 1e-3, 2e-3))
    cup = trimesh.Trimesh(left.vertices, left.faces[left.face_normals[:, 2] < 0.5], process=False)
    inside_out = trimesh.Trimesh(cup.vertices, cup.faces[:, ::-1], process=False)
    for open_surface in (cup, inside_out):  # of an open surface, either side may be touched
        contact_pose(as_mesh(open_surface), (10e-3, 1e-3, 2e-3))


def test_a_ray_meets_the_mesh_where_trimesh_says():
    """Rays towards random points near the hexagon and the dome, of which some miss."""
    rng = np.random.default_rng(0)
    for mesh in (HEXAGON, DOME):
        whole = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
        origins = rng.normal(size=(200, 3)) * 0.1 + (0, 0, 0.3)
        directions = rng.uniform(-0.05, 0.05, (200, 3)) - origins
        hits, rays, _ = whole.ray.intersects_location(origins, directions, multiple_hits=False)
        met = dict(zip(rays.tolist(), hits, strict=True))
        assert 20 < len(met) < 200
        for i in range(200):
            point = point_on_ray(mesh, origins[i], directions[i])
            assert (point is None) == (i not in met)
            if point is not None:
                np.testing.assert_allclose(point, met[i], atol=1e-6)


def test_a_ray_from_inside_leaves_and_one_away_misses():
    np.testing.assert_allclose(point_on_ray(HEXAGON, (0, 0, 0.01), (0, 0, 2)), (0, 0, 30e-3), atol=1e-12)
    assert point_on_ray(HEXAGON, (0, 0, 0.1), (0, 0, 1)) is None
