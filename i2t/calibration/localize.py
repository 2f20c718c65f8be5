"""Position of a press by a known tip, from the reading: on a pad of which some presses are known, or only the readings
of some, or nothing.

For a known layer a reading is linear in the weights w of the pad's magnetization (`i2t.calibration.physics`), and their
posterior is normal. A reading y then has, for each position and load that may have made it, the likelihood

    N(y; Phi E[w], Phi Cov[w] Phi' + noise^2 I),

where Phi is what the press would read of each weight; a `PressLibrary` holds it for a grid of presses. Of a pad never
pressed before, the mean is zero and the covariance alone says which chips answer to which positions. Presses with known
positions narrow the weights by linear regression. Presses with unknown positions do so through expectation maximisation
(Dempster, Laird and Rubin, J. R. Stat. Soc. B 39, 1977), begun with noise taken for larger than it is and cooled
(deterministic annealing; Ueda and Nakano, Neural Networks 11, 1998), so that the first guesses of positions do not
bind.

Metres, newtons, microtesla. `c` is the number of channels, three for each chip of the board; `k` that of weights.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.interpolate import make_interp_spline

from i2t.calibration.physics import LayerParameters, Tip, design_matrices, weight_features
from i2t.calibration.structured_gp import Presses
from i2t.types import PAD_WINDOW, Board

GRID_SPACING_M = 1e-3  # between computed positions; what lies between is interpolated by cubic splines
LIBRARY_BATCH = 64  # of a library at a time
ANNEALING_FACTORS = (8.0, 5.0, 3.0, 2.0, 1.5, 1.2, 1.0, 1.0, 1.0)  # on the noise, one for each round


class PressLibrary(NamedTuple):
    """Predicted readings on a grid of presses."""

    positions: Float[Array, "m 2"]  # m
    loads: Float[Array, " m"]  # N
    features: Float[Array, "m c k"]  # uT, of each weight


class WeightPosterior(NamedTuple):
    """Normal posterior of a pad's weights, and the noise of its readings."""

    mean: Float[Array, " k"]
    precision_cholesky: Float[Array, "k k"]
    noise_std: Float[Array, ""]  # uT


def make_press_library(
    layer: LayerParameters,
    board: Board,
    tip: Tip,
    *,
    reach: float,
    loads: Float[np.ndarray, " loads"],
    refinement: int = 2,
    spacing: float = GRID_SPACING_M,
) -> PressLibrary:
    """Predict the readings of presses by force on a square grid.

    Args:
        layer: Parameters of the layer.
        board: The sensor board, any number of chips.
        tip: What presses; hashable.
        reach: Largest distance of a position from the skin's middle along x and y (m).
        loads: Forces, each at every position (N).
        refinement: Positions of the library are `spacing / refinement` apart.
        spacing: Distance of the positions that are computed (m).

    Returns:
        The library.
    """
    edge = np.linspace(-reach, reach, round(2 * reach / spacing) + 1)
    y, x, load = (part.ravel() for part in np.meshgrid(edge, edge, loads, indexing="ij"))
    presses = Presses(jnp.asarray(np.stack([x, y], axis=-1), jnp.float32), jnp.asarray(load, jnp.float32))
    coarse = weight_features(layer, design_matrices(layer, board, tip, presses, by_force=True), PAD_WINDOW)
    dense = np.linspace(-reach, reach, refinement * (len(edge) - 1) + 1)
    between = jnp.asarray(make_interp_spline(edge, np.eye(len(edge)))(dense), jnp.float32)
    features = coarse.reshape(len(edge), len(edge), len(loads), *coarse.shape[1:])
    features = jnp.einsum("ai,bj,ijlok->ablok", between, between, features, precision="highest")
    y, x, load = (part.ravel() for part in np.meshgrid(dense, dense, loads, indexing="ij"))
    return PressLibrary(
        jnp.asarray(np.stack([x, y], axis=-1), jnp.float32),
        jnp.asarray(load, jnp.float32),
        features.reshape(len(x), *coarse.shape[1:]),
    )


def pad_prior_weights(library: PressLibrary, noise_std: float) -> WeightPosterior:
    """The weights of a pad never pressed: mean zero and variance 1.

    Args:
        library: What presses would read.
        noise_std: Standard deviation of a reading's noise (uT).

    Returns:
        The prior.
    """
    k = library.features.shape[-1]
    return WeightPosterior(jnp.zeros(k), jnp.eye(k), jnp.asarray(noise_std, jnp.float32))


@jax.jit
def log_likelihood(
    library: PressLibrary, weights: WeightPosterior, readings: Float[Array, "n c"]
) -> Float[Array, "n m"]:
    """Log likelihood of each reading, had each press of the library made it, up to a constant.

    Args:
        library: What presses would read.
        weights: Posterior of the pad's weights.
        readings: Readings (uT).

    Returns:
        A row for each reading, a column for each press of the library.
    """
    inverse = jax.scipy.linalg.solve_triangular(weights.precision_cholesky, jnp.eye(len(weights.mean)), lower=True).T
    unit = jnp.eye(readings.shape[1])

    def of_batch(features: Float[Array, "b c k"]) -> Float[Array, "b n"]:
        half = jnp.matmul(features, inverse, precision="highest")
        covariance = jnp.einsum("bok,bpk->bop", half, half, precision="highest")
        factor = jnp.linalg.cholesky(covariance + weights.noise_std**2 * unit[None])
        whiten = jax.scipy.linalg.solve_triangular(factor, jnp.broadcast_to(unit, factor.shape), lower=True)
        error = readings[None] - jnp.matmul(features, weights.mean, precision="highest")[:, None]
        white = jnp.einsum("bop,bnp->bno", whiten, error, precision="highest")
        level = jnp.sum(jnp.log(jnp.diagonal(factor, axis1=1, axis2=2)), axis=1)
        return -0.5 * jnp.sum(white**2, axis=-1) - level[:, None]

    m = len(library.features)
    padded = jnp.pad(library.features, ((0, -m % LIBRARY_BATCH), (0, 0), (0, 0)))
    batches = padded.reshape(-1, LIBRARY_BATCH, *padded.shape[1:])
    return jax.lax.map(of_batch, batches).reshape(-1, len(readings))[:m].T


@partial(jax.jit, static_argnames="radius")
def localize(
    library: PressLibrary, weights: WeightPosterior, readings: Float[Array, "n c"], *, radius: float = 1e-3
) -> tuple[Float[Array, "n 2"], Float[Array, " n"]]:
    """Locate each press; all presses of the library are equally likely before.

    Args:
        library: What presses would read.
        weights: Posterior of the pad's weights.
        readings: Readings (uT).
        radius: How far (m) from the true position counts as right.

    Returns:
        The position (m) that most probably lies within `radius` of the true one, and that probability.
    """
    probability = jax.nn.softmax(log_likelihood(library, weights, readings), axis=1)
    square = jnp.sum((library.positions[:, None] - library.positions[None]) ** 2, axis=-1)
    around = probability @ (square <= radius**2).astype(probability.dtype)
    best = jnp.argmax(around, axis=1)
    return library.positions[best], around[jnp.arange(len(best)), best]


def fit_weights_without_positions(
    library: PressLibrary, readings: Float[Array, "n c"], noise_std: float
) -> WeightPosterior:
    """Fit a pad's weights to readings of unknown positions and loads.

    Args:
        library: What presses would read.
        readings: Readings (uT).
        noise_std: Standard deviation of a reading's noise (uT).

    Returns:
        The posterior after annealed expectation maximisation.
    """
    weights = pad_prior_weights(library, noise_std)
    for factor in ANNEALING_FACTORS:
        heated = weights._replace(noise_std=jnp.asarray(factor * noise_std, jnp.float32))
        weights = _expectation_maximisation(library, heated, readings)
    return weights


@jax.jit
def _expectation_maximisation(library: PressLibrary, weights: WeightPosterior, readings: Array) -> WeightPosterior:
    """One step: share each reading out among the presses, and solve for the weights."""
    features, noise_std = library.features, weights.noise_std
    share = jax.nn.softmax(log_likelihood(library, weights, readings), axis=1)
    root = jnp.sqrt(jnp.sum(share, axis=0))[:, None, None] * features / noise_std
    rows = root.reshape(-1, root.shape[-1])
    projected = jnp.einsum("nm,no,mok->k", share, readings, features, precision="highest") / noise_std**2
    precision = jnp.matmul(rows.T, rows, precision="highest") + jnp.eye(rows.shape[-1])
    cholesky = jnp.linalg.cholesky(precision)
    return WeightPosterior(jax.scipy.linalg.cho_solve((cholesky, True), projected), cholesky, noise_std)
