"""Active touch as pure functions: `reset(key, params) -> (obs, state)`, `step(key, state, action, params) -> (obs,
state, reward, done, info)`.

The signature is that of gymnax (Lange, 2022), on which nothing here depends: lift `step` with `jax.vmap` over many
environments, and run it with `jax.lax.scan`. In each episode an object (and its placement) and a pad are drawn; an
action chooses a site of a pool and says which object is believed to be there; the reward is the negative cross
entropy (nats) of that belief, less the cost of a touch that was refused.

A site is touched only where that is safe on every object that may be there, at its believed placement, so that a
refusal tells nothing about the object. A refused touch does not move the arm: it costs a step, is said in
`info["refused"]`, and nothing else is touched in its place.

Two speeds: where `params.table` is given touches are looked up (`i2t.environments.tables`), else they are pressed
(`i2t.environments.press`). In either case placement, arm, force sensor and chips err as the lab's errors say. Without
camera, friction and memory of the skin. Metres, newtons, microtesla; everything here is simulated.
"""

from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from i2t.contact.press import PressLimits
from i2t.environments.press import TouchOutcome, touch_outcome
from i2t.geometry import random_motion
from i2t.recognition import belief as beliefs
from i2t.recognition.belief import Belief, Particles, TouchObservation
from i2t.recognition.outcomes import PredictedTouch
from i2t.rendering.ops import element
from i2t.runtime.compiling import traced_floats
from i2t.simulation.site_limits import SiteLimits
from i2t.simulation.sites import RECOGNITION_LIMITS
from i2t.simulation.touches import SimulationErrors
from i2t.skin.noise import Noise
from i2t.skin_models.likelihood import Likelihood
from i2t.types import Board, Pad, Surface

HOME_HEIGHT_M = 0.15  # of the tool above the world's origin before the first touch


@traced_floats
@dataclass(frozen=True)
class EnvironmentConfig:
    """The rules of an environment."""

    touches: int = 16  # of an episode
    errors: SimulationErrors = field(default_factory=SimulationErrors)
    limits: PressLimits = field(default_factory=PressLimits)
    safety: SiteLimits = RECOGNITION_LIMITS
    refusal_cost: float = 0.1


class OutcomeTable(NamedTuple):
    """Touches that were made once, to be looked up."""

    outcome: TouchOutcome  # (pads, objects, placements, sites)
    T_w_o: Float[Array, "placements 4 4"]


class TouchBeliefs(NamedTuple):
    """Data from which an environment says how probable each object is (`i2t.environments.beliefs`)."""

    predicted: PredictedTouch  # (pads, sites, objects, k)
    likelihood: Likelihood
    particles: Particles


class EnvironmentParams(NamedTuple):
    """Objects that may be there, and pads that touch them."""

    surfaces: Surface  # of the objects, stacked
    pads: Pad  # stacked
    response: Float[Array, "pads c n n"]  # uT per Pa, of each pad
    T_w_site: Float[Array, "sites 4 4"]
    owner: Int[Array, " sites"]  # object on which each site was drawn
    allowed: Bool[Array, " sites"]  # sites that are safe on every object
    table: OutcomeTable | None = None
    beliefs: TouchBeliefs | None = None

    @property
    def objects(self) -> int:
        """Number of objects."""
        return self.surfaces.triangles.shape[0]

    @property
    def sites(self) -> int:
        """Number of sites."""
        return self.T_w_site.shape[0]

    @property
    def channels(self) -> int:
        """Values of a reading."""
        return self.response.shape[1]

    def with_pads(self, rows: Int[np.ndarray, " kept"] | slice) -> "EnvironmentParams":
        """The same environment with some of its pads, say those held out.

        Args:
            rows: which.

        Returns:
            The parameters.
        """
        some = partial(jax.tree.map, lambda x: x[rows])
        table = None if self.table is None else self.table._replace(outcome=some(self.table.outcome))
        believed = None
        if self.beliefs is not None:
            believed = self.beliefs._replace(predicted=some(self.beliefs.predicted))
        return self._replace(pads=some(self.pads), response=self.response[rows], table=table, beliefs=believed)


class TouchAction(NamedTuple):
    """Place of the next touch, and what is believed."""

    touch: Int[Array, ""]  # number of a site
    prediction: Float[Array, " o"] | None = None  # logits of the objects; None: the environment's own posterior


class EnvironmentObservation(NamedTuple):
    """Observation after a touch."""

    reading: Float[Array, " c"]  # uT
    force: Float[Array, ""]  # N
    advance: Float[Array, ""]  # m, from the site to where the press ended, along the approach
    T_w_t: Float[Array, "4 4"]  # where the press ended, as the arm reports
    contact: Bool[Array, ""]  # whether anything was met
    refused: Bool[Array, ""]  # whether the touch was unsafe and not made
    left: Float[Array, ""]  # share of the touches that are left
    posterior: Float[Array, " o"]  # of the objects; empty without `EnvironmentParams.beliefs`


class EnvironmentState(NamedTuple):
    """An episode."""

    object: Int[Array, ""]
    pad: Int[Array, ""]
    placement: Int[Array, ""]  # row of the table
    T_w_o: Float[Array, "4 4"]  # where the object really is
    T_w_t: Float[Array, "4 4"]  # where the tool is
    touches: Int[Array, ""]  # made or refused so far
    belief: Belief | None


@dataclass(frozen=True)
class TouchEnvironment:
    """An environment of active touch; all methods are pure.

    Example:
        environment, params = make_environment(("star", "hexagon", "cylinder"), pads=4)
        obs, state = environment.reset(key, params)
        action = TouchAction(jnp.int32(3), jnp.zeros(3))
        obs, state, reward, done, info = environment.step(key, state, action, params)
    """

    config: EnvironmentConfig = field(default_factory=EnvironmentConfig)

    def reset(self, key: Key[Array, ""], params: EnvironmentParams) -> tuple[EnvironmentObservation, EnvironmentState]:
        """Begin an episode.

        Args:
            key: random key.
            params: what may be there.

        Returns:
            What is known before the first touch, and the episode.
        """
        key_object, key_pad, key_row, key_placement = jax.random.split(key, 4)
        row = jnp.zeros((), jnp.int32)
        if params.table is None:
            T_w_o = sample_placement(key_placement, self.config.errors)
        else:
            row = jax.random.randint(key_row, (), 0, len(params.table.T_w_o))
            T_w_o = params.table.T_w_o[row]
        state = EnvironmentState(
            object=jax.random.randint(key_object, (), 0, params.objects),
            pad=jax.random.randint(key_pad, (), 0, params.response.shape[0]),
            placement=row,
            T_w_o=T_w_o,
            T_w_t=_home(),
            touches=jnp.zeros((), jnp.int32),
            belief=None if params.beliefs is None else _prior(params),
        )
        nothing = TouchObservation(jnp.zeros(params.channels), jnp.zeros(()), jnp.zeros(()), jnp.asarray(False))
        return self._observe(state, nothing, jnp.asarray(False)), state

    def step(
        self, key: Key[Array, ""], state: EnvironmentState, action: TouchAction, params: EnvironmentParams
    ) -> tuple[EnvironmentObservation, EnvironmentState, Float[Array, ""], Bool[Array, ""], dict[str, Any]]:
        """One touch, as `step_env`, after whose last the next episode begins, as gymnax does.

        Args:
            key: random key.
            state: the episode.
            action: where to touch, and what is believed before it.
            params: what may be there.

        Returns:
            Observation, episode, reward, whether the episode ended, and `info`, which holds the last observation of an
            episode that ended (`final`).
        """
        key_step, key_reset = jax.random.split(key)
        obs, after, reward, done, info = self.step_env(key_step, state, action, params)
        fresh_obs, fresh = self.reset(key_reset, params)
        chosen = jax.tree.map(partial(jnp.where, done), (fresh_obs, fresh), (obs, after))
        return chosen[0], chosen[1], reward, done, info | {"final": obs}

    def step_env(
        self, key: Key[Array, ""], state: EnvironmentState, action: TouchAction, params: EnvironmentParams
    ) -> tuple[EnvironmentObservation, EnvironmentState, Float[Array, ""], Bool[Array, ""], dict[str, Any]]:
        """One touch of an episode, which is not followed by another.

        The prediction is judged before the touch that comes with it: it is what is believed on what was seen so far.

        Args:
            key: random key.
            state: the episode.
            action: where to touch, and what is believed before it.
            params: what may be there.

        Returns:
            Observation, episode, reward, whether the episode ended, and `info`: whether the touch was refused, the
            prediction's loss, the object and the pad.
        """
        key_touch, key_force, key_noise = jax.random.split(key, 3)
        known = (action.touch >= 0) & (action.touch < params.sites)
        site = jnp.clip(action.touch, 0, params.sites - 1)
        T_w_site, safe = params.T_w_site[site], known & params.allowed[site]
        outcome = self._outcome(key_touch, state, site, params)
        measured = self._measure(key_force, key_noise, outcome, element(params.pads.board, state.pad))
        measured = jax.tree.map(lambda x: jnp.where(safe, x, jnp.zeros_like(x)), measured)
        end = T_w_site @ jnp.eye(4).at[2, 3].set(measured.advance)
        after = state._replace(
            T_w_t=jnp.where(safe, end, state.T_w_t),
            touches=state.touches + 1,
            belief=self._believe(state, site, measured, safe, params),
        )
        loss = cross_entropy(self._prediction(state, action), state.object)
        reward = -loss - jnp.where(safe, 0.0, self.config.refusal_cost)
        info = {"refused": ~safe, "loss": loss, "object": state.object, "pad": state.pad}
        return self._observe(after, measured, ~safe), after, reward, after.touches >= self.config.touches, info

    def _outcome(self, key: Array, state: EnvironmentState, site: Array, params: EnvironmentParams) -> TouchOutcome:
        """The touch looked up, or pressed."""
        if params.table is not None:
            return jax.tree.map(lambda x: x[state.pad, state.object, state.placement, site], params.table.outcome)
        surface = element(params.surfaces, state.object)
        worn = jax.tree.map(lambda x: x[state.pad][None], (params.pads, params.response))
        made = touch_outcome(
            key, surface, state.T_w_o, params.T_w_site[site],
            pads=worn[0], response=worn[1], errors=self.config.errors, limits=self.config.limits,
        )  # fmt: skip
        return element(made, 0)

    def _measure(self, key_force: Array, key_noise: Array, outcome: TouchOutcome, board: Board) -> TouchObservation:
        """Measurement of a touch by the sensors."""
        noise = sensor_noise(key_noise, board, self.config.errors.noise)
        force = outcome.force + self.config.errors.force * jax.random.normal(key_force)
        return TouchObservation(
            outcome.reading + noise, jnp.where(outcome.contact, force, 0.0), outcome.advance, outcome.contact
        )

    def _believe(
        self, state: EnvironmentState, site: Array, measured: TouchObservation, safe: Array, params: EnvironmentParams
    ) -> Belief | None:
        """The belief after a touch; a refused one changes nothing."""
        if params.beliefs is None or state.belief is None:
            return None
        predicted = jax.tree.map(lambda x: x[state.pad, site], params.beliefs.predicted)
        after = beliefs.update(state.belief, measured, predicted, params.beliefs.likelihood)
        return jax.tree.map(partial(jnp.where, safe), after, state.belief)

    def _prediction(self, state: EnvironmentState, action: TouchAction) -> Array:
        """Prediction of an action."""
        if action.prediction is not None:
            return action.prediction
        if state.belief is None:
            raise ValueError("an action without a prediction needs params.beliefs (i2t.environments.beliefs)")
        return jnp.log(jnp.maximum(beliefs.posterior(state.belief), beliefs.MIN_PROBABILITY))

    def _observe(self, state: EnvironmentState, measured: TouchObservation, refused: Array) -> EnvironmentObservation:
        """Observation that an agent is shown."""
        posterior = jnp.zeros(0) if state.belief is None else beliefs.posterior(state.belief)
        return EnvironmentObservation(
            reading=measured.reading,
            force=measured.force,
            advance=measured.advance,
            T_w_t=state.T_w_t,
            contact=measured.contact,
            refused=refused,
            left=1 - state.touches / self.config.touches,
            posterior=posterior,
        )


def sample_placement(key: Key[Array, ""], errors: SimulationErrors) -> Float[Array, "4 4"]:
    """Pose of an object in an episode: at the world's origin, up to the errors of placement.

    Args:
        key: random key.
        errors: of the lab.

    Returns:
        T_w_o.
    """
    return random_motion(key, errors.placement, errors.placement_angle)


def cross_entropy(prediction: Float[Array, " o"], which: Int[Array, ""]) -> Float[Array, ""]:
    """Loss of a prediction; rewards are its negative.

    Args:
        prediction: logits of the objects.
        which: the object that is there.

    Returns:
        The loss (nats).
    """
    return -jnp.sum(jax.nn.one_hot(which, prediction.shape[-1]) * jax.nn.log_softmax(prediction))


def sensor_noise(key: Key[Array, ""], board: Board, noise: Noise) -> Float[Array, " c"]:
    """Noise that the chips add to a reading: the mean of the samples in contact minus that of those before.

    Distributed as in `i2t.skin.noise.add_sensor_noise` but for the converter's steps, which are far below the noise,
    and in one draw for each channel.

    Args:
        key: random key.
        board: whose chips read.
        noise: sizes of the errors.

    Returns:
        uT.
    """
    chips = board.chips.shape[-2]
    drawn = jax.random.normal(key, (3 * chips + 3,))
    white = jnp.sqrt((1 - noise.common) * (1 / noise.contact_samples + 1 / noise.ambient_samples))
    field_of_room = jnp.broadcast_to(jnp.sqrt(2 * noise.common) * noise.sigma(1) * drawn[-3:], (chips, 3))
    return white * noise.sigma(chips) * drawn[:-3] + board.to_board(field_of_room)


def _home() -> Float[Array, "4 4"]:
    """The tool above the origin, looking down."""
    return jnp.diag(jnp.array([1.0, -1.0, -1.0, 1.0])).at[2, 3].set(HOME_HEIGHT_M)


def _prior(params: EnvironmentParams) -> Belief:
    assert params.beliefs is not None
    return beliefs.init(params.beliefs.particles, params.objects, channels=params.channels)
