"""Episodes of recognition: an object is put down near where it is believed, and touched a number of times.

Episodes are simulated touch by touch (`EpisodeSimulator`) or at sites chosen beforehand (`run_episodes`), or taken from
a data set (`episodes_from_dataset`); `run_belief` gives the posteriors along them. Sites are those of a pool
(`i2t.recognition.site_pool`). Metres, newtons, microtesla.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key
from tqdm import tqdm

from i2t.dataset import Dataset
from i2t.errors import DataError
from i2t.recognition import belief
from i2t.recognition.belief import Likelihood, Particles, TouchObservation
from i2t.recognition.outcomes import PredictedTouch
from i2t.recognition.site_pool import SitePool
from i2t.rendering.ops import element
from i2t.simulation import touches as simulation
from i2t.simulation.press import PressLimits
from i2t.simulation.touches import SessionErrors, SimulationErrors
from i2t.types import Pad, ReturnCode, Surface, Touches

OBSERVED_BATCH = 40  # simulated at a time
# Kinds of evidence: weights of readings and of positions.
EVIDENCE = {"tactile only": (1.0, 0.0), "position only": (0.0, 1.0), "fused": (1.0, 1.0)}


@dataclass(frozen=True)
class EpisodeConfig:
    """The world in which episodes are simulated."""

    errors: SimulationErrors
    limits: PressLimits
    touches: int  # of each episode
    presses_before: int = 1000  # of the pad, before an episode: a skin that was trained with is no longer new

    @property
    def touch_errors(self) -> SimulationErrors:
        """Errors of single touches: those of a session are 0, so that worlds that differ in them alone share what is
        compiled.
        """
        return replace(self.errors, placement=0.0, placement_angle=0.0, hand_eye=0.0, hand_eye_angle=0.0)


class Episodes(NamedTuple):
    """Episodes as they went: e of them, t touches each."""

    truth: Int[np.ndarray, " e"]  # the object that was there
    site: Int[np.ndarray, "e t"]  # of the pool
    observations: TouchObservation  # (e, t)
    T_w_t: Float[np.ndarray, "e t 4 4"]  # where the presses ended


class EpisodeSimulator:
    """Simulated episodes that go on touch by touch, so that sites may be chosen by what was measured."""

    def __init__(
        self,
        key: Key[Array, ""],
        surfaces: Sequence[Surface],
        truth: Int[np.ndarray, " e"],
        *,
        sites: SitePool,
        pad: Pad,
        config: EpisodeConfig,
    ) -> None:
        """Put an object down in every episode.

        Args:
            key: Of everything that is drawn.
            surfaces: Of the objects.
            truth: The object that is there in each episode.
            sites: Which may be touched.
            pad: That touches.
            config: Errors, limits and the number of touches.
        """
        key_sessions, self.key_touch, key_reading = jax.random.split(key, 3)
        # The same keys at every touch: a sensor's errors depend on the touches before.
        self.reading_keys = np.asarray(jax.random.key_data(jax.random.split(key_reading, len(truth))))
        self.surfaces, self.truth, self.sites, self.pad, self.config = surfaces, truth, sites, pad, config
        self.sessions = _sample_sessions(key_sessions, len(truth), config.errors)
        self.touches: list[Touches] = []
        self.chosen: list[np.ndarray] = []

    def touch(self, site: Int[np.ndarray, "e n"], bar: tqdm | None = None) -> None:
        """Make the next n touches of every episode.

        Args:
            site: Of the pool, for each touch.
            bar: Shows progress.

        Raises:
            ValueError: A site is negative: none was chosen.
        """
        if (np.asarray(site) < 0).any():
            raise ValueError("an episode has no site to touch: none was chosen")
        before, n, episodes = len(self.touches), site.shape[1], len(self.truth)
        keys = jax.vmap(lambda i: jax.random.split(jax.random.fold_in(self.key_touch, i), episodes), out_axes=1)(
            before + jnp.arange(n)
        ).reshape(-1)
        drawn = np.asarray(jax.random.key_data(keys))  # rows of it fill up batches more than once
        episode, where = np.repeat(np.arange(episodes), n), site.reshape(-1)
        done: list[tuple[np.ndarray, Touches]] = []
        for which in range(len(self.surfaces)):
            rows = np.flatnonzero(self.truth[episode] == which)
            for start in range(0, len(rows), OBSERVED_BATCH):
                some = rows[start : start + OBSERVED_BATCH]
                done.append((some, self._touch_batch(which, drawn, episode, where, some)))
                if bar is not None:
                    bar.update(len(some))
        order = np.argsort(np.concatenate([rows for rows, _ in done]))
        made = jax.tree.map(lambda *x: np.concatenate(x)[order], *[part for _, part in done])
        made = jax.tree.map(lambda x: x.reshape(episodes, n, *x.shape[1:]), made)
        self.touches += [jax.tree.map(lambda x, i=i: x[:, i], made) for i in range(n)]
        self.chosen += list(np.asarray(site).T)

    def _touch_batch(
        self, which: int, drawn: np.ndarray, episode: np.ndarray, where: np.ndarray, rows: np.ndarray
    ) -> Touches:
        """Touches of one object, filled up to a batch so that one compilation serves all."""
        full = np.resize(rows, OBSERVED_BATCH)
        made = _touch_many(
            drawn[full], self.surfaces[which], self.sites.T_w_t[where[full]], element(self.sessions, episode[full]),
            self.pad, errors=self.config.touch_errors, limits=self.config.limits,
        )  # fmt: skip
        return jax.tree.map(lambda x: np.asarray(x[: len(rows)]), jax.device_get(made))

    def observations(self) -> TouchObservation:
        """All touches so far.

        Returns:
            Measurements, (e, t).
        """
        # Touches to come are there as nothing, so that adding them changes no draw of those made.
        made = jax.tree.map(lambda *x: np.stack(x, axis=1), *self.touches)
        missing = self.config.touches - len(self.touches)
        full = jax.tree.map(lambda x: np.concatenate([x, np.repeat(np.zeros_like(x[:, :1]), missing, 1)], 1), made)
        reading = np.asarray(_add_sensor_errors(self.reading_keys, full, self.pad, self.config.touch_errors))
        T_w_site = np.asarray(self.sites.T_w_t)[np.stack(self.chosen, 1)]
        moved = made.T_w_t[..., :3, 3] - T_w_site[..., :3, 3]
        advance = np.sum(moved * T_w_site[..., :3, 2], axis=-1)
        return TouchObservation(
            reading=jnp.asarray(reading[:, : len(self.touches)]),
            force=jnp.asarray(made.force),
            advance=jnp.asarray(advance.astype(np.float32)),
            contact=jnp.asarray(made.code != ReturnCode.AIR),
        )

    def episodes(self) -> Episodes:
        """What happened.

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
    with tqdm(total=chosen.size, desc=f"{label}: touching", unit="touch") as bar:
        simulator.touch(chosen, bar)
    return simulator.episodes()


def session_errors(key: Key[Array, ""], count: int, errors: SimulationErrors) -> SessionErrors:
    """What is wrong throughout each of the episodes that an `EpisodeSimulator` of this key has.

    Args:
        key: Of the simulator.
        count: Number of episodes.
        errors: Of the world.

    Returns:
        Errors of each episode.
    """
    return _sample_sessions(jax.random.split(key, 3)[0], count, errors)


def _sample_sessions(key: Array, count: int, errors: SimulationErrors) -> SessionErrors:
    return jax.vmap(lambda k: simulation.sample_session_errors(k, errors))(jax.random.split(key, count))


@partial(jax.jit, static_argnames=("errors", "limits"))
def _touch_many(
    drawn: Array,
    surface: Surface,
    T: Array,
    sessions: SessionErrors,
    pad: Pad,
    errors: SimulationErrors,
    limits: PressLimits,
) -> Touches:
    keys = jax.random.wrap_key_data(drawn)

    def one(key: Array, T: Array, session: SessionErrors) -> Touches:
        return simulation.simulate_touch(
            key, surface, jnp.eye(4), T, session=session, pad=pad, errors=errors, limits=limits
        )

    made = jax.vmap(one)(keys, T, sessions)
    blank = jnp.zeros((len(drawn), 0))
    return made._replace(patch=blank, wide=blank, truth=None)


@partial(jax.jit, static_argnames=("errors",))
def _add_sensor_errors(drawn: Array, touches: Touches, pad: Pad, errors: SimulationErrors) -> Array:
    keys = jax.random.wrap_key_data(drawn)
    return jax.vmap(lambda key, run: simulation.apply_sensor_model(key, run, pad, errors).reading)(keys, touches)


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
    rows = _first_touches(made, touches)
    kinds = [recorded.objects[i] for i in made.object[rows[:, 0]]]
    unknown = sorted(set(kinds) - set(names))
    if unknown:
        raise DataError(f"the data set has touches of {', '.join(unknown)}, of which there is no mesh; pass --objects")
    T_o_t = np.linalg.inv(made.T_w_o[rows]) @ made.T_w_t[rows]
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


def _first_touches(made: Touches, touches: int) -> Int[np.ndarray, "e t"]:
    """Rows of the first usable touches of each session that has enough of them. Raises DataError where none has."""
    episodes = []
    for session in np.unique(made.session):
        rows = np.flatnonzero((made.session == session) & (made.code != ReturnCode.FAILED) & np.isfinite(made.force))
        if len(rows) >= touches:
            episodes.append(rows[:touches])
    if not episodes:
        raise DataError(f"no session has {touches} touches with a measured force; record longer ones")
    return np.stack(episodes)


@jax.jit
def posteriors(
    table: PredictedTouch,
    site: Int[Array, "e t"],
    observations: TouchObservation,
    likelihood: Likelihood,
    particles: Particles,
) -> Float[Array, "e t objects"]:
    """Posteriors over the objects after each touch of each episode.

    Args:
        table: Predicted touches, (sites, objects, k).
        site: Row of the table for each touch.
        observations: What was measured, (e, t).
        likelihood: How far measurements may be from predictions.
        particles: Poses of each object.

    Returns:
        Probabilities of the objects.
    """
    objects, channels = table.hit.shape[1], table.reading.shape[-1]

    def episode(at: tuple[Array, TouchObservation]) -> Array:
        def step(now: belief.Belief, touched: tuple[Array, TouchObservation]) -> tuple[belief.Belief, Array]:
            now = belief.update(now, touched[1], element(table, touched[0]), likelihood)
            return now, belief.posterior(now)

        return jax.lax.scan(step, belief.init(particles, objects, channels=channels), at)[1]

    return jax.lax.map(episode, (site, observations), batch_size=8)


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
    table, site = jax.device_put(table), jnp.asarray(episodes.site)
    found = {}
    for kind in kinds:
        tactile, spatial = (jnp.float32(weight) for weight in EVIDENCE[kind])
        weighted = likelihood._replace(tactile_weight=tactile, spatial_weight=spatial)
        found[kind] = np.asarray(posteriors(table, site, episodes.observations, weighted, particles))
    return found
