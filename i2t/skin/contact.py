"""Frictionless contact of a rigid surface with an elastic layer bonded to a rigid base, and the motion inside the
layer.

The layer (thickness h, Young's modulus E, Poisson's ratio nu, small strain) fills -h <= z <= 0 of the tool frame; its
surface is z = 0 and the object comes from z > 0. A pressure p on the surface pushes it down by K p, in Fourier space
the product G(k) p(k) with

    G(k) = (1 - nu) / (mu k) [kappa sinh 2kh - 2kh] / D(k),   D(k) = kappa cosh 2kh + 2(kh)^2 + 5 - 12 nu + 8 nu^2,
    G(0) = h (1 + nu)(1 - 2 nu) / (E (1 - nu)),   kappa = 3 - 4 nu,   mu = E / (2 (1 + nu)),

written with decaying exponentials so that nothing overflows. A surface whose point above a cell lies `height` behind
its nearest point, moved `indentation` past first touch, leaves the gap g = K p + height - indentation, and

    p >= 0,   g >= 0,   p g = 0   in every cell

are the optimality conditions of the convex problem min p.Kp/2 + p.(height - indentation) over p >= 0 (when the force is
given: min p.Kp/2 + p.height over p >= 0 of that sum). It is solved by the spectral projected gradient method (Birgin,
Martinez and Raydan, SIAM J. Optim. 10, 2000) with the exact line search of a quadratic: monotone, and one convolution a
step where the conjugate gradients of Polonsky and Keer (Wear 231, 1999) take two. It is quick because the layer is well
conditioned: max G / min G is about 6 at the default cells.

Pressure acts on the cells of the pad only; the Fourier series has a longer period, so that its copies do not feel each
other. Beyond the pad the layer goes on: the free side faces of a real pad are not modelled (`docs/physics.md`). The
series is written in real sines and cosines about the pad's centre, and its transforms are small matrix products: as
fast as an FFT at this size, free to be evaluated anywhere, and at home on every device.

Arrays over the pad have row i along tool y and column j along tool x, at cell centres. Metres, pascals, newtons.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from i2t.types import PAD_WINDOW, Pad

FAR = 1.0  # m: heights are cut here, so that "nothing there" may be infinite
SMALLEST = 1e-9  # strain below which a problem is no longer scaled to 1, so that no contact divides by no number
TOLERANCE = 1e-5  # of the deepest deflection: about ten roundings of float32, a hundredth of the 0.1 % asked of a force
MAX_STEPS = 200

# Full float32 products where a device would round the factors (to 10 bits on some).
_dot = partial(jnp.matmul, precision=jax.lax.Precision.HIGHEST)


@dataclass(frozen=True)
class Grid:
    """Square cells on the pad, and the Fourier series of a longer period around it."""

    cells: int = 40  # along each edge of the pad
    modes: int = 64  # along each edge of the period, which is as many cells long; even, as is `cells`
    window: float = PAD_WINDOW  # m, edge of the pad

    @property
    def spacing(self) -> float:
        """Edge of a cell, m."""
        return self.window / self.cells

    @property
    def centres(self) -> np.ndarray:
        """(cells,) m: coordinates of the cell centres along either edge."""
        return ((np.arange(self.cells) + 0.5) / self.cells - 0.5) * self.window

    @property
    def wavenumbers(self) -> np.ndarray:
        """(modes,) 1/m: of the cosines 0 ... modes/2 - 1, then of the sines 1 ... modes/2, about the pad's centre."""
        half = self.modes // 2
        return 2 * np.pi / (self.modes * self.spacing) * np.r_[0:half, 1 : half + 1]


GRID = Grid()
FINE = Grid(80, 128)  # where sharp edges matter more than speed: see `docs/physics.md`


class Contact(NamedTuple):
    """A solved contact."""

    pressure: Float[Array, "n n"]  # Pa
    force: Float[Array, ""]  # N, along -z on the skin
    indentation: Float[Array, ""]  # m
    gap: Float[Array, "n n"]  # m, between skin and surface: zero in contact up to the tolerance
    residual: Float[Array, ""]  # largest violation of the conditions, as a gap, relative to the deepest deflection
    steps: Int[Array, ""]  # convolutions spent
    converged: Bool[Array, ""]


def solve(
    pad: Pad,
    height: Float[Array, "n n"],
    indentation: Float[Array, ""] | float,
    grid: Grid = GRID,
    start: Float[Array, "n n"] | None = None,
    tolerance: float = TOLERANCE,
    max_steps: int = MAX_STEPS,
) -> Contact:
    """The contact at a given indentation.

    `height` (m, >= 0, may be infinite) is the surface's distance behind its nearest point along tool z, `indentation`
    (m) the depth of that nearest point below the resting skin; at or above the skin (<= 0) nothing touches. `start` is
    a pressure (Pa) to begin from, say that of a neighbouring indentation.
    """
    gap = (jnp.minimum(height, FAR) - indentation) / pad.thickness
    scale = jnp.maximum(jnp.max(-gap), SMALLEST)
    offset = gap / scale
    kernel = compliance(pad, grid) * pad.young / pad.thickness
    state = _descend(
        kernel,
        offset,
        lambda p: jnp.maximum(p, 0),
        lambda p, gap: jnp.zeros_like(scale),
        -offset / jnp.max(kernel) if start is None else start / (pad.young * scale),
        grid,
        tolerance,
        max_steps,
    )
    return _contact(pad, state, scale, jnp.asarray(indentation), grid, tolerance)


def solve_force(
    pad: Pad,
    height: Float[Array, "n n"],
    force: Float[Array, ""] | float,
    grid: Grid = GRID,
    start: Float[Array, "n n"] | None = None,
    tolerance: float = TOLERANCE,
    max_steps: int = MAX_STEPS,
) -> Contact:
    """The contact at a given normal force (N, > 0), sought among the pressures that carry it; gives the indentation."""
    height = jnp.minimum(height, FAR)
    nearest = jnp.min(height)
    scale = jnp.maximum(force / (grid.spacing**2 * pad.young), SMALLEST)
    offset = (height - nearest) / (pad.thickness * scale)
    kernel = compliance(pad, grid) * pad.young / pad.thickness
    state = _descend(
        kernel,
        offset,
        _onto_simplex,
        lambda p, gap: jnp.sum(p * gap),
        -offset / jnp.max(kernel) if start is None else start / (pad.young * scale),
        grid,
        tolerance,
        max_steps,
    )
    return _contact(pad, state, scale, nearest + state.level * scale * pad.thickness, grid, tolerance)


def compliance(pad: Pad, grid: Grid = GRID) -> Float[Array, "k k"]:
    """G at the grid's wavenumbers, (modes, modes), m/Pa: downward displacement of the surface per pressure."""
    layer = _layer(pad, grid)
    flat = pad.thickness * (1 + pad.poisson) * (1 - 2 * pad.poisson) / (pad.young * (1 - pad.poisson))
    wavy = 2 * layer.kappa * layer.sinh * layer.cosh - 2 * layer.q * layer.fall
    wavy = (1 - pad.poisson) / (layer.shear * layer.k) * wavy / layer.determinant
    return jnp.where(layer.uniform, flat, wavy)


def spectrum(pressure: Float[Array, "n n"], grid: Grid = GRID, series: Grid | None = None) -> Float[Array, "k k"]:
    """Coefficients, (modes, modes) with rows along y, of the series that equals `pressure` on the pad's cells and zero
    on the rest of the period; or only those of its waves that the `series` of a coarser grid of the same period has.
    """
    series = grid if series is None else series
    k = series.wavenumbers
    lone = (k == 0) | (k == np.max(grid.wavenumbers))  # constant and shortest waves have no partner of their wavenumber
    waves = basis(series, grid.centres)[0] * np.where(lone, 1, 2)[:, None] / grid.modes
    return _product(waves, pressure, waves)


def convolve(kernel: Float[Array, "k k"], pressure: Float[Array, "n n"], grid: Grid = GRID) -> Float[Array, "n n"]:
    """Multiply each wave of `pressure` by `kernel`, and evaluate the series on the pad's cells."""
    waves, _ = basis(grid, grid.centres)
    return _product(waves.T, kernel * spectrum(pressure, grid), waves.T)


def basis(grid: Grid, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The series' waves at `places` (m, from the pad's centre), (modes, len(places)), and their slopes (1/m)."""
    k = grid.wavenumbers[:, None]
    cosine, sine = np.cos(k * places[None]), np.sin(k * places[None])
    even = np.arange(grid.modes)[:, None] < grid.modes // 2
    return np.where(even, cosine, sine), k * np.where(even, -sine, cosine)


def interior(
    pad: Pad,
    waves: Float[Array, "k k"],
    depth: Float[Array, ""] | float,
    grid: Grid = GRID,
    places: np.ndarray | None = None,
) -> tuple[Float[Array, "3 m m"], Float[Array, "3 m m"]]:
    """Displacement (m) and local rotation (rad) at `depth` (m, 0 at the surface to h at the base) under a pressure
    whose `spectrum` is `waves`, at the points (rows y, columns x) whose coordinates are `places`: the cell centres by
    default.

    Each comes as its components along tool x, y and z, first axis; the rotation is the vector curl(u) / 2, whose z
    component is zero without friction. Of the exact solution for a bonded layer (Papkovich-Neuber potentials; u = 0 at
    the base, sigma_zz = -p and no shear at the surface), for each wave, with q = k (h - depth), Q = k h:

        u_z = W p,   (u_x, u_y) = (d/dx, d/dy) U p / k,   rotation = (d/dy, -d/dx, 0) (W - dU/dq) p / 2,
        W = a (kappa sinh q - q cosh q) - b q sinh q,   U = -a q sinh q - b (kappa sinh q + q cosh q),
        W - dU/dq = (kappa + 1) (a sinh q + b cosh q),
        a = -[(kappa + 1) cosh Q + 2Q sinh Q] / (2 mu k D),   b = -[(kappa - 1) sinh Q - 2Q cosh Q] / (2 mu k D).
    """
    layer = _layer(pad, grid)
    over = 1 / (2 * layer.shear * layer.k * layer.determinant)
    a = -over * ((layer.kappa + 1) * layer.cosh + 2 * layer.q * layer.sinh)
    b = -over * ((layer.kappa - 1) * layer.sinh - 2 * layer.q * layer.cosh)
    above = pad.thickness - depth  # height above the base
    q = layer.k * above
    # sinh q and cosh q carry exp(-Q); a and b carry it too and D its square, so that all these factors cancel.
    rise, fall = jnp.exp(-layer.k * (pad.thickness - above)), jnp.exp(-layer.k * (pad.thickness + above))
    sinh, cosh = (rise - fall) / 2, (rise + fall) / 2
    flat = -above * (1 + pad.poisson) * (1 - 2 * pad.poisson) / (pad.young * (1 - pad.poisson))
    down = jnp.where(layer.uniform, flat, a * (layer.kappa * sinh - q * cosh) - b * q * sinh)
    along = (-a * q * sinh - b * (layer.kappa * sinh + q * cosh)) / layer.k  # a uniform wave has no slope
    turn = (layer.kappa + 1) * (a * sinh + b * cosh) / 2

    values, slopes = (w.T for w in basis(grid, grid.centres if places is None else places))
    along, down, turn = along * waves, down * waves, turn * waves
    displacement = [
        _product(values, along, slopes),
        _product(slopes, along, values),
        _product(values, down, values),
    ]
    rotation = [_product(slopes, turn, values), -_product(values, turn, slopes), jnp.zeros_like(displacement[0])]
    return jnp.stack(displacement), jnp.stack(rotation)


class _Layer(NamedTuple):
    """Parts of the layer's response to each wave; sinh and cosh of q carry exp(-q), the determinant exp(-2q)."""

    kappa: Array
    shear: Array
    k: Array  # 1/m, with 1 / h in place of zero
    uniform: Array  # where k = 0
    q: Array  # k h
    fall: Array  # exp(-2q)
    sinh: Array
    cosh: Array
    determinant: Array


def _layer(pad: Pad, grid: Grid) -> _Layer:
    k = np.hypot(grid.wavenumbers[:, None], grid.wavenumbers[None, :])
    uniform = jnp.asarray(k == 0)
    safe = jnp.where(uniform, 1 / pad.thickness, k)
    q = safe * pad.thickness
    fall = jnp.exp(-2 * q)
    kappa = 3 - 4 * pad.poisson
    determinant = kappa * (1 + fall**2) / 2 + fall * (2 * q**2 + (kappa**2 + 1) / 2)
    sinh, cosh = (1 - fall) / 2, (1 + fall) / 2
    return _Layer(kappa, pad.young / (2 * (1 + pad.poisson)), safe, uniform, q, fall, sinh, cosh, determinant)


def _product(left: Array | np.ndarray, middle: Array, right: Array | np.ndarray) -> Array:
    """left @ middle @ right.T, each product over the last axis, which is quickest in a batch."""
    dtype = middle.dtype
    return _dot(_dot(middle, jnp.asarray(right.T, dtype)).T, jnp.asarray(left.T, dtype)).T


class _State(NamedTuple):
    pressure: Array  # in units of scale * E
    gap: Array  # K p + offset
    level: Array  # of the gap in contact
    direction: Array  # of the next step
    length: Array  # of the gradient step that gave it
    residual: Array
    steps: Array


def _descend(
    kernel: Array,
    offset: Array,
    project: Callable[[Array], Array],
    level: Callable[[Array, Array], Array],
    start: Array,
    grid: Grid,
    tolerance: float,
    max_steps: int,
) -> _State:
    """Minimise p.Kp/2 + p.offset over the convex set onto which `project` projects."""
    # Gradient steps are kept within the inverse of K's spectrum.
    shortest, longest = 1 / jnp.max(kernel), 1 / jnp.min(kernel)

    def state(p: Array, gap: Array, length: Array, steps: Array) -> _State:
        # Taking the level off changes nothing in exact arithmetic (directions of constant force sum to zero); it saves
        # the digits below it.
        reached = level(p, gap)
        direction = project(p - length * (gap - reached)) - p
        deflection = _positive(jnp.max(gap - offset))
        return _State(p, gap, reached, direction, length, jnp.max(jnp.abs(direction)) / (length * deflection), steps)

    def step(now: _State) -> _State:
        d, change = now.direction, convolve(kernel, now.direction, grid)
        dd, dk, kk = (_positive(jnp.sum(product)) for product in (d * d, d * change, change * change))
        fraction = jnp.clip(-jnp.sum((now.gap - now.level) * d) / dk, 0, 1)
        length = jnp.where(now.steps % 2 == 0, dk / kk, dd / dk)  # Barzilai and Borwein's two, in turn
        p = jnp.maximum(now.pressure + fraction * d, 0)
        return state(p, now.gap + fraction * change, jnp.clip(length, shortest, longest), now.steps + 1)

    def unfinished(now: _State) -> Array:
        return (now.residual > tolerance) & (now.steps < max_steps)

    start = project(start)
    first = state(start, convolve(kernel, start, grid) + offset, shortest, jnp.asarray(1))
    return jax.lax.while_loop(unfinished, step, first)


def _onto_simplex(p: Array) -> Array:
    """The nearest array >= 0 that sums to 1: max(p - t, 0), with t by Newton's method, exact in finitely many steps."""

    def newton(_: Array, t: Array) -> Array:
        over = p > t
        return t + (jnp.sum(jnp.where(over, p - t, 0)) - 1) / jnp.maximum(jnp.sum(over), 1)

    return jnp.maximum(p - jax.lax.fori_loop(0, 12, newton, jnp.max(p) - 1), 0)


def _contact(pad: Pad, state: _State, scale: Array, indentation: Array, grid: Grid, tolerance: float) -> Contact:
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


def _positive(x: Array) -> Array:
    """`x`, or the smallest normal number where it is not above it, so that dividing is safe."""
    return jnp.maximum(x, jnp.finfo(x.dtype).tiny)
