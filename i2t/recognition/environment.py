"""A recognition episode as pure functions: `reset(key, params) -> (obs, state)`, `step(key, state, action, params) ->
(obs, state, reward, done, info)`.

The signature is that of gymnax (Lange, 2022), which this module does not need: lift `step` with `jax.vmap` over many
environments, and run it with `jax.lax.scan`. In each episode an object, its placement and a pad are drawn. An action
chooses a site of a pool and predicts the object. The reward is the negative cross entropy (nats) of that prediction,
minus the cost of a refused touch. `i2t.recognition.rollout` runs many episodes under a policy.

A step composes three functions: `touch` presses the skin at a site (`i2t.simulation.touches.simulate_touch`) or looks
up the press in a table, `record` writes the press into the episode, and `measure` reads all presses of the episode with
a sensor that has errors and memory.

A site is touched only if that is safe on every possible object at its believed placement, so that a refusal contains no
information about the object. A refused touch does not move the arm: it costs a step, is reported in `info["refused"]`,
and is not replaced by another touch.

Units are metres, newtons and microtesla; the believed pose of objects is the world's origin. Everything here is
simulated.
"""

from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, UInt32

from i2t.contact.press import PadResponse, PressLaw, PressLimits
from i2t.recognition import belief as beliefs
from i2t.recognition.belief import Belief, Particles, TouchObservation
from i2t.recognition.outcomes import PredictedTouch
from i2t.rendering.ops import element
from i2t.runtime.compiling import traced_floats
from i2t.simulation.site_limits import SiteLimits
from i2t.simulation.sites import RECOGNITION_LIMITS
from i2t.simulation.touches import (
    SessionErrors,
    SimulationErrors,
    read_session,
    sample_session_errors,
    simulate_touch,
)
from i2t.skin.pad import press as press_pad
from i2t.skin_models.likelihood import Likelihood
from i2t.types import Pad, ReturnCode, Surface

Poses = TypeVar("Poses", Array, np.ndarray)
PadTree = TypeVar("PadTree", Pad, PadResponse)


@traced_floats
@dataclass(frozen=True)
class EnvironmentConfig:
    """Rules of a recognition environment: simulated errors, limits and law of a press, number of touches of an episode,
    earlier presses of the pad, limits of safe sites, and the cost of a refused touch.
    """

    errors: SimulationErrors = field(default_factory=SimulationErrors)
    limits: PressLimits = field(default_factory=PressLimits)
    touches: int = 16  # number of touches in an episode
    law: PressLaw | None = press_pad  # law that gives the reading of a press of the pad; None: see `simulate_touch`
    presses_before: int = 1000  # presses of the pad before an episode, because the skin has been used in training
    safety: SiteLimits = RECOGNITION_LIMITS
    refusal_cost: float = 0.1

    @property
    def press_errors(self) -> SimulationErrors:
        """Errors of a press, without those of the sensor. Environments that differ only in the sensor's errors share
        compiled programs, even if integers in the sensor's errors differ.
        """
        none = SimulationErrors.error_free()
        return replace(self.errors, noise=none.noise, faults=none.faults)


class TouchOutcome(NamedTuple):
    """Outcome of a simulated touch at the end of its press: the reading (uT) of an ideal skin without errors or memory,
    the measured force (N), the tool's pose as the arm reports it, and whether it met anything.
    """

    reading: Float[Array, "*batch c"]  # uT
    force: Float[Array, "*batch"]  # N, measured force
    T_w_t: Float[Array, "*batch 4 4"]  # pose of the tool at the end of the press, as the arm reports it
    contact: Bool[Array, "*batch"]  # whether the touch met anything


class TabulatedTouches(NamedTuple):
    """Simulated touches of every pad on every object in every placement at every site: readings (uT) of an ideal skin,
    forces (N), travels (m) from the site, and whether each met anything.
    """

    reading: Float[Array, "pads objects placements sites c"]  # uT
    force: Float[Array, "pads objects placements sites"]  # N
    # m, travel from the site to the end of the press, along the approach
    advance: Float[Array, "pads objects placements sites"]
    contact: Bool[Array, "pads objects placements sites"]  # whether the touch met anything


class OutcomeTable(NamedTuple):
    """Touches simulated in advance, for look-ups by an environment, and the objects' true pose in each placement."""

    touches: TabulatedTouches
    T_w_o: Float[Array, "placements 4 4"]  # true poses of the objects


class TouchBeliefs(NamedTuple):
    """Touches predicted for each pad, site, object and pose particle, with the likelihood of measurements and the
    particles, from which an environment computes its posterior (`i2t.recognition.environment_beliefs`).
    """

    predicted: PredictedTouch  # (pads, sites, objects, k) predicted touches
    likelihood: Likelihood
    particles: Particles


class EnvironmentParams(NamedTuple):
    """The possible objects, the pads with their responses, and the sites with the object on which each was drawn and
    whether it may be touched; optionally a table of simulated touches, and predictions for the posterior.
    """

    surfaces: Surface  # stacked surfaces of the objects
    pads: Pad  # stacked pads
    response: PadResponse  # linear response of each pad
    T_w_site: Float[Array, "sites 4 4"]
    owner: Int[Array, " sites"]  # object on which each site was drawn
    allowed: Bool[Array, " sites"]  # True for sites that are safe on every object
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
        """Number of values of a reading."""
        return self.pads.gains.shape[-1]

    def with_pads(self, rows: Int[np.ndarray, " kept"] | slice) -> "EnvironmentParams":
        """Keep some of the environment's pads, for instance those held out.

        Args:
            rows: Indices of the pads to keep.

        Returns:
            Parameters with these pads only.
        """
        some = partial(jax.tree.map, lambda x: x[rows])
        table, believed = self.table, self.beliefs
        if table is not None:
            table = table._replace(touches=some(table.touches))
        if believed is not None:
            believed = believed._replace(predicted=some(believed.predicted))
        return self._replace(pads=some(self.pads), response=some(self.response), table=table, beliefs=believed)


class TouchAction(NamedTuple):
    """Action of an agent: the index of the site to touch next, and logits of the objects predicted before that touch
    (None for the environment's own posterior).
    """

    touch: Int[Array, ""]  # index of the site to touch
    # logits of the objects, as predicted by the agent; None for the environment's own posterior
    prediction: Float[Array, " o"] | None = None


class EnvironmentObservation(NamedTuple):
    """Observation of an agent after a touch: reading (uT), force (N), travel (m) from the site, tool pose, contact,
    whether the touch was refused, the fraction of the touches that is left, and the posterior (empty without beliefs).
    """

    reading: Float[Array, " c"]  # uT
    force: Float[Array, ""]  # N
    advance: Float[Array, ""]  # m, travel from the site to the end of the press, along the approach
    T_w_t: Float[Array, "4 4"]  # pose of the tool at the end of the press, as the arm reports it
    contact: Bool[Array, ""]  # whether the touch met anything
    refused: Bool[Array, ""]  # whether the touch was unsafe and not made
    remaining: Float[Array, ""]  # fraction of the episode's touches that are left
    posterior: Float[Array, " o"]  # posterior probabilities of the objects; empty without `EnvironmentParams.beliefs`


class EpisodeState(NamedTuple):
    """State of an episode of t touches: indices of object, pad and placement, constant errors, sites and outcomes of
    the touches so far, counts of made and refused touches, and belief. Rows of future touches are zero.
    """

    object: Int[Array, "*e"]
    pad: Int[Array, "*e"]
    placement: Int[Array, "*e"]  # row of the table with the episode's placement
    session: SessionErrors  # errors that stay the same during the episode
    # key of the sensor's errors, as bits, which can be selected and moved to the host
    sensor_key: UInt32[Array, "*e 2"]
    site: Int[Array, "*e t"]
    outcomes: TouchOutcome  # (*e, t) outcomes of the touches that were made
    num_touched: Int[Array, "*e"]  # number of touches made
    num_refused: Int[Array, "*e"]  # number of refused touches
    belief: Belief | None


@dataclass(frozen=True)
class TouchEnvironment:
    """Rules of an environment for recognising objects by simulated touches; all methods are pure, on one episode.

    Example:
        environment, params = make_environment(("star", "hexagon", "cylinder"), pads=4)
        obs, state = environment.reset(key, params)
        action = TouchAction(jnp.int32(3), jnp.zeros(3))
        obs, state, reward, done, info = environment.step(key, state, action, params)
    """

    config: EnvironmentConfig = field(default_factory=EnvironmentConfig)

    def reset(self, key: Key[Array, ""], params: EnvironmentParams) -> tuple[EnvironmentObservation, EpisodeState]:
        """Begin an episode with a random object and pad.

        Args:
            key: Random key.
            params: The objects and pads of the environment.

        Returns:
            Observation before the first touch, and the episode.
        """
        key_object, key_pad, key_session, key_sensor = jax.random.split(key, 4)
        which = jax.random.randint(key_object, (), 0, params.objects)
        pad = jax.random.randint(key_pad, (), 0, params.pads.gains.shape[0])
        state = self.begin(key_session, key_sensor, which, pad, params)
        nothing = TouchObservation(jnp.zeros(params.channels), jnp.zeros(()), jnp.zeros(()), jnp.asarray(False))
        return self._observe(state, nothing, jnp.asarray(False)), state

    def begin(
        self,
        key_session: Key[Array, ""],
        key_sensor: Key[Array, ""],
        which: Int[Array, ""] | int,
        pad: Int[Array, ""] | int,
        params: EnvironmentParams,
    ) -> EpisodeState:
        """Begin an episode with a given object and pad.

        Args:
            key_session: Random key of the errors of placement and camera.
            key_sensor: Random key of the sensor's errors.
            which: Index of the object.
            pad: Index of the pad.
            params: The objects and pads of the environment.

        Returns:
            Episode before its first touch.
        """
        row, t = jnp.zeros((), jnp.int32), self.config.touches
        if params.table is None:
            session = sample_session_errors(key_session, self.config.errors)
        else:
            row = jax.random.randint(key_session, (), 0, len(params.table.T_w_o))
            session = SessionErrors(params.table.T_w_o[row], jnp.eye(4))
        none = TouchOutcome(
            jnp.zeros((t, params.channels)), jnp.zeros(t), jnp.zeros((t, 4, 4)), jnp.zeros(t, bool)
        )  # fmt: skip
        return EpisodeState(
            object=jnp.asarray(which, jnp.int32),
            pad=jnp.asarray(pad, jnp.int32),
            placement=row,
            session=session,
            sensor_key=jax.random.key_data(key_sensor),
            site=jnp.zeros(t, jnp.int32),
            outcomes=none,
            num_touched=jnp.zeros((), jnp.int32),
            num_refused=jnp.zeros((), jnp.int32),
            belief=None if params.beliefs is None else _prior(params),
        )

    def step(
        self, key: Key[Array, ""], state: EpisodeState, action: TouchAction, params: EnvironmentParams
    ) -> tuple[EnvironmentObservation, EpisodeState, Float[Array, ""], Bool[Array, ""], dict[str, Any]]:
        """Make one touch as `step_env` does. After the last touch the next episode begins, as in gymnax.

        Args:
            key: Random key.
            state: The episode.
            action: The site of the touch, and the object predicted before it.
            params: The objects and pads of the environment.

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
        self, key: Key[Array, ""], state: EpisodeState, action: TouchAction, params: EnvironmentParams
    ) -> tuple[EnvironmentObservation, EpisodeState, Float[Array, ""], Bool[Array, ""], dict[str, Any]]:
        """Make one touch of an episode, without beginning another one after the last touch.

        The prediction is scored before the touch of the same action, because it follows from the earlier observations.

        Args:
            key: Random key.
            state: The episode.
            action: The site of the touch, and the object predicted before it.
            params: The objects and pads of the environment.

        Returns:
            Observation, episode, reward (minus the prediction's loss, and minus the cost of a refused touch), whether
            the episode ended, and `info`: whether the touch was refused, the loss (nats), the object and the pad.
        """
        listed = (action.touch >= 0) & (action.touch < params.sites)
        site = jnp.clip(action.touch, 0, params.sites - 1)
        safe = listed & params.allowed[site]
        pressed = record(state, site, self.touch(key, state, site, params))
        measured = element(self.measure(pressed, params), state.num_touched)
        after = jax.tree.map(partial(jnp.where, safe), self.believe(pressed, measured, params), state)
        after = after._replace(num_refused=state.num_refused + ~safe)
        measured = jax.tree.map(lambda x: jnp.where(safe, x, jnp.zeros_like(x)), measured)
        loss = cross_entropy(self._prediction(state, action), state.object)
        reward = -loss - jnp.where(safe, 0.0, self.config.refusal_cost)
        info = {"refused": ~safe, "loss": loss, "object": state.object, "pad": state.pad}
        done = after.num_touched + after.num_refused >= self.config.touches
        return self._observe(after, measured, ~safe), after, reward, done, info

    def touch(
        self, key: Key[Array, ""], state: EpisodeState, site: Int[Array, ""], params: EnvironmentParams
    ) -> TouchOutcome:
        """Simulate a press at a site, or look it up in the environment's table.

        Args:
            key: Random key of the arm's errors.
            state: The episode.
            site: Index of the site.
            params: The objects and pads of the environment.

        Returns:
            Outcome of the press, with the reading (uT) of an ideal skin.
        """
        T_w_site = params.T_w_site[site]
        if params.table is not None:
            row = state.pad, state.object, state.placement, site
            touched = jax.tree.map(lambda x: x[row], params.table.touches)
            end = T_w_site @ jnp.eye(4).at[2, 3].set(touched.advance)
            return TouchOutcome(touched.reading, touched.force, end, touched.contact)
        pressed = simulate_touch(
            key, element(params.surfaces, state.object), jnp.eye(4), T_w_site,
            session=state.session, pad=select_pad(params.pads, state.pad), errors=self.config.errors,
            limits=self.config.limits, law=self.config.law, response=select_pad(params.response, state.pad),
        )  # fmt: skip
        return TouchOutcome(pressed.reading, pressed.force, pressed.T_w_t, pressed.code != ReturnCode.AIR)

    def read(self, state: EpisodeState, pads: Pad) -> Float[Array, "t c"]:
        """Compute the readings of all touches of an episode by a simulated sensor with errors and memory.

        Args:
            state: The episode.
            pads: The pads of the environment.

        Returns:
            `(t, c)` readings (uT) of the episode's t touches. Those of future touches are meaningless and do not affect
            the others.
        """
        return read_session(
            jax.random.wrap_key_data(state.sensor_key), state.outcomes.reading, state.outcomes.T_w_t,
            select_pad(pads, state.pad), self.config.errors, presses_before=self.config.presses_before,
        )  # fmt: skip

    def measure(self, state: EpisodeState, params: EnvironmentParams) -> TouchObservation:
        """Measure all touches of an episode, with readings from `read`.

        Args:
            state: The episode.
            params: The objects and pads of the environment.

        Returns:
            Measurements of the t touches on axis 0; those of future touches are meaningless.
        """
        advance = advance_along_approach(params.T_w_site[state.site], state.outcomes.T_w_t)
        return TouchObservation(self.read(state, params.pads), state.outcomes.force, advance, state.outcomes.contact)

    def believe(self, state: EpisodeState, measured: TouchObservation, params: EnvironmentParams) -> EpisodeState:
        """Update the belief with the last touch, if the environment has one.

        Args:
            state: The episode, in which the last touch is recorded.
            measured: The measurements of that touch.
            params: The objects and pads of the environment.

        Returns:
            Episode with the belief after the touch.
        """
        if params.beliefs is None or state.belief is None:
            return state
        predicted = jax.tree.map(lambda x: x[state.pad, state.site[state.num_touched - 1]], params.beliefs.predicted)
        return state._replace(belief=beliefs.update(state.belief, measured, predicted, params.beliefs.likelihood))

    def _prediction(self, state: EpisodeState, action: TouchAction) -> Array:
        """Return the logits that an action predicts."""
        if action.prediction is not None:
            return action.prediction
        if state.belief is None:
            raise ValueError(
                "an action without a prediction needs params.beliefs (i2t.recognition.environment_beliefs)"
            )
        return jnp.log(jnp.maximum(beliefs.posterior(state.belief), beliefs.MIN_PROBABILITY))

    def _observe(self, state: EpisodeState, measured: TouchObservation, refused: Array) -> EnvironmentObservation:
        """Make the observation for an agent."""
        posterior = jnp.zeros(0) if state.belief is None else beliefs.posterior(state.belief)
        last = state.outcomes.T_w_t[jnp.maximum(state.num_touched - 1, 0)]
        return EnvironmentObservation(
            reading=measured.reading,
            force=measured.force,
            advance=measured.advance,
            T_w_t=jnp.where(state.num_touched > 0, last, _home()),
            contact=measured.contact,
            refused=refused,
            remaining=1 - (state.num_touched + state.num_refused) / self.config.touches,
            posterior=posterior,
        )


def select_pad(stacked: PadTree, number: Int[Array, ""]) -> PadTree:
    """Select one pad, or its response, from several.

    Args:
        stacked: Pads or responses, on axis 0.
        number: Index of the pad.

    Returns:
        Pad or response. A single pad is returned without selection, so that parallel episodes share what depends on it
        alone.
    """
    pads = jax.tree.leaves(stacked)[0].shape[0]
    return element(stacked, number if pads > 1 else 0)


def record(state: EpisodeState, site: Int[Array, ""], outcome: TouchOutcome) -> EpisodeState:
    """Write a touch into its episode.

    Args:
        state: The episode before the touch.
        site: Index of the site.
        outcome: The end of the touch.

    Returns:
        Episode with one more touch.
    """
    outcomes = jax.tree.map(lambda rows, row: rows.at[state.num_touched].set(row), state.outcomes, outcome)
    return state._replace(
        site=state.site.at[state.num_touched].set(site), outcomes=outcomes, num_touched=state.num_touched + 1
    )


def advance_along_approach(T_w_site: Poses, T_w_t: Poses) -> Poses:
    """Compute the travel from sites to the ends of presses, along the approach.

    Args:
        T_w_site: Poses of the sites, `(..., 4, 4)`.
        T_w_t: Poses of the tool at the ends, `(..., 4, 4)`.

    Returns:
        `(...)` distances (m), positive where the press went beyond its site along the tool's z axis.
    """
    return ((T_w_t[..., :3, 3] - T_w_site[..., :3, 3]) * T_w_site[..., :3, 2]).sum(-1)


def cross_entropy(prediction: Float[Array, " o"], which: Int[Array, ""]) -> Float[Array, ""]:
    """Compute the cross-entropy of a predicted object; rewards are its negative.

    Args:
        prediction: Logits of the objects.
        which: Index of the true object.

    Returns:
        Scalar loss (nats).
    """
    return -jnp.sum(jax.nn.one_hot(which, prediction.shape[-1]) * jax.nn.log_softmax(prediction))


def _home() -> Float[Array, "4 4"]:
    """Return the pose of the tool before the first touch: 0.15 m above the origin, pointing down."""
    return jnp.diag(jnp.array([1.0, -1.0, -1.0, 1.0])).at[2, 3].set(0.15)


def _prior(params: EnvironmentParams) -> Belief:
    assert params.beliefs is not None
    return beliefs.init(params.beliefs.particles, params.objects, channels=params.channels)
