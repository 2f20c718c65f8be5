"""Lanes: convolutions agree with those of the series, and a batch with its single problems."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2t.skin import lanes
from i2t.skin.contact import solve, solve_force
from i2t.skin.elasticity import (
    CELL_GRID,
    Grid,
    compliance,
    convolve,
    evaluate,
    spectrum,
    tangential_compliance,
    traction_waves,
)
from i2t.skin.friction import shear
from i2t.skin.pad import nominal_pad, sample_pad

PAD = nominal_pad()._replace(friction=jnp.asarray(0.6))
GRIDS = [CELL_GRID, Grid(8, 16), Grid(6, 8)]


def _random(*shape: int) -> jax.Array:
    return jnp.asarray(np.random.default_rng(0).normal(size=shape), jnp.float32)


def test_joining_quadrants_undoes_splitting():
    values = _random(3, 8, 8)
    np.testing.assert_array_equal(lanes.from_quadrants(lanes.to_quadrants(values)), values)


@pytest.mark.parametrize("grid", GRIDS)
def test_a_convolution_agrees_with_the_series(grid):
    kernel, values = compliance(PAD, grid), _random(3, grid.cells, grid.cells)
    convolved = lanes.convolve(lanes.convolution(kernel, grid), lanes.to_quadrants(values), grid)
    wanted = jax.vmap(lambda value: convolve(kernel, value, grid))(values)
    np.testing.assert_allclose(lanes.from_quadrants(convolved), wanted, atol=2e-6 * np.abs(wanted).max())


@pytest.mark.parametrize("grid", GRIDS)
def test_a_convolution_of_vectors_agrees_with_the_parts_along_and_across_each_wave(grid):
    along, across = tangential_compliance(PAD, grid)
    vectors = _random(3, 2, grid.cells, grid.cells)

    def series(vector: jax.Array) -> jax.Array:
        waves = traction_waves(spectrum(vector, grid), grid)
        return evaluate(along[None] * waves.lengthwise + across[None] * (waves.traction - waves.lengthwise), grid)

    split = jnp.stack([lanes.to_quadrants(vectors[:, i]) for i in range(2)])
    convolved = lanes.convolve_vectors(lanes.vector_convolution(jnp.stack([along, across]), grid), split, grid)
    joined = jnp.stack([lanes.from_quadrants(part) for part in convolved], axis=1)
    wanted = jax.vmap(series)(vectors)
    np.testing.assert_allclose(joined, wanted, atol=2e-6 * np.abs(wanted).max())


def test_a_batch_of_presses_of_one_pad_or_of_several_agrees_with_single_presses():
    y, x = np.meshgrid(CELL_GRID.centres, CELL_GRID.centres, indexing="ij")
    heights = jnp.asarray([(x**2 + (y - i * 1e-3) ** 2) / 12e-3 for i in range(3)], jnp.float32)
    indentations, slide = jnp.asarray([1e-4, 3e-4, 4e-4]), jnp.asarray([1e-5, 0.0])

    def press(pad, height, indentation):
        contact = solve(pad, height, indentation, CELL_GRID)
        forced = solve_force(pad, height, jnp.maximum(contact.force, 0.1), CELL_GRID)
        return contact.force, forced.indentation, shear(pad, contact.pressure, slide, CELL_GRID).traction

    pads = jax.vmap(sample_pad)(jax.random.split(jax.random.key(0), 3))
    pad = jax.tree.map(lambda leaf: leaf[0], pads)
    alone = jax.jit(press)
    nested = jax.jit(jax.vmap(jax.vmap(press, (None, 0, None)), (None, None, 0)))(pad, heights, indentations)
    several = jax.jit(jax.vmap(press))(pads, heights, indentations)
    for i in range(3):
        for batch, wanted in (
            (jax.tree.map(lambda leaf, i=i: leaf[2, i], nested), alone(pad, heights[i], indentations[2])),
            (
                jax.tree.map(lambda leaf, i=i: leaf[i], several),
                alone(jax.tree.map(lambda leaf, i=i: leaf[i], pads), heights[i], indentations[i]),
            ),
        ):
            for mine, theirs in zip(batch, wanted, strict=True):
                np.testing.assert_allclose(mine, theirs, rtol=1e-4, atol=1e-3 * np.abs(theirs).max())
