"""Motion of an elastic layer bonded to a rigid base under loads on its surface.

The layer (thickness h, Young's modulus E, Poisson's ratio nu, small strain) fills -h <= z <= 0 of the tool frame. Loads
act on its surface z = 0 and only on the cells of the pad: a pressure p pushes it down, a traction t drags it along x
and y. Loads are Fourier series, and every wave of wavenumber k moves independently. The general solution of Navier's
equation that vanishes at the base is (Papkovich-Neuber potentials), with q = k (h - depth),

    u_z = W f,   (u_x, u_y) = (d/dx, d/dy) U f / k,   W - dU/dq = (kappa + 1) (a sinh q + b cosh q),
    W = a (kappa sinh q - q cosh q) - b q sinh q,   U = -a q sinh q - b (kappa sinh q + q cosh q),

where kappa = 3 - 4 nu, and the two loads determine a and b at the surface, q = Q = k h. With mu = E / (2 (1 + nu)) and
D = kappa cosh 2Q + 2 Q^2 + 5 - 12 nu + 8 nu^2:

    pressure,               f = p:           -2 mu k D (a, b) = ((kappa + 1) cosh Q + 2 Q sinh Q,
                                                                 (kappa - 1) sinh Q - 2 Q cosh Q)
    traction along the wave, f = div t / k:   2 mu k D (a, b) = ((kappa - 1) sinh Q + 2 Q cosh Q,
                                                                 (kappa + 1) cosh Q - 2 Q sinh Q)

Traction across the wave shears the layer like a stack of plates, u = t sinh q / (mu k cosh Q). At the surface the
pressure's W gives

    G(k) = (1 - nu) / (mu k) [kappa sinh 2Q - 2Q] / D,   G(0) = h (1 + nu)(1 - 2 nu) / (E (1 - nu)),

and the other surface compliances simplify likewise, without differences of large numbers:
(kappa + 1) (kappa sinh Q cosh Q + Q) / (2 mu k D) for a traction along the wave, tanh Q / (mu k) across it, and
(kappa (kappa - 1) sinh^2 Q - 2 Q^2) / (2 mu k^2 D) from the pressure's slope to the motion along it.

All functions are written with decaying exponentials, so that nothing overflows.

A skin that is clamped at its edge, not bonded, also moves as a whole. One shape, w = cos^2(pi x / L) cos^2(pi y / L)
over the pad's edge L (1 in the middle, flat and at rest at the clamped rim: the usual Ritz shape of a clamped plate),
sinks by `Pad.mount_compliance` times its load, the sum of w p over the pad. The material turns with its slope.

The Fourier series has a longer period than the pad, so that its copies do not affect each other. Beyond the pad the
layer continues: the free side faces of a real pad are not modelled (`docs/physics.md`). The series is written in real
sines and cosines about the pad's centre. Its transforms are small matrix products, which at this size are as fast as an
FFT, can be evaluated anywhere, and run well on every device.

Arrays over the pad have row i along tool y and column j along tool x, at cell centres. Metres, pascals, newtons.
"""

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from i2t.patches.dimensions import PAD_WINDOW
from i2t.types import Pad

# Products in full float32, because some devices otherwise round the factors to 10 bits.
_dot = partial(jnp.matmul, precision=jax.lax.Precision.HIGHEST)


@dataclass(frozen=True)
class Grid:
    """Square cells on the pad, and the Fourier series of a longer period around it.

    Example:
        grid = i2t.Grid()
        height = (grid.centres[:, None] ** 2 + grid.centres[None, :] ** 2) / (2 * 8e-3)  # m, a ball of 8 mm radius
        pressed = i2t.press(i2t.nominal_pad(), height, 0.3e-3, grid=grid)
    """

    cells: int = 40  # number of cells along each edge of the pad
    modes: int = 64  # number of cells along each edge of the period; even, as is `cells`
    window: float = PAD_WINDOW  # m, edge of the pad

    @property
    def spacing(self) -> float:
        """Edge (m) of a cell."""
        return self.window / self.cells

    @property
    def centres(self) -> np.ndarray:
        """Coordinates (cells,) of the cell centres along either edge (m)."""
        return ((np.arange(self.cells) + 0.5) / self.cells - 0.5) * self.window

    @property
    def wavenumbers(self) -> np.ndarray:
        """Wavenumbers (modes,) in 1/m, cosines 0 ... modes/2 - 1, then sines 1 ... modes/2, about the pad's centre."""
        half = self.modes // 2
        return 2 * np.pi / (self.modes * self.spacing) * np.r_[0:half, 1 : half + 1]


GRID = Grid()  # default grid of cells on the skin, of 0.5 mm
# grid of 1 mm cells on the skin, for the pressures of many contacts, which need not be fine
CELL_GRID = Grid(cells=20, modes=32)
# grid of 0.25 mm cells on the skin for sharp edges, if they matter more than speed; see `docs/physics.md`
FINE_GRID = Grid(cells=80, modes=128)


class Load(NamedTuple):
    """Load on the skin for `interior`: Fourier series of pressure (Pa), its slopes and traction, and the sinking (m).

    Rows of coefficients are waves along y, columns waves along x.
    """

    slopes: Float[Array, "2 k k"]  # Pa/m, slopes of the pressure along x and y
    pressure: Float[Array, "k k"]  # Pa
    centre_sinking: Float[Array, ""]  # m, depth by which the middle of a skin clamped at its edge sinks
    traction_waves: "TractionWaves | None" = None  # waves of the traction; None without traction


class TractionWaves(NamedTuple):
    """Fourier series of a traction (Pa) on the skin: its waves, their lengthwise parts, divergence and curl (Pa/m)."""

    traction: Float[Array, "2 k k"]  # Pa, traction along x and y of each wave
    lengthwise: Float[Array, "2 k k"]  # Pa, component of each wave along its wave vector
    divergence: Float[Array, "k k"]  # Pa/m, divergence of each wave
    curl: Float[Array, "k k"]  # Pa/m, curl of each wave about z


def load(
    pad: Pad,
    pressure: Float[Array, "n n"],
    traction: Float[Array, "2 n n"] | None = None,
    grid: Grid = GRID,
    series: Grid | None = None,
) -> Load:
    """Convert a pressure and a traction on the skin to coefficients of a Fourier series.

    Args:
        pad: The skin.
        pressure: `(n, n)` pressure (Pa) on the cells of `grid`.
        traction: `(2, n, n)` traction (Pa) along x and y on the skin, if any.
        grid: Cells of the pad.
        series: A coarser grid of the same period, whose waves are kept; by default all waves of `grid`.

    Returns:
        The load, ready for `interior`.
    """
    series = grid if series is None else series
    waves = spectrum(pressure, grid, series)
    slopes = jnp.stack([_slope(waves, 1, series), _slope(waves, 0, series)])
    sinking = pad.mount_compliance * clamped_load(pressure, grid)
    return Load(
        slopes, waves, sinking, None if traction is None else traction_waves(spectrum(traction, grid, series), series)
    )


def traction_waves(traction: Float[Array, "2 k k"], grid: Grid = GRID) -> TractionWaves:
    """Split a traction's Fourier series into the parts along and across each wave.

    Args:
        traction: `(2, k, k)` coefficients (Pa) of the traction along x and y, for k = `modes` waves along each edge.
        grid: Grid of the series.

    Returns:
        The traction, its lengthwise part, its divergence and its curl, as coefficients.
    """
    k = grid.wavenumbers
    square = k[:, None] ** 2 + k[None, :] ** 2
    inverse = 1 / np.where(square == 0, np.inf, square)
    along_x, along_y = (_slope(traction[i], axis, grid) for i, axis in enumerate((1, 0)))
    across_x, across_y = (_slope(traction[i], axis, grid) for i, axis in enumerate((0, 1)))
    # k (k . t) / k^2; second derivatives mix sines and cosines only if they are along different axes.
    mixed = [_slope(slope, axis, grid) for slope, axis in ((across_y, 0), (across_x, 1))]
    lengthwise = jnp.stack([
        inverse * (k[None, :] ** 2 * traction[0] - mixed[0]),
        inverse * (k[:, None] ** 2 * traction[1] - mixed[1]),
    ])  # fmt: skip
    return TractionWaves(traction, lengthwise, along_x + along_y, across_y - across_x)


def interior(
    pad: Pad,
    load: Load,
    depth: Float[Array, ""] | float,
    grid: Grid = GRID,
    coordinates: np.ndarray | None = None,
) -> tuple[Float[Array, "3 m m"], Float[Array, "3 m m"]]:
    """Compute the displacement and local rotation of the layer at one depth under a load.

    Args:
        pad: The skin.
        load: Load on its surface, as coefficients of the series of `grid`.
        depth: Depth (m), from 0 at the surface to the layer's thickness at the base.
        grid: Grid of the series.
        coordinates: `(m,)` coordinates (m from the pad's centre) of rows (y) and columns (x) of the points; by default
            the cell centres.

    Returns:
        `(3, m, m)` displacement (m) and `(3, m, m)` rotation (rad), components along tool x, y and z. The rotation is
        the vector curl(u) / 2, with a z component only under a traction.
    """
    coordinates = grid.centres if coordinates is None else coordinates
    along, down, turn = _under_pressure(pad, grid, depth)
    move = [along * load.slopes[0], along * load.slopes[1], down * load.pressure]
    rotate = [turn * load.slopes[1], -turn * load.slopes[0]]
    if load.traction_waves is not None:
        lengthwise, across, down, turn, bend = _under_traction(pad, grid, depth)
        traction, part = load.traction_waves.traction, load.traction_waves.lengthwise
        for i in range(2):
            move[i] = move[i] + across * (traction[i] - part[i]) + lengthwise * part[i]
        move[2] = move[2] + down * load.traction_waves.divergence
        leaning = [turn * part[i] + bend * (traction[i] - part[i]) for i in range(2)]
        rotate = [rotate[0] - leaning[1], rotate[1] + leaning[0], across * load.traction_waves.curl / 2]
    moved = evaluate(jnp.stack([*move, *rotate]), grid, coordinates)
    displacement, rotation = moved[:3], moved[3:]
    if load.traction_waves is None:
        rotation = jnp.concatenate([rotation, jnp.zeros_like(rotation[:1])])

    # The sinking skin is a thin plate: normals stay normals about the middle of its thickness.
    shape, slope = (jnp.asarray(part, displacement.dtype) for part in _clamped(grid, coordinates))
    tilt_x, tilt_y = (-load.centre_sinking * jnp.outer(*pair) for pair in ((shape, slope), (slope, shape)))
    above = pad.thickness / 2 - depth
    sinking = jnp.stack([-above * tilt_x, -above * tilt_y, -load.centre_sinking * jnp.outer(shape, shape)])
    return displacement + sinking, rotation + jnp.stack([tilt_y, -tilt_x, jnp.zeros_like(tilt_x)])


def compliance(pad: Pad, grid: Grid = GRID) -> Float[Array, "k k"]:
    """Compute the layer's normal compliance at the grid's wavenumbers: downward displacement per pressure.

    Args:
        pad: The skin.
        grid: Grid of the series.

    Returns:
        `(modes, modes)` compliance (m/Pa).
    """
    layer = _layer(pad, grid)
    flat = pad.thickness * (1 + pad.poisson) * (1 - 2 * pad.poisson) / (pad.young * (1 - pad.poisson))
    wavy = 2 * layer.kappa * layer.sinh * layer.cosh - 2 * layer.q * layer.fall
    wavy = (1 - pad.poisson) / (layer.shear * layer.k) * wavy / layer.determinant
    return jnp.where(layer.uniform, flat, wavy)


def tangential_compliance(pad: Pad, grid: Grid = GRID) -> tuple[Float[Array, "k k"], Float[Array, "k k"]]:
    """Compute the layer's tangential compliance: displacement of its surface along the skin per traction.

    Args:
        pad: The skin.
        grid: Grid of the series.

    Returns:
        `(modes, modes)` compliances (m/Pa) for the parts of the traction along and across each wave.
    """
    layer = _layer(pad, grid)
    modulus = layer.shear * layer.k
    lengthwise = (layer.kappa + 1) * (layer.kappa * layer.sinh * layer.cosh + layer.q * layer.fall)
    across = jnp.where(layer.uniform, pad.thickness / layer.shear, layer.sinh / (modulus * layer.cosh))
    return lengthwise / (2 * modulus * layer.determinant), across


def tangential_displacement(pad: Pad, pressure: Float[Array, "n n"], grid: Grid = GRID) -> Float[Array, "2 n n"]:
    """Compute the displacement of the skin's surface along x and y under a pressure alone.

    Args:
        pad: The skin.
        pressure: `(n, n)` pressure (Pa).
        grid: Cells of the pad.

    Returns:
        `(2, n, n)` displacement (m) along x and y.
    """
    layer = _layer(pad, grid)
    along = layer.kappa * (layer.kappa - 1) * layer.sinh**2 - 2 * layer.q**2 * layer.fall
    waves = spectrum(pressure, grid) * along / (2 * layer.shear * layer.k**2 * layer.determinant)
    return evaluate(jnp.stack([_slope(waves, 1, grid), _slope(waves, 0, grid)]), grid)


def clamped_load(pressure: Float[Array, "n n"], grid: Grid = GRID) -> Float[Array, ""]:
    """Compute the load on a skin clamped at its edge: the pressure, weighted by the shape in which the skin sinks.

    Args:
        pressure: `(n, n)` pressure (Pa).
        grid: Cells of the pad.

    Returns:
        The load (N).
    """
    return jnp.sum(clamped_shape(grid, pressure.dtype) * pressure) * grid.spacing**2


def clamped_shape(grid: Grid, dtype: jnp.dtype) -> Float[Array, "n n"]:
    """Compute the shape w in which a skin clamped at its edge sinks, at the cell centres.

    Args:
        grid: Cells of the pad.
        dtype: Data type of the result.

    Returns:
        `(n, n)` values of w, 1 in the middle and 0 at the edge.
    """
    shape, _ = _clamped(grid, grid.centres)
    return jnp.asarray(np.outer(shape, shape), dtype)


def spectrum(
    pressure: Float[Array, "... n n"], grid: Grid = GRID, series: Grid | None = None
) -> Float[Array, "... k k"]:
    """Compute the coefficients of the Fourier series that equals a pressure on the pad's cells and zero elsewhere.

    Args:
        pressure: `(..., n, n)` pressure (Pa), or any other density.
        grid: Cells of the pad.
        series: A coarser grid of the same period, whose waves are kept; by default all waves of `grid`.

    Returns:
        `(..., modes, modes)` coefficients in the unit of `pressure`, rows along y.
    """
    series = grid if series is None else series
    waves = basis(series, grid.centres)[0] * _weights(grid, series)[:, None]
    return _product(waves, pressure, waves)


def evaluate(
    waves: Float[Array, "... k k"], grid: Grid = GRID, coordinates: np.ndarray | None = None
) -> Float[Array, "... m m"]:
    """Evaluate a Fourier series over the pad at points.

    Args:
        waves: `(..., modes, modes)` coefficients of the series.
        grid: Grid of the series.
        coordinates: `(m,)` coordinates (m from the pad's centre) of rows (y) and columns (x) of the points; by default
            the cell centres.

    Returns:
        `(..., m, m)` values at the points in the unit of `waves`, rows along tool y.
    """
    values, _ = basis(grid, grid.centres if coordinates is None else coordinates)
    return _product(values.T, waves, values.T)


def convolve(kernel: Float[Array, "k k"], pressure: Float[Array, "n n"], grid: Grid = GRID) -> Float[Array, "n n"]:
    """Multiply each wave of a pressure by a kernel, and evaluate the series on the pad's cells.

    Args:
        kernel: `(modes, modes)` factors, one for each wave, such as `compliance` (m/Pa).
        pressure: `(n, n)` pressure (Pa).
        grid: Cells of the pad.

    Returns:
        `(n, n)` values at the cell centres, in units of kernel times pressure.
    """
    return evaluate(kernel * spectrum(pressure, grid), grid)


def basis(grid: Grid, coordinates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Evaluate the waves of the grid's Fourier series along one axis.

    Args:
        grid: Grid of the series.
        coordinates: `(m,)` coordinates along the axis (m from the pad's centre).

    Returns:
        `(modes, m)` values, and `(modes, m)` slopes (1/m).
    """
    k = grid.wavenumbers[:, None]
    cosine, sine = np.cos(k * coordinates[None]), np.sin(k * coordinates[None])
    even = np.arange(grid.modes)[:, None] < grid.modes // 2
    return np.where(even, cosine, sine), k * np.where(even, -sine, cosine)


def half_waves(grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """Evaluate the waves of the grid's Fourier series along one axis at the cells of its positive half, by parity.

    Args:
        grid: Grid of cells and waves.

    Returns:
        `(2, modes / 2, cells / 2)` values of cosines and sines, and the same times the weights in `spectrum`.
    """
    waves = basis(grid, grid.centres[grid.cells // 2 :])[0].reshape(2, grid.modes // 2, grid.cells // 2)
    return waves, waves * _weights(grid, grid).reshape(2, grid.modes // 2, 1)


def _weights(grid: Grid, series: Grid) -> np.ndarray:
    """Compute the weight (modes,) of each wave of `series` in the coefficients of the series of `grid`."""
    k = series.wavenumbers
    lone = (k == 0) | (k == np.max(grid.wavenumbers))  # constant and shortest waves have no partner of their wavenumber
    return np.where(lone, 1, 2) / grid.modes


def _slope(waves: Array, axis: int, grid: Grid) -> Array:
    """Compute the coefficients of the derivative along y (axis 0) or x (axis 1). The shortest wave is left out: the
    series has no partner for its slope, which vanishes at the cell centres.
    """
    half = grid.modes // 2
    none, cosines, sines, last = jnp.split(waves, [1, half, grid.modes - 1], axis=axis)
    k = np.expand_dims(grid.wavenumbers[1:half], 1 - axis)
    return jnp.concatenate([jnp.zeros_like(none), k * sines, -k * cosines, jnp.zeros_like(last)], axis=axis)


def _clamped(grid: Grid, coordinates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute cos^2(pi x / L) at `coordinates`, constant outside the pad, and its slope (1/m)."""
    turn = np.pi * np.clip(coordinates / grid.window, -0.5, 0.5)
    return np.cos(turn) ** 2, -np.pi / grid.window * np.sin(2 * turn)


class _Layer(NamedTuple):
    """Parts of the layer's response to each wave; sinh and cosh of q contain exp(-q), the determinant exp(-2q)."""

    kappa: Array
    shear: Array
    k: Array  # 1/m, wave number, with 1 / h in place of zero
    uniform: Array  # True for the wave k = 0
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
    return _Layer(
        kappa=kappa,
        shear=pad.young / (2 * (1 + pad.poisson)),
        k=safe,
        uniform=uniform,
        q=q,
        fall=fall,
        sinh=sinh,
        cosh=cosh,
        determinant=determinant,
    )


class _Height(NamedTuple):
    """q, sinh q and cosh q at some height above the base. Both functions contain exp(-Q), like a and b, and D contains
    its square, so that all these factors cancel.
    """

    above: Array  # m, distance above the layer's base
    q: Array
    sinh: Array
    cosh: Array


def _height(pad: Pad, layer: _Layer, depth: Array | float) -> _Height:
    above = pad.thickness - depth
    rise, fall = jnp.exp(-layer.k * (pad.thickness - above)), jnp.exp(-layer.k * (pad.thickness + above))
    return _Height(above, layer.k * above, (rise - fall) / 2, (rise + fall) / 2)


def _under_pressure(pad: Pad, grid: Grid, depth: Array | float) -> tuple[Array, Array, Array]:
    """Compute, for each wave, the displacement along x (y) and the rotation per slope of the pressure, and the
    displacement along z per pressure: along, down, turn.
    """
    layer = _layer(pad, grid)
    at = _height(pad, layer, depth)
    over = 1 / (2 * layer.shear * layer.k * layer.determinant)
    a = -over * ((layer.kappa + 1) * layer.cosh + 2 * layer.q * layer.sinh)
    b = -over * ((layer.kappa - 1) * layer.sinh - 2 * layer.q * layer.cosh)
    flat = -at.above * (1 + pad.poisson) * (1 - 2 * pad.poisson) / (pad.young * (1 - pad.poisson))
    along = (-a * at.q * at.sinh - b * (layer.kappa * at.sinh + at.q * at.cosh)) / layer.k  # flat has no slope
    down = jnp.where(layer.uniform, flat, a * (layer.kappa * at.sinh - at.q * at.cosh) - b * at.q * at.sinh)
    turn = (layer.kappa + 1) * (a * at.sinh + b * at.cosh) / 2
    return along, down, turn


def _under_traction(pad: Pad, grid: Grid, depth: Array | float) -> tuple[Array, Array, Array, Array, Array]:
    """Compute, for each wave: the displacement along its traction, for the parts along and across it; the displacement
    along z per divergence; the rotation about the axis perpendicular to the traction, for both parts.
    """
    layer = _layer(pad, grid)
    at = _height(pad, layer, depth)
    over = 1 / (2 * layer.shear * layer.k * layer.determinant)
    a = over * ((layer.kappa - 1) * layer.sinh + 2 * layer.q * layer.cosh)
    b = over * ((layer.kappa + 1) * layer.cosh - 2 * layer.q * layer.sinh)
    lengthwise = a * at.q * at.sinh + b * (layer.kappa * at.sinh + at.q * at.cosh)
    across = jnp.where(layer.uniform, at.above / layer.shear, at.sinh / (layer.shear * layer.k * layer.cosh))
    down = (a * (layer.kappa * at.sinh - at.q * at.cosh) - b * at.q * at.sinh) / layer.k
    turn = (layer.kappa + 1) * (a * at.sinh + b * at.cosh) * layer.k / 2
    bend = jnp.where(layer.uniform, 0.5 / layer.shear, at.cosh / (2 * layer.shear * layer.cosh))
    return lengthwise, across, down, turn, bend


def _product(left: Array | np.ndarray, middle: Array, right: Array | np.ndarray) -> Array:
    """Compute left @ middle @ right.T, each product over the last axis, which is fastest in a batch."""
    dtype = middle.dtype
    rows = _dot(middle, jnp.asarray(right.T, dtype)).swapaxes(-1, -2)
    return _dot(rows, jnp.asarray(left.T, dtype)).swapaxes(-1, -2)
