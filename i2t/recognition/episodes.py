"""Episodes of recognition: an object is put down near where it is believed, and touched a number of times.

Episodes are simulated touch by touch (`EpisodeSimulator`) or at sites chosen beforehand (`run_episodes`), or taken from
a data set (`episodes_from_dataset`). `believe` predicts what was touched and gives the posteriors along episodes, a few
of them at a time; `run_belief` does so where touches were predicted before. Sites are those of a pool
(`i2t.recognition.site_pool`). Metres, newtons, microtesla.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from i2t.contact.press import PadResponse, PressLaw, PressLimits, pad_response
from i2t.dataset import Dataset
from i2t.errors import DataError
from i2t.geometry import inverse
from i2t.recognition import belief
from i2t.recognition.belief import Particles, TouchObservation
from i2t.recognition.outcomes import PredictedTouch
from i2t.recognition.site_pool import SitePool, predict_outcomes
from i2t.rendering.ops import element
from i2t.runtime.batching import everywhere, filled_batches, map_batches, select_rows, spread, spread_rows
from i2t.runtime.compiling import jit_by_amount, jit_quickly
from i2t.runtime.progress import Progress, progress
from i2t.simulation import touches as simulation
from i2t.simulation.touches import SessionErrors, SimulationErrors
from i2t.skin.pad import press as press_pad
from i2t.skin_models.likelihood import Likelihood
from i2t.skin_models.reading_model import LinearReadingModel
from i2t.types import Pad, ReturnCode, Surface, Touches

FEW_TOUCHES = 16_000  # of no more, compiling them quickly pays; last digits may differ from those of more
OBSERVED_BATCH = 16  # simulated at a time: fewer fill up the last batch less, and fit the caches
TouchNumber: TypeAlias = tuple[int, int, int]  # which touch of which episode, and its site

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


@dataclass(frozen=True)
class EpisodeConfig:
    """The world in which episodes are simulated."""

    errors: SimulationErrors
    limits: PressLimits
    touches: int  # of each episode
    law: PressLaw = press_pad  # what a press of the pad gives
    presses_before: int = 1000  # of the pad, before an episode: a skin that was trained with is no longer new

    @property
    def press_errors(self) -> SimulationErrors:
        """Errors without the sensor's, which are added later: worlds that differ in those alone share what is compiled,
        their whole numbers included.
        """
        none = SimulationErrors.none()
        return replace(self.errors, noise=none.noise, faults=none.faults)


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


class EpisodeSimulator:
    """Simulated episodes that go on touch by touch, so that sites may be chosen by measurements."""

    def __init__(
        self,
        key: Key[Array, ""],
        surfaces: Sequence[Surface],
        truth: Int[np.ndarray, " e"],
        *,
        sites: SitePool,
        pad: Pad,
        config: EpisodeConfig,
        made_before: dict[TouchNumber, Touches] | None = None,
    ) -> None:
        """Put an object down in every episode.

        Args:
            key: Of everything that is drawn.
            surfaces: Of the objects.
            truth: The object that is there in each episode.
            sites: Which may be touched.
            pad: That touches.
            config: Errors, limits and the number of touches.
            made_before: Touches that simulators of the same key, objects and sites made, which methods that are
                compared share as far as they touch the same; those made here join it.
        """
        self.made_before = made_before
        self.batch_size: int | None = None  # of simulated touches, fixed at the first
        self.key_touch, *drawn = _begin_episodes(key, config.errors, count=len(truth))
        # The same keys at every touch: a sensor's errors depend on the touches before.
        self.reading_keys, self.sessions = jax.device_get(drawn)
        self.surfaces, self.truth, self.pad, self.config = surfaces, truth, pad, config
        self._response = pad_response(pad, config.limits.final)
        self.T_w_site = np.asarray(sites.T_w_t)
        self.touches: list[Touches] = []
        self.chosen: list[np.ndarray] = []

    def touch(self, site: Int[np.ndarray, "e n"], bar: Progress | None = None) -> None:
        """Make the next n touches of every episode.

        Args:
            site: Of the pool, for each touch.
            bar: Shows progress.

        Raises:
            ValueError: A site is negative: none was chosen.
        """
        if (np.asarray(site) < 0).any():
            raise ValueError("an episode has no site to touch: none was chosen")
        n, episodes = site.shape[1], len(self.truth)
        keys = np.asarray(_touch_keys(self.key_touch, len(self.touches), n=n, episodes=episodes))
        episode, where = np.repeat(np.arange(episodes), n), site.reshape(-1)
        numbers = [(len(self.touches) + i % n, int(episode[i]), int(where[i])) for i in range(len(where))]
        known = {} if self.made_before is None else self.made_before
        made = {number: known[number] for number in numbers if number in known}
        if bar is not None:
            bar.update(len(made))
        missing = np.array([number not in made for number in numbers])
        for rows, batch in self._simulate(keys, episode, where, missing):
            made |= {numbers[i]: jax.tree.map(lambda x, j=j: x[j], batch) for j, i in enumerate(rows)}
            if bar is not None:
                bar.update(len(rows))
        if self.made_before is not None:
            self.made_before |= made
        whole = jax.tree.map(lambda *x: np.stack(x), *[made[number] for number in numbers])
        whole = jax.tree.map(lambda x: x.reshape(episodes, n, *x.shape[1:]), whole)
        self.touches += [jax.tree.map(lambda x, i=i: x[:, i], whole) for i in range(n)]
        self.chosen += list(np.asarray(site).T)

    def _simulate(
        self, keys: np.ndarray, episode: np.ndarray, where: np.ndarray, missing: np.ndarray
    ) -> Iterator[tuple[np.ndarray, Touches]]:
        """Touches of the missing rows, one object and not too many at a time; each batch is filled up, so that one
        compilation serves all.
        """
        of_objects = [np.flatnonzero(missing & (self.truth[episode] == i)) for i in range(len(self.surfaces))]
        if self.batch_size is None:
            most = int(np.bincount(self.truth[episode]).max())  # whether made before or not
            self.batch_size = min(OBSERVED_BATCH, 1 << (most - 1).bit_length())
        size = self.batch_size
        batches = [rows[start : start + size] for rows in of_objects for start in range(0, len(rows), size)]

        def call(rows: np.ndarray) -> tuple[np.ndarray, Surface, np.ndarray, SessionErrors]:
            full, which = np.resize(rows, size), int(self.truth[episode[rows[0]]])
            return keys[full], self.surfaces[which], self.T_w_site[where[full]], element(self.sessions, episode[full])

        limits = self.config.limits
        made = spread(
            _touch(len(self.truth) * self.config.touches), map(call, batches),
            shared=(self.pad, self.config.press_errors, limits, self._response),
            law=self.config.law,
        )  # fmt: skip
        for rows, batch in zip(batches, made, strict=True):
            yield rows, jax.tree.map(np.asarray, batch)

    def observations(self) -> TouchObservation:
        """All touches so far.

        Returns:
            Measurements, (e, t).
        """
        # Touches to come are there as nothing, so that adding them changes no draw of those made.
        made = jax.tree.map(lambda *x: np.stack(x, axis=1), *self.touches)
        missing = self.config.touches - len(self.touches)
        full = jax.tree.map(lambda x: np.concatenate([x, np.repeat(np.zeros_like(x[:, :1]), missing, 1)], 1), made)
        shared = self.pad, self.config.errors, self.config.presses_before
        parts = filled_batches(np.arange(len(self.truth)), OBSERVED_BATCH)
        calls = ((self.reading_keys[rows], select_rows(full, rows)) for rows in parts)
        read = list(spread(_add_sensor_errors, calls, shared=shared))
        reading = np.concatenate(read)[: len(self.truth)]
        T_w_site = self.T_w_site[np.stack(self.chosen, 1)]
        moved = made.T_w_t[..., :3, 3] - T_w_site[..., :3, 3]
        advance = np.sum(moved * T_w_site[..., :3, 2], axis=-1)
        return TouchObservation(
            reading=jnp.asarray(reading[:, : len(self.touches)]),
            force=jnp.asarray(made.force),
            advance=jnp.asarray(advance.astype(np.float32)),
            contact=jnp.asarray(made.code != ReturnCode.AIR),
        )

    def last_touches(self) -> MeasuredTouches:
        """The last touch of each episode.

        Returns:
            What was measured, (e,).
        """
        made = self.observations()
        T = np.asarray(self.touches[-1].T_w_t)
        return MeasuredTouches(T, np.asarray(made.reading)[:, -1], np.asarray(made.force)[:, -1])

    def episodes(self) -> Episodes:
        """Episodes so far.

        Returns:
            The episodes so far.
        """
        T = np.stack([touches.T_w_t for touches in self.touches], axis=1)
        return Episodes(self.truth, np.stack(self.chosen, 1), self.observations(), T)


def run_episodes(
    key: Key[Array, ""],
    surfaces: Sequence[Surface],
    truth: Int[np.ndarray, " e"],
    chosen: Int[np.ndarray, "e t"],
    *,
    sites: SitePool,
    pad: Pad,
    config: EpisodeConfig,
    label: str,
) -> Episodes:
    """Simulate episodes at sites chosen beforehand, with a progress bar.

    Args:
        key: Of everything that is drawn.
        surfaces: Of the objects.
        truth: The object that is there in each episode.
        chosen: Sites to touch.
        sites: The pool.
        pad: That touches.
        config: Errors, limits and the number of touches.
        label: What the bar says the touches are for.

    Returns:
        The episodes.
    """
    simulator = EpisodeSimulator(key, surfaces, truth, sites=sites, pad=pad, config=config)
    with progress(total=chosen.size, desc=f"{label}: touching", unit="touch") as bar:
        simulator.touch(chosen, bar)
    return simulator.episodes()


@partial(jit_quickly, static_argnames="count")
def _begin_episodes(
    key: Key[Array, ""], errors: SimulationErrors, *, count: int
) -> tuple[Key[Array, ""], Array, SessionErrors]:
    """Key of the touches, keys of the episodes' readings as data, and the errors of their sessions."""
    key_sessions, key_touch, key_reading = jax.random.split(key, 3)
    sample = jax.vmap(partial(simulation.sample_session_errors, errors=errors))
    sessions = sample(jax.random.split(key_sessions, count))
    return key_touch, jax.random.key_data(jax.random.split(key_reading, count)), sessions


@partial(jit_quickly, static_argnames=("n", "episodes"))
def _touch_keys(key: Key[Array, ""], before: Int[Array, ""] | int, *, n: int, episodes: int) -> Array:
    """Keys of the next n touches of every episode, in the order of episodes, as data: their rows fill up batches more
    than once.
    """
    steps = before + jnp.arange(n)
    keys = jax.vmap(lambda i: jax.random.split(jax.random.fold_in(key, i), episodes), out_axes=1)(steps)
    return jax.random.key_data(keys.reshape(-1))


def _simulate_touches(
    drawn: Array,
    surface: Surface,
    T: Array,
    sessions: SessionErrors,
    pad: Pad,
    errors: SimulationErrors,
    limits: PressLimits,
    response: PadResponse,
    *,
    law: PressLaw,
) -> Touches:
    keys = jax.random.wrap_key_data(drawn)

    def one(key: Array, T: Array, session: SessionErrors) -> Touches:
        return simulation.simulate_touch(
            key, surface, jnp.eye(4), T,
            session=session, pad=pad, errors=errors, limits=limits, law=law, response=response,
        )  # fmt: skip

    made = jax.vmap(one)(keys, T, sessions)
    blank = jnp.zeros((len(drawn), 0))
    return made._replace(patch=blank, wide=blank, truth=None)


_touch = jit_by_amount(_simulate_touches, FEW_TOUCHES, static_argnames="law")


@jit_quickly
def _add_sensor_errors(
    drawn: Array, touches: Touches, pad: Pad, errors: SimulationErrors, before: Int[Array, ""] | int
) -> Array:
    keys = jax.random.wrap_key_data(drawn)
    read = partial(simulation.apply_sensor_model, pad=pad, errors=errors, presses_before=before)
    return jax.vmap(lambda key, run: read(key, run).reading)(keys, touches)


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
                overtravel=overtravel, bar=bar,
            )  # fmt: skip
            some = some._replace(site=of_touch.reshape(each, touches))
            found: dict[str, np.ndarray] = {}
            for (suffix, model), table in zip(models.items(), tables, strict=True):
                believed = run_belief(table, some, model.likelihood, particles, model.kinds)
                found |= {f"{kind}{suffix}": p[: len(np.unique(rows))] for kind, p in believed.items()}
            parts.append(found)
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
