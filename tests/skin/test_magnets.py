"""Cylinder magnets against magpylib's closed form, a dipole far away, and the invariances of a set of magnets."""

import jax
import jax.numpy as jnp
import magpylib
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from i2t.skin import magnets
from i2t.skin.boards import eflesh_board
from i2t.skin.dipoles import dipole_field
from i2t.skin.magnets import Magnets

STRENGTH = 1e6  # A/m, about that of sintered neodymium
SIZES = [(1.5e-3, 1e-3), (1.5e-3, 6e-3), (4.75e-3, 1.6e-3)]  # radius and height of common disc and rod magnets
BOARD = eflesh_board()
cylinder = jax.jit(jax.vmap(magnets.cylinder_field, (0, None, None, None)), static_argnums=3)
field = jax.jit(magnets.field)
response = jax.jit(magnets.response)


def _exact(points: np.ndarray, radius: float, height: float) -> np.ndarray:
    magnet = magpylib.magnet.Cylinder(magnetization=(0, 0, STRENGTH), dimension=(2 * radius, height))
    return np.asarray(magnet.getB(points))


def _around(radius: float, height: float) -> np.ndarray:
    """Make points 1-20 mm from a cylinder: on all sides, on the axis, beyond the rim, and at the level of an end."""
    random, distance = np.random.default_rng(0), np.geomspace(1e-3, 20e-3, 25)
    flat, end = np.zeros(25), height / 2
    turn = Rotation.from_rotvec([0, 0, 1.0])
    special = [
        [flat, flat, end + distance],
        [radius + flat, flat, -end - distance],
        [radius + distance, flat, end + flat],
    ]
    points = random.uniform(-1, 1, (600, 3)) * ([radius + 20e-3] * 2 + [end + 20e-3]) * random.uniform(0, 1, (600, 1))
    outside = np.hypot(np.maximum(np.hypot(*points[:, :2].T) - radius, 0), np.maximum(np.abs(points[:, 2]) - end, 0))
    return np.concatenate(
        [turn.apply(np.moveaxis(special, 1, 2).reshape(-1, 3)), points[(outside > 1e-3) & (outside < 20e-3)]]
    )


@pytest.mark.parametrize("size", SIZES)
def test_a_cylinder_agrees_with_magpylib(size):
    points = _around(*size)
    ours = np.asarray(cylinder(jnp.asarray(points, jnp.float32), *size, STRENGTH))
    exact = _exact(points, *size)
    # 1e-4 is required, relative to the field's norm, as components vanish. The remaining errors are the rule's, at most
    # (1 + d / a)^-64 = 5e-6 at 1 mm from the widest cylinder, the rounding of points by 6e-8 of up to 25 mm (1.5e-9 m,
    # and the field changes by 4 / r), and that of sums of 64 terms up to r / a = 17 times their total.
    error = np.linalg.norm(ours - exact, axis=1) / np.linalg.norm(exact, axis=1)
    assert error.max() < 2e-5


def test_the_field_inside_a_magnet_and_the_convergence_of_the_nodes():
    """Current and charge models agree inside only for B, not for mu0 H. The rule's error is (1 + d / a)^-N: nearby, the
    error of 16 nodes is about a tenth of that.
    """
    radius, height = 3e-3, 4e-3
    points = np.array([[0, 0, 0], [1e-3, -0.5e-3, 1e-3], [0, 1.5e-3, -1.9e-3], [radius + 1e-3, 0, 0.5e-3]])
    exact = _exact(points, radius, height)
    ours = cylinder(jnp.asarray(points, jnp.float32), radius, height, STRENGTH)
    np.testing.assert_allclose(ours, exact, atol=2e-5 * np.abs(exact).max())
    few = magnets.cylinder_field(jnp.asarray(points[3], jnp.float32), radius, height, STRENGTH, 16)
    assert 1e-4 < np.linalg.norm(few - exact[3]) / np.linalg.norm(exact[3]) < 10 * (4 / 3) ** -16


def test_far_away_it_is_a_dipole():
    radius, height = 1e-3, 1.5e-3
    points = np.random.default_rng(1).normal(size=(20, 3))
    points = jnp.asarray(0.1 * points / np.linalg.norm(points, axis=1, keepdims=True), jnp.float32)
    moment = jnp.asarray([[0, 0, STRENGTH * np.pi * radius**2 * height]], jnp.float32)
    dipole = np.asarray(dipole_field(points, jnp.zeros((1, 3)), moment))
    ours = np.asarray(cylinder(points, radius, height, STRENGTH))
    # The next multipole is smaller by about (a / r)^2 = 1e-4; rounding adds r / a = 100 times 6e-8.
    np.testing.assert_allclose(ours, dipole, atol=3e-4 * np.abs(dipole).max())


def test_gradients_are_those_of_magpylib():
    """Forward and reverse derivatives with respect to place, against central differences of the closed form."""
    radius, height = 1.5e-3, 2e-3
    points = np.array([[0, 0, 3e-3], [radius, 0, 4e-3], [3e-3, 1e-3, 0.2e-3], [1e-3, -2e-3, -5e-3], [0, 3e-3, 1e-3]])
    step = 1e-6 * np.eye(3)  # truncation (step / r)^2 = 1e-6
    exact = np.stack([(_exact(points + s, radius, height) - _exact(points - s, radius, height)) / 2e-6 for s in step])
    exact = np.moveaxis(exact, 0, -1)
    for derive in (jax.jacfwd, jax.jacrev):
        ours = jax.jit(jax.vmap(derive(lambda p: magnets.cylinder_field(p, radius, height, STRENGTH))))(
            jnp.asarray(points, jnp.float32)
        )
        error = np.abs(ours - exact).max(axis=(1, 2)) / np.abs(exact).max(axis=(1, 2))
        assert np.all(error < 1e-3)  # required accuracy


@pytest.mark.full
def test_gradients_with_respect_to_the_magnet():
    """The field is linear in the magnetisation and homogeneous, B(s p, s a, s h) = B(p, a, h), so Euler's sum is 0."""
    at = jnp.asarray([1e-3, 2e-3, 3e-3]), jnp.asarray(1.5e-3), jnp.asarray(2e-3), jnp.asarray(STRENGTH)
    d_point, d_radius, d_height, d_strength = jax.jit(jax.jacrev(magnets.cylinder_field, (0, 1, 2, 3)))(*at)
    field = magnets.cylinder_field(*at)
    np.testing.assert_allclose(STRENGTH * d_strength, field, atol=1e-5 * np.abs(field).max())
    terms = d_point @ at[0], at[1] * d_radius, at[2] * d_height
    np.testing.assert_allclose(sum(terms), np.zeros(3), atol=1e-5 * np.abs(np.asarray(terms)).max())
    assert np.abs(terms[1]).max() > 0.1 * np.abs(field).max()


def _lattice() -> Magnets:
    """Make four unequal, tilted magnets above a board."""
    turns = Rotation.from_rotvec(0.3 * np.random.default_rng(2).normal(size=(4, 3)))
    places = np.array([[-4, -4, -1], [4, -4, -1.5], [-4, 4, -1], [4, 4, -2.0]]) * 1e-3 + [0, 0, 3e-3]
    return Magnets(
        *(
            jnp.asarray(value, jnp.float32)
            for value in (places, turns.as_matrix(), [1.5e-3, 2e-3, 1e-3, 1.5e-3], [1e-3, 2e-3, 3e-3, 1e-3])
        ),
        jnp.asarray([1.0, -0.8, 1.1, 0.9]) * STRENGTH,
    )


def test_moved_and_turned_magnets_agree_with_magpylib():
    random, lattice = np.random.default_rng(3), _lattice()
    shift, turn = random.normal(size=(4, 3)) * 0.5e-3, random.normal(size=(4, 3)) * 0.2
    exact = np.zeros((2, 5, 3))
    rest, places = Rotation.from_matrix(np.asarray(lattice.rotations, float)), np.asarray(lattice.positions, float)
    for state, place, pose in ((0, places, rest), (1, places + shift, Rotation.from_rotvec(turn) * rest)):
        for i in range(4):
            magnet = magpylib.magnet.Cylinder(
                magnetization=(0, 0, float(lattice.magnetizations[i])),
                dimension=(2 * float(lattice.radii[i]), float(lattice.heights[i])),
                position=place[i],
                orientation=pose[i],
            )
            exact[state] += 1e6 * magnet.getB(np.asarray(BOARD.chips))
    reading = response(BOARD, lattice, *(jnp.asarray(value, jnp.float32) for value in (shift, turn)))
    expected = BOARD.to_board(exact[1] - exact[0])
    # Rotations in float32 are exact to a few 1e-7, fields to 2e-5 as above.
    np.testing.assert_allclose(reading, expected, atol=2e-5 * np.abs(exact).max())
    assert np.abs(expected).max() > 100
    np.testing.assert_array_equal(response(BOARD, lattice, jnp.zeros((4, 3)), jnp.zeros((4, 3))), np.zeros(15))


def test_moving_everything_moves_the_frame():
    """If magnets and points move by one rigid motion, the field turns with them."""
    lattice, points, shift = _lattice(), jnp.asarray(BOARD.chips), jnp.asarray([1e-3, 2e-3, -3e-3])
    rotation = np.asarray(Rotation.from_rotvec([0.3, -0.5, 0.8]).as_matrix(), np.float32)
    around = lattice._replace(
        positions=lattice.positions @ rotation.T + shift[None], rotations=rotation[None] @ lattice.rotations
    )
    plain, there = np.asarray(field(points, lattice)), field(points @ rotation.T + shift[None], around)
    # Points and magnets are placed to 1e-9 m, and the field changes by 4 / r of itself: 2e-6.
    np.testing.assert_allclose(there, plain @ rotation.T, atol=1e-5 * np.abs(plain).max())
