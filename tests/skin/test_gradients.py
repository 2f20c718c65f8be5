"""Derivatives of contact and reading, forwards and backwards, against central differences in double precision."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2t.skin import contact
from i2t.skin.dipoles import response
from i2t.skin.elasticity import Grid
from i2t.skin.pad import nominal_pad, press, sample_pad

SMALL = Grid(20, 32)
Y, X = np.meshgrid(SMALL.centres, SMALL.centres, indexing="ij")
EXACT = 1e-12  # tolerance of the solver
STEP = 1e-6  # of every input's size: too small to move the rim of the contact over a cell, asserted below
ASKED = 1e-3
TIP = np.minimum(((X - 1.3e-3) ** 2 + (Y + 0.7e-3) ** 2) / (2 * 5e-3) + 0.02 * (X + 10e-3), 4e-3)
PAD, SAMPLE = nominal_pad(), sample_pad(jax.random.key(3))
PARTS = ("thickness", "young", "poisson", "mount_compliance")


@pytest.fixture
def double():
    with jax.enable_x64(True):
        yield


def _pad(give=2e-4):
    pad = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf, float)), SAMPLE)
    return pad._replace(mount_compliance=jnp.asarray(give))


def _inputs(rng, control):
    """A point (pad, height, control) and a random way to go from it, in proportion to each input's size."""
    pad, height, control = _pad(), jnp.asarray(TIP - TIP.min()), jnp.asarray(control)
    still = jax.tree.map(jnp.zeros_like, pad)
    way = still._replace(**{name: getattr(pad, name) * rng.normal() for name in PARTS})
    return (pad, height, control), (way, jnp.asarray(1e-3 * rng.normal(size=X.shape)), control * rng.normal())


def _outcome(found):
    return found.pressure, found.force, found.indentation, found.gap


def _depth(pad, height, depth):
    return _outcome(contact.solve(pad, height, depth, SMALL, tolerance=EXACT, max_steps=4000))


def _force(pad, height, force):
    return _outcome(contact.solve_force(pad, height, force, SMALL, tolerance=EXACT, max_steps=4000))


def _moved(at, way, step):
    return jax.tree.map(lambda a, w: a + step * w, at, way)


@pytest.mark.full
@pytest.mark.parametrize(("solve", "control"), [(_depth, 0.4e-3), (_force, 0.7)])
def test_contact_follows_its_inputs(double, solve, control):
    run = jax.jit(solve)
    push = jax.jit(lambda at, way: jax.jvp(solve, at, way))
    pull = jax.jit(lambda at, weights: jax.vjp(solve, *at)[1](weights))
    for seed in range(2):
        rng = np.random.default_rng(seed)
        at, way = _inputs(rng, control)
        plain, slope = push(at, way)
        ahead, behind = run(*_moved(at, way, STEP)), run(*_moved(at, way, -STEP))
        np.testing.assert_array_equal(ahead[0] > 0, behind[0] > 0)  # the contact set is fixed
        for found, here, there in zip(slope, ahead, behind, strict=True):
            difference = (here - there) / (2 * STEP)
            assert np.abs(found - difference).max() <= ASKED * np.abs(difference).max()
        # Backwards is forwards transposed.
        weights = tuple(jnp.asarray(rng.normal(size=value.shape)) / jnp.abs(value).max() for value in plain)
        forwards = sum(jnp.sum(w * s) for w, s in zip(weights, slope, strict=True))
        backwards = sum(jnp.sum(g * w) for g, w in zip(*map(jax.tree.leaves, (pull(at, weights), way)), strict=True))
        np.testing.assert_allclose(backwards, forwards, rtol=1e-8)


@pytest.mark.full
def test_reading_follows_its_inputs(double):
    def read(pad, height, depth):
        return press(pad, height, depth, grid=SMALL).reading

    def exact(pad, height, depth):
        return response(pad, _depth(pad, height, depth)[0], SMALL)

    at, way = _inputs(np.random.default_rng(4), 0.4e-3)
    run = jax.jit(exact)
    difference = (run(*_moved(at, way, STEP)) - run(*_moved(at, way, -STEP))) / (2 * STEP)
    # `press` stops at 1e-5 of the deflection, which is also about what its derivative may miss.
    weights = jnp.asarray(np.random.default_rng(5).normal(size=15))
    pulled = jax.jit(lambda at: jax.vjp(read, *at)[1](weights))(at)
    total = sum(jnp.sum(g * w) for g, w in zip(*map(jax.tree.leaves, (pulled, way)), strict=True))
    np.testing.assert_allclose(total, weights @ difference, atol=ASKED * np.abs(weights * difference).max())


@pytest.mark.full
def test_derivatives_in_single_precision_and_in_batches():
    """Gradients of a batch are those of its members, finite where nothing is met or nothing touches."""

    def force(height, depth):
        return contact.solve(PAD, height, depth, SMALL).force

    heights = jnp.asarray(np.stack([TIP - TIP.min(), np.where(X > 0, TIP, np.inf), TIP]), jnp.float32)
    depths = jnp.asarray([0.4e-3, 0.5e-3, -0.1e-3])
    along, stiffness = jax.jit(jax.vmap(jax.value_and_grad(force, argnums=(0, 1))))(heights, depths)[1]
    assert np.all(np.isfinite(along))
    assert np.all(along <= 1e-3 * np.abs(along).max())  # a surface further away presses less
    assert np.all(along[1][X < 0] == 0)
    assert stiffness[2] == 0
    # Raising the surface everywhere is lowering the pad.
    np.testing.assert_allclose(-jnp.sum(along, axis=(1, 2)), stiffness, rtol=1e-4)
    run = jax.jit(force)
    difference = (run(heights[0], 0.404e-3) - run(heights[0], 0.396e-3)) / 8e-6
    np.testing.assert_allclose(stiffness[0], difference, rtol=0.02)  # cells come into contact on the way


def test_second_derivatives_exist(double):
    """The force on a bonded layer is proportional to E, and so is its slope."""
    (pad, height, depth), _ = _inputs(np.random.default_rng(0), 0.4e-3)

    def slope(young):
        bonded = pad._replace(young=young, mount_compliance=jnp.zeros(()))
        return jax.grad(lambda depth: _depth(bonded, height, depth)[1])(depth)

    value, change = jax.jit(jax.value_and_grad(slope))(pad.young)
    np.testing.assert_allclose(change, value / pad.young, rtol=1e-8)
