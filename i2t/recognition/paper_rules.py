"""The paper's recognition (`i2t.paper`) on this package's episodes, pools of sites and predictors.

At each touch every possible object, taken to stand at the world's origin, is rendered where the press ended; a
predictor says what the skin would read there, pressed with the measured force. The distance of that from the measured
reading, in standard deviations of the training readings, is the object's. Proprioception, the paper's baseline, takes
the distance of the contact from the object's surface, in millimetres.

`paper_rules` applies the rules to episodes as they went. `run_loop` is the paper's whole procedure (`i2t.paper.loop`),
in which every method is scored by its own distances. A method is called Imagine2touch only if its predictor is the
paper's network.

Source: Ayad et al., "Imagine2touch", section II. Metres, newtons, microtesla; a reading has c = 3 * chips channels.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from functools import partial
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from i2t.paper import loop, rules
from i2t.paper.loop import LoopResult
from i2t.patches.dimensions import PATCH_PIXELS, PATCH_WINDOW, REACH
from i2t.patches.views import centre
from i2t.prediction.baselines import MeanReading
from i2t.prediction.predictor import Predictor
from i2t.prediction.touch_model import Reading, TouchBatch
from i2t.recognition.environment import TouchOutcome
from i2t.recognition.episodes import Episodes, MeasuredTouches
from i2t.recognition.rollout import RunningEpisodes, TouchNumber, advance, last_touches
from i2t.recognition.site_pool import SitePools, pool_informativeness
from i2t.rendering.render import render_view
from i2t.runtime.batching import filled_batches, spread
from i2t.skin.elasticity import CELL_GRID
from i2t.skin_models.layer import MIN_LOAD_N
from i2t.types import Surface

BASELINE_LENGTH_M = 1e-3  # by which distances of contacts are divided before exp(-d)
PROPRIOCEPTION = "proprioception"
VIEWS = 64  # rendered and predicted at a time: one compilation serves all


Scorer: TypeAlias = Callable[[MeasuredTouches], Float[np.ndarray, "n objects"]]  # distances of touches from objects


def constant_predictor(reading: Float[np.ndarray, " c"]) -> Predictor:
    """Predicts one reading for every touch: the paper's rules then judge by contact or none alone.

    Args:
        reading: uT, say the mean of the training readings.

    Returns:
        The predictor; its standard deviations say nothing.
    """
    mean = np.asarray(reading, np.float32)
    model = MeanReading(mean, np.ones_like(mean))
    return Predictor(model, PATCH_WINDOW, REACH, default_force=1.0, default_depth=0.0)


class _AtMedianForce(Predictor):
    """Predictor that is told the median force of its training touches, whatever was measured."""

    def predict_batch(self, touches: TouchBatch) -> Reading:
        """Predict, as in `Predictor.predict_batch`."""
        return super().predict_batch(touches._replace(force=np.full_like(touches.force, self.default_force)))


def at_median_force(predictor: Predictor) -> Predictor:
    """The same predictor without the measured force of each touch, which the paper's network does not know either.

    Args:
        predictor: Of readings.

    Returns:
        One that takes the median force of its training touches instead.
    """
    return _AtMedianForce(**{field.name: getattr(predictor, field.name) for field in fields(predictor)})


# --- distances ---


def reading_scorers(
    predictors: Mapping[str, Predictor], surfaces: Sequence[Surface], reading_std: Float[np.ndarray, " c"]
) -> dict[str, Scorer]:
    """Scorers by readings, one for each predictor.

    Args:
        predictors: Of readings, by name.
        surfaces: Of the objects.
        reading_std: Standard deviation (uT) of each channel in the training data.

    Returns:
        The scorers by the same names.
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
    """Distances of readings from those predicted on each object; where nothing is seen, zero is predicted.

    Args:
        predictors: Of readings, by name; views are rendered once for all.
        surfaces: Of the objects.
        touches: That were made.
        reading_std: Standard deviation (uT) of each channel in the training data.

    Returns:
        Distances in standard deviations, by the predictors' names.
    """
    # Rendered views have no noise to be smoothed away.
    ready = {name: each.with_pressure(smooth=False, cell=CELL_GRID.spacing) for name, each in predictors.items()}
    n, force = len(touches.force), np.maximum(touches.force, MIN_LOAD_N)
    predicted = {name: np.zeros((n, len(surfaces), touches.reading.shape[-1]), np.float32) for name in predictors}
    for start in range(0, n, VIEWS):
        rows = np.arange(start, min(start + VIEWS, n))
        full = np.resize(rows, VIEWS)
        for i, surface in enumerate(surfaces):
            wide, seen = jax.device_get(_views(surface, touches.T_w_t[full].astype(np.float32)))
            for name, predictor in ready.items():
                pitch, depth = predictor.window / PATCH_PIXELS, np.full(VIEWS, predictor.default_depth, np.float32)
                pressed = TouchBatch(centre(wide, PATCH_PIXELS), wide, pitch, force[full], 0 * depth, depth)
                reading = predictor.predict_batch(pressed).mean
                predicted[name][rows, i] = np.where(seen[:, None], reading, 0.0)[: len(rows)]
    measured, std = jnp.float32(touches.reading), jnp.float32(reading_std)
    return {name: np.asarray(rules.distances(measured, jnp.asarray(p), std)) for name, p in predicted.items()}


def contact_distances(surfaces: Sequence[Surface], touches: MeasuredTouches) -> Float[np.ndarray, "n objects"]:
    """Distances of contacts from each object's surface: proprioception.

    Args:
        surfaces: Of the objects.
        touches: That were made.

    Returns:
        Distances in millimetres.
    """
    point = np.asarray(touches.T_w_t[:, :3, 3], np.float32)
    calls = ((point[rows], surface) for surface in surfaces for rows in filled_batches(np.arange(len(point)), VIEWS))
    distance = np.concatenate(list(spread(_nearest_distances, calls))).reshape(len(surfaces), -1)
    return distance[:, : len(point)].T / BASELINE_LENGTH_M


# --- rules ---


def beliefs_by_rule(distance: Float[np.ndarray, "e t objects"]) -> dict[str, Float[np.ndarray, "e t objects"]]:
    """Beliefs by each of the paper's rules from distances.

    Args:
        distance: Of each touch from each object.

    Returns:
        Beliefs after each touch, by rule.
    """
    return {rule: loop.beliefs(distance, rule) for rule in rules.RULES}


def paper_rules(
    predictors: Mapping[str, Predictor],
    reading_std: Float[np.ndarray, " c"],
    surfaces: Sequence[Surface],
    episodes: Episodes,
) -> dict[str, Float[np.ndarray, "e t objects"]]:
    """Beliefs by the paper's rules along episodes as they went, from readings and from contact positions.

    Args:
        predictors: Of readings, by name.
        reading_std: Standard deviation (uT) of each channel in the training data.
        surfaces: Of the objects.
        episodes: As they went.

    Returns:
        Beliefs after each touch, by source (the predictors' names and "proprioception") and rule, such as
        "proprioception, votes".
    """
    touches = MeasuredTouches(
        np.asarray(episodes.T_w_t).reshape(-1, 4, 4),
        np.asarray(episodes.observations.reading).reshape(episodes.site.size, -1),
        np.asarray(episodes.observations.force).reshape(-1),
    )
    found = reading_distances(predictors, surfaces, touches, reading_std)
    found[PROPRIOCEPTION] = contact_distances(surfaces, touches)
    shape = (*episodes.site.shape, len(surfaces))
    return {
        f"{source}, {rule}": p
        for source, distance in found.items()
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
    """The paper's loop on pools of sites, in episodes of an environment.

    Args:
        key: Of hypotheses and sites.
        score: Distances of touches from the objects: the method.
        episodes: The episodes before their first touch, in an environment whose sites are the pools joined.
        pools: Of sites.
        pool: Number of each episode's pool.
        rule: Which of the paper's rules makes the belief that hypotheses are sampled from.
        shared: Touches that other methods made in the same episodes, which are not made again; those that are made here
            are added.
        progress: Called with how many touches were made.

    Returns:
        What happened; sites are those of the pools that were joined.
    """
    objects, each = pools.T_w_t.shape[1:3]
    shared = {} if shared is None else shared

    def row(hypothesis: np.ndarray, site: np.ndarray) -> np.ndarray:
        return (pool * objects + hypothesis) * each + site

    def touch(
        episodes: RunningEpisodes, hypothesis: np.ndarray, site: np.ndarray
    ) -> tuple[RunningEpisodes, MeasuredTouches]:
        after = advance(episodes, row(hypothesis, site)[:, None], shared=shared)
        shared.update(after.new)
        return after, last_touches(after)

    made = loop.run(
        key, episodes, touch, score, pool_informativeness(pools)[pool],
        count=episodes.environment.config.touches, rule=rule, progress=progress,
    )  # fmt: skip
    rows = [row(*one) for one in zip(made.hypothesis.T, made.site.T, strict=True)]
    return made._replace(site=np.stack(rows, axis=1))


# --- views ---


@jax.jit
def _nearest_distances(points: Array, surface: Surface) -> Array:
    return jax.vmap(lambda point: loop.nearest_distance(point, surface))(points)


@jax.jit
def _views(surface: Surface, T_w_t: Array) -> tuple[Array, Array]:
    """Wide views, and whether their patches show anything."""
    seen = jax.vmap(partial(render_view, surface))(T_w_t)
    return seen.wide, jnp.isfinite(seen.patch.nearest)
