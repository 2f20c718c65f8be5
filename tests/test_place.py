"""An object's pose from a depth view goes into the rig."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from i2t import place
from i2t.hardware import camera_folder
from i2t.hardware.poses import pose_to_vector
from i2t.hardware.protocols import View
from i2t.hardware.rig import Rig
from i2t.objects import catalogue
from i2t.objects.solids import transform_mesh
from i2t.patches.dimensions import TWIST_LEVER_M
from i2t.simulation.depth_camera import render_view


def pose(turn, at):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), at
    return T


# The camera looks at the object at 40 degrees from the vertical, 0.2 m away.
T_B_C = Rig().T_base_world @ pose([0, 0, 0], [0, 0, 0.015]) @ pose([np.pi - 0.7, 0, 0], [0, 0, 0])
T_B_C = T_B_C @ pose([0, 0, 0], [0, 0, -0.2])
TOOL = pose_to_vector(T_B_C @ np.linalg.inv(Rig().T_tool_camera))


@pytest.fixture
def lab(tmp_path):
    """Write a rig and a view of a star at another pose than the rig's, and return the folder and that pose."""
    rig = Rig()
    rig.write(tmp_path / "lab.toml")
    really = pose([0, 0, 0.06], [0.004, -0.006, 0.0])  # T_w_o
    mesh = transform_mesh(catalogue.make_object("star").mesh, rig.T_base_world @ really)
    corners = rig.T_base_world[:3, 3] + 0.1 * np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)])
    triangles = np.concatenate([mesh.vertices[mesh.faces], corners[[[0, 1, 2], [0, 2, 3]]]])
    depth, _ = render_view(triangles, T_B_C, rig.camera)
    rng = np.random.default_rng(0)
    seen = np.where(np.isfinite(depth), depth + 0.3e-3 * rng.standard_normal(depth.shape), np.nan).astype(np.float32)
    list(camera_folder.save_views(tmp_path / "views", rig.camera, [View(0.0, seen, None)]))
    return tmp_path, really


def test_a_view_gives_the_pose_and_missing_options_are_refused(lab, capsys):
    path, really = lab
    rig, views, tool = str(path / "lab.toml"), str(path / "views"), [str(x) for x in TOOL]
    for options, code, why in (
        (["--object", "star"], 2, "give --host, or --tool"),
        (["--object", "nothing.stl", "--tool", *tool], 2, "nothing.stl"),
        (["--object", "star", "--tool", *tool, "--views", str(path)], 2, "camera.toml cannot be read"),
        (["--object", "star", "--tool", "9", *tool[1:], "--views", views], 2, "points lie within"),
    ):
        assert place.main([rig, *options]) == code
        error = capsys.readouterr().err
        assert why in error
        assert error.count("\n") == 1
    assert place.main([rig, "--object", "star", "--views", views, "--tool", *tool, "--write"]) == 0
    assert "star is 7." in capsys.readouterr().out
    rig = Rig.read(path / "lab.toml")
    assert rig.object_from == "registration"
    off = np.linalg.inv(really) @ rig.T_world_object
    # 0.3 mm of noise on thousands of points: what is left is how finely surface and image are sampled.
    assert np.linalg.norm(off[:3, 3]) < 0.5e-3
    assert Rotation.from_matrix(off[:3, :3]).magnitude() < 0.01
    assert rig.mass == Rig().mass
    # The camera's own place, 1 mm and 0.5 degrees on each axis, is what remains: 0.2 m away, another 1.7 mm across.
    sigma = np.sqrt(np.diagonal(rig.object_covariance))
    assert 1e-3 < sigma[:3].min() < sigma[:3].max() < 2.2e-3
    np.testing.assert_allclose(np.degrees(sigma[3:] / TWIST_LEVER_M), 0.5, atol=0.05)
