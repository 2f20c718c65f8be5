"""Dipoles and layers of magnets against magpylib, and the reading under refinement."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from i2t.skin import contact, elasticity
from i2t.skin import dipoles as field
from i2t.skin.elasticity import FINE_GRID, GRID, Grid
from i2t.skin.pad import nominal_pad, press_force, sample_pad

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    import magpylib

PAD = nominal_pad()
response, pressed = jax.jit(field.response), jax.jit(field.pressed_field)
sample = jax.jit(sample_pad)
Y, X = np.meshgrid(GRID.centres, GRID.centres, indexing="ij")


def _load(seed: int) -> jnp.ndarray:
    """A press of about a newton somewhere on the pad, 3 mm wide (Pa)."""
    x, y = np.random.default_rng(seed).uniform(-5e-3, 5e-3, 2)
    return jnp.asarray(8e4 * np.maximum(1 - ((X - x) ** 2 + (Y - y) ** 2) / 3e-3**2, 0) ** 0.5, jnp.float32)


def test_dipoles_agree_with_magpylib():
    random = np.random.default_rng(0)
    positions, moments = random.uniform(-1e-2, 1e-2, (200, 3)), random.normal(size=(200, 3)) * 1e-6
    points = random.uniform(-1e-2, 1e-2, (20, 3)) - [0, 0, 0.02]
    ours = field.dipole_field(*(jnp.asarray(value, jnp.float32) for value in (points, positions, moments)))
    dipoles = [magpylib.misc.Dipole(moment=m, position=p) for m, p in zip(moments, positions, strict=True)]
    theirs = np.sum([magpylib.getB(dipole, points) for dipole in dipoles], axis=0)
    # 1e-5 is the figure asked. One dipole errs by about 10 roundings of 6e-8; a sum of random signs is smaller than its
    # terms, so the error is taken relative to their root sum of squares.
    terms = np.sqrt(np.sum([magpylib.getB(dipole, points) ** 2 for dipole in dipoles], axis=(0, 2)))
    assert np.all(np.abs(ours - theirs) < 1e-5 * terms[:, None])
    single = field.dipole_field(*(jnp.asarray(value[:1], jnp.float32) for value in (points, positions, moments)))
    np.testing.assert_allclose(single, dipoles[0].getB(points[:1])[None], rtol=1e-5)


def test_a_dipole_on_its_axis():
    """B = mu0 m / (2 pi r^3) along the axis, and half of it backwards at its side."""
    m, r = 2e-6, 5e-3
    points = jnp.asarray([[0, 0, -r], [r, 0, 0]])
    found = field.dipole_field(points, jnp.zeros((1, 3)), jnp.asarray([[0, 0, m]]))
    expected = 2e-7 * m / r**3
    np.testing.assert_allclose(found, [[0, 0, expected], [0, 0, -expected / 2]], rtol=1e-6, atol=1e-6 * expected)


@pytest.mark.parametrize("pattern", ["uniform", "poles"])
def test_the_layer_at_rest_agrees_with_solid_magnets(pattern):
    """The dipoles stand for 16 cuboid magnets, of which magpylib knows the field in closed form."""
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
    # Fourth-order means over cells of a = 0.5 mm at d = 1.5 mm and more below: (a / d)^4 x 17 / 5760 x 4! < 1e-3; five
    # Gauss nodes err less. Relative to the strongest chip, as some components vanish by symmetry.
    np.testing.assert_allclose(field.rest_field(pad), exact, atol=1e-3 * np.abs(exact).max())


@pytest.mark.full
@pytest.mark.parametrize("held", [False, True])
def test_a_pressed_layer_agrees_with_magpylib(held):
    """Every dipole moved and turned by hand, its field by magpylib; with friction and held at its edge or without."""
    pad, pressure = sample(jax.random.key(5)), _load(1)
    pad = pad._replace(mount_compliance=jnp.asarray(1e-4)) if held else pad
    traction = 0.5 * jnp.stack([pressure, -0.5 * pressure]) if held else None
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


@pytest.mark.full
def test_a_skin_held_at_its_edge_moves_at_all_its_chips():
    """Also at those 9 mm and more from the load, and in proportion to the load and to how far it gives."""
    x, y = -4e-3, 4e-3
    pressure = jnp.asarray(4e4 * (((X - x) ** 2 + (Y - y) ** 2) < 2.5e-3**2), jnp.float32)
    pad = sample(jax.random.key(5))
    bonded, once, twice = (
        np.asarray(response(pad._replace(mount_compliance=jnp.asarray(give)), pressure)).reshape(5, 3)
        for give in (0, 1e-4, 2e-4)
    )
    far = np.linalg.norm(np.asarray(pad.board.chips)[:, :2] - [x, y], axis=1) > 9e-3
    assert far.sum() == 2
    assert np.all(np.linalg.norm(once - bonded, axis=1) > 1)  # uT
    np.testing.assert_allclose((twice - bonded)[far], 2 * (once - bonded)[far], atol=0.5)


def test_turning_is_a_rotation():
    random = np.random.default_rng(2)
    w, m = random.normal(size=(3, 50)) * 0.5, random.normal(size=(3, 50))
    turned = field.turn(jnp.asarray(w, jnp.float32), jnp.asarray(m, jnp.float32))
    size = np.linalg.norm(w, axis=0)
    exact = Rotation.from_rotvec((w / size * 2 * np.arctan(size / 2)).T).apply(m.T).T
    np.testing.assert_allclose(turned, exact, atol=1e-6 * 4)  # roundings of components of up to about 4


def test_no_pressure_no_reading():
    # Two sums of 8000 dipoles of some mT altogether differ by their rounding: 1e-7 of a few thousand uT.
    np.testing.assert_allclose(response(PAD, jnp.zeros((40, 40))), np.zeros(15), atol=1e-3)


def test_reading_is_linear_in_the_magnetisation():
    one, two, pressure = sample(jax.random.key(1)), sample(jax.random.key(2)), _load(3)
    mixed = one._replace(magnetization=2 * one.magnetization - 3 * two.magnetization)
    expected = 2 * response(one, pressure) - 3 * response(one._replace(magnetization=two.magnetization), pressure)
    np.testing.assert_allclose(response(mixed, pressure), expected, atol=1e-5 * float(jnp.abs(expected).max()) * 10)


def test_gains_act_on_the_board_s_values():
    gains = jnp.linspace(0.5, 2.0, 15)
    plain = response(PAD, _load(4))
    np.testing.assert_allclose(response(PAD._replace(gains=gains), _load(4)), gains * plain, rtol=1e-6)


def test_a_map_of_any_size_is_sampled_at_its_cells():
    coarse = PAD._replace(magnetization=jnp.arange(12.0).reshape(2, 2, 3))
    fine = PAD._replace(magnetization=jnp.repeat(jnp.repeat(coarse.magnetization, 7, axis=0), 7, axis=1))
    np.testing.assert_array_equal(field.sheets(coarse)[1], field.sheets(fine)[1])


def _change(pads, heights, forces, coarse, fine) -> float:
    """Norm of the difference of the readings on two discretisations, over the norm of the readings."""

    def read(discretisation):
        grid, nodes = discretisation
        y, x = np.meshgrid(grid.centres, grid.centres, indexing="ij")
        height = jnp.asarray(np.stack([shape(x, y) for shape in heights]), jnp.float32)

        def one(pad, height, force):
            found = contact.solve_force(pad, height, force, grid)
            return field.response(pad, found.pressure, grid, nodes=nodes), found.converged

        def presses(pad):
            return jax.lax.map(lambda press: one(pad, *press), (height, jnp.asarray(forces)))

        readings, converged = jax.jit(lambda pads: jax.lax.map(presses, pads))(pads)
        assert np.all(converged)
        return np.asarray(readings)

    rough, exact = read(coarse), read(fine)
    return np.sqrt(np.sum((rough - exact) ** 2) / np.sum(exact**2))


def _tip(x0, y0, radius=2.3e-3):
    def height(x, y):
        square = radius**2 - (x - x0) ** 2 - (y - y0) ** 2
        return np.where(square > 0, radius - np.sqrt(np.maximum(square, 0)), np.inf)

    return height


def _disc(x, y):
    return np.where((x - 0.5e-3) ** 2 + (y + 1e-3) ** 2 < 3e-3**2, 0, 3.5e-3)


def _tee(x, y):
    upright = (abs(x) < 1e-3) & (abs(y) < 5e-3)
    return np.where(upright | ((abs(x) < 5e-3) & (abs(y - 4e-3) < 1e-3)), 0, 3.5e-3)


@pytest.fixture(scope="module")
def pads():
    keys = jax.random.split(jax.random.key(7), 3)
    samples = jax.jit(jax.vmap(sample_pad))(keys)
    return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), PAD, samples)


@pytest.mark.full
def test_reading_has_converged_for_tips(pads):
    """Cells halved and nodes doubled change the reading of a small tip at 0.8 N by less than 2 %."""
    places = np.random.default_rng(3).uniform(-7e-3, 7e-3, (8, 2))
    tips = [_tip(x, y) for x, y in places]
    assert (
        _change(pads, tips, np.full(8, 0.8, np.float32), (GRID, field.CELL_NODES), (FINE_GRID, 2 * field.CELL_NODES))
        < 0.02
    )


@pytest.mark.full
def test_fine_reading_has_converged_for_stamps(pads):
    """Outlines are cut by cells, so stamps need the fine grid to come within 2 % of one twice as fine."""
    forces = np.array([1.0, 1.0], np.float32)
    nominal = jax.tree.map(lambda leaf: leaf[:2], pads)
    assert (
        _change(nominal, [_disc, _tee], forces, (FINE_GRID, field.CELL_NODES), (Grid(160, 256), field.CELL_NODES))
        < 0.02
    )


@pytest.mark.full
def test_fewer_dipoles_suffice_for_a_fine_contact(pads):
    pad = jax.tree.map(lambda leaf: leaf[1], pads)
    y, x = np.meshgrid(FINE_GRID.centres, FINE_GRID.centres, indexing="ij")
    height = jnp.asarray(_tip(1e-3, 4e-3)(x, y), jnp.float32)
    fine, cheap = jax.jit(
        lambda pad, height: [
            press_force(pad, height, 0.8, FINE_GRID, dipoles=grid).reading for grid in (FINE_GRID, GRID)
        ]
    )(pad, height)
    assert np.linalg.norm(cheap - fine) < 0.02 * np.linalg.norm(fine)
