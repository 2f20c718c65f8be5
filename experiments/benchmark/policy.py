"""Section `policy` of the benchmark: what a decision for the next touch costs, next to imagining its outcomes anew.

25 objects with 64 pose particles each, 256 sites. Predicted touches are drawn at random, as their values change no
time; the peer is what a robot would do that had not predicted them before: `i2t.recognition.outcomes.predict_contact`
on real meshes, timed on a part of them and scaled up. The cold time, with compilation, is a row of its own.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.benchmark.timing import BenchmarkRow, compare, interleave
from i2t.objects import catalogue
from i2t.recognition import belief, outcomes, policy
from i2t.recognition.outcomes import LOADS_N, PredictedTouch
from i2t.rendering.render import prepare_surface
from i2t.simulation.press import PressLimits
from i2t.simulation.sites import RECOGNITION_LIMITS, collect_sites


@dataclass(frozen=True)
class Policy:
    """Sizes of the decision."""

    objects: int = 25
    sites: int = 256
    num_particles: int = 64
    channels: int = 15
    imagined: int = 512  # touches that the peer's time is taken of


def section(setup: Policy, turns: int) -> list[BenchmarkRow]:
    """A decision with predictions at hand, from a belief after some touches, and without."""
    rng = np.random.default_rng(0)
    table = _random_table(setup, rng)
    errors = rng.normal(scale=3, size=(200, setup.channels))
    likelihood = belief.fit_likelihood(
        errors, jnp.full(setup.channels, 20.0), jnp.float32(LOADS_N),
        overtravel=PressLimits.overtravel, position_std=1e-4,
    )  # fmt: skip
    particles = belief.sample_particles(outcomes.placement_std(1e-3, np.radians(1)), setup.num_particles)
    start = belief.init(particles, setup.objects, channels=setup.channels)
    now = start._replace(log_weight=start.log_weight + jnp.float32(rng.normal(size=start.log_weight.shape)))

    @jax.jit
    def decide(key: jax.Array, now: belief.Belief) -> jax.Array:
        gain = policy.expected_information_gain(key, now, table, likelihood)
        return policy.choose_site(gain, jnp.ones(setup.sites, bool))

    def ours() -> None:
        jax.block_until_ready(decide(jax.random.key(0), now))

    begin = time.perf_counter()
    ours()
    cold = time.perf_counter() - begin
    imagine = _predict_on_mesh(setup)
    share = setup.objects * setup.sites * setup.num_particles / setup.imagined
    seconds = interleave({"ours": ours, "peer": imagine}, turns)
    anew = [mine + share * theirs for mine, theirs in zip(seconds["ours"], seconds["peer"], strict=True)]
    work = f"a decision, {setup.objects} objects, {setup.sites} sites"
    return [
        compare("policy", work, seconds["ours"], "imagining anew", anew),
        compare("policy", f"{work}, cold", [cold] * turns, "imagining anew", anew),
    ]


def _random_table(setup: Policy, rng: np.random.Generator) -> PredictedTouch:
    """Predicted touches, (sites, objects, k), that are none of any object."""
    shape, loads = (setup.sites, setup.objects, setup.num_particles), np.array(LOADS_N)
    return PredictedTouch(
        hit=jnp.asarray(rng.random(shape) < 0.8),
        approach_distance=jnp.float32(rng.normal(scale=1e-3, size=shape)),
        jacobian=jnp.float32(rng.normal(scale=0.5, size=(*shape, 6))),
        indentation=jnp.float32(rng.uniform(1e-4, 5e-4, (*shape, len(loads)))),
        reading=jnp.float32(rng.normal(scale=10, size=(*shape, len(loads), setup.channels)) * loads[:, None]),
        variance=jnp.float32(rng.uniform(0, 0.1, (*shape, len(loads)))),
    )


def _predict_on_mesh(setup: Policy) -> Callable[[], Any]:
    """A part of the predictions, made on a mesh."""
    surface = prepare_surface(catalogue.make_object("star").mesh)
    sites = collect_sites(jax.random.key(1), surface, setup.imagined, RECOGNITION_LIMITS, "star")
    predict = jax.jit(
        jax.vmap(partial(outcomes.predict_contact, overtravel=PressLimits.overtravel), (None, None, None, 0, None))
    )
    return lambda: jax.block_until_ready(predict(surface, jnp.eye(4), jnp.zeros(6), sites, jnp.float32(LOADS_N)))
