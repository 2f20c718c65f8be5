"""Readings of one pad from contact pressure: a physical prior, a discrepancy, and both marginalised.

For small strain a reading is linear in the pressure on the skin (`i2t.skin_models.pressure_gp`) and in what a pad
hides, its magnetization (`i2t.skin_models.magnetization`). A touch t gives channel c, in units of that channel's
signal,

    y_c(t) = a Phi_c(t) . w + d_c(t) + e,    w ~ N(0, 1),    d_c ~ GP(0, r k),    e ~ N(0, v).

Phi_c(t) is the reading that each weight w of the magnetization gives under the pressure of t on a nominal pad: a few
presses tell w, and with it the response of all of the skin. The discrepancy d_c (Kennedy and O'Hagan, J. R. Stat. Soc.
B 63, 2001) is what the nominal pad leaves: another layer, other chips, another physics. Its covariance k is that of
`i2t.skin_models.pressure_gp`, and the more touches there are, the more of it is learnt.

The skin's layer decides which pressures a contact has; the one of LAYERS is taken under which touches are most probable
as predicted from all others. The hyperparameters a, r and v are marginalised on a grid, each weighted by that density
(pseudo-Bayesian model averaging; Gelfand and Dey, J. R. Stat. Soc. B 56, 1994), tempered, as channels and touches share
errors. For one load all of these models are linear in the pressure, and so is their mixture: a map for the mean and a
root for the variance, which holds the models' disagreement too:

    mean = p . M_F,    variance = p' V_F p   (in units of each channel's signal) for the load F and the pressure p.

NumPy in double precision, on the host. n touches, c channels, x cells of 1 mm, k weights.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
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
from i2t.skin.pad import POISSON_RATIO, YOUNG_PA
from i2t.skin_models import magnetic_layer as physics
from i2t.skin_models import pressure_gp as gp
from i2t.skin_models.layer import MIN_LOAD_N, NOMINAL_LAYER, Layer
from i2t.skin_models.pressure_gp import GPHyperparameters
from i2t.types import Board, in_one_line

LOADS_N = (0.3, 0.9, 2.7)  # most presses to 25 uT end between the outer ones
# From stiff to soft: Poisson's ratio and Young's modulus (Pa). At nu = 0 a bonded layer yields most to a flat press.
LAYERS = tuple(
    Layer(poisson, factor * YOUNG_PA)
    for poisson, factor in (
        (POISSON_RATIO, 1.7), (POISSON_RATIO, 1.0), (0.4, 1.0), (0.3, 1.0), (0.3, 0.6), (0.0, 0.6), (0.0, 0.35),
    )
)  # fmt: skip
# Of the discrepancy: about the medians of fits to 900 touches of a pad in six physics.
DISCREPANCY = GPHyperparameters(
    jnp.array([0.05, 0.75, 0.15, 0.03, 0.02]), bend=jnp.array(0.4), width=jnp.array(1.0), noise=jnp.array(0.0)
)
AMPLITUDES = (0.4, 0.8, 1.6, 3.2)  # a
DISCREPANCIES = (0.02, 0.06, 0.2, 0.6, 1.8)  # r
NOISES = (0.1, 0.2, 0.35, 0.6)  # v
MIDDLE = (0.8, 0.2, 0.3)  # with which layers are compared
CHOOSING_TOUCHES = 200  # with which layers and hyperparameters are weighed
DENSITY_EXPONENT = 0.3  # of the left-out density of all touches and channels together
MAX_MODELS, MIN_SHARE = 6, 0.02  # of the mixture: how many are kept, and the least share
POOLING_TOUCHES = 10.0  # touches' worth of belief that all channels have signals alike
UNIT_N = 0.002  # on one cell, where a reading is still linear in it
RANK = 160  # of a variance's root, the largest eigenvalues: the rest is below a per mille of it


class ReadingPrior(NamedTuple):
    """Assumptions about a pad that come from other pads and other physics."""

    layers: Sequence[Layer] = LAYERS  # to choose among
    discrepancy: GPHyperparameters = DISCREPANCY  # its noise does not count


READING_PRIOR = ReadingPrior()


@in_one_line
class LinearReadingModel(NamedTuple):
    """A pad's reading model at a few loads, where it is linear in the pressure on a layer."""

    loads: Float[Array, " l"]  # N
    mean: Float[Array, "l cells c"]  # uT per N on each cell of 1 mm
    root: Float[Array, "l cells rank"]  # of the variance, relative to the square of a channel's signal
    scale: Float[Array, " c"]  # uT, root mean square of each channel's signal
    softness: Float[Array, ""]  # indentation of the pad over that of the layer
    layer: Layer = NOMINAL_LAYER


class PressedTouches(NamedTuple):
    """Touches of one pad."""

    pressure: ContactPressure  # on some layer, n of them
    reading: Float[np.ndarray, "n c"]  # uT


class FittedReadings(NamedTuple):
    """Reading model of a pad, and how far off it is on touches left out."""

    model: LinearReadingModel
    left_out: Float[np.ndarray, "n c"]  # uT, measured minus predicted from all others


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
    features: Float[np.ndarray, "n c k"]  # rotated, in units of the channels' signals
    reading: Float[np.ndarray, "n c"]  # likewise
    scale: Float[np.ndarray, " c"]  # uT
    unit: Float[np.ndarray, " lengths"]  # N^2, per length of k the mean variance of the touches


class _Weighted(NamedTuple):
    """Touches weighted by the precision of discrepancy and noise, which no amplitude `a` changes."""

    precision: Float[np.ndarray, " n"]  # in the system's coordinates
    vectors: Float[np.ndarray, "n n"]
    features: Float[np.ndarray, "n c k"]  # of the touches themselves
    square: Float[np.ndarray, "k k"]  # what touches add to the weights' precision where `a` is 1
    towards: Float[np.ndarray, " k"]  # the weights' precision times their mean there


class _Posterior(NamedTuple):
    """Weights of the magnetization under some amplitude."""

    a: float
    factor: Float[np.ndarray, "k k"]  # lower Cholesky factor of the weights' precision
    mean: Float[np.ndarray, " k"]


class _Models(NamedTuple):
    """Models that differ in their amplitude alone."""

    r: float
    precision: Float[np.ndarray, " n"]  # as of `_Weighted`
    posteriors: Sequence[_Posterior]


# Factors of a thousand rows are too small to share: threads that wait in BLAS cost more than they give, and several
# hyperparameters are tried at a time instead.
_one_thread_each = threadpool_limits.wrap(limits=1, user_api="blas")


def readings_at_loads(
    model: LinearReadingModel, newtons: Float[Array, "l cells"]
) -> tuple[Float[Array, "l c"], Float[Array, " l"]]:
    """Readings of a pressure with each load of the model.

    Args:
        model: Of the pad.
        newtons: On each cell, with each load.

    Returns:
        Readings (uT), and their variances relative to the square of a channel's signal.
    """
    reading = jnp.einsum("lx,lxc->lc", newtons, model.mean, precision="highest")
    return reading, jnp.sum(jnp.einsum("lx,lxr->lr", newtons, model.root, precision="highest") ** 2, axis=-1)


def interpolate_reading(
    reading: Float[Array, "l c"], variance: Float[Array, " l"], loads: Float[Array, " l"], force: Float[Array, ""]
) -> tuple[Float[Array, " c"], Float[Array, ""]]:
    """A reading at any load: between those predicted, or beyond them.

    Readings per newton are linear in the logarithm of the load, up to one step between loads beyond the outer ones, and
    constant from there.

    Args:
        reading: uT, at `loads`.
        variance: Relative, at `loads`.
        loads: Ascending (N).
        force: The load asked for (N); none and less is no touch.

    Returns:
        Reading (uT) and its relative variance; zero without load.
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
    """Place of a load among others, in their logarithm.

    Args:
        loads: Ascending (N).
        force: The load (N); the first of `loads` is taken in place of none.

    Returns:
        Number i of the load that it follows (or would), its steps from there to load i + 1, and the load (N).
    """
    at, knots = jnp.log(jnp.where(force > 0, force, loads[0])), jnp.log(loads)
    i = jnp.clip(jnp.searchsorted(knots, at) - 1, 0, len(loads) - 2)
    return i, (at - knots[i]) / (knots[i + 1] - knots[i]), jnp.exp(at)


def interpolate(i: Int[Array, ""], step: Float[Array, ""], values: Float[Array, "l ..."]) -> Float[Array, "..."]:
    """Linear interpolation between values i and i + 1.

    Args:
        i: The first.
        step: Steps from there.
        values: At all loads.

    Returns:
        The value.
    """
    low, high = (
        jax.lax.dynamic_index_in_dim(values, i, keepdims=False),
        jax.lax.dynamic_index_in_dim(values, i + 1, keepdims=False),
    )
    return low + step * (high - low)


def read_pressure(
    model: LinearReadingModel, newtons: Float[Array, " cells"], load: Float[Array, ""]
) -> tuple[Float[Array, " c"], Float[Array, ""]]:
    """Reading of one pressure.

    Args:
        model: Of the pad.
        newtons: On each cell.
        load: Their sum (N).

    Returns:
        Reading (uT), and its variance relative to the square of a channel's signal.
    """
    share = newtons / jnp.maximum(load, MIN_LOAD_N)
    return interpolate_reading(*readings_at_loads(model, model.loads[:, None] * share[None]), model.loads, load)


@_one_thread_each
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
        touches: Pressed on the layer.
        layer: As `choose_layer` found it.
        board: Of the pad.
        softness: Indentation of the pad over that of the layer.
        discrepancy: Hyperparameters of the discrepancy's covariance.

    Returns:
        The model, and its mixture's errors on touches left out.
    """
    maps = magnetization_maps(board, layer)
    models, shares = _weigh_hyperparameters(_some(touches), maps, discrepancy)
    system = _system(touches, maps, discrepancy)
    groups, errors = [], []
    with ThreadPoolExecutor(usable_cores()) as pool:
        for (r, v), some in groupby(models, lambda at: (at.r, at.v)):
            weighted = _weigh(system, r, v)
            posteriors = [_posterior(weighted, at.a) for at in some]
            errors += [left_out for left_out, _ in pool.map(partial(_left_out, system, weighted), posteriors)]
            groups.append(_Models(r, weighted.precision, posteriors))
    left_out = np.einsum("m,mnc->nc", shares, errors) * system.scale
    mean, variance = _linear_maps(touches.pressure, system, maps, groups, shares, LOADS_N)
    model = LinearReadingModel(
        loads=jnp.float32(LOADS_N),
        mean=jnp.float32(mean * system.scale),
        root=jnp.float32(_roots(variance)),
        scale=jnp.float32(system.scale),
        softness=jnp.float32(softness),
        layer=Layer(*(jnp.float32(part) for part in layer)),
    )
    return FittedReadings(model, left_out)


@_one_thread_each
def choose_layer(
    pressed: Sequence[PressedTouches],
    layers: Sequence[Layer],
    board: Board,
    discrepancy: GPHyperparameters = DISCREPANCY,
) -> int:
    """Choose the layer under which touches are most probable as predicted from all others.

    Args:
        pressed: The same touches, pressed on each layer.
        layers: To choose among.
        board: Of the pad.
        discrepancy: Hyperparameters of the discrepancy's covariance.

    Returns:
        Its place among the layers.
    """
    middle, densities = _Hyperparameters(*MIDDLE), []
    for touches, layer in zip(pressed, layers, strict=True):
        system = _system(_some(touches), magnetization_maps(board, layer), discrepancy)
        densities += _densities(system, middle.r, middle.v, [middle.a])
    return int(np.argmax(densities))


def magnetization_maps(board: Board, layer: Layer) -> Float[np.ndarray, "x c k"]:
    """Readings of a newton on each cell, for each weight of a magnetization of prior variance 1.

    Args:
        board: Its chips' places in the plane count.
        layer: Of the nominal pad, of the prior's median thickness.

    Returns:
        uT/N.
    """
    chips, rotations = (np.asarray(part, np.float32) for part in board)
    return _maps(chips.tobytes(), rotations.tobytes(), float(layer.poisson), float(layer.young))


@lru_cache(maxsize=32)
def _maps(chips: bytes, rotations: bytes, poisson: float, young: float) -> np.ndarray:
    board = Board(
        np.frombuffer(chips, np.float32).reshape(-1, 3), np.frombuffer(rotations, np.float32).reshape(-1, 3, 3)
    )
    found = _cell_features(board, jnp.float32(poisson), jnp.float32(young))
    return np.asarray(found, np.float64)


@jit_quickly
def _cell_features(board: Board, poisson: Array, young: Array) -> Float[Array, "x c k"]:
    layer = jax.tree.map(jnp.float32, physics.layer_prior(3 * len(board.chips)).median)
    pad = physics.make_pad(layer._replace(young=young), board)._replace(
        poisson=poisson, mount_compliance=jnp.float32(0)
    )
    cells = CELL_GRID.cells

    def one(cell: Array) -> Array:
        pressed = jnp.zeros(cells**2).at[cell].set(UNIT_N / CELL_GRID.spacing**2)
        return physics.pressure_design(pad, pressed.reshape(cells, cells), CELL_GRID) / UNIT_N

    designs = map_batches(one, jnp.arange(cells**2), batch_size=physics.DESIGN_BATCH)
    return physics.weight_features(layer, designs, CELL_GRID.window)


def _some(touches: PressedTouches) -> PressedTouches:
    """At most CHOOSING_TOUCHES of them."""
    n = len(touches.reading)
    rows = np.sort(np.random.default_rng(0).permutation(n)[:CHOOSING_TOUCHES])
    return select_rows(touches, rows)


def _system(
    touches: PressedTouches, maps: Float[np.ndarray, "x c k"], discrepancy: GPHyperparameters = DISCREPANCY
) -> _System:
    reading = np.asarray(touches.reading, np.float64)
    square = np.sum(reading**2, axis=0)
    scale = np.sqrt((square + POOLING_TOUCHES * square.mean() / len(reading)) / (len(reading) + POOLING_TOUCHES)) + 1e-6
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
    """Covariance of the discrepancy between touches, and the mean variances it is relative to (N^2)."""
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


def _left_out(system: _System, weighted: _Weighted, posterior: _Posterior) -> tuple[Float[np.ndarray, "n c"], float]:
    """Errors of each touch as predicted from all others, in units of the channels' signals, and their log density."""
    n, c, k = weighted.features.shape
    alpha = weighted.vectors @ system.reading - posterior.a * (weighted.features @ posterior.mean)
    own = np.sum(weighted.vectors * system.vectors, axis=1)
    half = posterior.a * solve_triangular(posterior.factor, weighted.features.reshape(-1, k).T, lower=True)
    half = half.T.reshape(n, c, k)
    block = own[:, None, None] * np.eye(c) - np.einsum("nck,ndk->ncd", half, half, optimize=True)
    left_out = leave_out_blocks(block, alpha[..., None])
    return left_out.error[..., 0], float(np.sum(left_out.log_density) - n * np.sum(np.log(system.scale)))


def _densities(system: _System, r: float, v: float, amplitudes: Sequence[float]) -> list[float]:
    """Log densities of touches as predicted from all others."""
    weighted = _weigh(system, r, v)
    return [_left_out(system, weighted, _posterior(weighted, a))[1] for a in amplitudes]


def _weigh_hyperparameters(
    touches: PressedTouches, maps: Float[np.ndarray, "x c k"], discrepancy: GPHyperparameters
) -> tuple[list[_Hyperparameters], Float[np.ndarray, " m"]]:
    """The most probable points of the grid, those of one r and v together, and their shares."""
    system = _system(touches, maps, discrepancy)
    grid = [_Hyperparameters(a, r, v) for r, v, a in product(DISCREPANCIES, NOISES, AMPLITUDES)]
    with ThreadPoolExecutor(usable_cores()) as pool:
        densities = pool.map(lambda at: _densities(system, at[0], at[1], AMPLITUDES), product(DISCREPANCIES, NOISES))
        log_share = DENSITY_EXPONENT * np.concatenate(list(densities))
    share = np.exp(log_share - logsumexp(log_share))
    kept = sorted(i for i in np.argsort(-share)[:MAX_MODELS] if share[i] >= MIN_SHARE * share.max())
    return [grid[i] for i in kept], share[kept] / share[kept].sum()


def _linear_maps(
    pressure: ContactPressure,
    system: _System,
    maps: Float[np.ndarray, "x c k"],
    groups: Sequence[_Models],
    shares: Float[np.ndarray, " m"],
    loads: Sequence[float],
) -> tuple[Float[np.ndarray, "l x c"], Float[np.ndarray, "l x x"]]:
    """Mean map and variance at some loads, in units of the channels' signals."""
    channels, k = maps.shape[1:]
    prior, cross = _cell_covariances(pressure, system)
    scaled = maps / system.scale[:, None]

    def at_load(factor: Float[np.ndarray, " n"]) -> tuple[np.ndarray, np.ndarray]:
        towards = (cross * factor) @ system.vectors  # (x, n), in the system's coordinates
        mean, variance = [], []
        for r, precision, posteriors in groups:
            told = r * towards * precision
            left = scaled - np.tensordot(told, system.features, 1)
            own = r * (prior - towards @ told.T)
            for a, root, weights in posteriors:
                mean.append(a * (left @ weights) + told @ system.reading)
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
    """Covariance of the discrepancy between newtons on two cells, and between those on a cell and touches, at one
    load.
    """
    weights = np.asarray(system.discrepancy.weights / system.unit, np.float64)
    root = gp.kernel_factor(pressure.pressure.shape[-1]).astype(np.float64)
    axis = np.einsum("lij,ljk->lik", root, root)  # the kernel along one axis, for each length scale
    newtons = np.asarray(pressure.pressure, np.float64)
    blurred = np.einsum("lij,njk,lmk->lnim", axis, newtons, axis, optimize=True).reshape(len(axis), len(newtons), -1)
    prior = sum(w * np.kron(a, a) for w, a in zip(weights, axis, strict=True))
    return np.asarray(prior), np.einsum("l,lnx->xn", weights, blurred)


def _roots(variance: Float[np.ndarray, "l x x"]) -> Float[np.ndarray, "l x rank"]:
    """Roots of variances."""
    values, vectors = np.linalg.eigh((variance + variance.swapaxes(1, 2)) / 2)
    return (vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :])[:, :, -RANK:]
