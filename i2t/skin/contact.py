"""Frictionless contact of a rigid surface with an elastic layer bonded to a rigid base, and the motion of the material inside the layer.

The layer (thickness h, Young's modulus E, Poisson's ratio nu, small strain) fills -h <= z <= 0 of the tool frame; its surface is z = 0 and the object
comes from z > 0. A pressure p on the surface pushes it down by K p, in Fourier space the product G(k) p(k) with

    G(k) = (1 - nu) / (mu k) [kappa sinh 2kh - 2kh] / D(k),   D(k) = kappa cosh 2kh + 2(kh)^2 + 5 - 12 nu + 8 nu^2,
    G(0) = h (1 + nu)(1 - 2 nu) / (E (1 - nu)),   kappa = 3 - 4 nu,   mu = E / (2 (1 + nu)),

written with decaying exponentials so that nothing overflows. A surface whose point at a cell lies `height` behind its nearest point, moved
`indentation` past first touch, leaves the gap g = K p + height - indentation, and

    p >= 0,   g >= 0,   p g = 0   in every cell

are the optimality conditions of the convex problem min p.Kp/2 + p.(height - indentation) over p >= 0 (or, when the force is given, over p >= 0 with
a given sum). It is solved by the spectral projected gradient method (Birgin, Martinez, Raydan, SIAM J. Optim. 10, 2000) with the exact line search
of a quadratic: monotone, one convolution per step, and quick because the layer is well conditioned (max G / min G = 6 at the default cells, the square
root of which bounds the pace). Pressure acts on the cells of the pad only; the Fourier series has a longer period, so that its copies do not feel each other.
The layer goes on outside the pad: the real pad's free side faces are not modelled (`docs/physics.md` says what that costs).

Arrays over the pad have row i along tool y and column j along tool x, at cell centres. Lengths are metres, pressures pascals.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from i2t.types import PAD_WINDOW, Pad

FAR = 1.0  # m: heights are cut here, so that "nothing there" may be infinite
TOLERANCE = 1e-5  # of the deepest deflection: ten times the rounding of float32 transforms, a hundredth of the 0.1 % asked of the force
MAX_STEPS = 200  # the slowest of 500 random surfaces takes under a third of it


@dataclass(frozen=True)
class Grid:
    """Square cells on the pad, and the longer period of the Fourier series around it."""

    cells: int = 40  # along each edge of the pad
    points: int = 64  # along each edge of the period, in cells
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
    def wavenumbers(self) -> tuple[np.ndarray, np.ndarray]:
        """Angular wavenumbers along y, (points, 1), and x, (1, points // 2 + 1), of a real transform, 1/m."""
        turn = 2 * np.pi
        return (
            turn * np.fft.fftfreq(self.points, self.spacing)[:, None],
            turn * np.fft.rfftfreq(self.points, self.spacing)[None, :],
        )


GRID = Grid()


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

    `height` (m, >= 0, may be infinite) is the surface's distance behind its nearest point along tool z, `indentation` (m) the depth of that nearest point
    below the resting skin; at or above the skin (<= 0) nothing touches. `start` is a pressure (Pa) to begin from, say of a neighbouring indentation.
    """
    gap = (jnp.minimum(height, FAR) - indentation) / pad.thickness
    scale = _positive(jnp.max(-gap))
    kernel = compliance(pad, grid) * pad.young / pad.thickness
    weakest, strongest = jnp.max(kernel), jnp.min(kernel)
    offset = gap / scale
    first = jnp.maximum(-offset, 0) / weakest if start is None else start / (pad.young * scale)
    state = _descend(
        lambda p: convolve(kernel, p, grid),
        offset,
        lambda p: jnp.maximum(p, 0),
        lambda p, gap: jnp.zeros_like(scale),
        first,
        (1 / weakest, 1 / strongest),
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
    """The contact at a given normal force (N, > 0): the pressure is sought among those that carry it, and the indentation is found with it."""
    height = jnp.minimum(height, FAR)
    nearest = jnp.min(height)
    scale = _positive(jnp.asarray(force) / (grid.spacing**2 * pad.young))
    kernel = compliance(pad, grid) * pad.young / pad.thickness
    weakest, strongest = jnp.max(kernel), jnp.min(kernel)
    offset = (height - nearest) / (pad.thickness * scale)
    first = -offset if start is None else start / (pad.young * scale)
    state = _descend(
        lambda p: convolve(kernel, p, grid),
        offset,
        _onto_simplex,
        lambda p, gap: jnp.sum(p * gap),
        _onto_simplex(first),
        (1 / weakest, 1 / strongest),
        tolerance,
        max_steps,
    )
    return _contact(pad, state, scale, nearest + state.level * scale * pad.thickness, grid, tolerance)


def compliance(pad: Pad, grid: Grid = GRID) -> Float[Array, "p q"]:
    """G(k) of a real transform, (points, points // 2 + 1), m/Pa: downward displacement of the surface per pressure."""
    layer = _layer(pad, grid)
    flat = pad.thickness * (1 + pad.poisson) * (1 - 2 * pad.poisson) / (pad.young * (1 - pad.poisson))
    wavy = (
        (1 - pad.poisson)
        / (layer.shear * layer.k)
        * (2 * layer.kappa * layer.sinh * layer.cosh - 2 * layer.q * layer.fall)
    )
    return jnp.where(layer.uniform, flat, wavy / layer.determinant)


def convolve(kernel: Float[Array, "p q"], pressure: Float[Array, "n n"], grid: Grid = GRID) -> Float[Array, "n n"]:
    """Multiply by `kernel` in Fourier space, from the pad's cells to the pad's cells."""
    period = (grid.points, grid.points)
    return jnp.fft.irfft2(kernel * jnp.fft.rfft2(pressure, period), period)[: grid.cells, : grid.cells]


def interior(
    pad: Pad, pressure: Float[Array, "n n"], depths: Float[Array, "d"], grid: Grid = GRID
) -> tuple[Float[Array, "3 d n n"], Float[Array, "3 d n n"]]:
    """Displacement (m) and local rotation (rad) under the pad's cells, at `depths` (m, 0 at the surface to h at the base).

    Each comes as its components along tool x, y and z, first axis; the rotation is the vector curl(u)/2, whose z component is zero without friction.
    Of the exact solution for a bonded layer (Papkovich-Neuber potentials; u = 0 at the base, sigma_zz = -p and no shear at the surface), for each
    wavenumber k and with q = k (h - depth), Q = k h:

        u_z = W p,  u_xy = i (k_xy / k) U p,  rotation = i/2 (k_y, -k_x, 0) (W - dU/dq) p,
        W = a (kappa sinh q - q cosh q) - b q sinh q,   U = -a q sinh q - b (kappa sinh q + q cosh q),
        W - dU/dq = (kappa + 1) (a sinh q + b cosh q),
        a = -[(kappa + 1) cosh Q + 2Q sinh Q] / (2 mu k D),   b = -[(kappa - 1) sinh Q - 2Q cosh Q] / (2 mu k D).
    """
    layer = _layer(pad, grid)
    a = -((layer.kappa + 1) * layer.cosh + 2 * layer.q * layer.sinh)
    b = -((layer.kappa - 1) * layer.sinh - 2 * layer.q * layer.cosh)
    over = 1 / (2 * layer.shear * layer.k * layer.determinant)
    above = (pad.thickness - depths)[:, None, None]  # height above the base
    k = layer.k[None]
    q = k * above
    # sinh q and cosh q, both times exp(-Q); a, b and D above carry exp(-Q) and exp(-2Q) as well, and all these factors cancel.
    rise, fall = jnp.exp(-k * (pad.thickness - above)), jnp.exp(-k * (pad.thickness + above))
    sinh, cosh = (rise - fall) / 2, (rise + fall) / 2
    a, b = (a * over)[None], (b * over)[None]
    down = a * (layer.kappa * sinh - q * cosh) - b * q * sinh
    flat = -above * (1 + pad.poisson) * (1 - 2 * pad.poisson) / (pad.young * (1 - pad.poisson))
    down = jnp.where(layer.uniform[None], flat, down)
    along = jnp.where(layer.uniform[None], 0.0, -a * q * sinh - b * (layer.kappa * sinh + q * cosh)) / k
    turn = jnp.where(layer.uniform[None], 0.0, (layer.kappa + 1) * (a * sinh + b * cosh) / 2)

    # An odd multiplier has no real counterpart at the highest wavenumber of an even grid, so that one is left out.
    ky, kx = (np.where(np.abs(k) >= np.pi / grid.spacing * (1 - 1e-9), 0, k)[None] for k in grid.wavenumbers)
    period = (grid.points, grid.points)
    waves = jnp.fft.rfft2(pressure, period)[None]
    shift = 1j * waves
    spectra = [along * kx * shift, along * ky * shift, down * waves, turn * ky * shift, -turn * kx * shift]
    fields = jnp.fft.irfft2(jnp.stack(spectra), period)[..., : grid.cells, : grid.cells]
    return fields[:3], jnp.concatenate([fields[3:], jnp.zeros_like(fields[:1])])


class _Layer(NamedTuple):
    """Parts of the layer's response at each wavenumber; sinh and cosh (of q) carry a factor exp(-q), the determinant exp(-2q)."""

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
    ky, kx = grid.wavenumbers
    k = np.hypot(ky, kx)
    uniform = jnp.asarray(k == 0)
    safe = jnp.where(uniform, 1 / pad.thickness, k)
    q = safe * pad.thickness
    fall = jnp.exp(-2 * q)
    kappa = 3 - 4 * pad.poisson
    determinant = kappa * (1 + fall**2) / 2 + fall * (2 * q**2 + (kappa**2 + 1) / 2)
    sinh, cosh = (1 - fall) / 2, (1 + fall) / 2
    return _Layer(kappa, pad.young / (2 * (1 + pad.poisson)), safe, uniform, q, fall, sinh, cosh, determinant)


class _State(NamedTuple):
    pressure: Array  # in units of scale * E
    gap: Array  # K p + offset
    level: Array  # of the gap in contact
    direction: Array  # of the next step
    length: Array  # of the step that gave it
    residual: Array
    steps: Array


def _descend(
    apply: Callable[[Array], Array],
    offset: Array,
    project: Callable[[Array], Array],
    level: Callable[[Array, Array], Array],
    start: Array,
    lengths: tuple[Array, Array],
    tolerance: float,
    max_steps: int,
) -> _State:
    """Minimise p.Kp/2 + p.offset over the convex set onto which `project` projects; `lengths` bound the step by the spectrum of K."""

    def state(p: Array, gap: Array, length: Array, steps: Array) -> _State:
        # Taking the level off changes nothing in exact arithmetic (directions of constant force sum to zero) and saves the digits below it.
        reached = level(p, gap)
        direction = project(p - length * (gap - reached)) - p
        deflection = _positive(jnp.max(gap - offset))
        return _State(p, gap, reached, direction, length, jnp.max(jnp.abs(direction)) / (length * deflection), steps)

    def step(now: _State) -> _State:
        change = apply(now.direction)
        dd, dk, kk = (
            _positive(jnp.sum(a * b)) for a, b in ((now.direction,) * 2, (now.direction, change), (change,) * 2)
        )
        fraction = jnp.clip(-jnp.sum((now.gap - now.level) * now.direction) / dk, 0, 1)
        length = jnp.where(now.steps % 2 == 0, dk / kk, dd / dk)  # Barzilai and Borwein's two, in turn
        p = jnp.maximum(now.pressure + fraction * now.direction, 0)
        return state(p, now.gap + fraction * change, jnp.clip(length, *lengths), now.steps + 1)

    def unfinished(now: _State) -> Array:
        return (now.residual > tolerance) & (now.steps < max_steps)

    first = state(start, apply(start) + offset, lengths[0], jnp.asarray(1))
    return jax.lax.while_loop(unfinished, step, first)


def _onto_simplex(p: Array) -> Array:
    """The nearest array that is >= 0 and sums to 1: max(p - t, 0), with t by Newton's method, which is exact in finitely many steps."""

    def newton(_: int, t: Array) -> Array:
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
