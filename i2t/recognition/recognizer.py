"""Recognition of an object by touches that the belief itself chooses, for any single robot.

    recognizer = ObjectRecognizer(jax.random.key(0), pad_model, meshes)
    state = recognizer.init()
    while (site := recognizer.choose_touch(state)) is not None:
        reading, force, T_w_t, contact = touch(site.T_w_t)  # your robot
        observation = recognizer.observe(site, reading, force=force, T_w_t=T_w_t, contact=contact)
        state, info = recognizer.update(state, observation)
    print(info.name, info.confidence)

A state is a NamedTuple and never changes: `choose_touch` and `update` are pure. The slow part, predicting touches of
every object at every candidate site, is done once when a recogniser is created. The object may be an unknown one: with
`prior_unknown`, surrogates that resemble the known objects take part, and "unknown" has their total probability.

Units are metres, newtons and microtesla; W world, O object, T tool.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key
from scipy.special import logsumexp

from i2t import validation
from i2t.contact.press import PressLimits
from i2t.geometry import from_twist, inverse, nearest_rigid
from i2t.objects import catalogue
from i2t.recognition import belief, calibrated, outcomes
from i2t.recognition.belief import Belief, TouchObservation
from i2t.recognition.outcomes import PredictedTouch
from i2t.recognition.policy import choose_informative_site, expected_information_gain, safe_sites_mask
from i2t.recognition.site_pool import (
    SitePool,
    place_surfaces,
    predict_outcomes,
    prepare_surfaces,
    safe_sites,
    sample_sites,
)
from i2t.rendering.ops import element
from i2t.runtime.compiling import jit_quickly
from i2t.simulation import sites as touch_sites
from i2t.skin_models.likelihood import Likelihood
from i2t.skin_models.pad_model import PadModel
from i2t.types import in_one_line

MAX_EMPTY_DRAWS = 10  # number of draws of candidates without an allowed site after which no touch is chosen
# Calibration of the probability that the object is unknown, for a prior of 0.5: after t touches, its log odds L become
# offset + slope / (1 + growth (t - 1)) L. It was fitted on validation objects and others of which half were unknown
# (`experiments.studies open_set`).
UNKNOWN_SCALING = calibrated.PlattScaling(offset=0.40, slope=0.65, growth=0.18)


@dataclass(frozen=True)
class RecognizerConfig:
    """Settings of an `ObjectRecognizer`: choice of sites, stopping, unknown objects and safety limits.

    Raises:
        ValueError: The prior of an unknown object or the smallest contact probability is not a probability, or an
            unknown object has no surrogates.

    Example:
        config = i2t.RecognizerConfig(max_touches=20, max_error_probability=0.01)  # more certain, with more touches
        recognizer = i2t.ObjectRecognizer(jax.random.key(0), pad_model, meshes, config=config)
    """

    num_sites: int = 24  # number of candidate sites of each object
    # Smallest share of each known object's poses that the skin must meet at a candidate site. With 0, all sites are
    # candidates; near 1, only sites that every object reaches, so that the readings decide rather than missed touches.
    min_contact_probability: float = 0.0
    num_particles: int = 64  # number of poses of each object
    max_touches: int = 10
    # smallest number of touches before an episode may end for certainty; `max_touches` always ends it
    min_touches: int = 1
    # number of sites that could not be touched after which the recogniser chooses no further site
    max_excluded: int = 30
    # the episode ends when the most probable object is wrong with at most this probability
    max_error_probability: float = 0.05
    prior_unknown: float = 0.0  # prior probability that the object is an unknown one
    num_surrogates: int = 16  # number of objects that represent an unknown one
    skin_change: float = PressLimits.skin_change  # uT, change of the reading at which presses end
    overtravel: float = PressLimits.overtravel  # m, distance beyond a site at which a press without contact ends
    site_limits: touch_sites.SiteLimits = field(default=touch_sites.RECOGNITION_LIMITS)
    seed: int = 0  # seed of the pose particles and of choices

    def __post_init__(self) -> None:
        if not 0 <= self.prior_unknown < 1:
            raise ValueError(f"prior_unknown is {self.prior_unknown:g}; give a probability, from 0 to below 1")
        if not 0 <= self.min_contact_probability <= 1:
            raise ValueError(
                f"min_contact_probability is {self.min_contact_probability:g}; give a probability, from 0 to 1"
            )
        if self.prior_unknown > 0 and self.num_surrogates < 1:
            raise ValueError(f"num_surrogates is {self.num_surrogates}; an unknown object needs some, such as 16")


@in_one_line
class ChosenSite(NamedTuple):
    """Site that the recogniser chose for the next touch: its index, and the tool's pose there in the world."""

    number: int  # index of the site
    T_w_t: Float[np.ndarray, "4 4"]  # pose of the tool at which the skin just touches the believed surface


@in_one_line
class SiteObservation(NamedTuple):
    """Index of a touched site, and the measurements there: reading (uT), force (N), travel (m) and contact."""

    number: int  # index of the site
    touch: TouchObservation


@in_one_line
class TouchEvidence(NamedTuple):
    """Evidence of one touch for each hypothesis by its source: log predictive densities (nats) of presence, of the
    position given presence, and of the reading given both, divided by the temperature of the belief after the touch.

    Calibration is the remaining change of the log probability: the temperature grows with the number of touches, which
    share errors of the pad model, so that a touch reduces the weight of earlier ones.

    The hypotheses are the known objects in the order of `ObjectRecognizer.names`, and last the unknown object if it has
    a prior. Values are NaN for a hypothesis that a prior of 0 excludes. `i2t.recognition.belief.evidence_by_source`
    explains the order of the sources.

    Example:
        weights = info.evidence.weights(0, 1)  # for the first known object against the second
        reading, position, presence, calibration = weights
    """

    # Log density of the reading, up to a constant; 0 without contact.
    reading: Float[np.ndarray, " hypotheses"]
    # Log density of the travel at which the press ended; 0 without contact.
    position: Float[np.ndarray, " hypotheses"]
    # Log probability of contact, or of no contact.
    presence: Float[np.ndarray, " hypotheses"]
    # Change of the calibrated log probability less the three above, up to a constant.
    calibration: Float[np.ndarray, " hypotheses"]

    def weights(self, hypothesis: int, rival: int) -> Float[np.ndarray, "4"]:
        """Compute the weights of evidence for one hypothesis against another.

        Args:
            hypothesis: Index of the hypothesis.
            rival: Index of the other hypothesis.

        Returns:
            `(4,)` weights of evidence (nats) of the reading, the position, presence and the calibration. Their sum is
            the change of the log odds of the two calibrated probabilities by the touch.
        """
        return np.array([source[hypothesis] - source[rival] for source in self])


@in_one_line
class RecognizerState(NamedTuple):
    """State of a recognition: the belief over objects and poses, a mask of the sites touched or excluded so far, the
    number of touches, calibrated probabilities of the known objects, and the evidence of the last touch.
    """

    belief: Belief  # belief over objects and their poses
    touched: Bool[np.ndarray, " sites"]  # True for sites that were touched or excluded
    touches: int  # number of touches that the belief contains
    # calibrated probabilities of the known objects; an unknown one has the rest
    probability: Float[np.ndarray, " objects"]
    evidence: TouchEvidence  # evidence of the last touch; 0 before the first


@in_one_line
class RecognitionInfo(NamedTuple):
    """Calibrated probabilities of the known objects and of an unknown one after a touch, name (None for an unknown one)
    and probability of the most probable, and the evidence of the last touch by its source.
    """

    # probabilities of the known objects, in the order of `ObjectRecognizer.names`
    probability: Float[np.ndarray, " objects"]
    unknown: float  # probability of an unknown object
    name: str | None  # name of the most probable object; None for an unknown one
    confidence: float  # probability of the most probable object
    evidence: TouchEvidence  # evidence of the last touch; 0 before the first


class ObjectRecognizer:
    """Recognises which of several known objects a robot touches, choosing each touch by its belief.

    Example:
        recognizer = i2t.ObjectRecognizer(jax.random.key(0), pad_model, {"mug": mug, "bowl": bowl})
        state = recognizer.init()
        while (site := recognizer.choose_touch(state)) is not None:
            reading, force, T_w_t, contact = touch(site.T_w_t)  # by your arm
            observation = recognizer.observe(site, reading, force=force, T_w_t=T_w_t, contact=contact)
            state, info = recognizer.update(state, observation)
    """

    def __init__(
        self,
        key: Key[Array, ""],
        pad_model: PadModel,
        meshes: Mapping[str, Any],
        *,
        T_w_o: Float[Array | np.ndarray, "4 4"] | None = None,
        pose_prior: Float[np.ndarray, "6"] | Float[np.ndarray, "6 6"] | None = None,
        sites: SitePool | None = None,
        config: RecognizerConfig = RecognizerConfig(),
    ) -> None:
        """Predict touches of every object at every candidate site, with a progress bar.

        Args:
            key: Random key of the sites.
            pad_model: Model fitted to touches of the same skin (`i2t.skin_models.pad_fit.ContactModel`).
            meshes: Meshes of the known objects, by name.
            T_w_o: Believed pose of the object; the world's origin by default. Sites are drawn and checked on the
                objects there, over the table of `config.site_limits`.
            pose_prior: Covariance (m^2), or standard deviations (m), of its twist from there; 1 mm and 1 degree about
                each axis by default.
            sites: Candidates, with poses in the object's frame; safe random sites of every object by default. A site
                that is not safe at the believed pose is never chosen. The attribute `sites` holds those that meet
                `config.min_contact_probability`.
            config: Options of choices and stopping.

        Raises:
            ValueError: There are fewer than two objects, an object has too few safe sites, no site is met by all
                objects with the smallest contact probability, or `T_w_o` is not rigid.
            TypeError: `key` is not a random key, `pad_model` is not a pad model, or `meshes` is not a mapping.
        """
        validation.random_key("key", key)
        if not isinstance(pad_model, PadModel):
            kind = type(pad_model).__name__
            raise TypeError(f"pad_model: is a {kind}; give a pad model, such as i2t.load_pad_model('nominal').model")
        if not isinstance(meshes, Mapping):
            raise TypeError(f"meshes: is a {type(meshes).__name__}; give a mapping of names to meshes")
        if len(meshes) < 2:
            raise ValueError("a recogniser needs at least two objects")
        self.names, self.config, self.likelihood = tuple(meshes), config, pad_model.likelihood
        self.T_w_o = np.eye(4) if T_w_o is None else validation.pose("T_w_o", T_w_o)
        objects = list(meshes.values())
        surrogates = range(config.num_surrogates if config.prior_unknown > 0 else 0)
        unknown = [catalogue.surrogate_unknown(objects, i).mesh for i in surrogates]
        surfaces = prepare_surfaces(objects + unknown)
        placed = place_surfaces(surfaces, self.T_w_o)
        if sites is None:
            drawn = sample_sites(key, placed[: len(objects)], self.names, config.num_sites, config.site_limits)
            sites = drawn.moved(inverse(self.T_w_o))
        pose_prior = outcomes.placement_std(1e-3, float(np.radians(1.0))) if pose_prior is None else pose_prior
        self.particles = belief.sample_particles(pose_prior, config.num_particles, config.seed)
        (table,) = predict_outcomes(
            surfaces, self.particles.twist, sites.T_w_t, [pad_model.reading_model],
            overtravel=config.overtravel, label="candidates",
        )  # fmt: skip
        met = np.flatnonzero(table.hit[:, : len(objects)].mean(2).min(1) >= config.min_contact_probability)
        if not len(met):
            raise ValueError(
                f"at no site is every object met with a probability of {config.min_contact_probability:g}; lower "
                "min_contact_probability, or draw more sites"
            )
        self.safe = jnp.asarray(safe_sites(placed, sites.moved(self.T_w_o), config.site_limits)[met])
        # In the object's frame, as the predicted touches are.
        self.sites = SitePool(jnp.asarray(sites.T_w_t)[met], np.asarray(sites.owner)[met])
        self.table = jax.device_put(jax.tree.map(lambda x: x[met], table))
        self._objects = len(surfaces)

    def __repr__(self) -> str:
        """Describe the objects in one line."""
        return (
            f"ObjectRecognizer({len(self.names)} objects: {', '.join(self.names[:5])}{', ...' * (len(self.names) > 5)})"
        )

    def __str__(self) -> str:
        """Describe the objects, the candidate sites and the options."""
        poses, config = len(self.particles.twist), self.config
        safe = int(np.sum(np.asarray(self.safe)))
        return (
            f"ObjectRecognizer of {len(self.names)} objects: {', '.join(self.names)}\n"
            f"  {len(self.safe)} candidate sites, {safe} of them safe; {poses} poses of each object\n"
            f"  at most {config.max_touches} touches, until the probability of an error is at most "
            f"{config.max_error_probability:g}"
        )

    @property
    def channels(self) -> int:
        """Number of values in a reading."""
        return self.table.reading.shape[-1]

    def init(self, prior: Float[Array | np.ndarray, " objects"] | None = None) -> RecognizerState:
        """Return the recogniser's state before the first touch.

        Args:
            prior: Probabilities of the known objects given that it is one of them; equal by default.

        Returns:
            State without touches.
        """
        count, unknown = len(self.names), self._objects - len(self.names)
        prior = np.full(count, 1 / count) if prior is None else np.asarray(prior, float) / np.sum(prior)
        share = np.full(unknown, self.config.prior_unknown / max(1, unknown))
        probability = (1 - self.config.prior_unknown) * prior
        begun = belief.init(
            self.particles, self._objects, channels=self.channels, prior=np.concatenate([probability, share])
        )
        no_evidence = TouchEvidence(*np.zeros((4, count + (unknown > 0))))
        return RecognizerState(begun, np.zeros(len(self.sites.owner), bool), 0, probability, no_evidence)

    def choose_touch(self, state: RecognizerState, *, key: Key[Array, ""] | None = None) -> ChosenSite | None:
        """Choose the site with the largest expected information among random candidates that are probably safe.

        Args:
            state: The state after the touches so far.
            key: Random key of the candidates; by default it follows from the seed and the touched sites.

        Returns:
            Site, or None if no more touch is needed (`stop_reason` gives the reason) or possible: ten draws of
            candidates had no safe untouched site.
        """
        if self.stop_reason(state) is not None:
            return None
        if key is None:
            key = jax.random.fold_in(jax.random.key(self.config.seed), int(state.touched.sum()))
        spare = jax.random.clone(key)
        for draw in range(MAX_EMPTY_DRAWS):
            number = self._choose(state, key if draw == 0 else jax.random.fold_in(spare, draw))
            if number >= 0:
                return ChosenSite(number, self.site_pose(number))
        return None

    def expected_information(self, state: RecognizerState) -> Float[np.ndarray, " sites"]:
        """Estimate how much a touch of each site would tell about the object.

        Args:
            state: The state after the touches so far.

        Returns:
            `(sites,)` expected information (nats); NaN for a site that was touched or excluded, or is probably unsafe.
        """
        key = jax.random.fold_in(jax.random.key(self.config.seed), int(state.touched.sum()))
        gain = _information(key, state.belief, self.table, self.likelihood, skin_change=self.config.skin_change)
        allowed = np.asarray(safe_sites_mask(state.belief, self.safe)) & ~state.touched
        return np.where(allowed, np.asarray(gain.object, np.float64), np.nan)

    def stop_reason(self, state: RecognizerState) -> str | None:
        """Explain why no more touches are needed or possible.

        Args:
            state: The state after the touches so far.

        Returns:
            Phrase with the reason, or None as long as touches are needed.
        """
        config = self.config
        enough = state.touches >= max(1, min(config.min_touches, config.max_touches))
        if enough and state.probability.max() >= 1 - config.max_error_probability:
            return f"an object is {1 - config.max_error_probability:.0%} probable"
        if state.touches >= config.max_touches:
            return f"{state.touches} sites were touched"
        # Touches may be repeated, and a touch in progress is neither counted nor excluded yet.
        excluded = max(0, int(state.touched.sum()) - state.touches)
        if state.touched.all():
            return f"every site was touched, or excluded ({excluded})" if excluded else "every site was touched"
        if excluded >= config.max_excluded:
            return f"{excluded} sites were excluded, after {state.touches} touches"
        return None

    def observe(
        self,
        site: ChosenSite,
        reading: Float[Array | np.ndarray, " c"],
        *,
        force: float,
        T_w_t: Float[Array | np.ndarray, "4 4"],
        contact: bool,
    ) -> SiteObservation:
        """Convert a robot's measurements to the form that `update` takes.

        Args:
            site: The touched site.
            reading: Reading (uT) of the skin in contact, ambient subtracted, in the board's order.
            force: Measured force (N) along the tool's z axis; a negative one counts as 0.
            T_w_t: Pose of the tool at the end of the press.
            contact: Whether the touch met anything.

        Returns:
            Observation of this site.

        Raises:
            ValueError: The force is not finite or is larger than a skin withstands, the pose is not a rigid motion or
                its origin is more than 0.1 m from the site, or the reading has a wrong number of values.
            TypeError: The force, pose or reading does not consist of real numbers.
        """
        validation.number("force", validation.forces("force", force, measured=True), "newtons along tool z")
        T = validation.pose("T_w_t", T_w_t)
        values = validation.numbers("reading", reading, f"{self.channels} values (uT)")
        if values.shape != (self.channels,):
            raise ValueError(f"reading: has the shape {values.shape}; give the board's {self.channels} values (uT)")
        moved = T[:3, 3] - site.T_w_t[:3, 3]
        if np.linalg.norm(moved) > 0.1:  # collections go less far past a site
            raise ValueError(
                f"T_w_t: is {1e3 * np.linalg.norm(moved):.3g} mm from the site that was asked for; give the tool's "
                "pose at the end of the press, in metres and in W"
            )
        advance = float(moved @ site.T_w_t[:3, 2])
        touch = TouchObservation(
            jnp.float32(reading), jnp.float32(max(force, 0.0)), jnp.float32(advance), jnp.asarray(bool(contact))
        )
        return SiteObservation(site.number, touch)

    def update(self, state: RecognizerState, observation: SiteObservation) -> tuple[RecognizerState, RecognitionInfo]:
        """Update the belief and the touched sites with one touch.

        Args:
            state: The state before the touch.
            observation: The measurements of the touch.

        Returns:
            State after the touch, and its calibrated belief with the evidence of the touch.

        Raises:
            ValueError: A chip of the skin did not respond in this touch.
        """
        if not np.isfinite(np.asarray(observation.touch.reading)).all():
            raise ValueError(
                f"the touch at site {observation.number} lacks chips of the skin, and the pad model needs them all; "
                "exclude the site, and check the skin's cables"
            )
        after, p, steps = _update(state.belief, observation.touch, self.table, observation.number, self.likelihood)
        touches = state.touches + 1
        touched = self.exclude(state, observation.number).touched
        probability = self._calibrated(p, touches)
        evidence = self._evidence(np.asarray(steps, np.float64), state.probability, probability, touches)
        state = RecognizerState(after, touched, touches, probability, evidence)
        return state, self.info(state)

    def exclude(self, state: RecognizerState, number: int) -> RecognizerState:
        """Exclude a site from further choices, for instance because the robot cannot reach it.

        Args:
            state: The state so far.
            number: Index of the site.

        Returns:
            State with the site excluded.
        """
        touched = state.touched.copy()
        touched[number] = True
        return state._replace(touched=touched)

    def info(self, state: RecognizerState) -> RecognitionInfo:
        """Summarise the current belief.

        Args:
            state: The state after the touches so far.

        Returns:
            Calibrated probabilities, the most probable object, and the evidence of the last touch.
        """
        p = state.probability
        best, unknown = int(p.argmax()), float(max(0.0, 1 - p.sum()))
        if unknown > p[best]:
            return RecognitionInfo(p, unknown, None, unknown, state.evidence)
        return RecognitionInfo(p, unknown, self.names[best], float(p[best]), state.evidence)

    def object_pose(self, state: RecognizerState, name: str) -> Float[np.ndarray, "4 4"]:
        """Estimate the pose of an object, given that it is the true one.

        Args:
            state: The state after the touches so far.
            name: Name of the object.

        Returns:
            `(4, 4)` T_w_o of its mean pose.
        """
        mean, _ = belief.twist_estimate(state.belief, self.particles)
        return np.asarray(self.T_w_o @ np.asarray(from_twist(mean[self.names.index(name)]), np.float64))

    def particle_poses(
        self, state: RecognizerState, name: str, count: int = 8
    ) -> tuple[Float[np.ndarray, "n 4 4"], Float[np.ndarray, " n"]]:
        """Return the most probable poses of an object, given that it is the true one.

        Args:
            state: The state after the touches so far.
            name: Name of the object.
            count: Maximum number of poses.

        Returns:
            `(n, 4, 4)` poses T_w_o of its particles, the most probable first, and `(n,)` probabilities of all of them.
        """
        number = self.names.index(name)
        weight = np.asarray(jax.nn.softmax(state.belief.log_weight[number]), np.float64)
        best = np.argsort(-weight, kind="stable")[:count]
        twists = (self.particles.twist + state.belief.mean[number])[best]
        return self.T_w_o @ np.asarray(jax.vmap(from_twist)(twists), np.float64), weight[best]

    def site_pose(self, number: int) -> Float[np.ndarray, "4 4"]:
        """Return the tool's pose at a site, in the world.

        Args:
            number: Index of the site.

        Returns:
            `(4, 4)` T_w_t in float64, whose rotation is orthonormal to the last digit.
        """
        return nearest_rigid(self.T_w_o @ np.asarray(self.sites.T_w_t[number], float))

    def contact_probability(self, state: RecognizerState, number: int) -> Float[np.ndarray, " objects"]:
        """Compute for each known object the probability that a touch of a site meets it, given that it is the true one.

        Args:
            state: The state before the touch.
            number: Index of the site.

        Returns:
            `(objects,)` fractions of the objects' poses, weighted by the belief, in which the skin meets them.
        """
        weight = np.asarray(state.belief.log_weight, np.float64)
        weight = np.exp(weight - weight.max(1, keepdims=True))
        met = (weight * np.asarray(self.table.hit[number])).sum(1) / weight.sum(1)
        return met[: len(self.names)]

    def warm_up(self) -> None:
        """Compile by choosing a site and updating once in advance, so that no compilation delays an arm."""
        state = self.init()
        blank = TouchObservation(jnp.zeros(self.channels), jnp.float32(1.0), jnp.float32(0.0), jnp.asarray(False))
        for step in range(2):  # after a first touch the belief has other types
            self._choose(state, jax.random.fold_in(jax.random.key(self.config.seed), step))
            state, _ = self.update(state, SiteObservation(0, blank))

    def _choose(self, state: RecognizerState, key: Array) -> int:
        """Choose the index of a site among candidates drawn with a key; -1 if none of them is allowed."""
        (key_site,) = jax.random.split(key, 1)
        number = choose_informative_site(
            key_site, state.belief, self.table, self.likelihood,
            touched=jnp.asarray(state.touched), safe=self.safe, skin_change=self.config.skin_change,
        )  # fmt: skip
        return int(number)

    def _evidence(
        self,
        steps: Float[np.ndarray, "4 all"],
        before: Float[np.ndarray, " objects"],
        after: Float[np.ndarray, " objects"],
        touches: int,
    ) -> TouchEvidence:
        """Split the change of the log probabilities, before and after a touch, by the log weights of
        `belief.evidence_by_source`, with all surrogates as one hypothesis.
        """
        count = len(self.names)
        unknown = logsumexp(steps[:, count:], axis=1, keepdims=True) if self._objects > count else steps[:, count:]
        p = np.stack([before, after])
        if self._objects > count:
            p = np.concatenate([p, np.maximum(1 - p.sum(1, keepdims=True), 0)], axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):  # both are minus infinity if the prior is 0
            sources = np.diff(np.concatenate([steps[:, :count], unknown], axis=1), axis=0)
            sources /= calibrated.POSTERIOR_TEMPERATURE.temperature(touches)
            calibration = np.diff(np.log(p), axis=0)[0] - sources.sum(0)
        presence, position, reading = sources
        return TouchEvidence(reading, position, presence, calibration)

    def _calibrated(self, p: Float[Array, " all"], touches: int) -> Float[np.ndarray, " objects"]:
        """Calibrate probabilities of the known objects, given those of all objects including surrogates."""
        count = len(self.names)
        named = calibrated.POSTERIOR_TEMPERATURE.apply(p[:count], touches)
        if self._objects == count:
            return named
        everything, prior = np.asarray(p, np.float64)[None], self.config.prior_unknown
        raw = everything[:, :count], everything[:, count:].sum(-1)
        fitted_prior = 0.5  # of `UNKNOWN_SCALING`: move there, and back
        _, unknown = calibrated.with_unknown_prior(*raw, prior, fitted_prior)
        scaled = UNKNOWN_SCALING.apply(unknown, touches)
        shares = named[None] * (1 - scaled)[:, None]
        _, unknown = calibrated.with_unknown_prior(shares, scaled, fitted_prior, prior)
        return named * (1 - float(unknown[0]))


_information = jit_quickly(expected_information_gain)


@jit_quickly
def _update(
    now: Belief, touch: TouchObservation, table: PredictedTouch, number: int | Array, likelihood: Likelihood
) -> tuple[Belief, Array, Array]:
    """Update the belief with a touch of a site, and compute the probabilities of all objects and the log weights of the
    touch's sources of evidence.
    """
    predicted = element(table, number)
    after = belief.update(now, touch, predicted, likelihood)
    return after, belief.posterior(after), belief.evidence_by_source(now, touch, predicted, likelihood)
