"""Many episodes of an environment in parallel, under policies: random sites, the paper's heuristic, expected
information.

`begin_episodes` places the objects, `advance` makes the next touches of every episode, and `rollout` repeats both under
a policy, `policy(key, state, params) -> site`. The policies here never choose a site that is forbidden or was touched
before; if none is left they choose `i2t.recognition.policy.NO_SITE`.

A touch depends only on the key of the episodes, the index of the touch, the episode and the site. Methods that are
compared with the same key therefore share the touches that both of them make (`advance(..., shared=...)`).
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, UInt32

from i2t.contact.press import PadResponse
from i2t.paper import loop
from i2t.recognition import belief
from i2t.recognition.belief import TouchObservation
from i2t.recognition.environment import (
    EnvironmentConfig,
    EnvironmentParams,
    EpisodeState,
    TouchEnvironment,
    TouchOutcome,
    advance_along_approach,
)
from i2t.recognition.episodes import Episodes, MeasuredTouches
from i2t.recognition.policy import choose_site, draw_site, expected_information_gain
from i2t.recognition.site_pool import SitePool
from i2t.recognition.touch_table import environment_params
from i2t.runtime.batching import filled_batches, map_batches, map_on_devices, select_rows
from i2t.runtime.compiling import compiles_slowly, jit_by_amount, jit_quickly
from i2t.runtime.progress import Progress, progress
from i2t.types import Pad, Surface

# Number of touches, or of episodes, computed at a time; a small last batch wastes little, and the data fit the caches.
EPISODE_BATCH = 16

TouchNumber: TypeAlias = tuple[int, int, int]  # index of the touch, of the episode and of the site
SitePolicy: TypeAlias = Callable[[Array, EpisodeState, EnvironmentParams], Array]


class RunningEpisodes(NamedTuple):
    """States of e episodes that run in parallel, with their environment, the key of their touches, and the touches that
    the last call of `advance` made; arrays on the host.
    """

    environment: TouchEnvironment
    params: EnvironmentParams
    key_touch: UInt32[np.ndarray, "2"]  # key data of the random key from which all touches are drawn
    states: EpisodeState  # (e, ...) states of the episodes, all with the same number of touches
    # touches that the last call of `advance` made and that no episodes shared
    new: Mapping[TouchNumber, TouchOutcome] = {}


def begin_episodes(
    key: Key[Array, ""],
    environment: TouchEnvironment,
    params: EnvironmentParams,
    truth: Int[np.ndarray, " e"],
    pad: Int[np.ndarray, " e"] | None = None,
) -> RunningEpisodes:
    """Begin episodes by placing an object, with random errors, in each.

    Args:
        key: Random key of all random events in the episodes.
        environment: The rules of the episodes.
        params: The objects and pads of the environment.
        truth: Index of the true object of each episode.
        pad: Index of the pad of each episode; the first pad by default.

    Returns:
        Episodes before their first touch.
    """
    pad = np.zeros(len(truth), int) if pad is None else pad
    begun = _begin(key, jnp.asarray(truth), jnp.asarray(pad), params, environment.config)
    return RunningEpisodes(environment, params, *jax.device_get(begun))


def advance(
    episodes: RunningEpisodes,
    site: Int[np.ndarray, "e n"],
    *,
    shared: Mapping[TouchNumber, TouchOutcome] | None = None,
    bar: Progress | None = None,
) -> RunningEpisodes:
    """Make the next n touches of every episode.

    Args:
        episodes: The episodes so far.
        site: Indices of the sites to touch.
        shared: Touches of other episodes with the same key, objects and sites, which are not made again.
        bar: Progress bar to update.

    Returns:
        Episodes after the touches, with the touches that were not shared (`new`).

    Raises:
        ValueError: A site is negative because none was chosen.
    """
    site = np.asarray(site)
    if (site < 0).any():
        raise ValueError("an episode has no site to touch: none was chosen")
    states, (e, n) = episodes.states, site.shape
    count = int(states.num_touched[0])
    numbers = [(count + i % n, i // n, int(where)) for i, where in enumerate(site.reshape(-1))]
    touches = {} if shared is None else {number: shared[number] for number in numbers if number in shared}
    if bar is not None:
        bar.update(len(touches))
    missing = np.flatnonzero([number not in touches for number in numbers])
    new: dict[TouchNumber, TouchOutcome] = {}
    keys = np.asarray(_touch_keys(episodes.key_touch, count, n=n, episodes=e))
    for rows, batch in _touch(episodes, keys, site, missing):
        new |= {numbers[i]: jax.tree.map(lambda x, j=j: x[j], batch) for j, i in enumerate(rows)}
        if bar is not None:
            bar.update(len(rows))
    touches |= new
    outcome = jax.tree.map(lambda *x: np.stack(x).reshape(e, n, *x[0].shape), *[touches[number] for number in numbers])
    for i in range(n):
        states = _record(states, site[:, i], jax.tree.map(lambda x, i=i: x[:, i], outcome))
        if episodes.params.beliefs is not None:
            states = jax.device_get(_believe(states, episodes.params, episodes.environment.config))
    return episodes._replace(states=states, new=new)


def episodes_of(episodes: RunningEpisodes) -> Episodes:
    """Collect the record of episodes so far.

    Args:
        episodes: The episodes so far.

    Returns:
        Objects, sites and measurements of the touches made.
    """
    states, params = episodes.states, episodes.params
    e, count = len(states.object), int(states.num_touched[0])
    parts = filled_batches(np.arange(e), EPISODE_BATCH)
    calls = ((select_rows(states, rows),) for rows in parts)
    readings = map_on_devices(_read, calls, shared=(params.pads, episodes.environment.config))
    read = np.concatenate(list(readings))[:e, :count]
    site, touches = np.asarray(states.site[:, :count]), jax.tree.map(lambda x: x[:, :count], states.outcomes)
    advanced = advance_along_approach(np.asarray(params.T_w_site)[site], touches.T_w_t).astype(np.float32)
    seen = TouchObservation(*map(jnp.asarray, (read, touches.force, advanced, touches.contact)))
    return Episodes(np.asarray(states.object), site, seen, np.asarray(touches.T_w_t))


def last_touches(episodes: RunningEpisodes) -> MeasuredTouches:
    """Return the last touch of each episode.

    Args:
        episodes: The episodes so far.

    Returns:
        Measurements and poses of e touches.
    """
    record = episodes_of(episodes)
    seen = record.observations
    return MeasuredTouches(record.T_w_t[:, -1], np.asarray(seen.reading[:, -1]), np.asarray(seen.force[:, -1]))


def rollout(
    key: Key[Array, ""],
    environment: TouchEnvironment,
    params: EnvironmentParams,
    policy: SitePolicy,
    truth: Int[np.ndarray, " e"],
    pad: Int[np.ndarray, " e"] | None = None,
) -> tuple[Episodes, Float[np.ndarray, "e t o"]]:
    """Run episodes under a policy, with the environment's belief after each touch.

    Args:
        key: Random key; the same key gives the same objects and placements.
        environment: The rules of the episodes.
        params: The objects and pads of the environment, with beliefs.
        policy: Function that chooses sites.
        truth: Index of the true object of each episode.
        pad: Index of the pad of each episode; the first pad by default.

    Returns:
        Record of e episodes of t touches, and the `(e, t, o)` posteriors over the o objects after each touch.
    """
    key_world, key_policy = jax.random.split(key)
    episodes = begin_episodes(key_world, environment, params, truth, pad)
    posteriors = []
    for i in range(environment.config.touches):
        site = _choose(jax.random.fold_in(key_policy, i), episodes.states, params, policy=policy)
        episodes = advance(episodes, np.asarray(site)[:, None])
        posteriors.append(np.asarray(_posteriors(episodes.states.belief)))
    return episodes_of(episodes), np.stack(posteriors, axis=1)


def run_episodes(
    key: Key[Array, ""],
    surfaces: Sequence[Surface],
    truth: Int[np.ndarray, " e"],
    chosen: Int[np.ndarray, "e t"],
    *,
    sites: SitePool,
    pad: Pad,
    config: EnvironmentConfig,
    label: str,
) -> Episodes:
    """Simulate episodes at sites chosen in advance, with a progress bar.

    Args:
        key: Random key of all random events in the episodes.
        surfaces: Surfaces of the objects, all of one size class.
        truth: Index of the true object of each episode.
        chosen: Indices of the sites to touch.
        sites: Pool of the sites.
        pad: The pad.
        config: Errors, limits and the number of touches.
        label: Purpose of the touches, for the bar.

    Returns:
        Record of the episodes.
    """
    environment, params = TouchEnvironment(config), environment_params(surfaces, [pad], sites, config)
    episodes = begin_episodes(key, environment, params, truth)
    with progress(total=chosen.size, desc=f"{label}: touching", unit="touches") as bar:
        episodes = advance(episodes, chosen, bar=bar)
    return episodes_of(episodes)


# --- policies ---


def untouched_sites(state: EpisodeState, params: EnvironmentParams) -> Bool[Array, " sites"]:
    """Find the sites that are allowed and not yet touched in the episode.

    Args:
        state: The episode.
        params: The objects and pads of the environment.

    Returns:
        `(sites,)` mask of these sites.
    """
    is_past = jnp.arange(state.site.shape[0]) < state.num_touched
    return params.allowed.at[jnp.where(is_past, state.site, params.sites)].set(False, mode="drop")


def random_site(key: Key[Array, ""], state: EpisodeState, params: EnvironmentParams) -> Int[Array, ""]:
    """Choose any site that is allowed and not yet touched.

    Args:
        key: Random key.
        state: The episode.
        params: The objects and pads of the environment.

    Returns:
        Index of the site, or -1 if none is left.
    """
    return draw_site(key, jnp.ones(params.sites), untouched_sites(state, params))


def heuristic_site(key: Key[Array, ""], state: EpisodeState, params: EnvironmentParams) -> Int[Array, ""]:
    """Choose by the paper's heuristic an informative site of the most probable object
    (`i2t.paper.loop.site_informativeness`), or any other site if none is left.

    Args:
        key: Random key.
        state: The episode, with its belief.
        params: The objects and pads of the environment.

    Returns:
        Index of the site, or -1 if none is left.
    """
    key_object, key_site = jax.random.split(key)
    which = loop.choose_hypothesis(key_object, belief.posterior(_belief(state)), state.num_touched)
    own = params.owner[None] == jnp.arange(params.objects)[:, None]
    everywhere = jnp.broadcast_to(params.T_w_site[None], (params.objects, *params.T_w_site.shape))
    weight = loop.site_informativeness(everywhere[..., :3, 3], -everywhere[..., :3, 2], own, which)
    return draw_site(key_site, weight, untouched_sites(state, params))


def informative_site(key: Key[Array, ""], state: EpisodeState, params: EnvironmentParams) -> Int[Array, ""]:
    """Choose the site with the largest expected information about the object (`i2t.recognition.policy`).

    Args:
        key: Random key of the simulated outcomes.
        state: The episode, with its belief.
        params: The objects and pads of the environment.

    Returns:
        Index of the site, or -1 if none is left.
    """
    assert params.beliefs is not None
    table = jax.tree.map(lambda x: x[state.pad], params.beliefs.predicted)
    gain = expected_information_gain(
        key, _belief(state), table, params.beliefs.likelihood, num_draws=16, num_particles=8
    )
    return choose_site(gain, untouched_sites(state, params))


# Policies that choose the next touch site for recognition, by name.
POLICIES: dict[str, SitePolicy] = {
    "random": random_site,
    "heuristic": heuristic_site,
    "information": informative_site,
}


def _belief(state: EpisodeState) -> belief.Belief:
    if state.belief is None:
        raise ValueError(
            "this policy needs an environment with beliefs; see i2t.recognition.environment_beliefs.with_beliefs"
        )
    return state.belief


# --- compiled ---


@jit_quickly
def _begin(
    key: Key[Array, ""], truth: Array, pad: Array, params: EnvironmentParams, config: EnvironmentConfig
) -> tuple[Array, EpisodeState]:
    """Return the data of the key of the touches, and the episodes."""
    key_sessions, key_touch, key_reading = jax.random.split(key, 3)
    environment = TouchEnvironment(config)
    keys = [jax.random.split(key, len(truth)) for key in (key_sessions, key_reading)]

    def begin(session: Array, sensor: Array, which: Array, pad: Array) -> EpisodeState:
        return environment.begin(session, sensor, which, pad, params)

    states = jax.vmap(begin)(keys[0], keys[1], truth, pad)
    return jax.random.key_data(key_touch), states


@partial(jit_quickly, static_argnames=("n", "episodes"))
def _touch_keys(key: Array, before: Int[Array, ""] | int, *, n: int, episodes: int) -> Array:
    """Make the keys of the next n touches of every episode, in the order of episodes. They are returned as data,
    because their rows are repeated to fill batches.
    """
    steps = before + jnp.arange(n)
    key = jax.random.wrap_key_data(key)
    keys = jax.vmap(lambda i: jax.random.split(jax.random.fold_in(key, i), episodes), out_axes=1)(steps)
    return jax.random.key_data(keys.reshape(-1))


def _touch(
    episodes: RunningEpisodes, keys: np.ndarray, site: np.ndarray, missing: np.ndarray
) -> Iterator[tuple[np.ndarray, TouchOutcome]]:
    """Make the missing touches, given as rows of the flat `site`, in filled batches of one size."""
    states, params, (e, n) = episodes.states, episodes.params, site.shape
    size = min(EPISODE_BATCH, 1 << (e - 1).bit_length())
    of_pads = [missing[states.pad[missing // n] == pad] for pad in np.unique(states.pad)]
    batches = [rows[start : start + size] for rows in of_pads for start in range(0, len(rows), size)]
    given = episodes.environment.config
    config = EnvironmentConfig(given.press_errors, given.limits, given.touches, given.law)

    def call(rows: np.ndarray) -> tuple[np.ndarray, EpisodeState, np.ndarray, Pad, PadResponse]:
        full, pad = np.resize(rows, size), states.pad[rows[0] // n]
        of_pad = params if params.table is not None else params.with_pads(slice(pad, pad + 1))
        some = select_rows(states._replace(belief=None), full // n)
        return keys[full], some, site.reshape(-1)[full], of_pad.pads, of_pad.response

    touch = _touch_rows(e * given.touches)
    shared = params._replace(beliefs=None), config
    yield from zip(batches, map_on_devices(touch, map(call, batches), shared=shared), strict=True)


@compiles_slowly("the simulation of episodes", seconds=4)
def _touch_many(
    keys: Array,
    states: EpisodeState,
    site: Array,
    pads: Pad,
    response: PadResponse,
    params: EnvironmentParams,
    config: EnvironmentConfig,
) -> TouchOutcome:
    touch = partial(TouchEnvironment(config).touch, params=params._replace(pads=pads, response=response))
    return jax.vmap(touch)(jax.random.wrap_key_data(keys), states, site)


# Up to this number of touches, compiling quickly saves time. The last digits may differ from those of longer runs.
_touch_rows = jit_by_amount(_touch_many, 16_000)


def _record(states: EpisodeState, site: np.ndarray, outcome: TouchOutcome) -> EpisodeState:
    """Write one touch into each episode, on the host."""
    at = int(states.num_touched[0])

    def with_row(rows: np.ndarray, row: np.ndarray) -> np.ndarray:
        return np.concatenate([rows[:, :at], row[:, None].astype(rows.dtype), rows[:, at + 1 :]], axis=1)

    sites, outcomes = jax.tree.map(with_row, (states.site, states.outcomes), (site, outcome))
    return states._replace(site=sites, outcomes=outcomes, num_touched=states.num_touched + 1)


@jit_quickly
def _read(states: EpisodeState, pads: Pad, config: EnvironmentConfig) -> Array:
    return jax.vmap(partial(TouchEnvironment(config).read, pads=pads))(states)


@jit_quickly
def _believe(states: EpisodeState, params: EnvironmentParams, config: EnvironmentConfig) -> EpisodeState:
    """Update the belief of episodes with their last touch."""
    environment = TouchEnvironment(config)

    def believe(state: EpisodeState) -> EpisodeState:
        measured = environment.measure(state, params)
        return environment.believe(state, jax.tree.map(lambda x: x[state.num_touched - 1], measured), params)

    return map_batches(believe, states, batch_size=EPISODE_BATCH)


@partial(jit_quickly, static_argnames="policy")
def _choose(key: Array, states: EpisodeState, params: EnvironmentParams, *, policy: SitePolicy) -> Array:
    keys = jax.random.split(key, len(states.object))
    return map_batches(lambda at: policy(at[0], at[1], params), (keys, states), batch_size=8)


@jax.jit
def _posteriors(beliefs: belief.Belief) -> Array:
    return jax.vmap(belief.posterior)(beliefs)
