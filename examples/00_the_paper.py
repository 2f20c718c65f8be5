"""Imagine2touch in one page, simulated: touch two objects, learn to imagine touches, recognise others by them.

python examples/00_the_paper.py
"""

import jax
import numpy as np

import i2t
from i2t.dataset import holdout_names
from i2t.paper import loop
from i2t.prediction.methods import TrainingTouches
from i2t.prediction.networks import PaperDepth
from i2t.recognition.environment import EnvironmentConfig, TouchEnvironment
from i2t.recognition.metrics import hits
from i2t.recognition.paper_rules import contact_distances, reading_scorers, run_loop
from i2t.recognition.rollout import begin_episodes
from i2t.recognition.site_pool import prepare_surfaces, sample_pools
from i2t.recognition.touch_table import environment_params
from i2t.simulation.sites import RECOGNITION_LIMITS
from i2t.training import TrainConfig

TRAINING, TOOL, UNSEEN = ("hexagon", "parallelogram"), "cutter", ("star", "square", "cylinder")


def main(touches: int = 468, epochs: int = 60, episodes: int = 24, count: int = loop.TOUCHES) -> dict[str, float]:
    """Run the paper's experiment; return the share of episodes in which each method recognises the object."""
    key_touch, key_fit, key_pool, key_begin, key_loop = jax.random.split(jax.random.key(0), 5)
    pad, errors, limits = i2t.nominal_pad(), i2t.SimulationErrors(), i2t.PressLimits()

    # Touch two objects to learn from, and a tool to choose the best epoch by, at random places in sessions of 36.
    names = (*TRAINING, TOOL)
    surfaces = prepare_surfaces([i2t.make_object(name).mesh for name in names])
    touched = i2t.simulate_touches(key_touch, surfaces, pad, errors, touches, touches_per_session=36, limits=limits)
    dataset = i2t.Dataset.simulated(touched, names, pad)
    held_out = holdout_names(dataset, "object", [TOOL])
    split = i2t.Split(~held_out, held_out, np.zeros(len(held_out), bool), dataset.touches.session, "object")

    # Learn tau~ = f(patch): 48 x 48 -> 200 -> 5 -> 500 -> 15, with the decoded patch as a second task.
    predictor = PaperDepth().fit(
        key_fit, TrainingTouches(dataset, training=TrainConfig(epochs=epochs, batch_size=32)), split
    )
    tau = dataset.touches.reading[held_out]
    imagined = predictor.predict(dataset.touches.patch[held_out]).mean
    explained = 1 - ((imagined - tau) ** 2).sum() / ((tau - tau.mean(0)) ** 2).sum()
    print(f"touches of the {TOOL}, which was not learned from: R2 {explained:.2f} (simulated)")

    # Recognise objects never touched before: sample a hypothesis, touch where it tells most, let the touch vote.
    surfaces = prepare_surfaces([i2t.make_object(name).mesh for name in UNSEEN])
    pools = sample_pools(key_pool, surfaces, UNSEEN, pools=1, per_object=24, limits=RECOGNITION_LIMITS)
    truth = np.arange(episodes) % len(UNSEEN)
    world = TouchEnvironment(config := EnvironmentConfig(errors, limits, count))
    params = environment_params(surfaces, [pad], pools.joined(), config)
    scorers = reading_scorers({"Imagine2touch": predictor}, surfaces, dataset.touches.reading[~held_out].std(0))
    scorers["proprioception"] = lambda touch: contact_distances(surfaces, touch)  # where was the contact, alone
    right = {}
    for method, score in scorers.items():  # on the same objects, with the same draws
        robot = begin_episodes(jax.random.clone(key_begin), world, params, truth)
        made = run_loop(jax.random.clone(key_loop), score, robot, pools, np.zeros(episodes, int))
        right[method] = float(hits(loop.beliefs(made.distance, "votes"), truth)[:, -1].mean())
        chance = f"chance {1 / len(UNSEEN):.0%}; simulated"
        print(f"{method} recognised {right[method]:.0%} of {episodes} after {count} touches ({chance})")
    return right


if __name__ == "__main__":
    i2t.use_compile_cache()
    main()
