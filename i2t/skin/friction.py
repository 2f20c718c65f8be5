"""Coulomb friction between a pressed skin and a rigid object that drags it: sticking, slipping and traction.

The pressure is computed first, without friction, and then the traction that it can bear (Goodman, J. Appl. Mech. 29,
1962). The motion of the layer under both loads is exact. The traction's effect on the gap is neglected; it vanishes for
an incompressible half space and is small for a skin. On the skin's surface the traction q, along x and y, moves the
material by C q (`i2t.skin.elasticity`) and the pressure moves it by S p. From one state to the next the object moves by
`slide` along the skin. Relative to the object the skin slips by s = C q + S p - (displacement before) - slide, and in
every cell

    |q| <= friction p,   and either s = 0 or q = -friction p s / |s|.

These are the optimality conditions of min q.Cq/2 - q.(displacement before + slide - S p) over those discs: a convex
problem, solved like the normal one by spectral projected gradients (`i2t.skin.contact.descend`). Friction has a memory:
a path is a chain of states, each following the previous one, and smaller steps follow it more closely. A press along a
slant, a slide and a release are such paths. The traction after an increment depends on all previous increments.

Derivatives are those of the conditions (see `i2t.skin.contact`) while sticking cells stick and slipping cells slip:
C dq + ... = 0 on the former; on the latter the traction turns towards the change of the slip and grows with the
friction. Tool frame; metres, pascals, newtons.
"""

from collections.abc import Callable
from functools import lru_cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from i2t.skin import lanes
from i2t.skin.contact import CONTACT_SOLVER, conjugate_gradients, descend, safe_divisor
from i2t.skin.elasticity import (
    GRID,
    Grid,
    evaluate,
    spectrum,
    tangential_compliance,
    tangential_displacement,
    traction_waves,
)
from i2t.types import Pad


class Shear(NamedTuple):
    """Traction (Pa) and displacement (m) of the skin's surface under friction, slipping cells, and accuracy."""

    traction: Float[Array, "2 n n"]  # Pa, traction on the skin along x and y
    displacement: Float[Array, "2 n n"]  # m, displacement of the skin's surface along x and y
    slipping: Bool[Array, "n n"]  # True for cells in contact with the largest possible friction
    # largest violation of the friction conditions, as a slip relative to the largest displacement
    residual: Float[Array, ""]
    steps: Int[Array, ""]  # number of applications of C
    converged: Bool[Array, ""]


def without_traction(pad: Pad, pressure: Float[Array, "n n"], grid: Grid = GRID) -> Shear:
    """Compute the friction state of a skin without traction: pressed without friction, or not yet touched.

    Args:
        pad: The skin.
        pressure: `(n, n)` pressure (Pa).
        grid: Cells of the pad.

    Returns:
        The state without traction, with the displacement (m) under the pressure.
    """
    none = jnp.zeros((2, grid.cells, grid.cells), pressure.dtype)
    return Shear(
        traction=none,
        displacement=tangential_displacement(pad, pressure, grid),
        slipping=jnp.zeros((grid.cells, grid.cells), bool),
        residual=jnp.zeros((), pressure.dtype),
        steps=jnp.asarray(0),
        converged=jnp.asarray(True),
    )


@partial(jax.jit, static_argnames=("grid", "tolerance", "max_steps"))
def shear(
    pad: Pad,
    pressure: Float[Array, "n n"],
    slide: Float[Array, "2"],
    grid: Grid = GRID,
    *,
    before: Shear | None = None,
    tolerance: float = 1e-4,
    max_steps: int = CONTACT_SOLVER.max_steps,
) -> Shear:
    """Solve the traction and slip of the skin after the object in contact has moved along it.

    Args:
        pad: The skin.
        pressure: `(n, n)` pressure (Pa) at the end of the motion.
        slide: Motion (m) of the object along x and y of the skin since the previous state.
        grid: Cells of the pad.
        before: The previous state; by default the untouched skin.
        tolerance: Largest violation of the friction conditions, relative to the largest displacement. The default is
            ten times the rounding error of float32.
        max_steps: Maximum number of steps; if they do not suffice, `converged` is False.

    Returns:
        The traction (Pa), the displacement of the surface (m) and the mask of slipping cells after the motion.
    """
    kernels = jnp.stack(tangential_compliance(pad, grid)) * pad.young / pad.thickness
    spreading = tangential_displacement(pad, pressure, grid)
    followed = slide[:, None, None] - spreading + (0 if before is None else before.displacement)
    # The skin can follow only where it is pressed, so only these cells count.
    wanted = jnp.where(pressure[None] > 0, followed, 0) / pad.thickness
    # The problem is homogeneous, so its scale does not belong to the derivative.
    scale = jax.lax.stop_gradient(jnp.maximum(jnp.max(jnp.abs(wanted)), CONTACT_SOLVER.min_strain))
    wanted, limit = wanted / scale, pad.friction * pressure[None] / (pad.young * scale)
    fixed_kernels, fixed_limit, given = jax.lax.stop_gradient((kernels, limit, wanted))
    start = jnp.zeros_like(given) if before is None else jax.lax.stop_gradient(before.traction / (pad.young * scale))
    shared = (lanes.vector_convolution(fixed_kernels, grid), (jnp.min(fixed_kernels), jnp.max(fixed_kernels)))
    solver = _solver(grid, tolerance, max_steps)
    state: _Descended = jax.tree.map(lambda row: row[0], solver(shared, given[None], fixed_limit[None], start[None]))
    traction, slip = _tracked(kernels, limit, wanted, state.traction, state.slip, grid)
    return Shear(
        traction=traction * scale * pad.young,
        displacement=(slip + wanted) * scale * pad.thickness + spreading,
        slipping=_slipping(state.traction, limit)[0],
        residual=state.residual,
        steps=state.steps,
        converged=state.residual <= tolerance,
    )


class _Descended(NamedTuple):
    """Solution of one friction problem or several, in units of E and of h times its scale."""

    traction: Array
    slip: Array
    residual: Array
    steps: Array


@lru_cache
def _solver(grid: Grid, tolerance: float, max_steps: int) -> Callable[..., _Descended]:
    """Make a solver of friction problems on lanes."""

    def solver(shared: tuple[Array, tuple[Array, Array]], wanted: Array, limit: Array, start: Array) -> _Descended:
        matrices, bounds = shared
        limit = lanes.to_quadrants(limit[:, 0])

        def onto_discs(q: Array) -> Array:
            # Never divide by a size of zero, even if it is guarded by a tiny number: the limit is a quotient, and a
            # compiler that divides by the product of both divisors rounds that product to zero.
            size = _size(q)[0]
            outside = (size > limit) & (limit > 0)
            factor = jnp.where(limit > 0, jnp.where(outside, limit / jnp.where(outside, size, 1), 1), 0)
            return jnp.stack([q[0] * factor, q[1] * factor])

        state = descend(
            lambda q: lanes.convolve_vectors(matrices, q, grid),
            -_quadrants(wanted),
            onto_discs,
            level=lambda q, slip: jnp.zeros((), slip.dtype),
            start=_quadrants(start),
            bounds=bounds,
            tolerance=tolerance,
            max_steps=max_steps,
        )
        traction, slip = (
            jnp.stack([lanes.from_quadrants(part) for part in parts], axis=1) for parts in (state.point, state.gap)
        )
        return _Descended(traction, slip, state.residual.reshape(-1), state.steps.reshape(-1))

    return lanes.by_lanes(solver)


def _quadrants(vectors: Float[Array, "lanes 2 n n"]) -> Float[Array, "2 2 h 2 h lanes"]:
    """Split both components into quadrants."""
    return jnp.stack([lanes.to_quadrants(vectors[:, i]) for i in range(2)])


def _yielding(kernels: Array, q: Array, grid: Grid) -> Array:
    """Compute C q, the displacement of the surface under a traction, both along x and y."""
    parts = traction_waves(spectrum(q, grid), grid)
    return evaluate(kernels[:1] * parts.lengthwise + kernels[1:] * (parts.traction - parts.lengthwise), grid)


def _size(vectors: Array) -> Array:
    # Written out, because XLA turns a sum over two components into a loop, which is ten times slower.
    return jnp.sqrt(vectors[:1] * vectors[:1] + vectors[1:] * vectors[1:])


def _slipping(traction: Array, limit: Array, *, tolerance: float = 1e-4) -> Array:
    """Find the cells whose friction reaches its limit, up to a relative tolerance."""
    return (limit > 0) & (_size(traction) >= (1 - tolerance) * limit)


@partial(jax.custom_jvp, nondiff_argnums=(5,))
def _tracked(
    kernels: Array, limit: Array, wanted: Array, traction: Array, slip: Array, grid: Grid
) -> tuple[Array, Array]:
    """Return the solution `traction` and `slip` of a friction problem, differentiable by the other arrays."""
    return traction, slip


@_tracked.defjvp
def _track(grid: Grid, at: tuple, change: tuple) -> tuple[tuple, tuple]:
    kernels, limit, _, traction, slip = at
    d_kernels, d_limit, d_wanted, *_ = change
    slipping = _slipping(traction, limit)
    sticking = (limit > 0) & ~slipping
    towards = traction / safe_divisor(_size(traction))  # against the slip
    across = jnp.stack([-towards[1], towards[0]])
    # The farther a cell has slipped, the less a small motion turns its traction.
    slid = jnp.maximum(-jnp.sum(slip * towards, axis=0, keepdims=True), 0)
    stiff = jnp.where(slipping, slid / safe_divisor(limit), 0)

    def allowed(q: Array) -> Array:
        """Project a change of traction onto those that keep the size on slipping cells and vanish without contact."""
        # As a multiple of `across`, it contains `towards` only by its own rounding, however small it is.
        return jnp.where(sticking, q, jnp.where(slipping, across * jnp.sum(across * q, axis=0, keepdims=True), 0))

    def operator(q: Array) -> Array:
        q = allowed(q)
        return allowed(_yielding(kernels, q, grid) + stiff * q)

    grown = jnp.where(slipping, d_limit, 0) * towards
    moved = _yielding(kernels, grown, grid) + _yielding(d_kernels, traction, grid) - d_wanted
    turned = jax.lax.custom_linear_solve(
        operator, -moved, lambda operator, q: conjugate_gradients(operator, allowed(q)), symmetric=True
    )
    return (traction, slip), (grown + turned, moved + _yielding(kernels, turned, grid))
