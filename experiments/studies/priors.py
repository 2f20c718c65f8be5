"""Prior of pad models for a pad in one world, estimated from touches in other worlds.

A prior is a list of layers and the covariance of their discrepancy (`i2t.skin_models.reading_model.ReadingPrior`). For
each world, the best layer and the hyperparameters of the covariance are fitted to exact contacts and recorded readings
of a simulated pad. The prior consists of the best layers of its worlds and the medians of their hyperparameters.
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

FITTING_TOUCHES = 900  # as many as `DISCREPANCY` was fitted to


class WorldCall(NamedTuple):
    """Best layer and discrepancy for the touches of one world."""

    layer: int  # index into LAYERS
    discrepancy: GPHyperparameters


def call_of(dataset: Dataset) -> WorldCall:
    """Fit the layer and the covariance of its discrepancy to simulated touches.

    Args:
        dataset: Touches of one pad with their true contacts.

    Returns:
        The hyperparameters that best predict left-out sessions on the nominal layer, and the layer that then best
        explains the touches.
    """
    rows = np.random.default_rng(0).permutation(len(dataset))[:FITTING_TOUCHES]

    def press(rows: np.ndarray, layer: Layer) -> PressedTouches:
        touches = jax.tree.map(lambda x: x[rows], dataset.touches)
        return press_at_truth(touches.truth, layer)._replace(reading=np.asarray(touches.reading))

    contact, readings = press(rows, NOMINAL_LAYER)
    sessions = np.asarray(dataset.touches.session)[rows]
    discrepancy, _ = choose_hyperparameters(contact, jnp.asarray(readings), sessions, limit=FITTING_TOUCHES)
    pressed = [press(rows[: AVERAGING.max_touches], layer) for layer in LAYERS]
    return WorldCall(choose_layer(pressed, LAYERS, dataset.board, discrepancy), discrepancy)


def prior_from(calls: Sequence[WorldCall]) -> ReadingPrior:
    """Build the prior from some worlds.

    Args:
        calls: Best layers and discrepancies of the worlds.

    Returns:
        The distinct layers, in the order of LAYERS, and the medians of the hyperparameters, without noise.
    """
    layers = tuple(LAYERS[i] for i in sorted({call.layer for call in calls}))
    fits = [call.discrepancy for call in calls]
    medians = jax.tree.map(lambda *values: jnp.float32(np.median(values, axis=0)), *fits)
    weights = medians.weights / jnp.sum(medians.weights)
    return ReadingPrior(layers, medians._replace(weights=weights, noise=jnp.float32(0)))


def prior_without(calls: Mapping[str, WorldCall], world: str) -> ReadingPrior:
    """Build the prior for a pad in one world from all other worlds.

    Args:
        calls: Best layers and discrepancies by world.
        world: Name of the world that is left out.

    Returns:
        The prior from the remaining worlds.
    """
    return prior_from([call for name, call in calls.items() if name != world])
