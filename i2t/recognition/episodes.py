"""Episodes of recognition: an object is put down near where it is believed, and touched a number of times.

Episodes are simulated (`i2t.recognition.rollout`) or taken from a data set (`episodes_from_dataset`). `believe`
predicts what was touched and gives the posteriors along episodes, a few of them at a time; `run_belief` does so where
touches were predicted before. Sites are those of a pool (`i2t.recognition.site_pool`). Metres, newtons, microtesla.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from i2t.contact.press import PressLimits
from i2t.dataset import Dataset
from i2t.errors import DataError
from i2t.geometry import inverse
from i2t.recognition import belief
from i2t.recognition.belief import Particles, TouchObservation
from i2t.recognition.outcomes import PredictedTouch
from i2t.recognition.site_pool import SitePool, predict_outcomes
from i2t.rendering.ops import element
from i2t.runtime.batching import everywhere, filled_batches, map_batches, select_rows, spread_rows
from i2t.runtime.compiling import jit_quickly
from i2t.runtime.progress import progress
from i2t.skin_models.likelihood import Likelihood
from i2t.skin_models.reading_model import LinearReadingModel
from i2t.types import ReturnCode, Surface, Touches

BELIEVED_TOUCHES = 320  # predicted at a time on every object in every pose
BELIEVED_EPISODES = 8  # whose posteriors are formed at a time


# Weights of readings, of positions at which presses ended, and of whether anything was met.
EVIDENCE = {
    "readings": (1.0, 0.0, 0.0),
    "presence": (0.0, 0.0, 1.0),
    "position": (0.0, 1.0, 0.0),
    "readings and position": (1.0, 1.0, 0.0),
    "readings and presence": (1.0, 0.0, 1.0),
    "position and presence": (0.0, 1.0, 1.0),
    "fused": (1.0, 1.0, 1.0),
}


class Episodes(NamedTuple):
    """Record of e episodes of t touches each."""

    truth: Int[np.ndarray, " e"]  # the object that was there
    site: Int[np.ndarray, "e t"]  # of the pool
    observations: TouchObservation  # (e, t)
    T_w_t: Float[np.ndarray, "e t 4 4"]  # where the presses ended


class MeasuredTouches(NamedTuple):
    """Measurements and poses of n touches."""

    T_w_t: Float[np.ndarray, "n 4 4"]  # where the presses ended, as the arm reports
    reading: Float[np.ndarray, "n c"]  # uT
    force: Float[np.ndarray, " n"]  # N


def episodes_from_dataset(
    recorded: Dataset, names: Sequence[str], touches: int, *, overtravel: float = PressLimits.overtravel
) -> tuple[SitePool, Episodes]:
    """Take each session of a recorded data set as an episode of its first touches.

    A recording says where presses ended, so sites are where presses that met something ended, with an advance of
    nothing. One that met air ended `overtravel` beyond a site: its site lies that far back, so that the belief learns
    that nothing was met on the way and not that nothing lies further on.

    Args:
        recorded: Touches with measured forces.
        names: Of the objects that there are meshes of.
        touches: Of each episode.
        overtravel: Distance (m) beyond its site after which a recorded press gave up.

    Returns:
        The sites, T_o_site of the believed object, and the episodes.

    Raises:
        DataError: A session's object is not among `names`, or too few touches can be used.
    """
    made = recorded.touches
    episodes = [rows[:touches] for rows in usable_touches(made).values() if len(rows) >= touches]
    if not episodes:
        raise DataError(f"no session has {touches} touches with a measured force; record longer ones")
    rows = np.stack(episodes)
    kinds = [recorded.objects[i] for i in made.object[rows[:, 0]]]
    unknown = sorted(set(kinds) - set(names))
    if unknown:
        raise DataError(
            f"the data set has touches of {', '.join(unknown)}, and no object to tell apart is called so; pass a mesh "
            f"of that name among --objects, such as {unknown[0]}.stl"
        )
    T_o_t = inverse(made.T_w_o[rows]) @ made.T_w_t[rows]
    contact = made.code[rows] != ReturnCode.AIR
    advance = np.where(contact, 0.0, overtravel).astype(np.float32)
    T_o_site = T_o_t.copy()
    T_o_site[..., :3, 3] -= advance[..., None] * T_o_t[..., :3, 2]
    observations = TouchObservation(
        reading=jnp.asarray(made.reading[rows]),
        force=jnp.asarray(made.force[rows]),
        advance=jnp.asarray(advance),
        contact=jnp.asarray(contact),
    )
    truth = np.array([list(names).index(kind) for kind in kinds])
    sites = SitePool(jnp.float32(T_o_site.reshape(-1, 4, 4)), np.repeat(truth, touches))
    return sites, Episodes(truth, np.arange(rows.size).reshape(rows.shape), observations, T_o_t.astype(np.float32))


def usable_touches(made: Touches) -> dict[int, Int[np.ndarray, " t"]]:
    """Touches that tell something: those that did not fail and have a measured force.

    Args:
        made: Touches of any number of sessions.

    Returns:
        Rows, by number of the session.
    """
    usable = (made.code != ReturnCode.FAILED) & np.isfinite(made.force)
    return {int(session): np.flatnonzero(usable & (made.session == session)) for session in np.unique(made.session)}


@jit_quickly
def posteriors(
    site: Int[Array, "e t"],
    observations: TouchObservation,
    table: PredictedTouch,
    likelihood: Likelihood,
    particles: Particles,
) -> Float[Array, "e t objects"]:
    """Posteriors over the objects after each touch of each episode.

    Args:
        site: Row of the table for each touch.
        observations: What was measured, (e, t).
        table: Predicted touches, (sites, objects, k).
        likelihood: How far measurements may be from predictions.
        particles: Poses of each object.

    Returns:
        Probabilities of the objects.
    """

    def episode(at: tuple[Array, TouchObservation]) -> Array:
        def step(now: belief.Belief, touched: tuple[Array, TouchObservation]) -> tuple[belief.Belief, Array]:
            now = belief.update(now, touched[1], element(table, touched[0]), likelihood)
            return now, belief.posterior(now)

        return jax.lax.scan(step, belief.init(particles, table.hit.shape[1], channels=table.reading.shape[-1]), at)[1]

    return map_batches(episode, (site, observations), batch_size=BELIEVED_EPISODES)


def run_belief(
    table: PredictedTouch,
    episodes: Episodes,
    likelihood: Likelihood,
    particles: Particles,
    kinds: Sequence[str] = tuple(EVIDENCE),
) -> dict[str, Float[np.ndarray, "e t objects"]]:
    """Posteriors over the objects along episodes, from each kind of evidence.

    Args:
        table: Predicted touches, (sites, objects, k).
        episodes: As they went.
        likelihood: How far measurements may be from predictions.
        particles: Poses of each object.
        kinds: Of evidence, names of `EVIDENCE`.

    Returns:
        Probabilities of the objects, by kind of evidence.
    """
    table, particles = everywhere((table, particles))
    rows = (jnp.asarray(episodes.site), episodes.observations)
    found = {}
    for kind in kinds:
        shared = (table, weigh_evidence(likelihood, kind), particles)
        found[kind] = np.asarray(spread_rows(posteriors, rows, shared=shared, multiple=BELIEVED_EPISODES))
    return found


def weigh_evidence(likelihood: Likelihood, kind: str) -> Likelihood:
    """A likelihood in which one kind of evidence counts.

    Args:
        likelihood: How far measurements may be from predictions.
        kind: Of evidence, a name of `EVIDENCE`.

    Returns:
        The likelihood with these weights.
    """
    tactile, spatial, presence = (jnp.float32(weight) for weight in EVIDENCE[kind])
    return likelihood._replace(tactile_weight=tactile, spatial_weight=spatial, presence_weight=presence)


class BeliefModel(NamedTuple):
    """A belief's model of a pad, and the kinds of evidence that form it."""

    reading_model: LinearReadingModel
    likelihood: Likelihood
    kinds: Sequence[str] = tuple(EVIDENCE)


def believe(
    surfaces: Sequence[Surface],
    sites: SitePool,
    episodes: Episodes,
    particles: Particles,
    models: Mapping[str, BeliefModel],
    *,
    overtravel: float,
    label: str,
) -> dict[str, Float[np.ndarray, "e t objects"]]:
    """Posteriors over the objects along episodes whose sites are their own, with a progress bar.

    Touches are predicted for a few episodes at a time, once at each site that was touched, so that memory does not grow
    with the number of episodes.

    Args:
        surfaces: Of the objects.
        sites: Which were touched.
        episodes: As they went.
        particles: Poses of each object.
        models: Of some pads, at the same loads, by a suffix of the results' names.
        overtravel: Distance (m) beyond a site after which a press gives up.
        label: What the bar says the touches are for.

    Returns:
        Probabilities of the objects, by kind of evidence and suffix.
    """
    count, touches = episodes.site.shape
    each = max(min(BELIEVED_TOUCHES // touches, count), 1)
    share = -(-count * touches // len(np.unique(episodes.site)))  # episodes that follow each other on the same sites
    each -= each % share if share < each else 0  # are believed together, so that no site is imagined twice
    reading_models = [model.reading_model for model in models.values()]
    T, twist = np.asarray(sites.T_w_t), particles.twist
    chunks = filled_batches(np.arange(count), each)
    touched = [np.unique(episodes.site[rows], return_inverse=True) for rows in chunks]  # episodes may share sites
    most = max(len(where) for where, _ in touched)
    parts: list[dict[str, np.ndarray]] = []
    total = len(surfaces) * len(twist) * most * len(chunks)
    with progress(total=total, desc=f"{label}: imagining", unit="touch", unit_scale=True) as bar:
        for rows, (where, of_touch) in zip(chunks, touched, strict=True):
            some: Episodes = select_rows(episodes, rows)
            tables = predict_outcomes(
                surfaces, twist, T[np.resize(where, most)], reading_models,
                overtravel=overtravel, label=label, bar=bar,
            )  # fmt: skip
            some = some._replace(site=of_touch.reshape(each, touches))
            found: dict[str, np.ndarray] = {}
            for (suffix, model), table in zip(models.items(), tables, strict=True):
                believed = run_belief(table, some, model.likelihood, particles, model.kinds)
                found |= {f"{kind}{suffix}": p[: len(np.unique(rows))] for kind, p in believed.items()}
            parts.append(found)
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
