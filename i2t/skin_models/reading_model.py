"""Readings of one pad from contact pressure: a physical prior, a discrepancy, and both marginalised.

For small strain a reading is linear in the pressure on the skin (`i2t.skin_models.pressure_gp`) and in the pad's
magnetization, which is unknown (`i2t.skin_models.magnetization`). A touch t gives channel c, in units of that channel's
signal,

    y_c(t) = a Phi_c(t) . w + d_c(t) + e,    w ~ N(0, 1),    d_c ~ GP(0, r k),    e ~ N(0, v).

Phi_c(t) is the reading that each weight w of the magnetization gives under the pressure of t on a nominal pad. A few
presses determine w, and with it the response of the whole skin. The discrepancy d_c (Kennedy and O'Hagan, J. R. Stat.
Soc. B 63, 2001) is what the nominal pad does not explain: another layer, other chips, another physics. Its covariance k
is that of `i2t.skin_models.pressure_gp`; more touches determine more of it.

The skin's layer determines the pressures of a contact. The layer is chosen from LAYERS by the leave-one-out density of
the touches. The hyperparameters a, r and v are marginalised on a grid, each point weighted by that density
(pseudo-Bayesian model averaging; Gelfand and Dey, J. R. Stat. Soc. B 56, 1994), tempered, because channels and touches
share errors. For one load all of these models are linear in the pressure, and so is their mixture: a map for the mean
and a root for the variance, which includes the models' disagreement:

    mean = p . M_F,    variance = p' V_F p   (in units of each channel's signal) for the load F and the pressure p.

NumPy in double precision, on the host. n touches, c channels, x cells of 1 mm, k weights.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import groupby, product
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.linalg import cholesky, solve_triangular
from scipy.special import logsumexp
from threadpoolctl import threadpool_limits

from i2t.contact.pressure import ContactPressure
from i2t.leave_one_out import leave_out_blocks
from i2t.runtime.batching import map_batches, select_rows, usable_cores
from i2t.runtime.compiling import jit_quickly
from i2t.skin.elasticity import CELL_GRID
from i2t.skin.pad import NOMINAL_SKIN
from i2t.skin_models import magnetic_layer as physics
from i2t.skin_models import pressure_gp as gp
from i2t.skin_models.layer import MIN_LOAD_N, NOMINAL_LAYER, Layer
from i2t.skin_models.pressure_gp import GPHyperparameters
from i2t.types import Board, in_one_line

# N, loads at which touches are predicted; most presses that end at 25 uT end between the outer ones
LOADS_N = (0.3, 0.9, 2.7)
# Elastic layers from which a reading model chooses, from stiff to soft: Poisson's ratio and Young's modulus (Pa). At a
# Poisson's ratio of 0 a bonded layer yields most to a flat press.
LAYERS = tuple(
    Layer(poisson, factor * NOMINAL_SKIN.young)
    for poisson, factor in (
        (NOMINAL_SKIN.poisson, 1.7), (NOMINAL_SKIN.poisson, 1.0), (0.4, 1.0), (0.3, 1.0), (0.3, 0.6), (0.0, 0.6),
        (0.0, 0.35),
    )
)  # fmt: skip
# Default hyperparameters of the Gaussian process of the discrepancy between measured readings and physics; the five
# numbers are weights of its length scales (1.5 to 24 mm). They are near the medians of fits to 900 touches of a pad in
# six physics.
DISCREPANCY = GPHyperparameters(
    jnp.array([0.05, 0.75, 0.15, 0.03, 0.02]), bend=jnp.array(0.4), width=jnp.array(1.0), noise=jnp.array(0.0)
)


@dataclass(frozen=True)
class Averaging:
    """Grid of a reading model's hyperparameters (amplitude a, discrepancy r, noise v), and options of their average."""

    amplitudes: tuple[float, ...] = (0.4, 0.8, 1.6, 3.2)  # values of the amplitude a
    discrepancies: tuple[float, ...] = (0.02, 0.06, 0.2, 0.6, 1.8)  # values of the discrepancy r
    noises: tuple[float, ...] = (0.1, 0.2, 0.35, 0.6)  # values of the noise v
    middle: tuple[float, float, float] = (0.8, 0.2, 0.3)  # values of a, r and v at which layers are compared
    max_touches: int = 200  # largest number of touches that weigh layers and hyperparameters
    density_exponent: float = 0.3  # exponent of the leave-one-out density of all touches and channels together
    max_models: int = 6
    min_share: float = 0.02  # smallest share of a model, relative to the largest
    pooling_touches: float = 10.0  # number of prior touches for which all channels have equal signals
    # number of the largest eigenvalues kept in a variance's root; the rest is below a thousandth of it
    max_rank: int = 160


# grid of a reading model's amplitude a, discrepancy r and noise v, and options of their average
AVERAGING = Averaging()


class ReadingPrior(NamedTuple):
    """Prior assumptions about a pad's readings: layers to choose from, and hyperparameters of the discrepancy."""

    layers: Sequence[Layer] = LAYERS  # layers to choose from
    discrepancy: GPHyperparameters = DISCREPANCY  # hyperparameters of the discrepancy, whose noise is ignored


READING_PRIOR = ReadingPrior()  # elastic layers and discrepancy that are assumed before a pad is measured


@in_one_line
class LinearReadingModel(NamedTuple):
    """Model of a pad's readings (uT) at l loads (N), linear at each load in the contact pressure (N) on a layer."""

    loads: Float[Array, " l"]  # N, loads at which the model predicts
    mean: Float[Array, "l cells c"]  # uT per N on each cell of 1 mm
    root: Float[Array, "l cells rank"]  # root of the variance, relative to the square of a channel's signal
    scale: Float[Array, " c"]  # uT, root mean square of each channel's signal
    softness: Float[Array, ""]  # indentation of the pad divided by that of the layer
    layer: Layer = NOMINAL_LAYER


class PressedTouches(NamedTuple):
    """n touches of one pad: contact pressures (N) on an elastic layer, and their readings (uT)."""

    pressure: ContactPressure  # pressures of n touches on some layer
    reading: Float[np.ndarray, "n c"]  # uT


class FittedReadings(NamedTuple):
    """Fitted reading model of a pad, and its leave-one-out errors (uT, measured minus predicted) on the touches."""

    model: LinearReadingModel
    leave_one_out: Float[np.ndarray, "n c"]  # uT, measured minus predicted from all other touches


class _Hyperparameters(NamedTuple):
    """Hyperparameters, in the symbols of the module's formula."""

    a: float
    r: float
    v: float


class _System(NamedTuple):
    """Touches in the coordinates in which the discrepancy's covariance is diagonal."""

    discrepancy: GPHyperparameters
    values: Float[np.ndarray, " n"]  # eigenvalues of k
    vectors: Float[np.ndarray, "n n"]
    features: Float[np.ndarray, "n c k"]  # rotated features in units of the channels' signals
    reading: Float[np.ndarray, "n c"]  # rotated readings in units of the channels' signals
    scale: Float[np.ndarray, " c"]  # uT
    unit: Float[np.ndarray, " lengths"]  # N^2, mean variance of the touches for each length of k


class _Weighted(NamedTuple):
    """Touches weighted by the precision of discrepancy and noise, which does not depend on the amplitude `a`."""

    precision: Float[np.ndarray, " n"]  # precision of the weights in the system's coordinates
    vectors: Float[np.ndarray, "n n"]
    features: Float[np.ndarray, "n c k"]  # features in the touches' own coordinates
    square: Float[np.ndarray, "k k"]  # contribution of the touches to the weights' precision for a = 1
    towards: Float[np.ndarray, " k"]  # the weights' precision times their mean for a = 1


class _Posterior(NamedTuple):
    """Posterior of the magnetization's weights for one amplitude."""

    a: float
    factor: Float[np.ndarray, "k k"]  # lower Cholesky factor of the weights' precision
    mean: Float[np.ndarray, " k"]


class _Models(NamedTuple):
    """Models that differ only in their amplitude."""

    r: float
    precision: Float[np.ndarray, " n"]  # precision of the weights in the system's coordinates
    posteriors: Sequence[_Posterior]


# Matrices of a thousand rows are too small to share: waiting BLAS threads cost more than they gain. Instead, several
# hyperparameters are tried at a time.
_single_threaded = threadpool_limits.wrap(limits=1, user_api="blas")


def readings_at_loads(
    model: LinearReadingModel, newtons: Float[Array, "l cells"]
) -> tuple[Float[Array, "l c"], Float[Array, " l"]]:
    """Predict a pad's reading at each load of its model, for the contact pressure at that load.

    Args:
        model: Reading model of the pad.
        newtons: `(l, cells)` forces (N) on the cells at each load.

    Returns:
        `(l, c)` readings (uT), and `(l,)` variances relative to the square of a channel's signal.
    """
    reading = jnp.einsum("lx,lxc->lc", newtons, model.mean, precision="highest")
    return reading, jnp.sum(jnp.einsum("lx,lxr->lr", newtons, model.root, precision="highest") ** 2, axis=-1)


def interpolate_reading(
    reading: Float[Array, "l c"], variance: Float[Array, " l"], loads: Float[Array, " l"], force: Float[Array, ""]
) -> tuple[Float[Array, " c"], Float[Array, ""]]:
    """Interpolate or extrapolate a reading to any load.

    Readings per newton are linear in the logarithm of the load, up to one step between loads beyond the outer ones, and
    constant from there.

    Args:
        reading: `(l, c)` readings (uT) at the l `loads`.
        variance: `(l,)` variances at `loads`, relative to the square of a channel's signal.
        loads: `(l,)` ascending loads (N).
        force: The requested load (N); zero or less means no touch.

    Returns:
        `(c,)` reading (uT) and its relative variance, both zero without load.
    """
    i, step, newtons = load_step(loads, force)
    between = partial(interpolate, i, jnp.clip(step, -1.0, 2.0))
    at_force = jnp.exp(between(jnp.log(jnp.maximum(variance / loads**2, 1e-12)))) * newtons**2
    pressed = force > 0
    return (
        jnp.where(pressed, between(reading / loads[:, None]) * newtons, 0.0),
        jnp.where(pressed, at_force, 0.0),
    )


def load_step(
    loads: Float[Array, " l"], force: Float[Array, ""]
) -> tuple[Int[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """Locate a load among ascending loads, on a logarithmic scale, for interpolation.

    Args:
        loads: `(l,)` ascending loads (N).
        force: The load (N); it is replaced by the first of `loads` if it is not positive.

    Returns:
        Number i of the interval for the load; the logarithmic distance of the load from load i as a fraction of the
        interval, outside 0 to 1 beyond the outer loads; and the load (N).
    """
    at, knots = jnp.log(jnp.where(force > 0, force, loads[0])), jnp.log(loads)
    i = jnp.clip(jnp.searchsorted(knots, at) - 1, 0, len(loads) - 2)
    return i, (at - knots[i]) / (knots[i + 1] - knots[i]), jnp.exp(at)


def interpolate(i: Int[Array, ""], step: Float[Array, ""], values: Float[Array, "l ..."]) -> Float[Array, "..."]:
    """Interpolate linearly between values i and i + 1.

    Args:
        i: Number of the first value.
        step: Distance from the first value, as a fraction of the interval.
        values: `(l, ...)` values at all loads.

    Returns:
        The interpolated value, in the unit of `values`.
    """
    low, high = (
        jax.lax.dynamic_index_in_dim(values, i, keepdims=False),
        jax.lax.dynamic_index_in_dim(values, i + 1, keepdims=False),
    )
    return low + step * (high - low)


def read_pressure(
    model: LinearReadingModel, newtons: Float[Array, " cells"], load: Float[Array, ""]
) -> tuple[Float[Array, " c"], Float[Array, ""]]:
    """Predict a pad's reading under one contact pressure at any load.

    Args:
        model: Reading model of the pad.
        newtons: `(cells,)` forces (N) on the cells of 1 mm.
        load: Sum of these forces (N).

    Returns:
        `(c,)` reading (uT), and its variance relative to the square of a channel's signal.
    """
    share = newtons / jnp.maximum(load, MIN_LOAD_N)
    return interpolate_reading(*readings_at_loads(model, model.loads[:, None] * share[None]), model.loads, load)


@_single_threaded
def fit_readings(
    touches: PressedTouches,
    layer: Layer,
    board: Board,
    *,
    softness: float,
    discrepancy: GPHyperparameters = DISCREPANCY,
) -> FittedReadings:
    """Fit the reading model of a pad to its touches.

    Args:
        touches: n touches, pressed on the layer.
        layer: The layer that `choose_layer` chose.
        board: Board of the pad.
        softness: Indentation of the pad divided by that of the layer.
        discrepancy: Hyperparameters of the discrepancy's covariance.

    Returns:
        The model, and its `(n, c)` leave-one-out errors (uT).
    """
    maps = magnetization_maps(board, layer)
    models, shares = _weigh_hyperparameters(_subsample(touches), maps, discrepancy)
    system = _system(touches, maps, discrepancy)
    groups, errors = [], []
    with ThreadPoolExecutor(usable_cores()) as pool:
        for (r, v), some in groupby(models, lambda at: (at.r, at.v)):
            weighted = _weigh(system, r, v)
            posteriors = [_posterior(weighted, at.a) for at in some]
            errors += [error for error, _ in pool.map(partial(_leave_one_out, system, weighted), posteriors)]
            groups.append(_Models(r, weighted.precision, posteriors))
    held_out_errors = np.einsum("m,mnc->nc", shares, errors) * system.scale
    mean, variance = _linear_maps(touches.pressure, system, maps, groups, shares, LOADS_N)
    model = LinearReadingModel(
        loads=jnp.float32(LOADS_N),
        mean=jnp.float32(mean * system.scale),
        root=jnp.float32(_roots(variance)),
        scale=jnp.float32(system.scale),
        softness=jnp.float32(softness),
        layer=Layer(*(jnp.float32(part) for part in layer)),
    )
    return FittedReadings(model, held_out_errors)


@_single_threaded
def choose_layer(
    pressed: Sequence[PressedTouches],
    layers: Sequence[Layer],
    board: Board,
    discrepancy: GPHyperparameters = DISCREPANCY,
) -> int:
    """Choose the elastic layer under which a pad's touches have the largest leave-one-out density.

    Args:
        pressed: The same touches, pressed on each layer.
        layers: Layers to choose from.
        board: Board of the pad.
        discrepancy: Hyperparameters of the discrepancy's covariance.

    Returns:
        Index of the chosen layer.
    """
    middle, densities = _Hyperparameters(*AVERAGING.middle), []
    for touches, layer in zip(pressed, layers, strict=True):
        system = _system(_subsample(touches), magnetization_maps(board, layer), discrepancy)
        densities += _densities(system, middle.r, middle.v, [middle.a])
    return int(np.argmax(densities))


def magnetization_maps(board: Board, layer: Layer) -> Float[np.ndarray, "x c k"]:
    """Compute the readings of a newton on each cell, for each weight of a magnetization with prior variance 1.

    Args:
        board: Board of the pad; the depth of its chips is ignored.
        layer: Layer of the nominal pad, whose thickness is the prior's median.

    Returns:
        `(x, c, k)` readings per force (uT/N), for x cells of 1 mm, c channels and k weights.
    """
    chips, rotations = (np.asarray(part, np.float32) for part in board)
    return _maps(chips.tobytes(), rotations.tobytes(), float(layer.poisson), float(layer.young))


@lru_cache(maxsize=32)
def _maps(chips: bytes, rotations: bytes, poisson: float, young: float) -> np.ndarray:
    board = Board(
        np.frombuffer(chips, np.float32).reshape(-1, 3), np.frombuffer(rotations, np.float32).reshape(-1, 3, 3)
    )
    return np.asarray(_cell_features(board, jnp.float32(poisson), jnp.float32(young)), np.float64)


@jit_quickly
def _cell_features(board: Board, poisson: Array, young: Array) -> Float[Array, "x c k"]:
    layer = jax.tree.map(jnp.float32, physics.layer_prior(3 * len(board.chips)).median)
    pad = physics.make_pad(layer._replace(young=young), board)._replace(
        poisson=poisson, mount_compliance=jnp.float32(0)
    )
    cells, newtons = CELL_GRID.cells, 0.002  # so little that a reading is still linear in the force on one cell

    def design(cell: Array) -> Array:
        pressed = jnp.zeros(cells**2).at[cell].set(newtons / CELL_GRID.spacing**2)
        return physics.pressure_design(pad, pressed.reshape(cells, cells), CELL_GRID) / newtons

    designs = map_batches(design, jnp.arange(cells**2), batch_size=physics.DESIGN_BATCH)
    return physics.weight_features(layer, designs, CELL_GRID.window)


def _subsample(touches: PressedTouches) -> PressedTouches:
    """Take a random subset of the touches, the same in each call."""
    n = len(touches.reading)
    rows = np.sort(np.random.default_rng(0).permutation(n)[: AVERAGING.max_touches])
    return select_rows(touches, rows)


def _system(
    touches: PressedTouches, maps: Float[np.ndarray, "x c k"], discrepancy: GPHyperparameters = DISCREPANCY
) -> _System:
    reading = np.asarray(touches.reading, np.float64)
    square, prior = np.sum(reading**2, axis=0), AVERAGING.pooling_touches
    scale = np.sqrt((square + prior * square.mean() / len(reading)) / (len(reading) + prior)) + 1e-6
    covariance, unit = jax.device_get(_covariance(discrepancy, touches.pressure))
    values, vectors = np.linalg.eigh(covariance.astype(np.float64))
    newtons = np.asarray(touches.pressure.pressure, np.float64).reshape(len(reading), -1)
    features = np.tensordot(vectors.T @ newtons, maps, 1) / scale[:, None]
    return _System(discrepancy, np.maximum(values, 0.0), vectors, features, vectors.T @ (reading / scale), scale, unit)


_stiffening = jit_quickly(gp.stiffening)


@jit_quickly
def _covariance(
    discrepancy: GPHyperparameters, pressure: ContactPressure
) -> tuple[Float[Array, "n n"], Float[Array, " lengths"]]:
    """Compute the discrepancy's covariance between touches, and the mean variances it is relative to (N^2)."""
    linear = gp.inner_products(f := gp.features(pressure), f)
    unit = jnp.mean(jnp.diagonal(linear, axis1=1, axis2=2), axis=1)
    return gp.gram(discrepancy, unit, linear, pressure.load, pressure.load), unit


def _weigh(system: _System, r: float, v: float) -> _Weighted:
    precision = 1 / (r * system.values + v)
    vectors, k = system.vectors * precision, system.features.shape[-1]
    features = (vectors @ system.features.reshape(len(vectors), -1)).reshape(system.features.shape)
    rows = (np.sqrt(precision)[:, None, None] * system.features).reshape(-1, k)
    towards = np.tensordot(system.features, precision[:, None] * system.reading, ((0, 1), (0, 1)))
    return _Weighted(precision, vectors, features, rows.T @ rows, towards)


def _posterior(weighted: _Weighted, a: float) -> _Posterior:
    factor = cholesky(a**2 * weighted.square + np.eye(len(weighted.square)), lower=True)
    half = solve_triangular(factor, a * weighted.towards, lower=True)
    return _Posterior(a, factor, solve_triangular(factor, half, lower=True, trans="T"))


def _leave_one_out(
    system: _System, weighted: _Weighted, posterior: _Posterior
) -> tuple[Float[np.ndarray, "n c"], float]:
    """Compute leave-one-out errors, in units of the channels' signals, and their log density."""
    n, c, k = weighted.features.shape
    alpha = weighted.vectors @ system.reading - posterior.a * (weighted.features @ posterior.mean)
    own = np.sum(weighted.vectors * system.vectors, axis=1)
    half = posterior.a * solve_triangular(posterior.factor, weighted.features.reshape(-1, k).T, lower=True)
    half = half.T.reshape(n, c, k)
    block = own[:, None, None] * np.eye(c) - np.einsum("nck,ndk->ncd", half, half, optimize=True)
    held_out = leave_out_blocks(block, alpha[..., None])
    return held_out.error[..., 0], float(np.sum(held_out.log_density) - n * np.sum(np.log(system.scale)))


def _densities(system: _System, r: float, v: float, amplitudes: Sequence[float]) -> list[float]:
    """Compute the leave-one-out log density of the touches for each amplitude."""
    weighted = _weigh(system, r, v)
    return [_leave_one_out(system, weighted, _posterior(weighted, a))[1] for a in amplitudes]


def _weigh_hyperparameters(
    touches: PressedTouches, maps: Float[np.ndarray, "x c k"], discrepancy: GPHyperparameters
) -> tuple[list[_Hyperparameters], Float[np.ndarray, " m"]]:
    """Select the most probable points of the grid, ordered by r and v, with their shares."""
    system, grid = _system(touches, maps, discrepancy), AVERAGING
    points = [_Hyperparameters(a, r, v) for r, v, a in product(grid.discrepancies, grid.noises, grid.amplitudes)]
    with ThreadPoolExecutor(usable_cores()) as pool:
        pairs = product(grid.discrepancies, grid.noises)
        densities = pool.map(lambda at: _densities(system, at[0], at[1], grid.amplitudes), pairs)
        log_share = grid.density_exponent * np.concatenate(list(densities))
    share = np.exp(log_share - logsumexp(log_share))
    kept = sorted(i for i in np.argsort(-share)[: grid.max_models] if share[i] >= grid.min_share * share.max())
    return [points[i] for i in kept], share[kept] / share[kept].sum()


def _linear_maps(
    pressure: ContactPressure,
    system: _System,
    maps: Float[np.ndarray, "x c k"],
    groups: Sequence[_Models],
    shares: Float[np.ndarray, " m"],
    loads: Sequence[float],
) -> tuple[Float[np.ndarray, "l x c"], Float[np.ndarray, "l x x"]]:
    """Compute mean maps and variances at some loads, in units of the channels' signals."""
    channels, k = maps.shape[1:]
    prior, cross = _cell_covariances(pressure, system)
    scaled = maps / system.scale[:, None]

    def at_load(factor: Float[np.ndarray, " n"]) -> tuple[np.ndarray, np.ndarray]:
        towards = (cross * factor) @ system.vectors  # (x, n), in the system's coordinates
        mean, variance = [], []
        for r, precision, posteriors in groups:
            gain = r * towards * precision
            left = scaled - np.tensordot(gain, system.features, 1)
            own = r * (prior - towards @ gain.T)
            for a, root, weights in posteriors:
                mean.append(a * (left @ weights) + gain @ system.reading)
                half = a * solve_triangular(root, left.reshape(-1, k).T, lower=True).reshape(k, -1, channels)
                variance.append(own + np.tensordot(half, half, ((0, 2), (0, 2))) / channels)
        middle = np.einsum("m,mxc->xc", shares, mean)
        apart = np.stack(mean) - middle
        spread = np.einsum("m,mxc,mzc->xz", shares, apart, apart, optimize=True) / channels
        return middle, np.einsum("m,mxz->xz", shares, variance) + spread

    factors = np.asarray(_stiffening(system.discrepancy, jnp.float32(loads), pressure.load), np.float64)
    with ThreadPoolExecutor(usable_cores()) as pool:
        means, variances = zip(*pool.map(at_load, factors), strict=True)
    return np.stack(means), np.stack(variances)


def _cell_covariances(
    pressure: ContactPressure, system: _System
) -> tuple[Float[np.ndarray, "x x"], Float[np.ndarray, "x n"]]:
    """Compute the discrepancy's covariance between newtons on two cells, and between newtons on a cell and touches, at
    one load.
    """
    weights = np.asarray(system.discrepancy.weights / system.unit, np.float64)
    root = gp.kernel_factor(pressure.pressure.shape[-1]).astype(np.float64)
    axis = np.einsum("lij,ljk->lik", root, root)  # the kernel along one axis, for each length scale
    newtons = np.asarray(pressure.pressure, np.float64)
    blurred = np.einsum("lij,njk,lmk->lnim", axis, newtons, axis, optimize=True).reshape(len(axis), len(newtons), -1)
    prior = sum(w * np.kron(a, a) for w, a in zip(weights, axis, strict=True))
    return np.asarray(prior), np.einsum("l,lnx->xn", weights, blurred)


def _roots(variance: Float[np.ndarray, "l x x"]) -> Float[np.ndarray, "l x rank"]:
    """Compute the roots of variances."""
    values, vectors = np.linalg.eigh((variance + variance.swapaxes(1, 2)) / 2)
    return (vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :])[:, :, -AVERAGING.max_rank :]
