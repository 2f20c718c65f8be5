"""Section `policy` of the benchmark: a decision where to touch."""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.benchmark.contests import Contest
from i2t.objects import catalogue
from i2t.recognition import belief, outcomes
from i2t.recognition import policy as policies
from i2t.recognition.outcomes import LOADS_N, PredictedTouch
from i2t.rendering.render import prepare_surface
from i2t.simulation.press import PressLimits
from i2t.simulation.sites import RECOGNITION_LIMITS, collect_sites

CHANNELS = 15
PREDICTED_ANEW = 512  # touches that the peer's time is taken of


def policy(small: bool) -> Iterator[Contest]:
    """A decision for the next touch with predictions at hand, from a belief after some touches, and without.

    25 objects with 64 pose particles each, 256 sites. Predicted touches are drawn at random, as their values change no
    time; the peer is what a robot would do that had not predicted them before: `predict_contact` on real meshes, timed
    on a part of them and scaled up.
    """
    objects, sites, particles = (3, 8, 4) if small else (25, 256, 64)
    rng = np.random.default_rng(0)
    table = _random_table((sites, objects, particles), rng)
    errors = rng.normal(scale=3, size=(200, CHANNELS))
    likelihood = belief.fit_likelihood(
        errors, jnp.full(CHANNELS, 20.0), jnp.float32(LOADS_N),
        overtravel=PressLimits.overtravel, position_std=1e-4,
    )  # fmt: skip
    start = belief.init(belief.sample_particles(outcomes.placement_std(1e-3, np.radians(1)), particles), objects)
    now = start._replace(log_weight=start.log_weight + jnp.float32(rng.normal(size=start.log_weight.shape)))

    @jax.jit
    def decide(key: jax.Array, now: belief.Belief) -> jax.Array:
        gain = policies.expected_information_gain(key, now, table, likelihood)
        return policies.choose_site(gain, jnp.ones(sites, bool))

    count = 4 if small else PREDICTED_ANEW
    yield Contest(
        f"a decision, {objects} objects, {sites} sites",
        lambda: jax.block_until_ready(decide(jax.random.key(0), now)),
        "predicting the touches anew",
        _predict_on_mesh(count),
        peer_calls=objects * sites * particles / count,
    )


def _random_table(shape: tuple[int, int, int], rng: np.random.Generator) -> PredictedTouch:
    """Predicted touches, (sites, objects, k), that are none of any object."""
    loads = np.array(LOADS_N)
    return PredictedTouch(
        hit=jnp.asarray(rng.random(shape) < 0.8),
        approach_distance=jnp.float32(rng.normal(scale=1e-3, size=shape)),
        jacobian=jnp.float32(rng.normal(scale=0.5, size=(*shape, 6))),
        indentation=jnp.float32(rng.uniform(1e-4, 5e-4, (*shape, len(loads)))),
        reading=jnp.float32(rng.normal(scale=10, size=(*shape, len(loads), CHANNELS)) * loads[:, None]),
        variance=jnp.float32(rng.uniform(0, 0.1, (*shape, len(loads)))),
    )


def _predict_on_mesh(count: int) -> Callable[[], Any]:
    """Some predictions, made on a mesh."""
    surface = prepare_surface(catalogue.make_object("star").mesh)
    sites = collect_sites(jax.random.key(1), surface, count, RECOGNITION_LIMITS, "star")
    predict = jax.jit(
        jax.vmap(partial(outcomes.predict_contact, overtravel=PressLimits.overtravel), (None, None, None, 0, None))
    )
    return lambda: jax.block_until_ready(predict(surface, jnp.eye(4), jnp.zeros(6), sites, jnp.float32(LOADS_N)))
