"""Where on the skin a known tip pressed, told from the reading: on a pad of which some presses are known, or only the
readings of some, or nothing.

For a known layer a reading is linear in the weights w of the pad's magnetisation (`i2t.calibration.physics`), and what
is believed of them is normal. A reading y then has, for each place and load that may have made it, the likelihood

    N(y; Phi E[w], Phi Cov[w] Phi' + noise^2 I),

where Phi is what the press would read of each weight; an `Atlas` holds it for a grid of presses. Of a pad never pressed
before, the mean is zero and the covariance alone says which chips answer to which places. Presses with known places
narrow the weights by linear regression. Presses with unknown places do so through expectation maximisation (Dempster,
Laird and Rubin, J. R. Stat. Soc. B 39, 1977), begun with noise taken for larger than it is and cooled (deterministic
annealing; Ueda and Nakano, Neural Networks 11, 1998), so that the first guesses of places do not bind.

Metres, newtons, microtesla.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.interpolate import make_interp_spline

from i2t.calibration.physics import Layer, Tip, designs, features
from i2t.calibration.structured_gp import Presses
from i2t.types import PAD_WINDOW, READINGS, Board

SPACING = 1e-3  # m between computed places; what lies between is interpolated by cubic splines
BATCH = 64  # presses of an atlas at a time
COOLING = (8.0, 5.0, 3.0, 2.0, 1.5, 1.2, 1.0, 1.0, 1.0)  # factors on the noise, one for each round


class Atlas(NamedTuple):
    """What a grid of presses would read."""

    places: Float[Array, "m 2"]  # m
    loads: Float[Array, " m"]  # N
    phi: Float[Array, "m 15 k"]  # uT, of each weight


class Weights(NamedTuple):
    """What is believed of a pad's weights, and how well a reading is told by them."""

    mean: Float[Array, " k"]
    cholesky: Float[Array, "k k"]  # of their precision
    noise: Float[Array, ""]  # uT


def make_atlas(
    layer: Layer, board: Board, tip: Tip, reach: float, loads: np.ndarray, finer: int = 2, spacing: float = SPACING
) -> Atlas:
    """Presses of `tip` by force at places up to `reach` from the middle along x and y, `spacing / finer` apart, to each
    of `loads`.
    """
    edge = np.linspace(-reach, reach, round(2 * reach / spacing) + 1)
    y, x, load = (part.ravel() for part in np.meshgrid(edge, edge, loads, indexing="ij"))
    presses = Presses(jnp.asarray(np.stack([x, y], axis=-1), jnp.float32), jnp.asarray(load, jnp.float32))
    phi = features(layer, designs(layer, board, tip, presses, True), PAD_WINDOW)
    dense = np.linspace(-reach, reach, finer * (len(edge) - 1) + 1)
    between = jnp.asarray(make_interp_spline(edge, np.eye(len(edge)))(dense), jnp.float32)
    grid = phi.reshape(len(edge), len(edge), len(loads), READINGS, -1)
    grid = jnp.einsum("ai,bj,ijlok->ablok", between, between, grid, precision="highest")
    y, x, load = (part.ravel() for part in np.meshgrid(dense, dense, loads, indexing="ij"))
    return Atlas(
        jnp.asarray(np.stack([x, y], axis=-1), jnp.float32),
        jnp.asarray(load, jnp.float32),
        grid.reshape(len(x), READINGS, -1),
    )


def unknown(atlas: Atlas, noise: float) -> Weights:
    """Of a pad never pressed: weights of mean zero and variance 1."""
    k = atlas.phi.shape[-1]
    return Weights(jnp.zeros(k), jnp.eye(k), jnp.asarray(noise, jnp.float32))


@jax.jit
def log_likelihood(atlas: Atlas, weights: Weights, readings: Float[Array, "n 15"]) -> Float[Array, "n m"]:
    """Of each reading (uT), had each press of the atlas made it."""

    inverse = jax.scipy.linalg.solve_triangular(weights.cholesky, jnp.eye(len(weights.mean)), lower=True).T

    def of_some(phi: Float[Array, "b 15 k"]) -> Float[Array, "b n"]:
        half = jnp.matmul(phi, inverse, precision="highest")
        covariance = jnp.einsum("bok,bpk->bop", half, half, precision="highest")
        factor = jnp.linalg.cholesky(covariance + weights.noise**2 * jnp.eye(READINGS)[None])
        whiten = jax.scipy.linalg.solve_triangular(
            factor, jnp.broadcast_to(jnp.eye(READINGS), factor.shape), lower=True
        )
        error = readings[None] - jnp.matmul(phi, weights.mean, precision="highest")[:, None]
        white = jnp.einsum("bop,bnp->bno", whiten, error, precision="highest")
        level = jnp.sum(jnp.log(jnp.diagonal(factor, axis1=1, axis2=2)), axis=1)
        return -0.5 * jnp.sum(white**2, axis=-1) - level[:, None]

    m = len(atlas.phi)
    batches = jnp.pad(atlas.phi, ((0, -m % BATCH), (0, 0), (0, 0))).reshape(-1, BATCH, *atlas.phi.shape[1:])
    return jax.lax.map(of_some, batches).reshape(-1, len(readings))[:m].T


@partial(jax.jit, static_argnames="radius")
def locate(
    atlas: Atlas, weights: Weights, readings: Float[Array, "n 15"], radius: float = 1e-3
) -> tuple[Float[Array, "n 2"], Float[Array, " n"]]:
    """The place (m) that most probably lies within `radius` of where each reading (uT) was made, and that probability;
    all presses of the atlas are as likely before.
    """
    probability = jax.nn.softmax(log_likelihood(atlas, weights, readings), axis=1)
    apart = jnp.sum((atlas.places[:, None] - atlas.places[None]) ** 2, axis=-1)
    around = probability @ (apart <= radius**2).astype(probability.dtype)
    best = jnp.argmax(around, axis=1)
    return atlas.places[best], around[jnp.arange(len(best)), best]


def learn(atlas: Atlas, readings: Float[Array, "n 15"], noise: float) -> Weights:
    """Weights of a pad from readings (uT) whose places and loads nobody noted, as many as all of them tell."""
    weights = unknown(atlas, noise)
    for factor in COOLING:
        warm = weights._replace(noise=jnp.asarray(factor * noise, jnp.float32))
        weights = _round(atlas, warm, readings)
    return weights


@jax.jit
def _round(atlas: Atlas, weights: Weights, readings: Array) -> Weights:
    """One step of expectation maximisation: share each reading out among the presses, and solve for the weights."""
    share = jax.nn.softmax(log_likelihood(atlas, weights, readings), axis=1)
    root = jnp.sqrt(jnp.sum(share, axis=0))[:, None, None] * atlas.phi / weights.noise
    rows = root.reshape(-1, root.shape[-1])
    told = jnp.einsum("nm,no,mok->k", share, readings, atlas.phi, precision="highest") / weights.noise**2
    precision = jnp.matmul(rows.T, rows, precision="highest") + jnp.eye(rows.shape[-1])
    cholesky = jnp.linalg.cholesky(precision)
    return Weights(jax.scipy.linalg.cho_solve((cholesky, True), told), cholesky, weights.noise)
