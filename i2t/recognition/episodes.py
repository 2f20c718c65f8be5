"""Episodes of recognition: an object stands near its believed pose and is touched a number of times.

Episodes are simulated (`i2t.recognition.rollout`) or taken from a data set (`episodes_from_dataset`). `believe`
predicts the touches and computes the posteriors along episodes, a few of them at a time. `run_belief` computes them
from touches that were predicted before. Sites are those of a pool (`i2t.recognition.site_pool`). Units are metres,
newtons and microtesla.
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
from i2t.runtime.batching import filled_batches, map_batches, map_rows_on_devices, put_on_all_devices, select_rows
from i2t.runtime.compiling import jit_quickly
from i2t.runtime.progress import progress
from i2t.skin_models.likelihood import Likelihood
from i2t.skin_models.reading_model import LinearReadingModel
from i2t.types import ReturnCode, Surface, Touches

EPISODES_PER_BATCH = 8  # number of episodes whose posteriors are computed together

# Weights of three log likelihoods in the posterior, by kind of evidence: of the reading, of the position at which the
# press ended, and of presence, which is whether the press met the object.
EVIDENCE_WEIGHTS = {
    "readings": (1.0, 0.0, 0.0),
    "presence": (0.0, 0.0, 1.0),
    "position": (0.0, 1.0, 0.0),
    "readings and position": (1.0, 1.0, 0.0),
    "readings and presence": (1.0, 0.0, 1.0),
    "position and presence": (0.0, 1.0, 1.0),
    "fused": (1.0, 1.0, 1.0),
}


class Episodes(NamedTuple):
    """Record of e episodes of t touches each: indices of the true objects and of the touched sites, measurements, and
    poses of the tool at the ends of the presses.
    """

    truth: Int[np.ndarray, " e"]  # index of the true object
    site: Int[np.ndarray, "e t"]  # index of each touch's site in the pool
    observations: TouchObservation  # (e, t) observations of the touches
    T_w_t: Float[np.ndarray, "e t 4 4"]  # (4, 4) poses of the tool in W at the ends of the presses, m


class MeasuredTouches(NamedTuple):
    """Tool poses at the ends of n presses, as the arm reports them, with readings (uT) and forces (N)."""

    T_w_t: Float[np.ndarray, "n 4 4"]  # poses of the tool at the ends of the presses, as the arm reports them
    reading: Float[np.ndarray, "n c"]  # uT
    force: Float[np.ndarray, " n"]  # N


def episodes_from_dataset(
    recorded: Dataset,
    names: Sequence[str],
    touches: int,
    *,
    overtravel: float = PressLimits.overtravel,
    require_known: bool = True,
) -> tuple[SitePool, Episodes]:
    """Take each session of a recorded data set as an episode of its first usable touches, unless it has too few.

    A recording contains the ends of presses, so the site of a press with contact is its end, and its advance is zero. A
    press without contact ended `overtravel` beyond its site. Its site is placed that far back, so that the belief
    contains that the path was free, but not that there is nothing beyond it.

    Args:
        recorded: Touches with measured forces.
        names: Names of the objects with meshes.
        touches: Number of touches of each episode; sessions with fewer usable ones are left out.
        overtravel: Distance (m) beyond its site after which a recorded press gave up.
        require_known: Whether the object of each session must be among `names`; otherwise the true object of the other
            episodes is -1.

    Returns:
        Sites as T_o_site of the believed object, and the episodes.

    Raises:
        DataError: The object of an episode is not among `names`, or no session has enough usable touches.
    """
    recording = recorded.touches
    episodes = [rows[:touches] for rows in usable_touches(recording).values() if len(rows) >= touches]
    if not episodes:
        raise DataError(f"no session has {touches} touches with a measured force; record longer ones")
    rows = np.stack(episodes)
    kinds = [recorded.objects[i] for i in recording.object[rows[:, 0]]]
    unknown = sorted(set(kinds) - set(names))
    if unknown and require_known:
        raise DataError(
            f"the data set has touches of {', '.join(unknown)}, but no object to recognise has this name; pass a mesh "
            f"of that name among --objects, such as {unknown[0]}.stl"
        )
    T_o_t = inverse(recording.T_w_o[rows]) @ recording.T_w_t[rows]
    contact = recording.code[rows] != ReturnCode.AIR
    advance = np.where(contact, 0.0, overtravel).astype(np.float32)
    T_o_site = T_o_t.copy()
    T_o_site[..., :3, 3] -= advance[..., None] * T_o_t[..., :3, 2]
    observations = TouchObservation(
        reading=jnp.asarray(recording.reading[rows]),
        force=jnp.asarray(recording.force[rows]),
        advance=jnp.asarray(advance),
        contact=jnp.asarray(contact),
    )
    truth = np.array([list(names).index(kind) if kind in names else -1 for kind in kinds])
    sites = SitePool(jnp.float32(T_o_site.reshape(-1, 4, 4)), np.repeat(truth, touches))
    return sites, Episodes(truth, np.arange(rows.size).reshape(rows.shape), observations, T_o_t.astype(np.float32))


def usable_touches(touches: Touches) -> dict[int, Int[np.ndarray, " t"]]:
    """Find the touches that are evidence: those that did not fail and have a measured force.

    Args:
        touches: Touches of any number of sessions.

    Returns:
        Rows of these touches by index of the session.
    """
    usable = (touches.code != ReturnCode.FAILED) & np.isfinite(touches.force)
    sessions = np.unique(touches.session)
    return {int(session): np.flatnonzero(usable & (touches.session == session)) for session in sessions}


@jit_quickly
def posteriors(
    site: Int[Array, "e t"],
    observations: TouchObservation,
    table: PredictedTouch,
    likelihood: Likelihood,
    particles: Particles,
) -> Float[Array, "e t objects"]:
    """Compute posteriors over the objects after each of the t touches of each of e episodes.

    Args:
        site: Row of the table for each touch.
        observations: Measurements, (e, t).
        table: Predicted touches, (sites, objects, k) for k particles of each object.
        likelihood: The distribution of measurements about predictions.
        particles: Pose particles of each object.

    Returns:
        `(e, t, objects)` probabilities of the objects.
    """

    def episode(at: tuple[Array, TouchObservation]) -> Array:
        def step(now: belief.Belief, touched: tuple[Array, TouchObservation]) -> tuple[belief.Belief, Array]:
            now = belief.update(now, touched[1], element(table, touched[0]), likelihood)
            return now, belief.posterior(now)

        return jax.lax.scan(step, belief.init(particles, table.hit.shape[1], channels=table.reading.shape[-1]), at)[1]

    return map_batches(episode, (site, observations), batch_size=EPISODES_PER_BATCH)


def run_belief(
    table: PredictedTouch,
    episodes: Episodes,
    likelihood: Likelihood,
    particles: Particles,
    kinds: Sequence[str] = tuple(EVIDENCE_WEIGHTS),
) -> dict[str, Float[np.ndarray, "e t objects"]]:
    """Compute posteriors over the objects along e episodes of t touches, from each kind of evidence.

    Args:
        table: Predicted touches, (sites, objects, k) for k particles of each object.
        episodes: Record of the episodes.
        likelihood: The distribution of measurements about predictions.
        particles: Pose particles of each object.
        kinds: Kinds of evidence, keys of `EVIDENCE_WEIGHTS`.

    Returns:
        `(e, t, objects)` probabilities of the objects after each touch, by kind of evidence.
    """
    table, particles = put_on_all_devices((table, particles))
    rows = (jnp.asarray(episodes.site), episodes.observations)
    beliefs = {}
    for kind in kinds:
        shared = (table, select_evidence(likelihood, kind), particles)
        beliefs[kind] = np.asarray(map_rows_on_devices(posteriors, rows, shared=shared, multiple=EPISODES_PER_BATCH))
    return beliefs


def select_evidence(likelihood: Likelihood, kind: str) -> Likelihood:
    """Set the weights of a likelihood to one kind of evidence.

    Args:
        likelihood: The distribution of measurements about predictions.
        kind: Kind of evidence, a key of `EVIDENCE_WEIGHTS`.

    Returns:
        Likelihood with these weights.
    """
    tactile, spatial, presence = (jnp.float32(weight) for weight in EVIDENCE_WEIGHTS[kind])
    return likelihood._replace(tactile_weight=tactile, spatial_weight=spatial, presence_weight=presence)


class BeliefModel(NamedTuple):
    """Reading model and likelihood of a pad for computing beliefs, and names of the kinds of evidence to use."""

    reading_model: LinearReadingModel
    likelihood: Likelihood
    kinds: Sequence[str] = tuple(EVIDENCE_WEIGHTS)


def believe(
    surfaces: Sequence[Surface],
    sites: SitePool,
    episodes: Episodes,
    particles: Particles,
    models: Mapping[str, BeliefModel],
    *,
    overtravel: float,
    label: str,
    touches_at_a_time: int = 320,
) -> dict[str, Float[np.ndarray, "e t objects"]]:
    """Compute posteriors over the objects along e episodes of t touches with their own sites, with a progress bar.

    Touches are predicted for a few episodes at a time, once at each touched site, so that memory does not grow with the
    number of episodes.

    Args:
        surfaces: Surfaces of the objects.
        sites: Pool of the touched sites.
        episodes: Record of the episodes.
        particles: Pose particles of each object.
        models: Models of some pads for the same loads, by a suffix for the names of the results.
        overtravel: Distance (m) beyond a site after which a press gives up.
        label: Purpose of the touches, for the bar.
        touches_at_a_time: Maximum number of touches that are predicted together, on every object in every pose.

    Returns:
        `(e, t, objects)` probabilities of the objects after each touch, by the kind of evidence followed by the suffix.
    """
    count, touches = episodes.site.shape
    per_batch = max(min(touches_at_a_time // touches, count), 1)
    share = -(-count * touches // len(np.unique(episodes.site)))  # consecutive episodes on the same sites
    # These episodes stay together, so that each site is predicted once.
    per_batch -= per_batch % share if share < per_batch else 0
    reading_models = [model.reading_model for model in models.values()]
    T, twist = np.asarray(sites.T_w_t), particles.twist
    chunks = filled_batches(np.arange(count), per_batch)
    touched = [np.unique(episodes.site[rows], return_inverse=True) for rows in chunks]  # episodes may share sites
    largest = max(len(where) for where, _ in touched)
    parts: list[dict[str, np.ndarray]] = []
    total = len(surfaces) * len(twist) * largest * len(chunks)
    with progress(total=total, desc=f"{label}: predicting", unit="touches", unit_scale=True) as bar:
        for rows, (where, of_touch) in zip(chunks, touched, strict=True):
            some: Episodes = select_rows(episodes, rows)
            tables = predict_outcomes(
                surfaces, twist, T[np.resize(where, largest)], reading_models,
                overtravel=overtravel, label=label, bar=bar,
            )  # fmt: skip
            some = some._replace(site=of_touch.reshape(per_batch, touches))
            beliefs: dict[str, np.ndarray] = {}
            for (suffix, model), table in zip(models.items(), tables, strict=True):
                posterior = run_belief(table, some, model.likelihood, particles, model.kinds)
                beliefs |= {f"{kind}{suffix}": p[: len(np.unique(rows))] for kind, p in posterior.items()}
            parts.append(beliefs)
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
