"""Sections `latency` and `simulation`: computations between two touches of a robot, and simulated touches per second.

No other library offers them, so the rows have goals instead of peers.
"""

from collections.abc import Iterator
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

import i2t
from experiments.benchmark.contests import Contest, Work
from i2t.recognition import belief, policy
from i2t.recognition.outcomes import PredictedTouch, placement_std
from i2t.recognition.recognizer import RecognizerConfig
from i2t.simulation.touches import PressLimits, SimulationErrors
from i2t.skin.contact import FINE_GRID
from i2t.skin_models.likelihood import fit_likelihood
from i2t.skin_models.reading_model import LOADS_N


def simulation(small: bool) -> Iterator[Contest]:
    """Simulate touches of two objects in sessions of 36, on a random pad, with the errors of a lab."""
    surfaces = [i2t.prepare_surface(i2t.make_object(name).mesh) for name in ("hexagon", "star")]
    pad, per_object = i2t.sample_pad(jax.random.key(0)), 36 if small else 360
    ends = {"": PressLimits(), ", last press on the fine grid": PressLimits(final=FINE_GRID)}
    for ending, limits in list(ends.items())[: 1 if small else 2]:
        touches = partial(
            i2t.simulate_touches, jax.random.key(1), surfaces, pad, SimulationErrors(), per_object, limits=limits
        )
        goal = None if ending else 370.0
        yield Contest(f"simulated touches{ending}", touches, our_calls=1 / (2 * per_object), unit="1/s", goal=goal)


def latency(small: bool) -> Iterator[Contest]:
    """Time computations between two touches with the ready models: predictions on a mesh and of a patch, an update of
    the belief about five objects, and the choice of the next site, also from a large pool.
    """
    names = ("star", "square", "flower", "cylinder", "hammer")[: 2 if small else 5]
    meshes = {name: i2t.make_object(name).mesh for name in names}
    predictor, hammer = i2t.load_predictor("nominal"), meshes[names[-1]]
    T_o_t = i2t.contact_pose(hammer, hammer.vertices[hammer.vertices[:, 2].argmax()])
    patch = np.asarray(i2t.render_patch(i2t.prepare_surface(hammer), T_o_t).depth)
    steady = 0.0 if small else 0.5
    yield Contest(
        "prediction of a touch on a mesh", lambda: predictor.predict_touch(hammer, T_o_t, force=1.0), unit="ms",
        steady=steady,
    )  # fmt: skip
    yield Contest("prediction from a patch", lambda: predictor.predict(patch, force=1.0), unit="ms", steady=steady)

    config = RecognizerConfig(num_sites=4, num_particles=8) if small else RecognizerConfig()
    pad_model = i2t.load_pad_model("nominal").model
    recognizer = i2t.ObjectRecognizer(jax.random.key(0), pad_model, meshes, config=config)
    state = recognizer.init()
    site = recognizer.choose_touch(state)
    assert site is not None
    seen = recognizer.observe(site, np.zeros(recognizer.channels), force=1.0, T_w_t=site.T_w_t, contact=True)
    about = f"{len(names)} objects"
    yield Contest(f"update of the belief, {about}", lambda: recognizer.update(state, seen), unit="ms", steady=steady)
    yield Contest(f"choice of the next site, {about}", lambda: recognizer.choose_touch(state), unit="ms", steady=steady)
    shape = (8, 3, 4) if small else (256, 25, 64)
    about = f"{shape[1]} objects, {shape[0]} sites"
    yield Contest(f"choice from a large pool, {about}", _decision(*shape), unit="ms", steady=steady)


def _decision(sites: int, objects: int, particles: int) -> Work:
    """Make a function that chooses a site by expected information, from random predicted touches."""
    rng, loads = np.random.default_rng(0), np.array(LOADS_N)
    shape, channels = (sites, objects, particles), 15
    table = PredictedTouch(
        hit=jnp.asarray(rng.random(shape) < 0.8),
        approach_distance=jnp.float32(rng.normal(scale=1e-3, size=shape)),
        jacobian=jnp.float32(rng.normal(scale=0.5, size=(*shape, 6))),
        indentation=jnp.float32(rng.uniform(1e-4, 5e-4, (*shape, len(loads)))),
        reading=jnp.float32(rng.normal(scale=10, size=(*shape, len(loads), channels)) * loads[:, None]),
        variance=jnp.float32(rng.uniform(0, 0.1, (*shape, len(loads)))),
    )
    likelihood = fit_likelihood(
        rng.normal(scale=3, size=(200, channels)), jnp.full(channels, 20.0), jnp.float32(loads),
        overtravel=PressLimits.overtravel, position_std=1e-4,
    )  # fmt: skip
    poses = belief.sample_particles(placement_std(1e-3, np.radians(1)), particles)
    now = belief.init(poses, objects, channels=channels)
    now = now._replace(log_weight=now.log_weight + jnp.float32(rng.normal(size=now.log_weight.shape)))

    @jax.jit
    def choose(seed: jax.Array, now: belief.Belief) -> jax.Array:
        gain = policy.expected_information_gain(jax.random.key(seed), now, table, likelihood)
        return policy.choose_site(gain, jnp.ones(sites, bool))

    return lambda: jax.block_until_ready(choose(jnp.uint32(0), now))
