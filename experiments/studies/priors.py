"""The prior of pad models, estimated from the touches of some worlds for a pad in another.

A prior is a list of layers and the covariance of what they leave (`i2t.skin_models.reading_model.ReadingPrior`). Each
world calls for one of the layers and for hyperparameters of that covariance, fitted to exact contacts and recorded
readings of a simulated pad. A prior holds the layers that its worlds call for and the medians of their hyperparameters.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from i2t.dataset import Dataset
from i2t.skin_models.layer import NOMINAL_LAYER, Layer
from i2t.skin_models.pad_fit import press_at_truth
from i2t.skin_models.pressure_gp import GPHyperparameters, choose_hyperparameters
from i2t.skin_models.reading_model import AVERAGING, LAYERS, PressedTouches, ReadingPrior, choose_layer

CALLING_TOUCHES = 900  # of a world, as those that `DISCREPANCY` was fitted to


class WorldCall(NamedTuple):
    """What the touches of one world call for."""

    layer: int  # place in LAYERS
    discrepancy: GPHyperparameters


def call_of(dataset: Dataset) -> WorldCall:
    """Find the layer and the covariance that simulated touches call for.

    Args:
        dataset: Touches of one pad with their truth.

    Returns:
        The hyperparameters that predict sessions left out best on the nominal layer, and with them the layer that
        explains the touches best.
    """
    rows = np.random.default_rng(0).permutation(len(dataset))[:CALLING_TOUCHES]

    def press(rows: np.ndarray, layer: Layer) -> PressedTouches:
        touches = jax.tree.map(lambda x: x[rows], dataset.touches)
        return press_at_truth(touches.truth, layer)._replace(reading=np.asarray(touches.reading))

    contact, readings = press(rows, NOMINAL_LAYER)
    sessions = np.asarray(dataset.touches.session)[rows]
    discrepancy, _ = choose_hyperparameters(contact, jnp.asarray(readings), sessions, limit=CALLING_TOUCHES)
    pressed = [press(rows[: AVERAGING.max_touches], layer) for layer in LAYERS]
    return WorldCall(choose_layer(pressed, LAYERS, dataset.board, discrepancy), discrepancy)


def prior_from(calls: Sequence[WorldCall]) -> ReadingPrior:
    """The prior that some worlds give.

    Args:
        calls: Of the worlds.

    Returns:
        The layers that they call for, in the order of LAYERS, and the medians of their hyperparameters, without noise.
    """
    layers = tuple(LAYERS[i] for i in sorted({call.layer for call in calls}))
    fits = [call.discrepancy for call in calls]
    medians = jax.tree.map(lambda *values: jnp.float32(np.median(values, axis=0)), *fits)
    weights = medians.weights / jnp.sum(medians.weights)
    return ReadingPrior(layers, medians._replace(weights=weights, noise=jnp.float32(0)))


def prior_without(calls: Mapping[str, WorldCall], world: str) -> ReadingPrior:
    """The prior for a pad in a world, from all others.

    Args:
        calls: Of the worlds, by name.
        world: That is left out.

    Returns:
        The prior.
    """
    return prior_from([call for name, call in calls.items() if name != world])
