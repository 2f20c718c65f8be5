"""Predicted touches of a few sites, objects and poses, given and not imagined: nothing is rendered or pressed. Tests
that use them share their shapes, and so what is compiled.
"""

import jax.numpy as jnp
import numpy as np

from i2t.recognition.belief import TouchObservation
from i2t.recognition.outcomes import PredictedTouch
from i2t.skin_models.likelihood import Likelihood, fit_likelihood

SITES, OBJECTS, PARTICLES, CHANNELS = 5, 2, 4, 12  # of a 4-chip board
LOADS = jnp.array([0.3, 0.9, 2.7])
OVERTRAVEL_M = 6e-3


def predicted_touches() -> PredictedTouch:
    """Touches whose readings differ by site and object, and not by pose."""
    rng = np.random.default_rng(0)
    shape = (SITES, OBJECTS, PARTICLES)
    reading = rng.normal(scale=10, size=(*shape[:2], 1, 1, CHANNELS))
    reading = reading * np.ones((PARTICLES, 1, 1)) * np.asarray(LOADS)[:, None]
    return PredictedTouch(
        hit=jnp.ones(shape, bool), approach_distance=jnp.zeros(shape), jacobian=jnp.zeros((*shape, 6)),
        indentation=jnp.float32(np.tile(1e-4 * LOADS, (*shape, 1))), reading=jnp.float32(reading),
        variance=jnp.full((*shape, 3), 1e-3),
    )  # fmt: skip


def likelihood() -> Likelihood:
    """Errors of 1 uT and 0.1 mm."""
    errors = np.random.default_rng(1).normal(size=(50, CHANNELS))
    return fit_likelihood(errors, jnp.ones(CHANNELS), LOADS, overtravel=OVERTRAVEL_M, position_std=1e-4)


def measured(table: PredictedTouch, site: int, which: int) -> TouchObservation:
    """A touch of an object at a site, at the middle load, without errors."""
    return TouchObservation(
        reading=table.reading[site, which, 0, 1],
        force=jnp.float32(0.9),
        advance=jnp.float32(1.8e-4),
        contact=jnp.asarray(True),
    )
