"""Frictionless contact of a rigid surface with the elastic layer of `i2t.skin.elasticity`.

The object comes from z > 0 of the tool frame. The surface's point above a cell lies `height` behind its nearest point
and is moved `indentation` past first touch, which leaves the gap g = K p + height - indentation. K p is the
displacement of the skin under the pressure: the layer's compliance and, if the skin is clamped at its edge, the sinking
of the whole. The conditions

    p >= 0,   g >= 0,   p g = 0   in every cell

are the optimality conditions of the convex problem min p.Kp/2 + p.(height - indentation) over p >= 0 (if the force is
given: min p.Kp/2 + p.height over p >= 0 of that sum). It is solved by the spectral projected gradient method (Birgin,
Martinez and Raydan, SIAM J. Optim. 10, 2000) with the exact line search of a quadratic. This is monotone and takes one
convolution a step, while the conjugate gradients of Polonsky and Keer (Wear 231, 1999) take two. It is fast because the
layer is well conditioned: max G / min G is about 6 at the default cells.

Derivatives are those of the conditions, not of the steps that met them (implicit differentiation). While the cells in
contact stay the same, K dp + dK p + dheight - dindentation = 0 on them and dp = 0 elsewhere. This symmetric and
positive linear system is solved by conjugate gradients only if a derivative is requested, forwards or backwards. If the
force is given, dindentation keeps the sum of p, and the system is also solved for the same motion of all cells (the
Schur complement of the constraint). Where a cell is just gaining or losing contact, the derivative is one-sided.

Arrays over the pad have row i along tool y and column j along tool x, at cell centres. Metres, pascals, newtons.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from i2t.skin import lanes
from i2t.skin.elasticity import CELL_GRID as CELL_GRID
from i2t.skin.elasticity import FINE_GRID as FINE_GRID
from i2t.skin.elasticity import GRID, Grid, clamped_shape, compliance, convolve
from i2t.types import Pad

MAX_HEIGHT_M = 1.0  # m, height at which surface heights are clipped; they may be infinite where there is no surface


@dataclass(frozen=True)
class ContactSolver:
    """Accuracy and limits of the solver of contacts between skin and object."""

    # Largest violation relative to the deepest deflection: about ten roundings of float32. A force shall be accurate
    # to 0.1 %, a hundred times this.
    tolerance: float = 1e-5
    max_steps: int = 200
    # largest number of steps of the conjugate gradients for a derivative; about 20 are enough
    max_linear_steps: int = 100
    min_strain: float = 1e-9  # strain below which a problem is not scaled to 1, which avoids a division by zero


CONTACT_SOLVER = ContactSolver()  # default accuracy and limits of the contact solver


class Contact(NamedTuple):
    """Contact of the skin with an object: pressure (Pa), force (N), indentation and gap (m), accuracy of solution."""

    pressure: Float[Array, "n n"]  # Pa, pressure on each cell
    force: Float[Array, ""]  # N, force along -z on the skin
    indentation: Float[Array, ""]  # m, indentation of the skin
    gap: Float[Array, "n n"]  # m, gap between skin and surface; zero in contact up to the tolerance
    # largest violation of the contact conditions, as a gap relative to the deepest deflection
    residual: Float[Array, ""]
    steps: Int[Array, ""]  # number of convolutions that the solver used
    converged: Bool[Array, ""]


@partial(jax.jit, static_argnames=("grid", "tolerance", "max_steps"))
def solve(
    pad: Pad,
    height: Float[Array, "n n"],
    indentation: Float[Array, ""] | float,
    grid: Grid = GRID,
    *,
    start: Float[Array, "n n"] | None = None,
    tolerance: float = CONTACT_SOLVER.tolerance,
    max_steps: int = CONTACT_SOLVER.max_steps,
) -> Contact:
    """Solve the frictionless contact of the skin with a rigid surface at a given indentation.

    Args:
        pad: The skin.
        height: `(n, n)` distance (m, >= 0, may be infinite) of the surface behind its nearest point along tool z.
        indentation: Distance (m) of that nearest point below the resting skin; nothing touches if it is not positive.
        grid: Cells of the pad.
        start: `(n, n)` pressure (Pa) to start from, such as that of a neighbouring indentation.
        tolerance: Largest violation of the contact conditions, relative to the deepest deflection.
        max_steps: Maximum number of steps; if they do not suffice, `converged` is False.

    Returns:
        Pressure, force, gap and accuracy of the contact.
    """
    gap = (jnp.minimum(height, MAX_HEIGHT_M) - indentation) / pad.thickness
    # The problem is homogeneous, so its scale does not belong to the derivative.
    scale = jax.lax.stop_gradient(jnp.maximum(jnp.max(-gap), CONTACT_SOLVER.min_strain))
    start = None if start is None else start / (pad.young * scale)
    state = _solution(pad, gap / scale, start, grid=grid, forced=False, tolerance=tolerance, max_steps=max_steps)
    return _contact(pad, state, scale, jnp.asarray(indentation), grid, tolerance)


@partial(jax.jit, static_argnames=("grid", "tolerance", "max_steps"))
def solve_force(
    pad: Pad,
    height: Float[Array, "n n"],
    force: Float[Array, ""] | float,
    grid: Grid = GRID,
    *,
    start: Float[Array, "n n"] | None = None,
    tolerance: float = CONTACT_SOLVER.tolerance,
    max_steps: int = CONTACT_SOLVER.max_steps,
) -> Contact:
    """Solve the frictionless contact of the skin with a rigid surface at a given normal force.

    Args:
        pad: The skin.
        height: `(n, n)` distance (m) of the surface behind its nearest point, as for `solve`.
        force: Normal force (N), > 0.
        grid: Cells of the pad.
        start: `(n, n)` pressure (Pa) to start from.
        tolerance: Largest violation of the contact conditions, relative to the deepest deflection.
        max_steps: Maximum number of steps; if they do not suffice, `converged` is False.

    Returns:
        The contact with its indentation.
    """
    height = jnp.minimum(height, MAX_HEIGHT_M)
    nearest = jax.lax.stop_gradient(jnp.min(height))  # an origin, which does not belong to the derivative
    scale = jnp.maximum(force / (grid.spacing**2 * pad.young), CONTACT_SOLVER.min_strain)
    offset = (height - nearest) / (pad.thickness * scale)
    start = None if start is None else start / (pad.young * scale)
    state = _solution(pad, offset, start, grid=grid, forced=True, tolerance=tolerance, max_steps=max_steps)
    return _contact(pad, state, scale, nearest + state.level * scale * pad.thickness, grid, tolerance)


def cells_in_contact(
    newtons: Float[Array, "*cells"] | Float[np.ndarray, "*cells"], *, threshold: float = 1e-3
) -> Bool[Array, "*cells"] | Bool[np.ndarray, "*cells"]:
    """Find the cells of the skin that are in contact, bearing a noticeable force.

    Args:
        newtons: Force (N) on each cell of 1 mm.
        threshold: Force (N) above which a cell is in contact; the default is a pressure of 1 kPa.

    Returns:
        Mask of the cells in contact.
    """
    return newtons > threshold


class _Solution(NamedTuple):
    """Solution of one contact problem or several, in units of E and of h times its scale."""

    pressure: Array
    gap: Array
    level: Array
    residual: Array
    steps: Array


def _solution(
    pad: Pad, offset: Array, start: Array | None, *, grid: Grid, forced: bool, tolerance: float, max_steps: int
) -> _Solution:
    """Solve min p.Kp/2 + p.offset over p >= 0, or over those that sum to 1 (`forced`), with its derivatives."""
    soft = _softness(pad, grid)
    fixed, given = jax.lax.stop_gradient((soft, offset))
    _, longest = _bounds(fixed, grid)
    start = -given / longest if start is None else jax.lax.stop_gradient(start)
    shared = (lanes.convolution(fixed.kernel, grid), fixed)
    solver = _solver(grid, forced, tolerance, max_steps)
    solution: _Solution = jax.tree.map(lambda row: row[0], solver(shared, given[None], start[None]))
    pressure, gap, level = _tracked(soft, offset, *solution[:3], grid, forced)
    return solution._replace(pressure=pressure, gap=gap, level=level)


@lru_cache
def _solver(grid: Grid, forced: bool, tolerance: float, max_steps: int) -> Callable[..., _Solution]:
    """Make a solver of contact problems on lanes."""

    def solver(shared: tuple[Array, _Softness], offset: Array, start: Array) -> _Solution:
        matrices, soft = shared
        shape = lanes.to_quadrants(clamped_shape(grid, offset.dtype)[None])

        def deflect(p: Array) -> Array:
            return lanes.convolve(matrices, p, grid) + soft.mount * lanes.lane_sum(shape * p) * shape

        state = descend(
            deflect,
            lanes.to_quadrants(offset),
            _onto_simplex if forced else lambda p: jnp.maximum(p, 0),
            level=lambda p, gap: lanes.lane_sum(p * gap) if forced else jnp.zeros((), gap.dtype),
            start=lanes.to_quadrants(start),
            bounds=_bounds(soft, grid),
            tolerance=tolerance,
            max_steps=max_steps,
        )
        point, gap = lanes.from_quadrants(state.point), lanes.from_quadrants(state.gap)
        level = jnp.broadcast_to(state.level, state.steps.shape)
        return _Solution(point, gap, *(number.reshape(-1) for number in (level, state.residual, state.steps)))

    return lanes.by_lanes(solver)


class _Softness(NamedTuple):
    """K, for pressures in units of E and displacements in units of h."""

    kernel: Array  # softness for each wave
    mount: Array  # softness of the mount for the whole skin, per sum of w p


def _softness(pad: Pad, grid: Grid) -> _Softness:
    unit = pad.young / pad.thickness
    return _Softness(compliance(pad, grid) * unit, pad.mount_compliance * grid.spacing**2 * unit)


def _bounds(soft: _Softness, grid: Grid) -> tuple[Array, Array]:
    """Bound K's spectrum; the squares of w sum to 9/64 of the cells."""
    return jnp.min(soft.kernel), jnp.max(soft.kernel) + soft.mount * (9 / 64 * grid.cells**2)


def _deflect(soft: _Softness, pressure: Array, grid: Grid) -> Array:
    shape = clamped_shape(grid, pressure.dtype)
    return convolve(soft.kernel, pressure, grid) + soft.mount * jnp.sum(shape * pressure) * shape


@partial(jax.custom_jvp, nondiff_argnums=(5, 6))
def _tracked(
    soft: _Softness, offset: Array, pressure: Array, gap: Array, level: Array, grid: Grid, forced: bool
) -> tuple[Array, Array, Array]:
    """Return the solution `pressure`, `gap` and `level` of a contact problem, differentiable by `soft` and `offset`."""
    return pressure, gap, level


@_tracked.defjvp
def _track(grid: Grid, forced: bool, at: tuple, change: tuple) -> tuple[tuple, tuple]:
    soft, _, pressure, gap, level = at
    d_soft, d_offset, *_ = change
    touching = pressure > 0

    def inside(values: Array) -> Array:
        return jnp.where(touching, values, 0)

    def total(values: Array) -> Array:
        return jnp.sum(inside(values))

    def mean(values: Array) -> Array:
        return total(values) / jnp.maximum(jnp.sum(touching), 1)

    def deflect(values: Array) -> Array:
        return _deflect(soft, values, grid)

    def pressing(displacement: Array) -> Array:
        """Compute the change of pressure (in units of E) on the cells in contact, and zero elsewhere, that deflects
        these cells by `displacement` (in units of h).
        """
        return jax.lax.custom_linear_solve(
            lambda values: inside(deflect(inside(values))),
            displacement,
            lambda operator, values: conjugate_gradients(operator, inside(values)),
            symmetric=True,
        )

    opened = _deflect(d_soft, pressure, grid) + d_offset
    if forced:
        # The object rises so that the force stays the same. Under a small contact that rise is nearly all of `opened`,
        # so the mean is subtracted first, to keep the digits of the remainder.
        rigid = pressing(jnp.ones_like(pressure))
        own = pressing(mean(opened) - opened)
        d_pressure = own - total(own) / safe_divisor(total(rigid)) * rigid
    else:
        d_pressure = pressing(-opened)
    d_gap = deflect(d_pressure) + opened
    return (pressure, gap, level), (d_pressure, d_gap, mean(d_gap) if forced else jnp.zeros_like(level))


def conjugate_gradients(operator: Callable[[Array], Array], b: Array) -> Array:
    """Solve the linear system operator(x) = b by conjugate gradients.

    Rounding must not lead out of the subspace on which the operator is positive: components outside never become
    smaller, and the steps grow without bound once nothing else is left. A mask of cells and a projection onto a
    direction stay within their subspace; subtracting a mean does not.

    Args:
        operator: Linear operator, symmetric, and positive on a subspace that contains `b`.
        b: Right side, of any shape.

    Returns:
        The solution x in that subspace, with the shape of `b`; not finite if `b` is not.
    """
    size = jnp.max(jnp.abs(b))  # the squares of b itself may underflow or overflow
    b = b / jnp.where(size > 0, size, 1)
    tolerance = (20 * float(jnp.finfo(b.dtype).eps)) ** 2 * jnp.sum(b * b)

    def step(now: tuple) -> tuple:
        x, rest, way, square, steps = now
        change = operator(way)
        length = square / safe_divisor(jnp.sum(way * change))
        rest = rest - length * change
        new = jnp.sum(rest * rest)
        return x + length * way, rest, rest + new / safe_divisor(square) * way, new, steps + 1

    def unfinished(now: tuple) -> Array:
        return (now[3] > tolerance) & (now[4] < CONTACT_SOLVER.max_linear_steps)

    first = (jnp.zeros_like(b), b, b, jnp.sum(b * b), jnp.asarray(0))
    return size * jax.lax.while_loop(unfinished, step, first)[0]


class ContactState(NamedTuple):
    """State of `descend` for each lane (contact): point, gradient, next target, step length, residual and steps.

    Values of a whole lane have cell axes of length 1.
    """

    point: Array  # a point of the allowed set
    gap: Array  # gradient K x + offset at `point`
    level: Array  # constant of the gap that the set's own conditions leave free
    target: Array  # target of the next step
    length: Array  # length of the gradient step to `target`
    residual: Array  # largest violation of the contact conditions, relative to the largest deflection
    steps: Array  # number of applications of K


def descend(
    deflect: Callable[[Array], Array],
    offset: Float[Array, "*cells lanes"],
    project: Callable[[Array], Array],
    *,
    level: Callable[[Array, Array], Array],
    start: Float[Array, "*cells lanes"],
    bounds: tuple[Array, Array],
    tolerance: float,
    max_steps: int,
) -> ContactState:
    """Minimise x.Kx/2 + x.offset over a convex set by spectral projected gradients, for each lane (contact) separately.

    The result is not differentiable.

    Args:
        deflect: Function from x to K x, symmetric and positive.
        offset: The linear term; the last axis counts lanes.
        project: Function that finds the nearest point of the set.
        level: Function of point and gap that gives the constant of the gap that the set's conditions leave free.
        start: Point to start from.
        bounds: Smallest and largest eigenvalue of K; gradient steps are kept within their inverses.
        tolerance: Largest violation of the conditions, relative to the largest deflection.
        max_steps: Maximum number of applications of K.

    Returns:
        The last state of the descent. A lane stops once it meets the tolerance.
    """
    shortest, longest = (1 / bound for bound in bounds[::-1])

    def state(x: Array, gap: Array, length: Array, steps: Array) -> ContactState:
        # Subtracting the level changes nothing in exact arithmetic (directions of constant force sum to zero), but it
        # keeps the digits below it.
        reached = level(x, gap)
        target = project(x - length * (gap - reached))
        deflection = safe_divisor(lanes.lane_max(gap - offset))
        moved = lanes.lane_max(target - x)
        # If nothing may move (no friction), length times deflection may be too small to divide by.
        residual = jnp.where(moved > 0, moved / jnp.where(moved > 0, length * deflection, 1), 0)
        return ContactState(x, gap, reached, target, length, residual, steps)

    def unfinished(now: ContactState) -> Array:
        return (now.residual > tolerance) & (now.steps < max_steps)

    def step(now: ContactState) -> ContactState:
        going = unfinished(now)
        d = now.target - now.point
        change = deflect(d)
        dd, dk, kk = (safe_divisor(lanes.lane_sum(product)) for product in (d * d, d * change, change * change))
        fraction = jnp.clip(-lanes.lane_sum((now.gap - now.level) * d) / dk, 0, 1)
        fraction = jnp.where(going, fraction, 0)
        length = jnp.where(now.steps % 2 == 0, dk / kk, dd / dk)  # Barzilai and Borwein's two lengths, alternating
        length = jnp.where(going, jnp.clip(length, shortest, longest), now.length)
        x = (1 - fraction) * now.point + fraction * now.target  # between two points of the set, hence inside it
        return state(x, now.gap + fraction * change, length, now.steps + going)

    start = project(start)
    lengths = jnp.full_like(lanes.lane_sum(offset), shortest)
    first = state(start, deflect(start) + offset, lengths, jnp.ones_like(lengths, int))
    return jax.lax.while_loop(lambda now: jnp.any(unfinished(now)), step, first)


def _onto_simplex(p: Float[Array, "*cells lanes"]) -> Float[Array, "*cells lanes"]:
    """Find the nearest array >= 0 whose lanes sum to 1: max(p - t, 0). Newton's method finds t. Its first step ends at
    or below t from anywhere; then t rises and cells only leave; once none leaves, t is exact.
    """

    def newton(t: Array) -> tuple[Array, Array]:
        above = p > t
        count = lanes.lane_sum(above.astype(p.dtype))
        return t + (lanes.lane_sum(jnp.where(above, p - t, 0)) - 1) / jnp.maximum(count, 1), count

    largest = jnp.max(p, lanes.cell_axes(p), keepdims=True)
    # Near the solution p sums to about 1, and t is about 0.
    t, _ = newton(jnp.where(largest > 0, 0, largest - 1))
    size = p[..., 0].size
    first = t, jnp.full_like(t, size + 1), jnp.full_like(t, size + 2)
    t, *_ = jax.lax.while_loop(lambda now: jnp.any(now[1] < now[2]), lambda now: (*newton(now[0]), now[1]), first)
    return jnp.maximum(p - t, 0)


def _contact(pad: Pad, state: _Solution, scale: Array, indentation: Array, grid: Grid, tolerance: float) -> Contact:
    pressure = state.pressure * scale * pad.young
    return Contact(
        pressure=pressure,
        force=jnp.sum(pressure) * grid.spacing**2,
        indentation=indentation,
        gap=(state.gap - state.level) * scale * pad.thickness,
        residual=state.residual,
        steps=state.steps,
        converged=state.residual <= tolerance,
    )


def safe_divisor(x: Array) -> Array:
    """Raise a number to the smallest positive normal number if it is below it, for use as a divisor.

    Args:
        x: Any number.

    Returns:
        `x`, or the smallest positive normal number if `x` is below it.
    """
    return jnp.maximum(x, jnp.finfo(x.dtype).tiny)
