"""Imagine2touch in one page, simulated: touch two objects, learn to imagine touches, recognise others by them.

python examples/00_the_paper.py
"""

import jax
import numpy as np

import i2t
from i2t.paper import loop
from i2t.prediction.methods import TrainingTouches
from i2t.prediction.networks import PaperDepth
from i2t.recognition.environment import EnvironmentConfig, TouchEnvironment
from i2t.recognition.paper_rules import reading_scorers, run_loop
from i2t.recognition.rollout import begin_episodes
from i2t.recognition.site_pool import prepare_surfaces, sample_pools
from i2t.recognition.touch_table import environment_params
from i2t.simulation.sites import RECOGNITION_LIMITS
from i2t.training import TrainConfig

TRAINING, UNSEEN = ("hexagon", "parallelogram"), ("star", "square", "cylinder")


def main(touches: int = 936, epochs: int = 60, episodes: int = 24, count: int = loop.TOUCHES) -> float:
    """Run the paper's experiment, and return the share of episodes whose object is recognised."""
    keys, pad = jax.random.split(jax.random.key(0), 5), i2t.nominal_pad()
    errors, limits = i2t.SimulationErrors(), i2t.PressLimits()

    # Touch two objects at random places, in sessions of 36; a fifth of the sessions chooses the best epoch.
    surfaces = prepare_surfaces([i2t.make_object(name).mesh for name in TRAINING])
    touched = i2t.simulate_touches(keys[0], surfaces, pad, errors, touches // 2, touches_per_session=36, limits=limits)
    dataset = i2t.Dataset.simulated(touched, TRAINING, pad)
    session = dataset.touches.session
    held_out = session % 5 == 4
    split = i2t.Split(~held_out, held_out, np.zeros(len(session), bool), session, "session")

    # Learn tau~ = f(patch): 48 x 48 -> 200 -> 5 -> 500 -> 15, with the decoded patch as a second task.
    predictor = PaperDepth().fit(
        keys[1], TrainingTouches(dataset, training=TrainConfig(epochs=epochs, batch_size=32)), split
    )
    tau = dataset.touches.reading[held_out]
    imagined = predictor.predict(dataset.touches.patch[held_out]).mean
    explained = 1 - ((imagined - tau) ** 2).sum() / ((tau - tau.mean(0)) ** 2).sum()
    print(f"validation sessions: R2 {explained:.2f} (simulated)")

    # Recognise objects never touched before: sample a hypothesis, touch where it tells most, let the touch vote.
    surfaces = prepare_surfaces([i2t.make_object(name).mesh for name in UNSEEN])
    pools = sample_pools(keys[2], surfaces, UNSEEN, pools=1, each=24, limits=RECOGNITION_LIMITS)
    truth = np.arange(episodes) % len(UNSEEN)
    world = TouchEnvironment(config := EnvironmentConfig(errors, limits, count))
    params = environment_params(surfaces, [pad], pools.joined(), config)
    robot = begin_episodes(keys[3], world, params, truth)
    score = reading_scorers({"paper": predictor}, surfaces, dataset.touches.reading[~held_out].std(0))["paper"]
    made = run_loop(keys[4], score, robot, pools, np.zeros(episodes, int))
    belief = loop.beliefs(made.distance, "votes")[:, -1]
    right = float((belief.argmax(1) == truth).mean())
    print(f"recognised after {count} touches: {right:.0%} of {episodes} (chance {1 / len(UNSEEN):.0%}; simulated)")
    return right


if __name__ == "__main__":
    i2t.use_compile_cache()
    main()
