"""A little of everything that is laid over devices, as a program: `python bulk_work.py OUT [PROCESSES NUMBER PORT]`.

OUT gets all numbers, by name. With the other words it is one of several processes that work as one, each of them a
little later than the one before. Each works on one core, because XLA divides a loop by the number of cores, which may
change last bits.
"""

import os
import sys
import time
from typing import Any

if __name__ == "__main__" and hasattr(os, "sched_setaffinity"):  # before XLA counts cores
    cores = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {cores[int((sys.argv[3:4] or ["0"])[0]) % len(cores)]})

import jax
import jax.numpy as jnp
import numpy as np

from i2t.objects import catalogue
from i2t.prediction import training
from i2t.prediction.model import Inputs, ModelConfig
from i2t.prediction.training import Batch, TrainConfig
from i2t.recognition import belief
from i2t.recognition.belief import TouchObservation
from i2t.recognition.episodes import Episodes, run_belief
from i2t.recognition.outcomes import LOADS_N, PRESSURE_GRID, LinearReadingModel
from i2t.recognition.site_pool import SitePool, pose_particles, predict_outcomes, prepare_surfaces
from i2t.simulation.press import PressLimits
from i2t.simulation.touches import SimulationErrors, simulate_touches
from i2t.skin.pad import nominal_pad
from i2t.types import ReturnCode

ERRORS, LIMITS = SimulationErrors(), PressLimits()
NETWORK = ModelConfig(pixels=8, encoder_width=16, bottleneck=4, decoder_width=24, auxiliary_width=12, members=3)


def compute() -> dict[str, np.ndarray]:
    """Touches of five sessions, predicted touches, posteriors along episodes, and an ensemble of three networks."""
    surfaces = prepare_surfaces([catalogue.make_object(name).mesh for name in ("square", "hexagon")])
    touches = simulate_touches(jax.random.key(0), surfaces, nominal_pad(), ERRORS, [7, 5], touches_per_session=3)
    rng = np.random.default_rng(0)
    cells = PRESSURE_GRID.cells**2
    weights, own = rng.normal(size=(3, cells, 15)), 0.1 * rng.normal(size=(3, cells, 4))
    scale, loads = jnp.full(15, 20.0), jnp.float32(LOADS_N)
    model = LinearReadingModel(loads, jnp.float32(weights), jnp.float32(own), scale, jnp.float32(1.0))
    reach = LIMITS.overtravel
    likelihood = belief.fit_likelihood(rng.normal(size=(50, 15)), scale, loads, overtravel=reach, position_std=1e-4)
    particles = pose_particles(ERRORS, 64, 0)
    sites = SitePool(jnp.asarray(touches.T_w_t), np.asarray(touches.object))
    (table,) = predict_outcomes(surfaces, particles.twist, sites.T_w_t, [model], overtravel=reach)
    site = np.arange(48).reshape(24, 2) % len(sites.owner)
    force, met = touches.force[site], touches.code[site] != ReturnCode.AIR
    seen = TouchObservation(touches.reading[site], force, 1e-4 * force, met)
    episodes = Episodes(np.zeros(24, int), site, seen, np.asarray(touches.T_w_t)[site])
    beliefs = run_belief(table, episodes, likelihood, particles, ["fused", "position"])
    everything: dict[str, Any] = {"touches": touches, "table": table, "beliefs": beliefs, "networks": _trained(rng)}
    paths = jax.tree_util.tree_leaves_with_path(everything)
    return {jax.tree_util.keystr(path): np.asarray(leaf) for path, leaf in paths}


def _trained(rng: np.random.Generator) -> training.TrainState:
    images, targets = jnp.float32(rng.normal(size=(40, 8, 8))), jnp.float32(rng.normal(size=(40, 15)))
    raw = Batch(Inputs(images, jnp.zeros((40, 0))), targets)
    ready = training.prepare(NETWORK, training.normalisation(raw), raw)
    cfg = TrainConfig(epochs=5, batch_size=16)
    state = training.fit(training.start(NETWORK, cfg, 40), NETWORK, cfg, ready, ready, chunk=3)
    return state._replace(key=jax.random.key_data(state.key))


if __name__ == "__main__":
    out, *several = sys.argv[1:]
    if several:
        processes, number, port = map(int, several)
        jax.distributed.initialize(f"127.0.0.1:{port}", processes, number)
        time.sleep(40 * number)  # longer than collectives wait
    print(f"{jax.device_count()} devices of {jax.process_count()} processes")
    np.savez(out, **compute())
