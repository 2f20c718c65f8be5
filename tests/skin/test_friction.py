"""Friction against Cattaneo and Mindlin, its own conditions, and its dependence on the path."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2t.skin import contact, elasticity
from i2t.skin.elasticity import GRID, Grid
from i2t.skin.friction import shear, without_traction
from i2t.skin.pad import nominal_pad

PAD = nominal_pad()._replace(friction=jnp.asarray(0.6))
Y, X = np.meshgrid(GRID.centres, GRID.centres, indexing="ij")
TOLERANCE = 1e-4  # default of `shear`
TIP = jnp.asarray(((X - 0.4e-3) ** 2 + (Y + 1.3e-3) ** 2) / (2 * 6e-3), jnp.float32)
STAMP = jnp.asarray(np.where((abs(X) < 3e-3) & (abs(Y - 1e-3) < 2e-3), 0.02 * (X + 3e-3), np.inf), jnp.float32)
solve = jax.jit(contact.solve)
first = jax.jit(lambda pad, pressure, slide: shear(pad, pressure, slide))
then = jax.jit(lambda pad, pressure, slide, before: shear(pad, pressure, slide, GRID, before=before))


@jax.jit
def surface_motion(pressure, traction):
    return elasticity.interior(PAD, elasticity.load(PAD, pressure, traction), 0.0)[0][:2]


def _total(state, grid=GRID):
    return np.asarray(state.traction, float).sum(axis=(1, 2)) * grid.spacing**2


@pytest.mark.full
def test_reproduces_cattaneo_and_mindlin_where_they_hold():
    """A sphere on a layer 33 times as thick as the contact is wide is pressed without friction and then dragged."""
    grid = Grid(32, 512, 1e-3)
    radius, indentation = 2e-3, 0.03e-3
    pad = PAD._replace(thickness=jnp.asarray(8e-3))
    y, x = np.meshgrid(grid.centres, grid.centres, indexing="ij")
    solved = contact.solve(pad, jnp.asarray((x**2 + y**2) / (2 * radius), jnp.float32), indentation, grid)
    a, load, mu = np.sqrt(radius * indentation), float(solved.force), float(pad.friction)
    modulus, nu = float(pad.young) / (2 * (1 + float(pad.poisson))), float(pad.poisson)
    slides = 3 * mu * load * (2 - nu) / (16 * modulus * a)  # on a half space, at which the whole contact slips
    pressed = without_traction(pad, solved.pressure, grid)
    drag = jax.jit(lambda pad, pressure, slide, before: shear(pad, pressure, slide, grid, before=before))
    for part in (0.3, 0.6, 0.9):
        state = drag(pad, solved.pressure, jnp.asarray([part * slides, 0]), pressed)
        assert state.converged
        along, across = _total(state, grid)
        # 5 % is required. The base and the copies of the period contribute one or two per cent.
        np.testing.assert_allclose(along, mu * load * (1 - (1 - part) ** 1.5), rtol=0.05)
        assert abs(across) < 1e-3 * along
        stuck = np.sum((np.asarray(solved.pressure) > 0) & ~np.asarray(state.slipping)) * grid.spacing**2
        # Cells are an eighth of the radius, so a rim of half a cell may be counted either way.
        np.testing.assert_allclose(np.sqrt(stuck / np.pi), a * np.sqrt(1 - part), atol=0.6 * grid.spacing)


@pytest.mark.full
@pytest.mark.parametrize(("height", "indentation"), [(TIP, 0.4e-3), (STAMP, 0.2e-3)])
def test_the_conditions_of_friction_hold(height, indentation):
    pressure = solve(PAD, height, indentation).pressure
    limit = float(PAD.friction) * np.asarray(pressure, float)
    for slide in ([0.0, 0.0], [1e-4, -3e-4], [5e-3, 0.0]):
        state = first(PAD, pressure, jnp.asarray(slide))
        assert state.converged
        assert state.residual <= TOLERANCE
        traction, slipping = np.asarray(state.traction, float), np.asarray(state.slipping)
        size = np.linalg.norm(traction, axis=0)
        assert np.all(size <= limit * (1 + 1e-5))
        # The displacement is that of both loads, computed by `interior`.
        top = surface_motion(pressure, state.traction)
        largest = float(jnp.abs(top).max())
        np.testing.assert_allclose(state.displacement, top, atol=1e-4 * largest)
        slip = np.asarray(state.displacement, float) - np.asarray(slide)[:, None, None]
        violation = 3 * TOLERANCE * max(largest, np.abs(slide).max())
        assert np.all(np.linalg.norm(slip, axis=0)[(limit > 0) & ~slipping] < violation)
        # On slipping cells the traction opposes the slip.
        against = -np.sum(traction * slip, axis=0) - size * np.linalg.norm(slip, axis=0)
        assert np.all(np.abs(against)[slipping] < violation * size[slipping])
    assert slipping[limit > 0].all()  # the skin cannot follow the last, large slide
    force = limit.sum() * GRID.spacing**2
    np.testing.assert_allclose(_total(state), [force, 0], atol=5e-3 * force)
    smooth = first(PAD._replace(friction=jnp.zeros(())), pressure, jnp.asarray([1e-4, 0]))
    assert smooth.converged
    np.testing.assert_array_equal(smooth.traction, np.zeros((2, 40, 40)))


def test_sticking_does_not_depend_on_the_path_and_slipping_does():
    pressure = solve(PAD, STAMP, 0.2e-3).pressure
    pressed = without_traction(PAD, pressure)
    still, small, large = jnp.zeros(2), jnp.asarray([1e-6, 0]), jnp.asarray([4e-4, 0])
    ahead = then(PAD, pressure, small, pressed)
    back = then(PAD, pressure, -small, ahead)
    assert np.abs(_total(back)).max() < 0.02 * np.abs(_total(ahead)).max()  # except at the corners, which slip
    slid = then(PAD, pressure, large, pressed)
    kept = then(PAD, pressure, still, slid)
    np.testing.assert_allclose(_total(kept), _total(slid), atol=1e-3 * _total(slid)[0])
    returned = then(PAD, pressure, -large, slid)
    assert _total(slid)[0] > 0
    assert _total(returned)[0] < -0.1 * _total(slid)[0]  # it passed zero on the way back
    # Releasing the press after a slide reduces the traction with the pressure.
    released = then(PAD, 0.5 * pressure, still, slid)
    np.testing.assert_allclose(_total(released), 0.5 * _total(slid), atol=0.05 * _total(slid)[0])


def test_if_all_slips_traction_is_friction_times_pressure_and_its_derivative_is_the_pressure():
    grid = Grid(8, 12, 1e-3)
    pressure = jnp.asarray(np.pad(np.random.default_rng(1).uniform(1e4, 3e4, (4, 4)), 2), jnp.float32)

    def traction(friction):
        return shear(PAD._replace(friction=friction), pressure, jnp.asarray([3e-2, 4e-2]), grid).traction

    sheared, slope = jax.jit(lambda friction: jax.jvp(traction, (friction,), (jnp.ones(()),)))(jnp.asarray(0.6))
    along = np.array([0.6, 0.8])[:, None, None] * np.asarray(pressure)
    np.testing.assert_allclose(sheared, 0.6 * along, atol=0.01 * along.max())
    np.testing.assert_allclose(slope, along, atol=0.01 * along.max())


def test_derivatives_are_finite_if_all_sticks_in_the_program_that_presses():
    """The pressure is a variable there, so the compiler rearranges the quotient of friction and stiffness."""
    grid = Grid(20, 32)
    y, x = np.meshgrid(grid.centres, grid.centres, indexing="ij")
    height = jnp.asarray((x**2 + y**2) / (2 * 3.6e-3), jnp.float32)

    def traction(friction, force):
        pressure = contact.solve_force(PAD, height, force, grid).pressure
        return shear(PAD._replace(friction=friction), pressure, jnp.asarray([1e-5, 0.0]), grid).traction

    run = jax.jit(lambda force: jax.jvp(lambda log: traction(0.6 * jnp.exp(log), force), (0.0,), (1.0,)))
    sheared, slope = run(jnp.float32(0.5))
    assert np.all(np.isfinite(sheared))
    assert np.abs(sheared).max() > 0
    np.testing.assert_allclose(slope, 0, atol=1e-6 * np.abs(sheared).max())  # friction does not change sticking cells


@pytest.mark.full
def test_derivatives_agree_with_differences():
    small = Grid(20, 32)
    y, x = np.meshgrid(small.centres, small.centres, indexing="ij")
    with jax.enable_x64(True):
        pad = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf, float)), PAD)
        height = jnp.asarray(((x - 0.4e-3) ** 2 + (y + 1.3e-3) ** 2) / (2 * 8e-3))
        pressure = contact.solve(pad, height, 0.5e-3, small, tolerance=1e-12, max_steps=4000).pressure
        rng = np.random.default_rng(0)
        at = (pad.thickness, pad.young, pad.poisson, pad.friction, pressure, jnp.asarray([1.2e-4, 5e-5]))
        way = tuple(value * jnp.asarray(rng.normal(size=value.shape)) for value in at)

        def state(thickness, young, poisson, friction, pressure, slide):
            changed = pad._replace(thickness=thickness, young=young, poisson=poisson, friction=friction)
            sheared = shear(changed, pressure, slide, small, tolerance=1e-11, max_steps=4000)
            return sheared.traction, sheared.displacement, sheared.slipping

        run = jax.jit(state)
        ahead, behind = (run(*(a + step * w for a, w in zip(at, way, strict=True))) for step in (1e-7, -1e-7))
        np.testing.assert_array_equal(ahead[2], behind[2])
        assert 0 < np.sum(ahead[2]) < np.sum(pressure > 0)  # some cells slip, some stick
        slopes = jax.jit(lambda at, way: jax.jvp(lambda *at: state(*at)[:2], at, way)[1])(at, way)
        weights = tuple(jnp.asarray(rng.normal(size=slope.shape)) / jnp.abs(slope).max() for slope in slopes)
        pulled = jax.jit(lambda at: jax.vjp(lambda *at: state(*at)[:2], *at)[1](weights))(at)
        for slope, here, there in zip(slopes, ahead, behind, strict=False):
            difference = (here - there) / 2e-7
            np.testing.assert_allclose(slope, difference, atol=1e-3 * np.abs(difference).max())
        forwards = sum(jnp.sum(w * s) for w, s in zip(weights, slopes, strict=True))
        backwards = sum(jnp.sum(w * p) for w, p in zip(way, pulled, strict=True))
        np.testing.assert_allclose(backwards, forwards, rtol=1e-8)
