"""Gaussian process (GP) from contact pressure to readings.

For small strain the reading of a magnetic skin is linear in the pressure p on its surface, reading_c = sum_x g_c(x)
p(x): the displacement is linear in p and the field is linear in the displacement. The unknown of a pad is the map g_c,
one smooth picture per channel. A Gaussian-process prior on g_c with covariances C_l(x, x') = exp(-|x - x'|^2 / 2 l^2)
gives a covariance between two touches that needs no explicit map,

  k(t, t') = sum_l a_l p_t . C_l p_t' [1 - b + b exp(-(log(F_t / F_t'))^2 / 2 w^2)],

where the bracket lets the response change with the load F (a layer stiffens as it is pressed; lattices buckle). For one
round tip this is the structured kernel f(F) x g(x, y) of a calibrated skin; for any other contact it is its
superposition. Zero pressure means zero reading, so the mean is zero. Channels share the covariance and differ in scale;
each chip of the board has 3.

Rasmussen and Williams, "Gaussian Processes for Machine Learning", algorithm 2.1. The hyperparameters minimise the error
on held-out groups of touches (section 5.3, cross-validation). They never maximise the evidence, because the prior is
known to be wrong in detail. Fits run in double precision, because the condition number of the covariance of n touches
is up to n / noise. Predictions are in single precision.
"""

import warnings
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int, Key

from i2t.contact.pressure import CELL_MM, ContactPressure
from i2t.files import serialization
from i2t.leave_one_out import leave_out_blocks, leave_out_rows
from i2t.runtime.batching import select_rows
from i2t.runtime.compiling import jit_quickly
from i2t.skin_models.base import load_fitted
from i2t.types import in_one_line

# mm, length scales of the maps from pressure to readings, from below a skin's thickness to its edge
MAP_LENGTHS_MM = (1.5, 3.0, 6.0, 12.0, 24.0)
FILE_KIND = "i2t pressure model"  # kind of file in the header of a saved pressure model
Tree = TypeVar("Tree")


@in_one_line
class GPHyperparameters(NamedTuple):
    """Hyperparameters of a `GP`: weights of length scales, share and width of the change with load, noise."""

    weights: Float[Array, " lengths"]  # weights a_l of the length scales, for unit mean variance
    bend: Float[Array, ""]  # share b of the covariance that changes with the load
    width: Float[Array, ""]  # width w of the change with the load, in log load
    noise: Float[Array, ""]  # variance of a channel's noise, relative to that of its signal


@in_one_line
class GP(NamedTuple):
    """Gaussian process from contact pressure to readings, fitted to n training touches."""

    hyper: GPHyperparameters
    touches: ContactPressure  # n training touches
    unit: Float[Array, " lengths"]  # N^2, mean variance of the training touches for each length scale
    cholesky: Float[Array, "n n"]
    weights: Float[Array, "n channels"]
    scale: Float[Array, " channels"]  # uT, root mean square of each channel's signal

    @property
    def leave_one_out(self) -> Float[np.ndarray, "n channels"]:
        """Errors (uT) on the training touches: measured minus predicted from all other touches."""
        return np.asarray(_leave_one_out(self))

    def predict(self, contact: ContactPressure) -> tuple[Float[Array, "m channels"], Float[Array, "m channels"]]:
        """Predict readings of contacts that were not measured.

        Args:
            contact: m contact pressures.

        Returns:
            `(m, channels)` means and standard deviations (uT), the sensor's noise included.
        """
        return _predict(self, contact)

    def save(self, path: Path | str) -> None:
        """Write the Gaussian process to one file, which appears whole or not at all.

        Args:
            path: Path of the file; `.npz` by convention.

        Raises:
            SerializationError: The file cannot be written.
        """
        serialization.save(path, FILE_KIND, self)


class PressureTouches(NamedTuple):
    """n touches to fit a Gaussian process to: contact pressures (N), readings (uT), and groups for cross-validation."""

    pressure: ContactPressure  # n contact pressures
    reading: Float[np.ndarray, "n channels"] | Float[Array, "n channels"]  # uT
    groups: Int[np.ndarray, " n"]  # run or spatial block of each touch, which cross-validation keeps together


@dataclass(frozen=True)
class PressureModel:
    """Options for fitting a Gaussian process from contact pressure to readings.

    Its hyperparameters are chosen on held-out groups of touches.

    Attributes:
        steps: Steps of Adam in `choose_hyperparameters`.
        folds: Parts of cross-validation, at most as many as groups.
        limit: Maximum number of touches on which hyperparameters are chosen.
    """

    steps: int = 40
    folds: int = 4
    limit: int = 600

    def fit(self, key: Key[Array, ""], data: PressureTouches) -> GP:
        """Choose the Gaussian process's hyperparameters and condition it on touches.

        Args:
            key: Random key of the folds, and of the sample if there are more touches than `limit`.
            data: The touches.

        Returns:
            The fitted Gaussian process.

        Raises:
            ValueError: The hyperparameters cannot be chosen (see `choose_hyperparameters`).
        """
        touches, groups, readings = data.pressure, data.groups, jnp.asarray(data.reading)
        seed = int(jax.random.key_data(key)[-1])  # the seed of `jax.random.key(seed)`
        hyper, _ = choose_hyperparameters(
            touches, readings, groups, steps=self.steps, folds=self.folds, limit=self.limit, seed=seed
        )
        return fit(hyper, touches, readings)


def load_pressure_gp(path: Path | str) -> GP:
    """Read a Gaussian process from contact pressure to readings from its file.

    Args:
        path: Path of a file that `GP.save` wrote.

    Returns:
        The Gaussian process, in float32.

    Raises:
        SerializationError: The file is missing, damaged or of another kind.
    """
    return load_fitted(path, FILE_KIND, GP, _checked)


def _checked(path: Path | str, gp: GP, about: dict[str, Any]) -> GP:
    """Convert a process to float32; raise ValueError if its parts do not fit each other."""
    jax.eval_shape(predict, gp, gp.touches)  # raises if the shapes do not fit
    if not all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gp)):
        raise ValueError("values that are not finite")
    return _single(gp)


def kernel_factor(m: int) -> Float[np.ndarray, "lengths m m"]:
    """Compute, for each length scale l, the symmetric square root R_l of the covariance of cells along one axis.

    Args:
        m: Number of 1 mm cells along the axis.

    Returns:
        `(lengths, m, m)` matrices R_l with (R_l R_l)_ij = exp(-(x_i - x_j)^2 / 2 l^2), for cell centres x.
    """
    x = CELL_MM * np.arange(m)
    values, vectors = np.linalg.eigh([np.exp(-((x[:, None] - x) ** 2) / (2 * length**2)) for length in MAP_LENGTHS_MM])
    return ((vectors * np.sqrt(np.maximum(values, 0))[:, None, :]) @ vectors.swapaxes(1, 2)).astype(np.float32)


def features(touches: ContactPressure) -> Float[Array, "lengths n mm"]:
    """Compute each touch's features: its pressure smoothed over each length scale. Inner products are covariances.

    Args:
        touches: n contact pressures on m x m cells.

    Returns:
        `(lengths, n, m^2)` features (N).
    """
    root = jnp.asarray(kernel_factor(touches.pressure.shape[-1]))
    blurred = jnp.einsum("lij,njk,lmk->lnim", root, touches.pressure, root, precision="highest")
    return blurred.reshape(*blurred.shape[:2], -1)


def gram(
    hyper: GPHyperparameters,
    unit: Float[Array, " lengths"],
    linear: Float[Array, "lengths a b"],
    load_a: Float[Array, " a"],
    load_b: Float[Array, " b"],
) -> Float[Array, "a b"]:
    """Compute the Gaussian process's covariance between the readings of a first and of b second touches.

    Args:
        hyper: Hyperparameters.
        unit: `(lengths,)` mean variances of the training touches (N^2).
        linear: `(lengths, a, b)` inner products of the touches' features (N^2).
        load_a: `(a,)` loads of the first touches (N).
        load_b: `(b,)` loads of the second touches (N).

    Returns:
        `(a, b)` covariances k, relative to the variance of a channel's signal.
    """
    return jnp.einsum("l,lab->ab", hyper.weights / unit, linear) * stiffening(hyper, load_a, load_b)


def stiffening(hyper: GPHyperparameters, load_a: Float[Array, " a"], load_b: Float[Array, " b"]) -> Float[Array, "a b"]:
    """Compute the factor of the covariance between touches that falls with the difference of their loads.

    Args:
        hyper: Hyperparameters; only `bend` and `width` are used.
        load_a: `(a,)` loads (N).
        load_b: `(b,)` loads (N).

    Returns:
        `(a, b)` correlations: 1 for equal loads, at least 1 - `bend`.
    """
    ratio = jnp.log(jnp.maximum(load_a, 1e-3))[:, None] - jnp.log(jnp.maximum(load_b, 1e-3))[None, :]
    return 1 - hyper.bend + hyper.bend * jnp.exp(-(ratio**2) / (2 * hyper.width**2))


def inner_products(a: Float[Array, "lengths a mm"], b: Float[Array, "lengths b mm"]) -> Float[Array, "lengths a b"]:
    """Compute the inner products of the features of two sets of touches.

    Args:
        a: `(lengths, a, m^2)` features of the first touches (N).
        b: `(lengths, b, m^2)` features of the second touches (N).

    Returns:
        `(lengths, a, b)` inner products (N^2).
    """
    return jnp.einsum("lax,lbx->lab", a, b, precision="highest")


def fit(hyper: GPHyperparameters, touches: ContactPressure, readings: Float[Array, "n c"]) -> GP:
    """Condition the GP on touches, with given hyperparameters, in double precision.

    Args:
        hyper: Hyperparameters.
        touches: n contact pressures.
        readings: `(n, c)` measured readings (uT).

    Returns:
        The fitted GP, in float32.
    """
    with jax.enable_x64(True):
        return _single(_condition(*_double((hyper, touches, readings))))


@jit_quickly
def _condition(hyper: GPHyperparameters, touches: ContactPressure, readings: Float[Array, "n c"]) -> GP:
    linear = inner_products(f := features(touches), f)
    unit = jnp.mean(jnp.diagonal(linear, axis1=1, axis2=2), axis=1)
    scale = jnp.sqrt(jnp.mean(readings**2, axis=0) / (1 + hyper.noise)) + 1e-6
    K = gram(hyper, unit, linear, touches.load, touches.load)
    cholesky = jnp.linalg.cholesky(K + hyper.noise * jnp.eye(len(K)))
    weights = jax.scipy.linalg.cho_solve((cholesky, True), readings / scale[None])
    return GP(hyper=hyper, touches=touches, unit=unit, cholesky=cholesky, weights=weights, scale=scale)


def predict(gp: GP, touches: ContactPressure) -> tuple[Float[Array, "n c"], Float[Array, "n c"]]:
    """Predict readings of touches that were not measured.

    Args:
        gp: A fitted GP.
        touches: n contact pressures.

    Returns:
        `(n, c)` means and standard deviations (uT), the sensor's noise included.
    """
    f, f_train = features(touches), features(gp.touches)
    cross = gram(gp.hyper, gp.unit, inner_products(f, f_train), touches.load, gp.touches.load)
    own = jnp.einsum("l,lnx,lnx->n", gp.hyper.weights / gp.unit, f, f, precision="highest")
    explained = jax.scipy.linalg.solve_triangular(gp.cholesky, cross.T, lower=True)
    variance = jnp.maximum(own - jnp.sum(explained**2, axis=0), 0.0) + gp.hyper.noise
    mean = jnp.matmul(cross, gp.weights, precision="highest")
    return mean * gp.scale[None], jnp.sqrt(variance)[:, None] * gp.scale[None]


_predict = jax.jit(predict)


@jax.jit
def _leave_one_out(gp: GP) -> Float[Array, "n channels"]:
    half = jax.scipy.linalg.solve_triangular(gp.cholesky, jnp.eye(len(gp.cholesky)), lower=True)
    return leave_out_rows(jnp.sum(half**2, axis=0), gp.weights).error * gp.scale[None]


def choose_hyperparameters(
    touches: ContactPressure,
    readings: Float[Array, "n c"],
    groups: Int[np.ndarray, " n"],
    *,
    steps: int = 40,
    folds: int = 4,
    limit: int = 600,
    seed: int = 0,
) -> tuple[GPHyperparameters, Float[Array, " steps"]]:
    """Find the hyperparameters with the least squared error on held-out groups.

    Adam descends the error of cross-validation, with groups kept whole, in unconstrained coordinates from a broad
    start. The best of all its steps is taken.

    Args:
        touches: n contact pressures.
        readings: `(n, c)` measured readings (uT).
        groups: `(n,)` run or spatial block of each touch.
        steps: Steps of Adam.
        folds: Parts of cross-validation, at most as many as groups.
        limit: Maximum number of touches; of more, a random sample is used, because the cost grows with the cube.
        seed: Seed of the folds and of the sample.

    Returns:
        The hyperparameters, and the R2 on held-out groups at each step. A warning counts steps without a finite score.

    Raises:
        ValueError: There are fewer than two groups, or no step has a finite score because touches or readings are not
            finite or all pressures are zero.
    """
    touches, readings, ends = _by_fold(touches, readings, groups, folds=folds, limit=limit, seed=seed)
    with jax.enable_x64(True):
        path, errors = jax.device_get(_single(_descend(*_double((touches, readings)), ends=ends, steps=steps)))
    finite = np.isfinite(errors)
    if not finite.any():
        raise ValueError(
            f"cross-validation of the Gaussian process has no finite score on {len(readings)} touches; "
            "check for contact pressures or readings that are not finite, or zero throughout"
        )
    if lost := int(np.sum(~finite)):
        warnings.warn(
            f"the score of the Gaussian process is not finite in {lost} of {steps} steps on {len(readings)} touches; "
            "its hyperparameters are the best of the others",
            stacklevel=2,
        )
    best = int(np.argmin(np.where(finite, errors, np.inf)))
    return jax.device_put((jax.tree.map(lambda values: values[best], path), 1 - errors))


def _by_fold(
    touches: ContactPressure,
    readings: Float[Array, "n c"],
    groups: Int[np.ndarray, " n"],
    *,
    folds: int,
    limit: int,
    seed: int,
) -> tuple[ContactPressure, Float[Array, "k c"], tuple[int, ...]]:
    """Order at most `limit` touches and their readings fold after fold; also return the rows at which folds end."""
    if len(groups) > limit:
        rows = np.sort(np.random.default_rng(seed).choice(len(groups), limit, replace=False))
        touches, readings, groups = select_rows((touches, readings, groups), rows)
    names, group = np.unique(np.asarray(groups), return_inverse=True)
    folds = min(folds, len(names))
    if folds < 2:
        raise ValueError(f"cross-validation needs at least two groups of touches (runs or blocks), got {len(names)}")
    fold = np.random.default_rng(seed).permutation(len(names))[group] % folds
    order, ends = np.argsort(fold, kind="stable"), np.cumsum(np.bincount(fold))
    return *select_rows((touches, readings), order), tuple(ends.tolist())


@partial(jit_quickly, static_argnames=("ends", "steps"))
def _descend(
    touches: ContactPressure, readings: Array, *, ends: tuple[int, ...], steps: int
) -> tuple[GPHyperparameters, Float[Array, " steps"]]:
    """Compute the hyperparameters along the path of Adam, and the share of variance that they leave unexplained on the
    folds, which end at rows `ends`.
    """
    linear = inner_products(f := features(touches), f)
    unit = jnp.mean(jnp.diagonal(linear, axis1=1, axis2=2), axis=1)
    standard = readings / (jnp.sqrt(jnp.mean(readings**2, axis=0, keepdims=True)) + 1e-6)
    load, blocks = touches.load, [slice(start, end) for start, end in zip((0, *ends), ends, strict=False)]

    def unexplained(free: dict[str, Array]) -> Float[Array, ""]:
        now = _hyperparameters(free)
        K = gram(now, unit, linear, load, load)
        precision = _inverse(K + now.noise * jnp.eye(len(K)))
        weights = jnp.matmul(precision, standard, precision="highest")
        folds = [leave_out_blocks(precision[block, block], weights[block]) for block in blocks]
        return sum(jnp.sum(fold.error**2) for fold in folds) / jnp.sum(standard**2)

    optimizer = optax.adam(0.25)

    def step(
        state: tuple[dict, optax.OptState], _: None
    ) -> tuple[tuple[dict, optax.OptState], tuple[GPHyperparameters, Array]]:
        free, opt_state = state
        error, gradient = jax.value_and_grad(unexplained)(free)
        updates, opt_state = optimizer.update(gradient, opt_state)
        return (optax.apply_updates(free, updates), opt_state), (_hyperparameters(free), error)

    start = {
        "weights": jnp.zeros(len(MAP_LENGTHS_MM)),
        "bend": jnp.zeros(()),
        "width": jnp.zeros(()),
        "noise": jnp.full((), -2.0),
    }
    return jax.lax.scan(step, (start, optimizer.init(start)), None, steps)[1]


def _double(tree: Tree) -> Tree:
    """Convert a tree of arrays to float64, if that is enabled."""
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), tree)


def _single(tree: Tree) -> Tree:
    """Convert a tree of arrays to float32."""
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), tree)


def _hyperparameters(free: dict[str, Array]) -> GPHyperparameters:
    """Convert unconstrained coordinates to hyperparameters."""
    return GPHyperparameters(
        jax.nn.softmax(free["weights"]),
        jax.nn.sigmoid(free["bend"]),
        jnp.exp(free["width"]),
        jnp.exp(free["noise"]),
    )


@jax.custom_jvp
def _inverse(system: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Invert a symmetric positive matrix."""
    return jax.scipy.linalg.cho_solve((jnp.linalg.cholesky(system), True), jnp.eye(len(system)))


@_inverse.defjvp
def _inverse_jvp(systems: tuple[Array], changes: tuple[Array]) -> tuple[Array, Array]:
    """Use d(A^-1) = -A^-1 dA A^-1, which avoids the derivative of the factor."""
    inverse = _inverse(*systems)
    change = jnp.matmul(inverse, jnp.matmul(changes[0], inverse, precision="highest"), precision="highest")
    return inverse, -change
