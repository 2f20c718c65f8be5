"""Recognise an object by touches that the belief itself chooses; for any one robot.

    recognizer = ObjectRecognizer(jax.random.key(0), pad_model, meshes)
    state = recognizer.init()
    while (site := recognizer.choose_touch(state)) is not None:
        reading, force, T_w_t, contact = touch(site.T_w_t)  # your robot
        observation = recognizer.observe(site, reading, force=force, T_w_t=T_w_t, contact=contact)
        state, info = recognizer.update(state, observation)
    print(info.name, info.confidence)

A state is a NamedTuple and never changed: `choose_touch` and `update` are pure. What takes long, predicting touches of
every object at every candidate site, is done once when a recogniser is made. The object may be none of those known:
with `prior_unknown` surrogates, objects like those known, take part, and "unknown" is what they have together.

Metres, newtons, microtesla; W world, O object, T tool.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key

from i2t import validation
from i2t.contact.press import PressLimits
from i2t.geometry import from_twist, inverse, nearest_rigid
from i2t.objects import catalogue
from i2t.recognition import belief, calibrated, outcomes
from i2t.recognition.belief import Belief, TouchObservation
from i2t.recognition.outcomes import PredictedTouch
from i2t.recognition.policy import choose_informative_site
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

MAX_EMPTY_DRAWS = 10  # of candidates among which no site is allowed, after which no touch is chosen
# Calibration of the unknown class, fitted on validation objects and others where half of all were unknown
# (`experiments.studies open_set`).
CALIBRATION_PRIOR_UNKNOWN = 0.5
UNKNOWN_SCALING = calibrated.PlattScaling(0.40, 0.65, 0.18)
MAX_OFF_SITE_M = 0.1  # m from a site to where a press of it ended; collections go no further past one
POSE_STD_M, POSE_STD_RAD = 1e-3, float(np.radians(1.0))  # of an object's pose unless it is given


@dataclass(frozen=True)
class RecognizerConfig:
    """Settings of a recogniser's choices and stopping.

    Raises:
        ValueError: The unknown object's probability is no probability, or no surrogates stand for it.

    Example:
        config = i2t.RecognizerConfig(max_touches=20, max_error_probability=0.01)  # surer, for more touches
        recognizer = i2t.ObjectRecognizer(jax.random.key(0), pad_model, meshes, config=config)
    """

    num_sites: int = 24  # of each object, to choose among
    num_particles: int = 64  # poses of each object
    max_touches: int = 10
    min_touches: int = 1  # before it may stop because it is sure, up to max_touches
    max_excluded: int = 30  # sites that could not be touched, after which none is asked for
    max_error_probability: float = 0.05  # it stops when the most probable object is wrong with at most this probability
    prior_unknown: float = 0.0  # probability beforehand that it is none of the objects
    num_surrogates: int = 16  # objects like those known, where it may be none of them
    skin_change: float = PressLimits.skin_change  # uT at which presses end
    overtravel: float = PressLimits.overtravel  # m beyond a site after which a press has met air
    site_limits: touch_sites.SiteLimits = field(default=touch_sites.RECOGNITION_LIMITS)
    seed: int = 0  # of pose particles and choices

    def __post_init__(self) -> None:
        if not 0 <= self.prior_unknown < 1:
            raise ValueError(f"prior_unknown is {self.prior_unknown:g}; give a probability, from 0 to below 1")
        if self.prior_unknown > 0 and self.num_surrogates < 1:
            raise ValueError(f"num_surrogates is {self.num_surrogates}; an unknown object needs some, 16 say")


@in_one_line
class ChosenSite(NamedTuple):
    """A site to be touched."""

    number: int  # of the site
    T_w_t: Float[np.ndarray, "4 4"]  # the tool's pose where the skin would just lie on the believed surface


@in_one_line
class SiteObservation(NamedTuple):
    """Measurement at a touch of a site."""

    number: int  # of the site
    touch: TouchObservation  # what was measured there


@in_one_line
class RecognizerState(NamedTuple):
    """Belief, and the sites that were touched."""

    belief: Belief  # over objects and their poses
    touched: Bool[np.ndarray, " sites"]  # or excluded
    touches: int  # that updated the belief
    probability: Float[np.ndarray, " objects"]  # calibrated, of the known objects; what lacks to 1 is unknown


@in_one_line
class RecognitionInfo(NamedTuple):
    """Calibrated belief after a touch."""

    probability: Float[np.ndarray, " objects"]  # of the known objects, in the order of `ObjectRecognizer.names`
    unknown: float  # probability that it is none of them
    name: str | None  # the most probable object; None for an unknown one
    confidence: float  # probability of that


class ObjectRecognizer:
    """Recognises one of some objects, touch by touch.

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
        """Predict touches of every object at every candidate site; a bar shows progress.

        Args:
            key: Of the sites.
            pad_model: Fitted to touches of the skin that will touch (`i2t.skin_models.pad_fit.ContactModel`).
            meshes: Of the known objects, by name.
            T_w_o: Where the object is believed to stand; the world's origin by default. Sites are drawn and checked on
                the objects there, over the table of `config.site_limits`.
            pose_prior: Covariance (m^2), or standard deviations (m), of its twist from there; 1 mm and 1 degree about
                each axis by default.
            sites: Candidates, with poses in the object's frame; safe random sites of every object by default. One that
                is not safe where the object is believed to stand is never chosen.
            config: How it chooses and when it stops.

        Raises:
            ValueError: Fewer than two objects, an object has too few safe sites, or `T_w_o` is not rigid.
            TypeError: The key is none, or `meshes` no mapping.
        """
        validation.random_key("key", key)
        if not isinstance(pad_model, PadModel):
            kind = type(pad_model).__name__
            raise TypeError(f"pad_model: is a {kind}; give a pad model, such as i2t.load_pad_model('nominal').model")
        if not isinstance(meshes, Mapping):
            raise TypeError(f"meshes: is a {type(meshes).__name__}; give a mapping of names to meshes")
        if len(meshes) < 2:
            raise ValueError("a recogniser needs at least two objects to tell apart")
        self.names, self.config, self.likelihood = tuple(meshes), config, pad_model.likelihood
        self.T_w_o = np.eye(4) if T_w_o is None else validation.pose("T_w_o", T_w_o)
        known = list(meshes.values())
        surrogates = range(config.num_surrogates if config.prior_unknown > 0 else 0)
        unknown = [catalogue.surrogate_unknown(known, i).mesh for i in surrogates]
        surfaces = prepare_surfaces(known + unknown)
        placed = place_surfaces(surfaces, self.T_w_o)
        if sites is None:
            drawn = sample_sites(key, placed[: len(known)], self.names, config.num_sites, config.site_limits)
            sites = drawn.moved(inverse(self.T_w_o))
        self.sites = sites  # in the object's frame, as the predicted touches are
        pose_prior = outcomes.placement_std(POSE_STD_M, POSE_STD_RAD) if pose_prior is None else pose_prior
        self.particles = belief.sample_particles(pose_prior, config.num_particles, config.seed)
        (table,) = predict_outcomes(
            surfaces, self.particles.twist, sites.T_w_t, [pad_model.reading_model],
            overtravel=config.overtravel, label="candidates",
        )  # fmt: skip
        self.table = jax.device_put(table)
        self.safe = jnp.asarray(safe_sites(placed, sites.moved(self.T_w_o), config.site_limits))
        self._objects = len(surfaces)

    def __repr__(self) -> str:
        """One line with the objects."""
        return (
            f"ObjectRecognizer({len(self.names)} objects: {', '.join(self.names[:5])}{', ...' * (len(self.names) > 5)})"
        )

    @property
    def channels(self) -> int:
        """Values of a reading."""
        return self.table.reading.shape[-1]

    def init(self, prior: Float[Array | np.ndarray, " objects"] | None = None) -> RecognizerState:
        """The state before the first touch.

        Args:
            prior: Probabilities of the known objects if it is one of them; all equal by default.

        Returns:
            The state.
        """
        known, unknown = len(self.names), self._objects - len(self.names)
        prior = np.full(known, 1 / known) if prior is None else np.asarray(prior, float) / np.sum(prior)
        share = np.full(unknown, self.config.prior_unknown / max(1, unknown))
        probability = (1 - self.config.prior_unknown) * prior
        begun = belief.init(
            self.particles, self._objects, channels=self.channels, prior=np.concatenate([probability, share])
        )
        return RecognizerState(begun, np.zeros(len(self.sites.owner), bool), 0, probability)

    def choose_touch(self, state: RecognizerState, *, key: Key[Array, ""] | None = None) -> ChosenSite | None:
        """The site of most expected information, among those that are safe on the possible objects.

        Args:
            state: After the touches so far.
            key: Of the candidates; by default a function of the seed and of the sites touched.

        Returns:
            The site, or None where no more touch is wanted (`stop_reason` says why) or allowed: `MAX_EMPTY_DRAWS` draws
            of candidates had no site that is safe and untouched.
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

    def stop_reason(self, state: RecognizerState) -> str | None:
        """Reason to stop touching.

        Args:
            state: After the touches so far.

        Returns:
            A phrase, or None while touches are wanted.
        """
        config = self.config
        enough = state.touches >= max(1, min(config.min_touches, config.max_touches))
        if enough and state.probability.max() >= 1 - config.max_error_probability:
            return f"an object is {1 - config.max_error_probability:.0%} probable"
        if state.touches >= config.max_touches:
            return f"{state.touches} sites were touched"
        # Touches may be repeated, and a touch that is under way is neither of both yet.
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
        """Bring a robot's measurements into the form of `update`.

        Args:
            site: That was touched.
            reading: Of the skin in contact, ambient subtracted (uT), in the board's order.
            force: Along the tool's z axis (N), as it was measured.
            T_w_t: The tool's pose at the end of the press.
            contact: Whether anything was met.

        Returns:
            The observation.

        Raises:
            ValueError: The force is not finite or more than a skin bears, the pose is no rigid motion or its origin is
                further than `MAX_OFF_SITE_M` from the site, or the reading has another number of values.
            TypeError: One of them holds no real numbers.
        """
        validation.number("force", validation.forces("force", force, measured=True), "newtons along tool z")
        T = validation.pose("T_w_t", T_w_t)
        values = validation.numbers("reading", reading, f"{self.channels} values (uT)")
        if values.shape != (self.channels,):
            raise ValueError(f"reading: has the shape {values.shape}; give the board's {self.channels} values (uT)")
        moved = T[:3, 3] - site.T_w_t[:3, 3]
        if np.linalg.norm(moved) > MAX_OFF_SITE_M:
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
        """Learn from a touch.

        Args:
            state: Before the touch.
            observation: What it measured.

        Returns:
            The state after it, and what is believed.

        Raises:
            ValueError: A chip of the skin did not answer in this touch.
        """
        if not np.isfinite(np.asarray(observation.touch.reading)).all():
            raise ValueError(
                f"the touch at site {observation.number} lacks chips of the skin, and the pad model needs them all; "
                "exclude the site, and check the skin's cables"
            )
        after, p = _update(state.belief, observation.touch, self.table, observation.number, self.likelihood)
        touches = state.touches + 1
        touched = self.exclude(state, observation.number).touched
        state = RecognizerState(after, touched, touches, self._calibrated(p, touches))
        return state, self.info(state)

    def exclude(self, state: RecognizerState, number: int) -> RecognizerState:
        """The state in which a site is not chosen again, for instance because it could not be reached.

        Args:
            state: So far.
            number: Of the site.

        Returns:
            The new state.
        """
        touched = state.touched.copy()
        touched[number] = True
        return state._replace(touched=touched)

    def info(self, state: RecognizerState) -> RecognitionInfo:
        """Current belief.

        Args:
            state: After the touches so far.

        Returns:
            Calibrated probabilities, and the most probable object.
        """
        p = state.probability
        best, unknown = int(p.argmax()), float(max(0.0, 1 - p.sum()))
        if unknown > p[best]:
            return RecognitionInfo(p, unknown, None, unknown)
        return RecognitionInfo(p, unknown, self.names[best], float(p[best]))

    def object_pose(self, state: RecognizerState, name: str) -> Float[np.ndarray, "4 4"]:
        """Pose of an object, if it is the one that is there.

        Args:
            state: After the touches so far.
            name: Of the object.

        Returns:
            T_w_o of its mean pose.
        """
        mean, _ = belief.twist_estimate(state.belief, self.particles)
        return np.asarray(self.T_w_o @ np.asarray(from_twist(mean[self.names.index(name)]), np.float64))

    def site_pose(self, number: int) -> Float[np.ndarray, "4 4"]:
        """The tool's pose at a site.

        Args:
            number: Of the site.

        Returns:
            T_w_t in float64, its rotation orthonormal to the last digit.
        """
        return nearest_rigid(self.T_w_o @ np.asarray(self.sites.T_w_t[number], float))

    def contact_probability(self, state: RecognizerState, number: int) -> Float[np.ndarray, " objects"]:
        """Probability that a touch of a site meets each of the known objects, if it is the one that is there.

        Args:
            state: Before the touch.
            number: Of the site.

        Returns:
            The share of an object's poses, weighted by what is believed of them, in which the skin meets it.
        """
        weight = np.asarray(state.belief.log_weight, np.float64)
        weight = np.exp(weight - weight.max(1, keepdims=True))
        met = (weight * np.asarray(self.table.hit[number])).sum(1) / weight.sum(1)
        return met[: len(self.names)]

    def warm_up(self) -> None:
        """Choose and update once in advance, so that nothing is compiled while an arm waits."""
        state = self.init()
        blank = TouchObservation(jnp.zeros(self.channels), jnp.float32(1.0), jnp.float32(0.0), jnp.asarray(False))
        for step in range(2):  # after a first touch the belief has other types
            self._choose(state, jax.random.fold_in(jax.random.key(self.config.seed), step))
            state, _ = self.update(state, SiteObservation(0, blank))

    def _choose(self, state: RecognizerState, key: Array) -> int:
        """The number of a site among candidates drawn with a key; -1 where none of them is allowed."""
        (key_site,) = jax.random.split(key, 1)
        found = choose_informative_site(
            key_site, state.belief, self.table, self.likelihood,
            touched=jnp.asarray(state.touched), safe=self.safe, skin_change=self.config.skin_change,
        )  # fmt: skip
        return int(found)

    def _calibrated(self, p: Float[Array, " all"], touches: int) -> Float[np.ndarray, " objects"]:
        """Calibrated probabilities of the known objects from those of all, surrogates included."""
        known = len(self.names)
        named = calibrated.TEMPERATURE_SCALING.apply(p[:known], touches)
        if self._objects == known:
            return named
        everything, prior = np.asarray(p, np.float64)[None], self.config.prior_unknown
        raw = everything[:, :known], everything[:, known:].sum(-1)
        # The scaling was fitted at another prior: there, and back.
        _, unknown = calibrated.with_unknown_prior(*raw, prior, CALIBRATION_PRIOR_UNKNOWN)
        read = UNKNOWN_SCALING.apply(unknown, touches)
        shares = named[None] * (1 - read)[:, None]
        _, unknown = calibrated.with_unknown_prior(shares, read, CALIBRATION_PRIOR_UNKNOWN, prior)
        return named * (1 - float(unknown[0]))


@jit_quickly
def _update(
    now: Belief, touch: TouchObservation, table: PredictedTouch, number: int | Array, likelihood: Likelihood
) -> tuple[Belief, Array]:
    """The belief after a touch of a site, and the probabilities of all objects."""
    after = belief.update(now, touch, element(table, number), likelihood)
    return after, belief.posterior(after)
