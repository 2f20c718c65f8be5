"""The paper's recognition (`i2t.paper`) on this package's episodes, pools of sites and predictors.

At each touch every possible object, standing at the world's origin, is rendered at the end of the press, and a
predictor computes the reading of the skin there, pressed with the measured force. The object's distance is that of this
reading from the measured one, in standard deviations of the training readings. Proprioception, the paper's baseline,
takes the distance of the contact from the object's surface, in millimetres.

`paper_rules` applies the rules to recorded episodes. `run_loop` is the paper's whole procedure (`i2t.paper.loop`), in
which every method is scored by its own distances, and `run_paper_loop` compares methods by it on simulated touches. A
method is called Imagine2touch only if its predictor is the paper's network.

Source: Ayad et al., "Imagine2touch", section II. Units are metres, newtons and microtesla; a reading has c = 3 * chips
channels.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from functools import partial
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from i2t import validation
from i2t.contact.press import PressLimits
from i2t.errors import did_you_mean
from i2t.paper import loop, rules
from i2t.paper.loop import LoopResult
from i2t.patches.dimensions import PATCH_PIXELS, PATCH_WINDOW, REACH
from i2t.patches.views import centre
from i2t.prediction.baselines import MeanReading
from i2t.prediction.predictor import Predictor
from i2t.prediction.touch_model import Reading, TouchBatch
from i2t.recognition.environment import EnvironmentConfig, TouchEnvironment, TouchOutcome
from i2t.recognition.episodes import Episodes, MeasuredTouches
from i2t.recognition.metrics import hits
from i2t.recognition.rollout import RunningEpisodes, TouchNumber, advance, begin_episodes, last_touches
from i2t.recognition.site_pool import SitePools, pool_informativeness, sample_pools
from i2t.recognition.touch_table import environment_params
from i2t.rendering.render import render_view
from i2t.runtime.batching import filled_batches, map_on_devices
from i2t.simulation.site_limits import SiteLimits
from i2t.simulation.sites import RECOGNITION_LIMITS
from i2t.simulation.touches import SimulationErrors
from i2t.skin.elasticity import CELL_GRID
from i2t.skin_models.layer import MIN_LOAD_N
from i2t.types import Pad, Surface, in_one_line

PROPRIOCEPTION = "proprioception"  # name of the scorer that uses only the poses at which presses ended
VIEW_BATCH = 64  # number of views that are rendered and predicted together, so that the program compiles once


Scorer: TypeAlias = Callable[[MeasuredTouches], Float[np.ndarray, "n objects"]]  # distances of touches from objects


@in_one_line
class PaperEpisodes(NamedTuple):
    """Record of e episodes in which a method ran the paper's recognition loop: indices of the true objects and of the
    pools of sites, and the method's distance of each touch from each object (in standard deviations of the training
    readings; in millimetres for proprioception).

    Example:
        results = i2t.run_paper_loop(keys, {"mine": predictor}, surfaces, pad, reading_std=std, episodes=24)
        accuracy = results["mine"].hits().mean(0)  # after each touch
    """

    truth: Int[np.ndarray, " e"]  # index of the true object
    pool: Int[np.ndarray, " e"]  # index of the pool of sites; episodes of one pool are not independent
    distance: Float[np.ndarray, "e t objects"]  # of each touch from each object, by the method

    def beliefs(self, rule: str = "votes") -> Float[np.ndarray, "e t objects"]:
        """Compute the beliefs over the objects by one of the paper's rules.

        Args:
            rule: Name of one of `i2t.paper.rules.BELIEF_RULES`.

        Returns:
            `(e, t, objects)` beliefs after each touch.

        Raises:
            ValueError: There is no rule of this name.
        """
        if rule not in rules.BELIEF_RULES:
            raise ValueError(f"rule: is {rule!r}; {did_you_mean(rule, rules.BELIEF_RULES)}")
        return loop.beliefs(self.distance, rule)

    def hits(self, rule: str = "votes") -> Float[np.ndarray, "e t"]:
        """Score whether the decisions by one of the paper's rules are right.

        Args:
            rule: Name of one of `i2t.paper.rules.BELIEF_RULES`.

        Returns:
            `(e, t)` scores after each touch: 1 if right, 0 if wrong, and 1/n if the true object ties with n - 1 others.

        Raises:
            ValueError: There is no rule of this name.
        """
        return hits(self.beliefs(rule), self.truth)


def constant_predictor(reading: Float[np.ndarray, " c"]) -> Predictor:
    """Make a predictor of one constant reading. With it the paper's rules judge by contact alone.

    Args:
        reading: Reading (uT), such as the mean of the training readings.

    Returns:
        Predictor of this reading, with meaningless standard deviations.
    """
    mean = np.asarray(reading, np.float32)
    model = MeanReading(mean, np.ones_like(mean))
    return Predictor(model, PATCH_WINDOW, REACH, default_force=1.0, default_travel=0.0)


class _AtMedianForce(Predictor):
    """Predictor that uses the median force of its training touches instead of the measured one."""

    def predict_batch(self, touches: TouchBatch) -> Reading:
        """Predict readings as `Predictor.predict_batch` does, with that median force for every touch."""
        return super().predict_batch(touches._replace(force=np.full_like(touches.force, self.default_force)))


def at_median_force(predictor: Predictor) -> Predictor:
    """Remove the measured force from a predictor's input, because the paper's network does not use it either.

    Args:
        predictor: A predictor of readings.

    Returns:
        Predictor that uses the median force of its training touches instead.
    """
    return _AtMedianForce(**{field.name: getattr(predictor, field.name) for field in fields(predictor)})


# --- distances ---


def reading_scorers(
    predictors: Mapping[str, Predictor], surfaces: Sequence[Surface], reading_std: Float[np.ndarray, " c"]
) -> dict[str, Scorer]:
    """Make for each predictor a function that scores touches by the distances of readings from each object's.

    Args:
        predictors: Predictors of readings, by name.
        surfaces: Surfaces of the objects.
        reading_std: Standard deviation (uT) of each channel in the training data.

    Returns:
        Scorers by the same names.
    """

    def score(name: str, touches: MeasuredTouches) -> Float[np.ndarray, "n objects"]:
        return reading_distances({name: predictors[name]}, surfaces, touches, reading_std)[name]

    return {name: partial(score, name) for name in predictors}


def reading_distances(
    predictors: Mapping[str, Predictor],
    surfaces: Sequence[Surface],
    touches: MeasuredTouches,
    reading_std: Float[np.ndarray, " c"],
) -> dict[str, Float[np.ndarray, "n objects"]]:
    """Compute distances of measured readings from those predicted on each object; an empty view predicts zero.

    Args:
        predictors: Predictors of readings, by name, which share the rendered views.
        surfaces: Surfaces of the objects.
        touches: The measured touches.
        reading_std: Standard deviation (uT) of each channel in the training data.

    Returns:
        `(n, objects)` distances of the n touches in standard deviations, by the predictors' names.
    """
    # Rendered views have no noise to smooth away.
    ready = {
        name: predictor.with_pressure(smooth=False, cell=CELL_GRID.spacing) for name, predictor in predictors.items()
    }
    n, force = len(touches.force), np.maximum(touches.force, MIN_LOAD_N)
    predicted = {name: np.zeros((n, len(surfaces), touches.reading.shape[-1]), np.float32) for name in predictors}
    for start in range(0, n, VIEW_BATCH):
        rows = np.arange(start, min(start + VIEW_BATCH, n))
        full = np.resize(rows, VIEW_BATCH)
        for i, surface in enumerate(surfaces):
            view, seen = jax.device_get(_views(surface, touches.T_w_t[full].astype(np.float32)))
            for name, predictor in ready.items():
                pitch = predictor.window / PATCH_PIXELS
                travel = np.full(VIEW_BATCH, predictor.default_travel, np.float32)
                pressed = TouchBatch(centre(view, PATCH_PIXELS), view, pitch, force[full], 0 * travel, travel)
                reading = predictor.predict_batch(pressed).mean
                predicted[name][rows, i] = np.where(seen[:, None], reading, 0.0)[: len(rows)]
    measured, std = jnp.float32(touches.reading), jnp.float32(reading_std)
    return {name: np.asarray(rules.distances(measured, jnp.asarray(p), std)) for name, p in predicted.items()}


def contact_distances(surfaces: Sequence[Surface], touches: MeasuredTouches) -> Float[np.ndarray, "n objects"]:
    """Compute distances of the tool's origin, at the end of each press, from each object's surface (proprioception).

    Args:
        surfaces: Surfaces of the objects.
        touches: The measured touches.

    Returns:
        `(n, objects)` distances in millimetres.
    """
    point = np.asarray(touches.T_w_t[:, :3, 3], np.float32)
    batches = filled_batches(np.arange(len(point)), VIEW_BATCH)
    calls = ((point[rows], surface) for surface in surfaces for rows in batches)
    distance = np.concatenate(list(map_on_devices(_nearest_distances, calls))).reshape(len(surfaces), -1)
    return distance[:, : len(point)].T / 1e-3  # mm


# --- rules ---


def beliefs_by_rule(distance: Float[np.ndarray, "e t objects"]) -> dict[str, Float[np.ndarray, "e t objects"]]:
    """Compute beliefs by each of the paper's rules from distances.

    Args:
        distance: `(e, t, objects)` distance from each object of each of the t touches of e episodes.

    Returns:
        `(e, t, objects)` beliefs after each touch, by rule.
    """
    return {rule: loop.beliefs(distance, rule) for rule in rules.BELIEF_RULES}


def paper_rules(
    predictors: Mapping[str, Predictor],
    reading_std: Float[np.ndarray, " c"],
    surfaces: Sequence[Surface],
    episodes: Episodes,
) -> dict[str, Float[np.ndarray, "e t objects"]]:
    """Compute beliefs by the paper's rules along recorded episodes, from readings and from contact positions.

    Args:
        predictors: Predictors of readings, by name.
        reading_std: Standard deviation (uT) of each channel in the training data.
        surfaces: Surfaces of the objects.
        episodes: Record of e episodes of t touches.

    Returns:
        `(e, t, objects)` beliefs after each touch, by source (the predictors' names and "proprioception") and rule,
        such as "proprioception, votes".
    """
    touches = MeasuredTouches(
        np.asarray(episodes.T_w_t).reshape(-1, 4, 4),
        np.asarray(episodes.observations.reading).reshape(episodes.site.size, -1),
        np.asarray(episodes.observations.force).reshape(-1),
    )
    distances = reading_distances(predictors, surfaces, touches, reading_std)
    distances[PROPRIOCEPTION] = contact_distances(surfaces, touches)
    shape = (*episodes.site.shape, len(surfaces))
    return {
        f"{source}, {rule}": p
        for source, distance in distances.items()
        for rule, p in beliefs_by_rule(distance.reshape(shape)).items()
    }


# --- the loop ---


def run_loop(
    key: Key[Array, ""],
    score: Scorer,
    episodes: RunningEpisodes,
    pools: SitePools,
    pool: Int[np.ndarray, " e"],
    *,
    rule: str = "votes",
    shared: dict[TouchNumber, TouchOutcome] | None = None,
    progress: Callable[[int], object] = lambda touches: None,
) -> LoopResult:
    """Run the paper's loop on pools of sites, in episodes of an environment.

    Args:
        key: Random key of hypotheses and sites.
        score: The method: it computes the distances of touches from the objects.
        episodes: The episodes before their first touch, in an environment whose sites are the joined pools.
        pools: Pools of sites.
        pool: Index of each episode's pool.
        rule: The paper's rule for the belief from which hypotheses are sampled.
        shared: Touches that other methods made in the same episodes. They are reused, and new ones are added.
        progress: Function that is called with the number of touches made.

    Returns:
        Record of the loop, whose sites are indices into the joined pools.
    """
    objects, per_object = pools.T_w_t.shape[1:3]
    shared = {} if shared is None else shared

    def row(hypothesis: np.ndarray, site: np.ndarray) -> np.ndarray:
        return (pool * objects + hypothesis) * per_object + site

    def touch(
        episodes: RunningEpisodes, hypothesis: np.ndarray, site: np.ndarray
    ) -> tuple[RunningEpisodes, MeasuredTouches]:
        after = advance(episodes, row(hypothesis, site)[:, None], shared=shared)
        shared.update(after.new)
        return after, last_touches(after)

    result = loop.run(
        key, episodes, touch, score, pool_informativeness(pools)[pool],
        count=episodes.environment.config.touches, rule=rule, progress=progress,
    )  # fmt: skip
    rows = [row(hypothesis, site) for hypothesis, site in zip(result.hypothesis.T, result.site.T, strict=True)]
    return result._replace(site=np.stack(rows, axis=1))


def run_paper_loop(
    keys: Key[Array, "3"],
    predictors: Mapping[str, Predictor],
    surfaces: Mapping[str, Surface],
    pad: Pad,
    *,
    reading_std: Float[np.ndarray, " c"],
    episodes: int,
    touches: int = loop.PAPER_TOUCHES,
    errors: SimulationErrors | None = None,
    limits: PressLimits | None = None,
    site_limits: SiteLimits = RECOGNITION_LIMITS,
    sites_per_object: int = 24,
    episodes_per_pool: int | None = None,
    progress: Callable[[int], object] = lambda touches: None,
) -> dict[str, PaperEpisodes]:
    """Recognise objects by the paper's loop on simulated touches, with each predictor and with proprioception.

    The true object of episode i is object i modulo the number of objects. All methods meet the same objects, placements
    and errors, and make the same draws as long as their beliefs are equal.

    Args:
        keys: Three random keys: of the sites, of all random events in the episodes, and of hypotheses and choices.
        predictors: Predictors of readings, by name.
        surfaces: Surfaces of the possible objects, by name, all of one size class (`prepare_surfaces`).
        pad: The pad.
        reading_std: Standard deviation (uT) of each channel in the training data.
        episodes: Number of episodes e.
        touches: Number of touches t of each episode.
        errors: Errors of camera, arm and skin.
        limits: Limits of a press.
        site_limits: Limits of safe sites.
        sites_per_object: Number of sites of each object in a pool.
        episodes_per_pool: Number of consecutive episodes that share a pool of sites; all of them by default.
        progress: Function that is called with the number of touches made.

    Returns:
        Episodes by the predictors' names and "proprioception".

    Raises:
        TypeError: A count is not a whole number.
        ValueError: There are no surfaces, a predictor is named proprioception, `reading_std` is not finite or not above
            0, a count is below 1, `keys` are not three keys, or an object has too few safe sites.

    Example:
        predictor = i2t.load_predictor("runs/train")
        surfaces = dict(zip(("star", "square"), i2t.prepare_surfaces([star, square])))
        keys = jax.random.split(jax.random.key(0), 3)
        results = i2t.run_paper_loop(keys, {"mine": predictor}, surfaces, pad, reading_std=std, episodes=24)
        accuracy = results["mine"].hits()[:, -1].mean()
    """
    validation.random_key("keys", keys)
    if keys.shape[:1] != (3,):
        raise ValueError(f"keys: shape {keys.shape}; give three keys, such as jax.random.split(key, 3)")
    if not surfaces:
        raise ValueError("surfaces: no object; give at least one")
    if PROPRIOCEPTION in predictors:
        raise ValueError(f"predictors: {PROPRIOCEPTION} is the name of another method; give the predictor another name")
    validation.count("episodes", episodes)
    validation.count("touches", touches)
    validation.count("sites_per_object", sites_per_object)
    if episodes_per_pool is not None:
        validation.count("episodes_per_pool", episodes_per_pool)
    std, channels = validation.numbers("reading_std", reading_std, "standard deviations (uT)"), 3 * pad.board.num_chips
    if std.shape != (channels,) or not (np.isfinite(std) & (std > 0)).all():
        raise ValueError(f"reading_std: is not {channels} finite numbers above 0; give one (uT) for each channel")
    config = EnvironmentConfig(errors or SimulationErrors(), limits or PressLimits(), touches)
    key_sites, key_episodes, key_choices = keys
    names, shapes = list(surfaces), list(surfaces.values())
    truth, pool = np.arange(episodes) % len(names), np.arange(episodes) // (episodes_per_pool or episodes)
    pools = sample_pools(
        key_sites, shapes, names, pools=int(pool[-1]) + 1, per_object=sites_per_object, limits=site_limits
    )
    params = environment_params(shapes, [pad], pools.joined(), config)
    begun = begin_episodes(key_episodes, TouchEnvironment(config), params, truth)
    scorers = reading_scorers(predictors, shapes, reading_std)
    scorers[PROPRIOCEPTION] = partial(contact_distances, shapes)
    shared: dict[TouchNumber, TouchOutcome] = {}
    results: dict[str, PaperEpisodes] = {}
    for method, score in scorers.items():
        result = run_loop(jax.random.clone(key_choices), score, begun, pools, pool, shared=shared, progress=progress)
        results[method] = PaperEpisodes(truth, pool, result.distance)
    return results


# --- views ---


@jax.jit
def _nearest_distances(points: Array, surface: Surface) -> Array:
    return jax.vmap(lambda point: loop.nearest_distance(point, surface))(points)


@jax.jit
def _views(surface: Surface, T_w_t: Array) -> tuple[Array, Array]:
    """Render views, and test whether their patches show a surface."""
    seen = jax.vmap(partial(render_view, surface))(T_w_t)
    return seen.depth, jnp.isfinite(seen.patch.nearest)
