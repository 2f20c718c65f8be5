"""Dipoles and layers of magnets against magpylib, and the reading under refinement."""

from functools import partial

import jax
import jax.numpy as jnp
import magpylib
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from i2t.skin import contact, elasticity
from i2t.skin import dipoles as field
from i2t.skin.elasticity import FINE_GRID, GRID, Grid
from i2t.skin.pad import nominal_pad, sample_pad
from tests.helpers.round_tips import round_tip

PAD = nominal_pad()
LOADS, COARSE = Grid(16, 32), Grid(8, 16)
response, pressed = jax.jit(field.response), jax.jit(field.pressed_field)
sample = jax.jit(sample_pad)
Y, X = np.meshgrid(GRID.centres, GRID.centres, indexing="ij")


def _load(seed: int) -> jnp.ndarray:
    """Make the pressure (Pa) of about a newton somewhere on the pad, 3 mm wide."""
    x, y = np.random.default_rng(seed).uniform(-5e-3, 5e-3, 2)
    return jnp.asarray(8e4 * np.maximum(1 - ((X - x) ** 2 + (Y - y) ** 2) / 3e-3**2, 0) ** 0.5, jnp.float32)


def test_dipoles_agree_with_magpylib():
    random = np.random.default_rng(0)
    positions, moments = random.uniform(-1e-2, 1e-2, (200, 3)), random.normal(size=(200, 3)) * 1e-6
    points = random.uniform(-1e-2, 1e-2, (20, 3)) - [0, 0, 0.02]
    ours = field.dipole_field(*(jnp.asarray(value, jnp.float32) for value in (points, positions, moments)))
    dipoles = [magpylib.misc.Dipole(moment=m, position=p) for m, p in zip(moments, positions, strict=True)]
    theirs = np.sum([magpylib.getB(dipole, points) for dipole in dipoles], axis=0)
    # 1e-5 is required. The error of one dipole is about 10 roundings of 6e-8. A sum of random signs is smaller than its
    # terms, so the error is relative to their root sum of squares.
    terms = np.sqrt(np.sum([magpylib.getB(dipole, points) ** 2 for dipole in dipoles], axis=(0, 2)))
    assert np.all(np.abs(ours - theirs) < 1e-5 * terms[:, None])
    # Along the axis B = mu0 m / (2 pi r^3); beside the dipole it is half of that, in the opposite direction.
    m, r = 2e-6, 5e-3
    at_poles = field.dipole_field(jnp.asarray([[0, 0, -r], [r, 0, 0]]), jnp.zeros((1, 3)), jnp.asarray([[0, 0, m]]))
    expected = 2e-7 * m / r**3
    np.testing.assert_allclose(at_poles, [[0, 0, expected], [0, 0, -expected / 2]], rtol=1e-6, atol=1e-6 * expected)


@pytest.mark.parametrize("pattern", ["uniform", "poles"])
def test_the_layer_at_rest_agrees_with_solid_magnets(pattern):
    """The dipoles represent 16 cuboid magnets, whose field magpylib has in closed form."""
    pad = nominal_pad(pattern)
    thickness, strength, edge = float(pad.thickness), float(jnp.abs(pad.magnetization).max()), 5e-3
    exact = np.zeros((5, 3))
    for i in range(4):
        for j in range(4):
            magnet = magpylib.magnet.Cuboid(
                magnetization=(0, 0, strength * (1 if pattern == "uniform" or (i + j) % 2 == 0 else -1)),
                dimension=(edge, edge, thickness),
                position=((j - 1.5) * edge, (i - 1.5) * edge, -thickness / 2),
            )
            exact += 1e6 * magnet.getB(np.asarray(pad.board.chips))
    # Fourth-order means over cells of a = 0.5 mm at d = 1.5 mm and more below: (a / d)^4 x 17 / 5760 x 4! < 1e-3; the
    # error of five Gauss nodes is smaller. It is relative to the strongest chip, as some components vanish by symmetry.
    np.testing.assert_allclose(field.rest_field(pad), exact, atol=1e-3 * np.abs(exact).max())


@pytest.mark.full
def test_a_pressed_layer_agrees_with_magpylib():
    """Every dipole is moved and turned explicitly, its field is magpylib's; with friction and clamped at its edge."""
    pad, pressure = sample(jax.random.key(5))._replace(mount_compliance=jnp.asarray(1e-4)), _load(1)
    traction = 0.5 * jnp.stack([pressure, -0.5 * pressure])
    depths, moments = field.sheets(pad)
    waves = elasticity.load(pad, pressure, traction)
    inside, exact = jax.jit(elasticity.interior), np.zeros((5, 3))
    for depth, sheet in zip(depths, moments, strict=True):
        u, w = (np.moveaxis(np.asarray(a, float), 0, -1).reshape(-1, 3) for a in inside(pad, waves, depth))
        places = np.stack([X, Y, np.full_like(X, -float(depth))], -1).reshape(-1, 3) + u
        size = np.linalg.norm(w, axis=1, keepdims=True)
        turn = Rotation.from_rotvec(w / np.maximum(size, 1e-12) * 2 * np.arctan(size / 2))
        turned = turn.apply(np.moveaxis(np.asarray(sheet, float), 0, -1).reshape(-1, 3))
        dipoles = magpylib.Collection(
            *(magpylib.misc.Dipole(moment=m, position=p) for m, p in zip(turned, places, strict=True))
        )
        exact += 1e6 * dipoles.getB(np.asarray(pad.board.chips))
    np.testing.assert_allclose(pressed(pad, pressure, traction=traction), exact, atol=1e-5 * np.abs(exact).max())


def test_the_reading_is_linear_in_the_magnetisation_and_the_gains_and_zero_without_pressure():
    first, second, pressure = sample(jax.random.key(1)), sample(jax.random.key(2)), _load(3)
    plain, other = (response(first._replace(magnetization=pad.magnetization), pressure) for pad in (first, second))
    mixed = response(first._replace(magnetization=2 * first.magnetization - 3 * second.magnetization), pressure)
    np.testing.assert_allclose(mixed, 2 * plain - 3 * other, atol=1e-4 * float(jnp.abs(mixed).max()))
    gains = jnp.linspace(0.5, 2.0, 15)
    unit = response(first._replace(gains=jnp.ones(15)), pressure)
    np.testing.assert_allclose(response(first._replace(gains=gains), pressure), gains * unit, rtol=1e-6)
    # Two sums of 8000 dipoles, of some mT in total, differ by their rounding: 1e-7 of a few thousand uT.
    np.testing.assert_allclose(response(first, jnp.zeros((40, 40))), np.zeros(15), atol=1e-3)


def _change(pads, heights, forces, coarse, fine) -> float:
    """Compute the norm of the difference between readings on two discretisations, relative to that of the readings."""

    def read(discretisation):
        grid, nodes = discretisation
        y, x = np.meshgrid(grid.centres, grid.centres, indexing="ij")
        height = jnp.asarray(np.stack([shape(x, y) for shape in heights]), jnp.float32)

        def press(pad, height, force):
            solved = contact.solve_force(pad, height, force, grid)
            return field.response(pad, solved.pressure, grid, nodes=nodes), solved.converged

        def presses(pad):
            return jax.lax.map(lambda row: press(pad, *row), (height, jnp.asarray(forces)))

        readings, converged = jax.jit(lambda pads: jax.lax.map(presses, pads))(pads)
        assert np.all(converged)
        return np.asarray(readings)

    rough, exact = read(coarse), read(fine)
    return np.sqrt(np.sum((rough - exact) ** 2) / np.sum(exact**2))


def _disc(x, y):
    return np.where((x - 0.5e-3) ** 2 + (y + 1e-3) ** 2 < 3e-3**2, 0, 3.5e-3)


def _tee(x, y):
    upright = (abs(x) < 1e-3) & (abs(y) < 5e-3)
    return np.where(upright | ((abs(x) < 5e-3) & (abs(y - 4e-3) < 1e-3)), 0, 3.5e-3)


@pytest.fixture(scope="module")
def pads():
    samples = jax.jit(jax.vmap(sample_pad))(jax.random.split(jax.random.key(7), 3))
    return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), PAD, samples)


@pytest.mark.full
def test_the_reading_has_converged(pads):
    """Halving the cells and doubling the nodes changes the reading of a small tip at 0.8 N by less than 2 %. Cells cut
    outlines, so stamps need the fine grid to be within 2 % of the next finer one.
    """
    tips = [partial(round_tip, at=at) for at in np.random.default_rng(3).uniform(-7e-3, 7e-3, (5, 2))]
    coarse, fine = (GRID, field.DIPOLE_SHEETS), (FINE_GRID, 2 * field.DIPOLE_SHEETS)
    assert _change(pads, tips, np.full(5, 0.8, np.float32), coarse, fine) < 0.02
    two, coarse, fine = jax.tree.map(lambda leaf: leaf[:2], pads), (FINE_GRID, 5), (Grid(160, 256), 5)
    assert _change(two, [_disc, _tee], np.ones(2, np.float32), coarse, fine) < 0.02


@pytest.mark.parametrize(("dipoles", "first_sheet"), [(None, 0), (COARSE, 0), ((LOADS,) * 2 + (COARSE,) * 3, 1)])
def test_the_linear_response_is_the_derivative_at_rest(dipoles, first_sheet):
    pad = sample_pad(jax.random.key(1))._replace(mount_compliance=jnp.asarray(1e-4))

    def reading(pressure):
        return field.response(pad, pressure, LOADS, dipoles=dipoles, first_sheet=first_sheet)

    wanted = jax.jacrev(reading)(jnp.zeros((LOADS.cells, LOADS.cells)))
    linear = field.linear_response(pad, LOADS, dipoles=dipoles, first_sheet=first_sheet)
    np.testing.assert_allclose(linear, wanted, atol=1e-5 * np.abs(wanted).max())
