"""Methods that infer what a press met. Each gives weights of the library's patches, but for a network, which gives
pixels.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array

from i2t import mlp, training
from i2t.prediction import gp
from i2t.prediction.gp import ContactPressure
from i2t.recognition.outcomes import linear_reading_model
from i2t.reconstruction.local_shape import (
    SMALLEST_FORCE_N,
    PatchLibrary,
    PressModel,
    infer_patch,
    log_likelihood,
)
from i2t.reconstruction.press_curves import SKIN_CHANGES_UT, PressCurve
from i2t.reconstruction.press_models import model_presses
from i2t.types import CONTACT_TOLERANCE_M, Board

FORCES_N = np.geomspace(0.05, 8.0, 24)  # at which imagined presses may stop
GP_PATCHES = 50  # touches of a pad from which a forward model is learned, each at the library's four loads
HIDDEN_UNITS = 128
PRESSES_A_STEP = 128
RIVALS = 100
COARSE = 2  # pixels of a patch to one of the network's


class PixelNetwork(NamedTuple):
    """A network from readings to pixels, and what its inputs are scaled by."""

    layers: mlp.Layers
    mean: Array
    std: Array


def imagined_press(key: Array, index: Array, model: PressModel) -> PressCurve:
    """A press of one of the library's patches with two stops, as it would be measured; its truth is left empty."""
    key_slant, key_noise, key_force = jax.random.split(key, 3)
    what = model.likelihood
    slant = what.slant_std * jax.random.normal(key_slant, (2,))
    at_loads = model.reading[:, :, index] + jnp.einsum("i,lic->lc", slant, model.sliding[:, :, :, index])
    forces = jnp.asarray(FORCES_N, jnp.float32)
    knots = jnp.log(model.loads)
    per_newton = jax.vmap(lambda y: jnp.interp(jnp.log(forces), knots, y), 1, 1)(at_loads / model.loads[:, None])
    curve = per_newton * forces[:, None]
    change = jnp.linalg.norm(curve, axis=1)
    travel = jnp.interp(jnp.log(forces), knots, model.travel[:, index])

    def stop(limit: Array, key: Array) -> tuple[Array, Array, Array]:
        i = jnp.where(jnp.any(change > limit), jnp.argmax(change > limit), len(forces) - 1)
        i = jnp.maximum(i, 1)
        step = jnp.clip((limit - change[i - 1]) / jnp.maximum(change[i] - change[i - 1], 1e-6), 0, 1)
        mix = partial(_between, i=i, step=step)
        noise = jnp.sqrt(model.noise) * jax.random.normal(key, model.noise.shape)
        return model.axes.T @ (mix(curve) + noise), mix(forces), mix(travel)

    limits = jnp.asarray(SKIN_CHANGES_UT, jnp.float32)
    reading, force, travelled = jax.vmap(stop)(limits, jax.random.split(key_noise, len(limits)))
    force = jnp.maximum(force + what.force_std * jax.random.normal(key_force, force.shape), 0)
    return PressCurve(reading, force, travelled, jnp.zeros((2, 0)), jnp.zeros((2, 2)))


def _between(values: Array, *, i: Array, step: Array) -> Array:
    return values[i - 1] + step * (values[i] - values[i - 1])


def imagined_presses(key: Array, model: PressModel, rows: np.ndarray) -> PressCurve:
    """Imagined presses of some of the library's patches."""
    keys = jax.random.split(key, len(rows))
    return jax.jit(jax.vmap(imagined_press, (0, 0, None)))(keys, jnp.asarray(rows), model)


def first_stop(press: PressCurve) -> PressCurve:
    """The press as if it had ended at its first stop."""
    stops = press.force.ndim - 1
    return jax.tree.map(lambda field: field[:, :1] if stops else field[:1], press)


# --- by imagination ---------------------------------------------------------------------------------------------------


def bayes_weights(press: PressCurve, model: PressModel, library: PatchLibrary) -> Array:
    """Posterior weights of one press."""
    return infer_patch(press.reading, press.force, press.travel, model=model, library=library, samples=1).weight


def learned_model(key: Array, model: PressModel, library: PatchLibrary, board: Board) -> PressModel:
    """The forward model that a Gaussian process learns from noisy touches of some of the library's patches."""
    rows = np.random.default_rng(1).permutation(len(library.patch))[:GP_PATCHES]
    readings = jnp.einsum("dc,ldn->nlc", model.axes, model.reading[:, :, rows])
    noise = (jnp.sqrt(model.noise)[None, None] * jax.random.normal(key, readings.shape)) @ model.axes
    side = round(library.newtons.shape[-1] ** 0.5)
    pressure = jnp.asarray(library.newtons[rows], jnp.float32).reshape(-1, side, side)
    contacts = ContactPressure(pressure, jnp.tile(jnp.asarray(library.loads), len(rows)))
    groups = np.repeat(np.asarray(library.object)[rows], len(library.loads))
    process = gp.condition(contacts, (readings + noise).reshape(-1, readings.shape[-1]), groups, seed=0)
    learned = linear_reading_model(process, loads=tuple(float(load) for load in library.loads))
    return model_presses(learned, library, board=board, likelihood=model.likelihood)


def judge_candidate(
    press: PressCurve, true: Array, others: Array, own: PressModel, model: PressModel
) -> tuple[Array, Array]:
    """Number of other candidates that explain one press better than the true one, and by how many bits the true one
    does so better than patches of the library on the average; `own` is the model of all candidates.
    """
    force = jnp.maximum(press.force, SMALLEST_FORCE_N)
    found = log_likelihood(press.reading, force, press.travel, model=own)
    known = log_likelihood(press.reading, force, press.travel, model=model)
    what = model.likelihood
    gain = what.temperature * found[true] - jax.nn.logsumexp(what.temperature * known) + jnp.log(len(known))
    log_mixed = jnp.logaddexp(jnp.log1p(-what.prior_share) + gain, jnp.log(what.prior_share))
    return jnp.sum(found[others] > found[true]), log_mixed / jnp.log(2.0)


# --- baselines and the ceiling ----------------------------------------------------------------------------------------


def features(press: PressCurve) -> Array:
    """Measurements of a press, as one row: readings, logarithms of forces, travels (mm)."""
    rows = [press.reading.reshape(*press.reading.shape[:-2], -1), jnp.log(press.force + 0.05), 1e3 * press.travel]
    return jnp.concatenate(rows, -1)


def neighbour_weights(press: PressCurve, seen: Array, scale: Array, count: Array) -> Array:
    """Equal weights for the patches of the nearest imagined presses (n, features), in units of `scale`."""
    distance = jnp.sum(((features(press)[None] - seen) / scale[None]) ** 2, axis=-1)
    bound = jnp.sort(distance)[jnp.minimum(count, len(distance)) - 1]
    near = (distance <= bound).astype(jnp.float32)
    return near / jnp.sum(near)


def image_weights(press: PressCurve, library: PatchLibrary, width: Array) -> Array:
    """Weights by a perfect tactile image: the true newtons on each cell of 1 mm at every stop against the library's."""
    distance = jnp.zeros(len(library.patch))
    knots = jnp.log(library.loads)
    for s in range(press.force.shape[0]):
        total = jnp.maximum(jnp.sum(press.newtons[s]), 0.05)
        low = jnp.clip(jnp.searchsorted(knots, jnp.log(total)) - 1, 0, len(knots) - 2)
        step = jnp.clip((jnp.log(total) - knots[low]) / (knots[low + 1] - knots[low]), 0, 1)
        first, second = (library.newtons[:, i].astype(jnp.float32) / library.loads[i] for i in (low, low + 1))
        wanted = press.newtons[s] / total
        apart = jnp.sum((first + step * (second - first) - wanted[None]) ** 2, axis=-1)
        distance = distance + apart / jnp.sum(wanted**2)
    return jax.nn.softmax(-0.5 * distance / (width**2 * press.force.shape[0]))


def train_network(key: Array, presses: PressCurve, library: PatchLibrary, steps: int) -> PixelNetwork:
    """A small network from what presses of the library's patches measured to mask, contact and depth of each pixel."""
    inputs = features(presses)
    mean, std = jnp.mean(inputs, axis=0), jnp.std(inputs, axis=0) + 1e-6
    inputs = (inputs - mean[None]) / std[None]
    patch = 1e3 * jnp.asarray(library.patch[:, ::COARSE, ::COARSE], jnp.float32).reshape(len(inputs), -1)
    key_init, key_steps = jax.random.split(key)
    outputs = 3 * patch.shape[1]
    layers = mlp.init(key_init, (inputs.shape[1], HIDDEN_UNITS, HIDDEN_UNITS, outputs))

    def loss(layers: mlp.Layers, key: Array) -> Array:
        rows = jax.random.randint(key, (PRESSES_A_STEP,), 0, len(inputs))
        mask, depth, log_std = _pixels(jax.vmap(partial(mlp.apply, layers))(inputs[rows]))
        target = patch[rows]
        near = target <= 1e3 * CONTACT_TOLERANCE_M
        gaussian = 0.5 * ((target - depth) / jnp.exp(log_std)) ** 2 + log_std
        return jnp.mean(gaussian + optax.sigmoid_binary_cross_entropy(mask, near))

    fit = jax.jit(
        lambda layers, keys: training.descend(layers, loss, optax.adam(optax.cosine_decay_schedule(2e-3, steps)), keys)
    )
    return PixelNetwork(fit(layers, jax.random.split(key_steps, steps))[0], mean, std)


def network_pixels(network: PixelNetwork, press: PressCurve) -> tuple[Array, Array, Array]:
    """Mask probability, depth (m) and its standard deviation (m) of the network's coarse pixels (q, q)."""
    values = mlp.apply(network.layers, (features(press) - network.mean) / network.std)
    mask, depth, log_std = _pixels(values)
    side = round(mask.shape[-1] ** 0.5)
    mask, depth, log_std = (part.reshape(side, side) for part in (mask, depth, log_std))
    return jax.nn.sigmoid(mask), 1e-3 * depth, 1e-3 * jnp.exp(log_std)


def _pixels(values: Array) -> tuple[Array, Array, Array]:
    mask, depth, log_std = jnp.split(values, 3, axis=-1)
    return mask, depth + 2.0, jnp.clip(log_std, -4.0, 2.0)
