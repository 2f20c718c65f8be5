"""Frictionless contact of a rigid surface with the elastic layer of `i2t.skin.elasticity`.

The object comes from z > 0 of the tool frame. A surface whose point above a cell lies `height` behind its nearest
point, moved `indentation` past first touch, leaves the gap g = K p + height - indentation, where K p is how far the
pressure pushes the skin down (the layer's compliance and, of a skin clamped at its edge, the sinking of the whole), and

    p >= 0,   g >= 0,   p g = 0   in every cell

are the optimality conditions of the convex problem min p.Kp/2 + p.(height - indentation) over p >= 0 (when the force is
given: min p.Kp/2 + p.height over p >= 0 of that sum). It is solved by the spectral projected gradient method (Birgin,
Martinez and Raydan, SIAM J. Optim. 10, 2000) with the exact line search of a quadratic: monotone, and one convolution a
step where the conjugate gradients of Polonsky and Keer (Wear 231, 1999) take two. It is quick because the layer is well
conditioned: max G / min G is about 6 at the default cells.

Derivatives are those of the conditions, not of the steps that met them (implicit differentiation): while the cells in
contact stay the same, K dp + dK p + dheight - dindentation = 0 on them and dp = 0 elsewhere, one symmetric and positive
linear system, solved by conjugate gradients only where a derivative is asked for, forwards or backwards. Where the
force is given, dindentation keeps the sum of p, and the system is solved for the same motion of all cells as well (the
Schur complement of the constraint). Where a cell is just gaining or losing contact, it is the derivative of one side.

Arrays over the pad have row i along tool y and column j along tool x, at cell centres. Metres, pascals, newtons.
"""

from collections.abc import Callable
from functools import lru_cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from i2t.skin import lanes
from i2t.skin.elasticity import CELL_GRID as CELL_GRID
from i2t.skin.elasticity import FINE_GRID as FINE_GRID
from i2t.skin.elasticity import GRID, Grid, clamped_shape, compliance, convolve
from i2t.types import Pad

MAX_HEIGHT_M = 1.0  # m: heights are cut here, so that "nothing there" may be infinite
MIN_STRAIN = 1e-9  # strain below which a problem is no longer scaled to 1, so that no contact divides by no number
CONTACT_TOLERANCE = (
    1e-5  # of the deepest deflection: about ten roundings of float32, a hundredth of the 0.1 % asked of a force
)
MAX_STEPS = 200
CONTACT_NEWTONS = 1e-3  # on a cell of 1 mm (1 kPa), above which it counts as contact
LINEAR_STEPS = 100  # at most, of the conjugate gradients for a derivative; about 20 are enough


class Contact(NamedTuple):
    """A solved contact."""

    pressure: Float[Array, "n n"]  # Pa
    force: Float[Array, ""]  # N, along -z on the skin
    indentation: Float[Array, ""]  # m
    gap: Float[Array, "n n"]  # m, between skin and surface: zero in contact up to the tolerance
    residual: Float[Array, ""]  # largest violation of the conditions, as a gap, relative to the deepest deflection
    steps: Int[Array, ""]  # convolutions spent
    converged: Bool[Array, ""]


@partial(jax.jit, static_argnames=("grid", "tolerance", "max_steps"))
def solve(
    pad: Pad,
    height: Float[Array, "n n"],
    indentation: Float[Array, ""] | float,
    grid: Grid = GRID,
    *,
    start: Float[Array, "n n"] | None = None,
    tolerance: float = CONTACT_TOLERANCE,
    max_steps: int = MAX_STEPS,
) -> Contact:
    """The contact at a given indentation.

    Args:
        pad: the skin.
        height: m, >= 0, may be infinite: the surface's distance behind its nearest point along tool z.
        indentation: m, depth of that nearest point below the resting skin; at or above it (<= 0) nothing touches.
        grid: cells of the pad.
        start: Pa, a pressure to begin from, say that of a neighbouring indentation.
        tolerance: largest violation of the conditions, of the deepest deflection.
        max_steps: after which it is given up, and `converged` is False.

    Returns:
        The contact.
    """
    gap = (jnp.minimum(height, MAX_HEIGHT_M) - indentation) / pad.thickness
    # The problem is homogeneous, so that its scale is no part of the derivative.
    scale = jax.lax.stop_gradient(jnp.maximum(jnp.max(-gap), MIN_STRAIN))
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
    tolerance: float = CONTACT_TOLERANCE,
    max_steps: int = MAX_STEPS,
) -> Contact:
    """The contact at a given normal force, sought among the pressures that carry it.

    Args:
        pad: the skin.
        height: m, as for `solve`.
        force: N, > 0.
        grid: cells of the pad.
        start: Pa, a pressure to begin from.
        tolerance: largest violation of the conditions, of the deepest deflection.
        max_steps: after which it is given up, and `converged` is False.

    Returns:
        The contact, with its indentation.
    """
    height = jnp.minimum(height, MAX_HEIGHT_M)
    nearest = jax.lax.stop_gradient(jnp.min(height))  # an origin, and as such no part of the derivative
    scale = jnp.maximum(force / (grid.spacing**2 * pad.young), MIN_STRAIN)
    offset = (height - nearest) / (pad.thickness * scale)
    start = None if start is None else start / (pad.young * scale)
    state = _solution(pad, offset, start, grid=grid, forced=True, tolerance=tolerance, max_steps=max_steps)
    return _contact(pad, state, scale, nearest + state.level * scale * pad.thickness, grid, tolerance)


class _Solution(NamedTuple):
    """A solved contact problem, or some of them, in units of E and of h times its scale."""

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
    """The solver of contact problems on lanes."""

    def solver(shared: tuple[Array, _Softness], offset: Array, start: Array) -> _Solution:
        matrices, soft = shared
        shape = lanes.to_quadrants(clamped_shape(grid, offset.dtype)[None])

        def deflect(p: Array) -> Array:
            return lanes.convolve(matrices, p, grid) + soft.mount * lanes.total(shape * p) * shape

        state = descend(
            deflect,
            lanes.to_quadrants(offset),
            _onto_simplex if forced else lambda p: jnp.maximum(p, 0),
            level=lambda p, gap: lanes.total(p * gap) if forced else jnp.zeros((), gap.dtype),
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

    kernel: Array  # of each wave
    mount: Array  # of the whole skin, per sum of w p


def _softness(pad: Pad, grid: Grid) -> _Softness:
    unit = pad.young / pad.thickness
    return _Softness(compliance(pad, grid) * unit, pad.mount_compliance * grid.spacing**2 * unit)


def _bounds(soft: _Softness, grid: Grid) -> tuple[Array, Array]:
    """Bounds of K's spectrum; the squares of w sum to 9/64 of the cells."""
    return jnp.min(soft.kernel), jnp.max(soft.kernel) + soft.mount * (9 / 64 * grid.cells**2)


def _deflect(soft: _Softness, pressure: Array, grid: Grid) -> Array:
    shape = clamped_shape(grid, pressure.dtype)
    return convolve(soft.kernel, pressure, grid) + soft.mount * jnp.sum(shape * pressure) * shape


@partial(jax.custom_jvp, nondiff_argnums=(5, 6))
def _tracked(
    soft: _Softness, offset: Array, pressure: Array, gap: Array, level: Array, grid: Grid, forced: bool
) -> tuple[Array, Array, Array]:
    """The solution `pressure`, `gap` and `level` of a contact problem, with its derivatives by `soft` and `offset`."""
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
        """The change of pressure on the cells in contact that deflects them by `displacement`."""
        return jax.lax.custom_linear_solve(
            lambda values: inside(deflect(inside(values))),
            displacement,
            lambda operator, values: conjugate_gradients(operator, inside(values)),
            symmetric=True,
        )

    opened = _deflect(d_soft, pressure, grid) + d_offset
    if forced:
        # The object rises by what keeps the force. Under a small contact that is nearly all of `opened`, and the mean
        # is taken off first, so that roundings are those of what is left.
        rigid = pressing(jnp.ones_like(pressure))
        own = pressing(mean(opened) - opened)
        d_pressure = own - total(own) / positive(total(rigid)) * rigid
    else:
        d_pressure = pressing(-opened)
    d_gap = deflect(d_pressure) + opened
    return (pressure, gap, level), (d_pressure, d_gap, mean(d_gap) if forced else jnp.zeros_like(level))


def conjugate_gradients(operator: Callable[[Array], Array], b: Array) -> Array:
    """Solve operator(x) = b.

    Rounding must not lead out of the subspace on which the operator is positive: what is outside never becomes smaller,
    and the steps grow without bound once it is all that is left. A mask of cells and a projection onto a direction keep
    to their subspace; taking off a mean does not.

    Args:
        operator: Symmetric, and positive on a subspace with `b` in it.
        b: Right side, of any size.

    Returns:
        x, in that subspace; not finite where `b` is not.
    """
    size = jnp.max(jnp.abs(b))  # squares of b itself may be too small or too large for a number
    b = b / jnp.where(size > 0, size, 1)
    tolerance = (20 * float(jnp.finfo(b.dtype).eps)) ** 2 * jnp.sum(b * b)

    def step(now: tuple) -> tuple:
        x, rest, way, square, steps = now
        change = operator(way)
        length = square / positive(jnp.sum(way * change))
        rest = rest - length * change
        new = jnp.sum(rest * rest)
        return x + length * way, rest, rest + new / positive(square) * way, new, steps + 1

    def unfinished(now: tuple) -> Array:
        return (now[3] > tolerance) & (now[4] < LINEAR_STEPS)

    first = (jnp.zeros_like(b), b, b, jnp.sum(b * b), jnp.asarray(0))
    return size * jax.lax.while_loop(unfinished, step, first)[0]


class ContactState(NamedTuple):
    """State of a descent on lanes. Numbers of a lane have axes of length 1 for the cells."""

    point: Array  # within the allowed set
    gap: Array  # the gradient there, K x + offset
    level: Array  # of the gap that the set's own conditions leave free
    target: Array  # of the next step
    length: Array  # of the gradient step that gave it
    residual: Array  # largest violation of the conditions over the largest deflection
    steps: Array  # applications of K


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
    """Minimise x.Kx/2 + x.offset over a convex set by spectral projected gradients, each lane for itself. Not
    differentiated.

    Args:
        deflect: x to K x, symmetric and positive.
        offset: the linear term; the last axis counts lanes.
        project: the nearest point of the set.
        level: from point and gap, the constant of the gap that the set's own conditions leave free.
        start: where to begin.
        bounds: of K's spectrum, smallest and largest; gradient steps are kept within their inverses.
        tolerance: largest violation of the conditions, of the largest deflection.
        max_steps: applications of K after which it is given up.

    Returns:
        Where the descent has come to. A lane stays where it has met the tolerance.
    """
    shortest, longest = (1 / bound for bound in bounds[::-1])

    def state(x: Array, gap: Array, length: Array, steps: Array) -> ContactState:
        # Taking the level off changes nothing in exact arithmetic (directions of constant force sum to zero); it saves
        # the digits below it.
        reached = level(x, gap)
        target = project(x - length * (gap - reached))
        deflection = positive(lanes.largest(gap - offset))
        moved = lanes.largest(target - x)
        # Where nothing may move (no friction), length times deflection may be too small a number to divide by.
        residual = jnp.where(moved > 0, moved / jnp.where(moved > 0, length * deflection, 1), 0)
        return ContactState(x, gap, reached, target, length, residual, steps)

    def unfinished(now: ContactState) -> Array:
        return (now.residual > tolerance) & (now.steps < max_steps)

    def step(now: ContactState) -> ContactState:
        going = unfinished(now)
        d = now.target - now.point
        change = deflect(d)
        dd, dk, kk = (positive(lanes.total(product)) for product in (d * d, d * change, change * change))
        fraction = jnp.clip(-lanes.total((now.gap - now.level) * d) / dk, 0, 1)
        fraction = jnp.where(going, fraction, 0)
        length = jnp.where(now.steps % 2 == 0, dk / kk, dd / dk)  # Barzilai and Borwein's two, in turn
        length = jnp.where(going, jnp.clip(length, shortest, longest), now.length)
        x = (1 - fraction) * now.point + fraction * now.target  # between two points of the set, so within it
        return state(x, now.gap + fraction * change, length, now.steps + going)

    start = project(start)
    lengths = jnp.full_like(lanes.total(offset), shortest)
    first = state(start, deflect(start) + offset, lengths, jnp.ones_like(lengths, int))
    return jax.lax.while_loop(lambda now: jnp.any(unfinished(now)), step, first)


def _onto_simplex(p: Float[Array, "*cells lanes"]) -> Float[Array, "*cells lanes"]:
    """The nearest array >= 0 whose lanes sum to 1: max(p - t, 0). Newton's method finds t: from anywhere its first step
    ends at or below it, and from there t rises and cells only leave; once none leaves, t is exact.
    """

    def newton(t: Array) -> tuple[Array, Array]:
        above = p > t
        count = lanes.total(above.astype(p.dtype))
        return t + (lanes.total(jnp.where(above, p - t, 0)) - 1) / jnp.maximum(count, 1), count

    most = jnp.max(p, lanes.cell_axes(p), keepdims=True)
    # Near the solution p sums to about 1, and t is about 0.
    t, _ = newton(jnp.where(most > 0, 0, most - 1))
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


def positive(x: Array) -> Array:
    """A number that is safe to divide by.

    Args:
        x: Any number.

    Returns:
        `x`, or the smallest normal number where it is not above it.
    """
    return jnp.maximum(x, jnp.finfo(x.dtype).tiny)
