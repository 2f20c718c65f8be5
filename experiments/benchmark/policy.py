"""Section `policy` of the benchmark: what a decision for the next touch costs, against imagining its outcomes anew.

25 objects in 64 places each, 256 sites. Outcomes are drawn at random, as their values change no time; the peer is what
a robot would do that had not imagined them before: `i2t.recognition.outcomes.meet` on real meshes, timed on a part of
them and scaled up. The cold time, with compilation, is a row of its own.
"""

import time
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from experiments.benchmark.timing import Row, compare, in_turns
from i2t.objects import catalogue
from i2t.recognition import belief, outcomes, policy
from i2t.recognition.outcomes import LOADS, PredictedTouch
from i2t.rendering.render import prepare_surface
from i2t.simulation.press import PressLimits
from i2t.simulation.sites import RECOGNITION, collect_sites


@dataclass(frozen=True)
class Policy:
    """How much there is to choose among."""

    objects: int = 25
    sites: int = 256
    places: int = 64
    imagined: int = 512  # touches that the peer's time is taken of


def section(setup: Policy, turns: int) -> list[Row]:
    """A decision with outcomes at hand, from a belief after some touches, and without."""
    rng = np.random.default_rng(0)
    shape = (setup.sites, setup.objects, setup.places)
    loads = jnp.float32(LOADS)
    table = PredictedTouch(
        jnp.asarray(rng.random(shape) < 0.8), *(jnp.float32(x) for x in (
            rng.normal(scale=1e-3, size=shape), rng.normal(scale=0.5, size=(*shape, 6)),
            rng.uniform(1e-4, 5e-4, (*shape, 3)), rng.normal(scale=10, size=(*shape, 3, 15)) * np.array(LOADS)[:, None],
            rng.uniform(0, 0.1, (*shape, 3)),
        )),
    )  # fmt: skip
    errors = rng.normal(scale=3, size=(200, 15))
    like = belief.fit_likelihood(errors, jnp.full(15, 20.0), loads, PressLimits.past_goal, 1e-4)
    places = belief.sample_particles(outcomes.placement_std(1e-3, np.radians(1)), setup.places)
    start = belief.init(places, setup.objects)
    now = start._replace(log_weight=start.log_weight + jnp.float32(rng.normal(size=start.log_weight.shape)))

    @jax.jit
    def decide(key: jax.Array, now: belief.Belief) -> jax.Array:
        return policy.choose_site(policy.expected_information_gain(key, now, table, like), jnp.ones(setup.sites, bool))

    def ours() -> None:
        jax.block_until_ready(decide(jax.random.key(0), now))

    begin = time.perf_counter()
    ours()
    cold = time.perf_counter() - begin
    imagine = _imagining(setup, loads)
    share = setup.objects * setup.sites * setup.places / setup.imagined
    seconds = in_turns({"ours": ours, "peer": imagine}, turns)
    anew = [mine + share * theirs for mine, theirs in zip(seconds["ours"], seconds["peer"], strict=True)]
    work = f"a decision, {setup.objects} objects, {setup.sites} sites"
    return [
        compare("policy", work, seconds["ours"], "imagining anew", anew),
        compare("policy", f"{work}, cold", [cold] * turns, "imagining anew", anew),
    ]


def _imagining(setup: Policy, loads: jax.Array):
    """A part of the outcomes, imagined on a mesh."""
    surface = prepare_surface(catalogue.make_object("star").mesh)
    sites = collect_sites(jax.random.key(1), surface, setup.imagined, RECOGNITION, "star")
    meet = jax.jit(jax.vmap(partial(outcomes.predict_contact, past=PressLimits.past_goal), (None, None, None, 0, None)))
    return lambda: jax.block_until_ready(meet(surface, jnp.eye(4), jnp.zeros(6), sites, loads))
