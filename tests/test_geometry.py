"""Rotations against SciPy, transforms against their group axioms (tolerances: a few float32 roundings of numbers of
order one).
"""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from i2t import geometry
from i2t.patches.dimensions import TWIST_LEVER_M

ROUNDING = 20 * np.finfo(np.float32).eps
vectors = st.lists(st.floats(-3, 3, width=32), min_size=3, max_size=3).map(np.array)
# Translations up to 3 m, turns below half a one: 1.8 rad along each axis at most.
twists = st.tuples(vectors, vectors).map(lambda both: np.concatenate([both[0], 0.6 * both[1]]))
there_and_back = jax.jit(lambda twist: geometry.log(geometry.exp(twist)))


def motion(twist) -> np.ndarray:
    return geometry.exp(np.asarray(twist, np.float64))


@settings(max_examples=30, deadline=None)
@given(vectors, vectors, vectors)
def test_rotations_are_scipy_s_and_the_inverse_undoes(rotvec, translation, point):
    R = geometry.so3_exp(jnp.float32(rotvec))
    np.testing.assert_allclose(R, Rotation.from_rotvec(rotvec).as_matrix(), atol=ROUNDING)
    T = geometry.transform(R, jnp.float32(translation))
    back = geometry.apply(geometry.inverse(T), geometry.apply(T, jnp.float32(point)))
    np.testing.assert_allclose(back, point, atol=10 * ROUNDING)


@pytest.mark.full
def test_derivatives_are_right_at_rest():
    """At rest, the exponential of a twist is the identity plus its generator, so the chain of both is the identity."""
    generators = np.cross(np.eye(3)[:, None], np.eye(3)[None]).transpose(2, 1, 0)  # d R_ij / d r_k
    np.testing.assert_allclose(jax.jacfwd(geometry.so3_exp)(jnp.zeros(3)), generators, atol=ROUNDING)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(there_and_back))(jnp.zeros(6)), np.eye(6), atol=ROUNDING)


def test_a_rounded_motion_becomes_the_nearest_rigid_one():
    """Symmetric rounding of a rotation's frame, R (I + S), changes no rotation; it is the polar decomposition."""
    T = np.asarray(geometry.from_twist(np.array([0.1, -0.2, 0.3, 0.01, 0.02, -0.01])))
    rounded = T.copy()
    rounded[:3, :3] = T[:3, :3] @ (np.eye(3) + 1e-3 * np.array([[1, 2, 3], [2, -1, 4], [3, 4, 2]]))
    np.testing.assert_allclose(geometry.nearest_rigid(rounded), T, atol=1e-14)
    single = geometry.nearest_rigid(jnp.float32(T))
    assert single.dtype == np.float64
    np.testing.assert_allclose(single[:3, :3] @ single[:3, :3].T, np.eye(3), atol=1e-14)


@settings(max_examples=50, deadline=None)
@given(twists, twists, twists, vectors)
def test_motions_are_a_group_that_acts_on_points(a, b, c, point):
    """Float64 on the host: the axioms hold to a few roundings of numbers up to 30."""
    A, B, C = motion(a), motion(b), motion(c)
    compose, inverse, apply = geometry.compose, geometry.inverse, geometry.apply
    for one, other in (
        (compose(compose(A, B), C), compose(A, compose(B, C))),
        (compose(A, np.eye(4)), A),
        (compose(A, inverse(A)), np.eye(4)),
        (inverse(compose(A, B)), compose(inverse(B), inverse(A))),
        (apply(compose(A, B), point), apply(A, apply(B, point))),
    ):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-13)
    assert geometry.is_rigid(compose(A, B))


@settings(max_examples=50, deadline=None)
@given(twists, st.floats(1e-9, 1))
def test_exponential_is_the_matrix_exponential_and_the_logarithm_undoes_it(twist, share):
    """Below half a turn, where the logarithm is unique; on both kinds of arrays, each to its own roundings."""
    generator = np.zeros((4, 4))
    generator[:3, :3], generator[:3, 3] = np.cross(np.eye(3), twist[3:]).T * -1, twist[:3]
    np.testing.assert_allclose(motion(twist), expm(generator), rtol=0, atol=1e-12)
    short = np.float64(twist) * share
    np.testing.assert_allclose(geometry.log(geometry.exp(short)), short, rtol=0, atol=1e-12)
    np.testing.assert_allclose(there_and_back(jnp.float32(short)), short, rtol=0, atol=50 * ROUNDING)
    np.testing.assert_allclose(geometry.to_twist(geometry.from_twist(short * 1e-3)), short * 1e-3, rtol=0, atol=1e-15)


def test_logarithm_holds_for_batches_up_to_half_a_turn():
    vectors = np.random.default_rng(0).normal(size=(200, 3))
    vectors *= (np.linspace(0, np.pi - 1e-9, 200) / np.linalg.norm(vectors, axis=1))[:, None]
    matrices = Rotation.from_rotvec(vectors).as_matrix()
    np.testing.assert_allclose(geometry.so3_exp(vectors), matrices, atol=1e-14)
    np.testing.assert_allclose(geometry.so3_log(matrices), vectors, atol=1e-12)
    half = Rotation.from_rotvec([[np.pi, 0, 0], [0, np.pi, 0], [0, 0, -np.pi]]).as_matrix()
    np.testing.assert_allclose(geometry.so3_exp(geometry.so3_log(half)), half, atol=1e-12)


def test_twist_measures_rotations_at_the_lever():
    T = geometry.from_twist(np.array([1e-3, 0, 0, 0, 0, 1e-4]))
    assert T[0, 3] == 1e-3
    rim = np.array([0, TWIST_LEVER_M, 0])
    assert np.linalg.norm(geometry.apply(T, rim) - rim - [1e-3, 0, 0]) == pytest.approx(1e-4, rel=1e-3)


def test_arrays_keep_their_kind_and_drivers_need_no_jax():
    for T in (np.eye(4), np.eye(4, dtype=np.float32)):
        made = [geometry.inverse(T), geometry.log(T), geometry.compose(T, T), geometry.apply(T, T[:3, :3])]
        assert [(type(found), found.dtype) for found in made] == [(np.ndarray, T.dtype)] * 4
    code = "import sys, numpy; from i2t.geometry import log; log(numpy.eye(4)); assert 'jax' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_contact_frame_faces_the_surface_and_turns_by_the_smallest_rotation():
    """Pressing straight down keeps x with the world's; leaning turns the frame by just the angle between the axes."""
    for normal in ((0, 0, 1), (0, 0, -1), (1, 0, 0), (0.6, 0, 0.8), (-0.48, 0.6, -0.64), (0, 1e-4, -1)):
        normal = np.array(normal) / np.linalg.norm(normal)
        T = np.asarray(geometry.contact_frame(jnp.array([1.0, 2.0, 3.0]), jnp.float32(normal), 0.7))
        np.testing.assert_allclose(T[:3, 2], -normal, atol=1e-5)
        np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-5)
        assert np.linalg.det(T[:3, :3]) == pytest.approx(1, abs=1e-5)
        np.testing.assert_allclose(T[:3, 3], [1, 2, 3])
    down = geometry.contact_frame(jnp.zeros(3), jnp.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(down[:3, 0], [1, 0, 0], atol=ROUNDING)
    leaning = geometry.contact_frame(jnp.zeros(3), jnp.float32([0.6, 0.0, 0.8]))
    turn = Rotation.from_matrix(np.asarray(leaning[:3, :3] @ down[:3, :3].T))
    assert turn.magnitude() == pytest.approx(np.arccos(0.8), abs=1e-5)


@pytest.mark.full
def test_random_motion_has_the_stated_spread():
    keys = jax.random.split(jax.random.key(0), 4000)
    T = np.asarray(jax.vmap(lambda key: geometry.random_motion(key, 2e-3, 0.01))(keys))
    # Standard error of a standard deviation over n = 12 000 draws is 1 / sqrt(2 n) = 0.65 %; four of them are allowed.
    assert T[:, :3, 3].std() == pytest.approx(2e-3, rel=0.026)
    assert Rotation.from_matrix(T[:, :3, :3]).as_rotvec().std() == pytest.approx(0.01, rel=0.026)


def test_products_of_poses_keep_all_digits_on_every_device():
    """An accelerator rounds the factors of a product that does not ask for more."""
    pose = geometry.transform(jnp.eye(3), jnp.arange(3.0))
    for work in (
        geometry.inverse,
        lambda T: geometry.apply(T, T[:3, :3]),
        lambda T: geometry.contact_frame(T[0, :3], T[1, :3]),
    ):
        products = str(jax.make_jaxpr(work)(pose)).split("dot_general[")[1:]
        assert products
        assert all("precision=(Precision.HIGHEST, Precision.HIGHEST)" in product[:300] for product in products)


def test_rigid_motions_are_distinguished_from_others():
    for rotation in Rotation.random(5, rng=0).as_matrix():
        T = geometry.transform(rotation, np.array([0.1, -2, 3])).astype(np.float32)
        assert geometry.is_rigid(jnp.asarray(T))
        far = 3 * geometry.ORTHOGONALITY_TOLERANCE
        sheared = T @ (np.eye(4) + far * np.eye(4, k=1) * [0, 1, 0, 0])
        for other in (T * [1 + far, 1, 1, 1], T * [1, 1, -1, 1], sheared, T.T, T * [1, 1, 1, np.nan]):
            assert not geometry.is_rigid(jnp.asarray(other, jnp.float32))
