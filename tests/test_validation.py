"""Checks of users' arguments: poses, paths, masked arrays and tips."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import i2t
from i2t import geometry, validation
from i2t.depth.camera import read_depth
from i2t.files.writing import as_path
from i2t.hardware.camera_folder import read_view
from i2t.models import ready_path
from i2t.objects import read_mesh
from i2t.reconstruction.evidence import contact_evidence, view_evidence

CAMERA = i2t.Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
IMAGE = np.full((48, 64), 0.3, np.float32)


def looking_down() -> np.ndarray:
    return geometry.transform(np.diag([1.0, -1, -1]), np.array([0.02, 0.01, 0.3]))


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_rigid_motions_pass_as_they_are(kind):
    for rotation in Rotation.random(5, rng=0).as_matrix():
        T = geometry.transform(rotation, np.array([0.4, -1, 2])).astype(kind)
        np.testing.assert_array_equal(validation.pose("T", T), T)
        np.testing.assert_array_equal(validation.pose("T", T.tolist()), T)
        assert geometry.is_rigid(np.linalg.inv(T))  # whose last row is rounded
        assert validation.pose("T", np.linalg.inv(T)).dtype == np.float64


T = looking_down()
NO_MOTIONS = [
    (T.T, "T: .*last row is 0.02, 0.01, 0.3, 1.*perhaps it is transposed"),
    (np.vstack([T[:3], [0, 0, 0, 2]]), "last row is 0, 0, 0, 2.; write 0, 0, 0, 1"),
    (np.vstack([T[:3], [1, 0, 0, 1]]), "last row is 1, 0, 0, 1.; write 0, 0, 0, 1"),
    (T * [1, 1, 1, 1e3] - np.diag([0, 0, 0, 999]), "lies 300 m away.*divide millimetres by 1000"),
    (T @ np.diag([1, 1, -1, 1]), "mirrored"),
    (T @ np.diag([2, 2, 2, 1]), "orthonormal"),
    (T * np.nan, "NaN"),
    (T[:3], r"shape \(3, 4\)"),
]


@pytest.mark.parametrize(("pose", "why"), NO_MOTIONS)
def test_other_matrices_are_refused(pose, why):
    with pytest.raises(ValueError, match=why):
        validation.pose("T", pose)


CORNER = i2t.Mesh(np.array([[0.0, 0, 0], [0.02, 0, 0], [0, 0.02, 0]]), np.array([[0, 1, 2]], np.int32))
TAKERS = {
    "patch_from_depth, camera": lambda pose: i2t.patch_from_depth(IMAGE, CAMERA, pose, np.eye(4)),
    "patch_from_depth, tool": lambda pose: i2t.patch_from_depth(IMAGE, CAMERA, np.eye(4), pose),
    "pose_at_pixel": lambda pose: i2t.pose_at_pixel(IMAGE, CAMERA, pose, (30, 20)),
    "register_by_depth, object": lambda pose: i2t.register_by_depth(CORNER, pose, IMAGE, CAMERA, np.eye(4)),
    "register_by_depth, camera": lambda pose: i2t.register_by_depth(CORNER, np.eye(4), IMAGE, CAMERA, pose),
    "register_by_touch, object": lambda pose: _by_touch(pose, np.eye(4)),
    "register_by_touch, contact": lambda pose: _by_touch(np.eye(4), pose),
    "contact_evidence": contact_evidence,
    "view_evidence": lambda pose: view_evidence(IMAGE, CAMERA, pose),
}


def _by_touch(T_w_o: np.ndarray, T_w_contact: np.ndarray) -> i2t.PoseEstimate:
    key, surface, contacts = jax.random.key(0), i2t.prepare_surface(CORNER), T_w_contact[None]
    return i2t.register_by_touch(key, surface, T_w_o, contacts, jnp.ones(1), translation_std=1e-3, rotation_std=0.01)


@pytest.mark.parametrize("taker", TAKERS)
def test_every_function_that_takes_a_pose_refuses_a_transposed_one_and_millimetres(taker):
    for pose, why in (NO_MOTIONS[0], NO_MOTIONS[3]):
        with pytest.raises(ValueError, match=why.removeprefix("T: ")):
            TAKERS[taker](pose)


def test_masked_numbers_are_not_a_number():
    masked = np.ma.masked_greater(np.array([1.0, 5.0]), 3)
    np.testing.assert_array_equal(validation.numbers("depth", masked, ""), [1, np.nan])
    whole = np.ma.MaskedArray([1, 2])
    np.testing.assert_array_equal(validation.numbers("depth", whole, ""), [1, 2])
    with pytest.raises(TypeError, match="depth: masks some of its int64"):
        validation.numbers("depth", np.ma.masked_greater(np.array([1, 5]), 3), "metres")


def test_arguments_that_are_not_paths_are_refused():
    """The test runs without the test suite's type checks, which users do not have."""
    for function, *others in (
        (ready_path, "predictor"), (read_depth, "mm"), (read_mesh, "mm"),
        (i2t.load_pad,), (i2t.load_dataset,), (i2t.load_predictor,), (read_view,),
    ):  # fmt: skip
        takes = getattr(function, "__wrapped__", function)
        for value in (None, 5, ["a"]):
            with pytest.raises(TypeError, match=r"path: .*not a path; give the name of a file or folder"):
                takes(value, *others)
        with pytest.raises(ValueError, match="is empty"):
            takes("", *others)
    assert as_path("path", Path("a")) == as_path("path", "a") == Path("a")


def test_no_tip_is_larger_than_a_ball_of_20_cm():
    assert validation.round_tip("sphere:100") == ("sphere", 100)
    with pytest.raises(ValueError, match="500 mm is larger than 100 mm"):
        validation.round_tip("sphere:500")
    with pytest.raises(ValueError, match="60 mm is larger than 50 mm"):
        validation.round_tip("sphere:60", 50)
