"""A Gaussian process from imagined pressure to readings.

For small strain the reading of a magnetic skin is linear in the pressure p on its surface, reading_c = sum_x g_c(x) p(x): the displacement is linear in p
and the field is linear in the displacement. What a pad hides is the map g_c, one smooth picture per channel. A Gaussian-process prior on g_c with a
Gaussian covariance of length l gives a covariance between two touches that needs no hidden map at all,

  k(t, t') = sum_l a_l <B_l p_t, B_l p_t'> [1 - b + b exp(-(log(F_t / F_t'))^2 / 2 w^2)],

where B_l blurs by l and the bracket lets the response bend with the load F (a layer stiffens as it is pressed; lattices buckle). For one round tip this
is the structured kernel f(F) x g(x, y) of a calibrated skin; for any other contact it is its superposition. Zero pressure means zero reading, so the
mean is zero. Channels share the covariance and differ in scale. Rasmussen and Williams, "Gaussian Processes for Machine Learning", chapter 2, algorithm
2.1; hyperparameters by grouped cross-validation (section 5.4.2), never by evidence, because the prior is known to be wrong in detail.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

LENGTHS = (1.0, 1.8, 3.2, 5.6)  # mm, of the maps g_c
CELL = 1.0  # mm


class Imagined(NamedTuple):
    """What a touch is expected to do to the skin's surface; one touch, or many on axis 0."""

    pressure: Float[Array, "*n m m"]  # N on each 1 mm cell
    load: Float[Array, "*n"]  # N, total


class Hyper(NamedTuple):
    """Hyperparameters of the covariance."""

    weights: Float[Array, "lengths"]  # a_l, for unit mean variance
    bend: Float[Array, ""]  # b
    width: Float[Array, ""]  # w, in log load
    noise: Float[Array, ""]  # variance of a standardised channel, relative to the mean signal variance


class GP(NamedTuple):
    """A fitted process: training touches, hyperparameters and the solved system."""

    hyper: Hyper
    touches: Imagined
    unit: Float[Array, "lengths"]  # per length, the mean variance of the training touches
    cholesky: Float[Array, "n n"]
    weights: Float[Array, "n channels"]
    scale: Float[Array, "channels"]  # uT, root mean square of each channel


def blurs(m: int) -> Float[np.ndarray, "lengths m m"]:
    """The matrices B_l (applied along both axes) for m cells of `CELL`."""
    x = CELL * np.arange(m)
    kernels = np.stack([np.exp(-((x[:, None] - x) ** 2) / (2 * length**2)) for length in LENGTHS])
    return (kernels / kernels.sum(-1).mean(-1)[:, None, None]).astype(np.float32)


def features(touches: Imagined) -> Float[Array, "lengths n mm"]:
    """B_l p of every touch, flattened."""
    B = jnp.asarray(blurs(touches.pressure.shape[-1]))
    blurred = jnp.einsum("lij,njk,lmk->lnim", B, touches.pressure, B)
    return blurred.reshape(*blurred.shape[:2], -1)


def gram(
    hyper: Hyper, unit: Float[Array, "lengths"], linear: Float[Array, "lengths a b"], load_a: Float[Array, "a"], load_b: Float[Array, "b"]
) -> Float[Array, "a b"]:
    """Covariance between touches from the inner products of their blurred pressures."""
    ratio = jnp.log(jnp.maximum(load_a, 1e-3))[:, None] - jnp.log(jnp.maximum(load_b, 1e-3))[None, :]
    bend = 1 - hyper.bend + hyper.bend * jnp.exp(-(ratio**2) / (2 * hyper.width**2))
    return jnp.einsum("l,lab->ab", hyper.weights / unit, linear) * bend


def inner(a: Float[Array, "lengths a mm"], b: Float[Array, "lengths b mm"]) -> Float[Array, "lengths a b"]:
    """Inner products per length."""
    return jnp.einsum("lax,lbx->lab", a, b, precision="highest")


def fit(hyper: Hyper, touches: Imagined, readings: Float[Array, "n channels"]) -> GP:
    """Condition on n touches and their readings (uT)."""
    linear = inner(f := features(touches), f)
    unit = jnp.mean(jnp.diagonal(linear, axis1=1, axis2=2), axis=1)
    scale = jnp.sqrt(jnp.mean(readings**2, axis=0)) + 1e-6
    K = gram(hyper, unit, linear, touches.load, touches.load)
    cholesky = jnp.linalg.cholesky(K + (hyper.noise + 1e-5) * jnp.eye(len(K)))
    weights = jax.scipy.linalg.cho_solve((cholesky, True), readings / scale)
    return GP(hyper, touches, unit, cholesky, weights, scale)


def predict(gp: GP, touches: Imagined) -> tuple[Float[Array, "n channels"], Float[Array, "n channels"]]:
    """Mean and standard deviation (uT) of the readings of n touches, sensor noise included."""
    f, f_train = features(touches), features(gp.touches)
    cross = gram(gp.hyper, gp.unit, inner(f, f_train), touches.load, gp.touches.load)
    own = jnp.einsum("l,lnx,lnx->n", gp.hyper.weights / gp.unit, f, f)
    explained = jax.scipy.linalg.solve_triangular(gp.cholesky, cross.T, lower=True)
    variance = jnp.maximum(own - jnp.sum(explained**2, axis=0), 0.0) + gp.hyper.noise
    return cross @ gp.weights * gp.scale, jnp.sqrt(variance)[:, None] * gp.scale


def candidates(n: int, seed: int = 0) -> Hyper:
    """n hyperparameters on axis 0, spread over every plausible value (log-uniform, Dirichlet mixtures of lengths)."""
    rng = np.random.default_rng(seed)
    weights = rng.dirichlet(np.full(len(LENGTHS), 0.5), n)
    return Hyper(
        jnp.float32(weights),
        jnp.float32(rng.uniform(0, 0.6, n)),
        jnp.float32(np.exp(rng.uniform(np.log(0.3), np.log(2), n))),
        jnp.float32(np.exp(rng.uniform(np.log(1e-3), np.log(1), n))),
    )


def choose(
    touches: Imagined, readings: Float[Array, "n channels"], groups: Int[np.ndarray, "n"], n_candidates: int = 64, folds: int = 4, seed: int = 0
) -> tuple[Hyper, Float[Array, "candidates"]]:
    """The hyperparameters with the least squared error on held-out groups (runs or spatial blocks), and the R2 of every candidate."""
    linear = inner(f := features(touches), f)
    unit = jnp.mean(jnp.diagonal(linear, axis1=1, axis2=2), axis=1)
    standard = readings / (jnp.sqrt(jnp.mean(readings**2, axis=0)) + 1e-6)
    names, group = np.unique(np.asarray(groups), return_inverse=True)
    if len(names) < 2:
        raise ValueError(f"cross-validation needs at least two groups of touches (runs or blocks), got {len(names)}")
    fold = jnp.asarray(np.random.default_rng(seed).permutation(len(names))[group] % min(folds, len(names)))
    options = candidates(n_candidates, seed)

    @jax.jit
    def error(hyper: Hyper) -> Float[Array, ""]:
        K = gram(hyper, unit, linear, touches.load, touches.load)

        def held_out(k: Int[Array, ""]) -> Float[Array, ""]:
            test = fold == k
            # Held-out rows become independent of all others: unit variance on the diagonal, no target, and the system keeps its shape.
            keep = ~test
            mask = keep[:, None] & keep[None, :]
            system = jnp.where(mask, K, 0.0) + jnp.diag(jnp.where(keep, hyper.noise + 1e-5, 1.0))
            weights = jax.scipy.linalg.cho_solve(
                (jnp.linalg.cholesky(system), True), jnp.where(keep[:, None], standard, 0.0)
            )
            residual = jnp.where(test[:, None], K @ weights - standard, 0.0)
            return jnp.sum(residual**2)

        return jnp.sum(jax.lax.map(held_out, jnp.arange(min(folds, len(names)))))

    errors = jnp.stack([error(jax.tree.map(lambda x, i=i: x[i], options)) for i in range(n_candidates)])
    best = int(jnp.argmin(jnp.where(jnp.isfinite(errors), errors, jnp.inf)))
    return jax.tree.map(lambda x: x[best], options), 1 - errors / jnp.sum(standard**2)
