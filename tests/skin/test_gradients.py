"""Derivatives of contact and reading, forwards and backwards, against central differences in double precision."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2t.skin import contact
from i2t.skin.dipoles import response
from i2t.skin.elasticity import GRID, Grid
from i2t.skin.pad import nominal_pad, press, sample_pad
from i2t.skin_models.magnetic_layer import RoundTip

SMALL = Grid(20, 32)
Y, X = np.meshgrid(SMALL.centres, SMALL.centres, indexing="ij")
EXACT = 1e-12  # tolerance of the solver
STEP = 1e-6  # relative to every input; too small to move the rim of the contact over a cell, as asserted below
MAX_ERROR = 1e-3
TIP = np.minimum(((X - 1.3e-3) ** 2 + (Y + 0.7e-3) ** 2) / (2 * 5e-3) + 0.02 * (X + 10e-3), 4e-3)
PAD, SAMPLE = nominal_pad(), sample_pad(jax.random.key(3))
PARTS = ("thickness", "young", "poisson", "mount_compliance")


@pytest.fixture
def double():
    with jax.enable_x64(True):
        yield


def _inputs(rng, control):
    """Make a point (pad, height, control) and a random direction, in proportion to each input's size."""
    pad = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf, float)), SAMPLE)
    pad = pad._replace(mount_compliance=jnp.asarray(2e-4))
    still = jax.tree.map(jnp.zeros_like, pad)
    way = still._replace(**{name: getattr(pad, name) * rng.normal() for name in PARTS})
    along = way, jnp.asarray(1e-3 * rng.normal(size=X.shape)), jnp.asarray(control * rng.normal())
    return (pad, jnp.asarray(TIP - TIP.min()), jnp.asarray(control)), along


def _outcome(pad, height, control, solve=contact.solve):
    solved = solve(pad, height, control, SMALL, tolerance=EXACT, max_steps=4000)
    return solved.pressure, solved.force, solved.indentation, solved.gap


def _moved(at, way, step):
    return jax.tree.map(lambda a, w: a + step * w, at, way)


def _dot(left, right):
    return sum(jnp.sum(a * b) for a, b in zip(*map(jax.tree.leaves, (left, right)), strict=True))


@pytest.mark.full
@pytest.mark.parametrize(("solve", "control"), [(contact.solve, 0.4e-3), (contact.solve_force, 0.7)])
def test_derivatives_of_the_contact_agree_with_differences(double, solve, control):
    rng, run = np.random.default_rng(0), jax.jit(partial(_outcome, solve=solve))
    at, way = _inputs(rng, control)
    plain, slope = jax.jit(lambda at, way: jax.jvp(run, at, way))(at, way)
    ahead, behind = run(*_moved(at, way, STEP)), run(*_moved(at, way, -STEP))
    np.testing.assert_array_equal(ahead[0] > 0, behind[0] > 0)  # the contact set is fixed
    for derivative, here, there in zip(slope, ahead, behind, strict=True):
        difference = (here - there) / (2 * STEP)
        assert np.abs(derivative - difference).max() <= MAX_ERROR * np.abs(difference).max()
    # The reverse derivative is the transpose of the forward one.
    weights = tuple(jnp.asarray(rng.normal(size=value.shape)) / jnp.abs(value).max() for value in plain)
    pulled = jax.jit(lambda at, weights: jax.vjp(run, *at)[1](weights))(at, weights)
    np.testing.assert_allclose(_dot(pulled, way), _dot(weights, slope), rtol=1e-8)


@pytest.mark.full
def test_derivatives_of_the_reading_agree_with_differences(double):
    at, way = _inputs(np.random.default_rng(4), 0.4e-3)
    run = jax.jit(lambda pad, height, indentation: response(pad, _outcome(pad, height, indentation)[0], SMALL))
    difference = (run(*_moved(at, way, STEP)) - run(*_moved(at, way, -STEP))) / (2 * STEP)
    # `press` stops at 1e-5 of the deflection, which is also about the error of its derivative.
    weights = jnp.asarray(np.random.default_rng(5).normal(size=15))
    pulled = jax.jit(lambda at: jax.vjp(lambda *at: press(*at, grid=SMALL).reading, *at)[1](weights))(at)
    np.testing.assert_allclose(
        _dot(pulled, way), weights @ difference, atol=MAX_ERROR * np.abs(weights * difference).max()
    )


@pytest.mark.full
def test_derivatives_in_single_precision_and_in_batches():
    """Gradients of a batch are those of its members, finite even if nothing is met or touched."""

    def force(height, indentation):
        return contact.solve(PAD, height, indentation, SMALL).force

    heights = jnp.asarray(np.stack([TIP - TIP.min(), np.where(X > 0, TIP, np.inf), TIP]), jnp.float32)
    indentations = jnp.asarray([0.4e-3, 0.5e-3, -0.1e-3])
    along, stiffness = jax.jit(jax.vmap(jax.value_and_grad(force, argnums=(0, 1))))(heights, indentations)[1]
    assert np.all(np.isfinite(along))
    assert np.all(along <= 1e-3 * np.abs(along).max())  # raising a surface never increases the force
    assert np.all(along[1][X < 0] == 0)
    assert stiffness[2] == 0
    # Raising the surface everywhere is the same as lowering the pad.
    np.testing.assert_allclose(-jnp.sum(along, axis=(1, 2)), stiffness, rtol=1e-4)
    run = jax.jit(force)
    difference = (run(heights[0], 0.404e-3) - run(heights[0], 0.396e-3)) / 8e-6
    np.testing.assert_allclose(stiffness[0], difference, rtol=0.02)  # cells come into contact on the way


def test_second_derivatives_exist(double):
    """The force on a bonded layer is proportional to E, and so is its slope."""
    (pad, height, indentation), _ = _inputs(np.random.default_rng(0), 0.4e-3)

    def slope(young):
        bonded = pad._replace(young=young, mount_compliance=jnp.zeros(()))
        return jax.grad(lambda indentation: _outcome(bonded, height, indentation)[1])(indentation)

    value, change = jax.jit(jax.value_and_grad(slope))(pad.young)
    np.testing.assert_allclose(change, value / pad.young, rtol=1e-8)


PLACES_MM = ((0, 0), (1, 1), (0.3, -2.1))  # two where cells come into contact four at a time, and an arbitrary one
RADII_MM = (1.35, 3.6)
LOADS = {True: (0.15, 0.25, 0.7, 1.5), False: (0.05e-3, 0.2e-3, 0.4e-3, 0.6e-3)}  # N, m


def _along(dtype, forced, tolerance):
    """Make a function from steps along the logarithms of PARTS to the pressures of places x tips x loads."""
    pad = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf), dtype), PAD)._replace(
        mount_compliance=jnp.asarray(6e-5, dtype)
    )
    tips = [RoundTip("sphere", 1e-3 * r) for r in RADII_MM]
    heights = jnp.stack([tip.height(1e-3 * np.array(at), GRID) for tip in tips for at in PLACES_MM]).astype(dtype)
    solve = contact.solve_force if forced else contact.solve

    def run(steps):
        moved = pad._replace(**{n: getattr(pad, n) * jnp.exp(s) for n, s in zip(PARTS, steps, strict=True)})

        def press(height, load):
            return solve(moved, height, load, GRID, tolerance=tolerance, max_steps=2000).pressure

        return jax.vmap(jax.vmap(press, (None, 0)), (0, None))(heights, jnp.asarray(LOADS[forced], dtype))

    return run


@pytest.mark.parametrize("forced", [True, False])
def test_single_precision_is_enough_at_symmetric_places(forced):
    """The mount sinks a small contact nearly as a whole, which hardly matters if the force is given."""
    run, none = _along(jnp.float32, forced, contact.CONTACT_SOLVER.tolerance), jnp.zeros(len(PARTS), jnp.float32)
    along = jax.jit(lambda way: jax.jvp(run, (none,), (way,)))
    slopes = [along(way) for way in jnp.eye(len(PARTS), dtype=jnp.float32)]
    with jax.enable_x64(True):
        exact, step = jax.jit(_along(jnp.float64, forced, EXACT)), 1e-5
        ends = [[np.asarray(exact(sign * step * way)) for sign in (1, -1)] for way in np.eye(len(PARTS))]
    for (pressure, slope), (ahead, behind) in zip(slopes, ends, strict=True):
        assert np.all((ahead > 0) == (pressure > 0))  # the contact set is fixed and equals that in single precision
        assert np.all((behind > 0) == (pressure > 0))
        difference = (ahead - behind) / (2 * step)
        assert np.all(np.abs(slope - difference).max((2, 3)) <= MAX_ERROR * np.abs(difference).max((2, 3)))


@pytest.mark.parametrize(("solve", "control"), [(contact.solve, 0.4e-3), (contact.solve_force, 0.7)])
def test_the_reverse_derivative_is_the_transposed_forward_one_in_single_precision(solve, control):
    rng, height = np.random.default_rng(7), jnp.asarray(TIP - TIP.min(), jnp.float32)
    way, weights = (jnp.asarray(rng.normal(size=TIP.shape), jnp.float32) for _ in range(2))
    run = jax.jit(lambda height: solve(PAD, height, control, SMALL).pressure)
    forwards = jnp.sum(weights * jax.jvp(run, (height,), (way,))[1])
    backwards = jnp.sum(way * jax.vjp(run, height)[1](weights)[0])
    np.testing.assert_allclose(backwards, forwards, rtol=1e-3)


def test_derivatives_by_non_finite_inputs_are_not_finite():
    """A non-finite input is propagated and does not give a derivative of zero."""
    height = jnp.asarray(TIP - TIP.min(), jnp.float32)
    for solve, control in ((contact.solve, 0.4e-3), (contact.solve_force, 0.7)):
        way = jnp.zeros_like(height).at[10, 10].set(jnp.nan)
        run = jax.jit(lambda height, solve=solve, control=control: solve(PAD, height, control, SMALL).pressure)
        assert not np.isfinite(jax.jvp(run, (height,), (way,))[1]).all()
