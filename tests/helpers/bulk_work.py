"""A little of everything that is laid over devices, as a program: `python bulk_work.py OUT`.

OUT gets all numbers, by name. It works on one core, because XLA divides a loop by the number of cores, which may change
last bits.
"""

import os
import sys

if __name__ == "__main__" and hasattr(os, "sched_setaffinity"):  # before XLA counts cores
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})

import jax
import jax.numpy as jnp
import numpy as np

from i2t import training
from i2t.objects import catalogue
from i2t.prediction.model import Inputs, ModelConfig, learner, normalisation, prepared
from i2t.recognition.belief import TouchObservation
from i2t.recognition.episodes import Episodes, run_belief
from i2t.recognition.site_pool import pose_particles, prepare_surfaces
from i2t.runtime import compiling
from i2t.simulation.touches import SimulationErrors, simulate_touches
from i2t.skin.pad import nominal_pad
from i2t.training import Batch, TrainConfig

ERRORS = SimulationErrors()
compiling.QUICK_OPTIONS.clear()  # programs are all compiled by what XLA_FLAGS say, which is with few optimisations
NETWORK = ModelConfig(pixels=8, encoder_width=16, bottleneck=4, decoder_width=24, auxiliary_width=12, members=3)


def compute() -> dict[str, np.ndarray]:
    """Touches of five sessions, posteriors along episodes of given touches, and an ensemble of three networks."""
    from helpers.predicted_touches import CHANNELS, PARTICLES, SITES, likelihood, predicted_touches

    surfaces = prepare_surfaces([catalogue.make_object(name).mesh for name in ("square", "hexagon")])
    touches = simulate_touches(jax.random.key(0), surfaces, nominal_pad(), ERRORS, [7, 5], touches_per_session=3)
    rng = np.random.default_rng(0)
    site = np.arange(48).reshape(24, 2) % SITES
    reading, force = jnp.float32(rng.normal(size=(24, 2, CHANNELS))), jnp.float32(rng.uniform(0.3, 2.7, (24, 2)))
    seen = TouchObservation(reading, force, 1e-4 * force, jnp.ones((24, 2), bool))
    episodes = Episodes(np.zeros(24, int), site, seen, np.asarray(touches.T_w_t)[site])
    particles = pose_particles(ERRORS, PARTICLES, 0)
    beliefs = run_belief(predicted_touches(), episodes, likelihood(), particles, ["fused", "position"])
    everything = {"touches": touches, "beliefs": beliefs, "networks": _trained(rng)}
    paths = jax.tree_util.tree_leaves_with_path(everything)
    return {jax.tree_util.keystr(path): np.asarray(leaf) for path, leaf in paths}


def _trained(rng: np.random.Generator) -> training.TrainState:
    images, targets = jnp.float32(rng.normal(size=(40, 8, 8))), jnp.float32(rng.normal(size=(40, 15)))
    raw = Batch(Inputs(images, jnp.zeros((40, 0))), targets)
    ready = prepared(NETWORK, normalisation(raw), raw)
    cfg = TrainConfig(epochs=5, batch_size=16)
    state = training.init(jax.random.key(0), learner(NETWORK), cfg, 40)
    epoch = training.compiled(learner(NETWORK), cfg)
    for _ in range(cfg.epochs):
        state, _ = epoch(state, ready, ready)
    return state._replace(key=jax.random.key_data(state.key))  # which NumPy can hold


if __name__ == "__main__":
    print(f"{jax.device_count()} devices")
    np.savez(sys.argv[1], **compute())
