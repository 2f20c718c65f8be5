"""Pad models: readings of one pad at a contact and the errors of their prediction, fitted to recorded touches.

The object of each recorded session is first registered by its own contacts (`i2t.registration`), which locates a
contact ten times better than the camera's view. A reading model (`i2t.skin_models.reading_model`) is fitted to the
readings and to the contacts' pressures at the measured forces, on the layer that explains the readings best. Its
leave-one-out errors give the likelihood of `i2t.recognition.belief`.

The ends of presses are predicted worse than the contacts that a pose was fitted to suggest. Each session is therefore
registered again from a part of its touches, which predicts where the other touches end. The errors, after subtraction
of the uncertainties of pose and indentation, give the distribution of a position's error, including its tails
(`fit_position_errors`).

Metres, newtons, microtesla.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key

from i2t.contact.press import PressLimits
from i2t.contact.pressure import ContactPressure, PressureModelConfig, predict_pressures, surface_pressure
from i2t.dataset import Dataset
from i2t.dataset.digests import touch_digests
from i2t.geometry import full_precision, inverse
from i2t.patches.dimensions import VIEW_PIXELS, VIEW_WINDOW
from i2t.registration.contacts import contact_poses
from i2t.registration.estimate import PoseEstimate
from i2t.registration.touch import register_by_touch
from i2t.runtime.batching import map_in_threads, select_rows
from i2t.runtime.compiling import jit_quickly
from i2t.simulation.touches import SimulationErrors
from i2t.skin.elasticity import CELL_GRID
from i2t.skin_models.layer import MIN_LOAD_N, Layer, approach, layer_pad
from i2t.skin_models.likelihood import (
    TOUCH_ERRORS,
    ScaleMixture,
    fit_likelihood,
    fit_position_errors,
    outlier_range,
)
from i2t.skin_models.pad_model import KnownPad, PadModel, PadOrigin
from i2t.skin_models.pressure_gp import GPHyperparameters
from i2t.skin_models.reading_model import (
    AVERAGING,
    DISCREPANCY,
    READING_PRIOR,
    FittedReadings,
    PressedTouches,
    ReadingPrior,
    choose_layer,
    fit_readings,
)
from i2t.types import Board, Surface, Touches, Truth


@dataclass(frozen=True)
class SessionRegistration:
    """Options for registering recorded sessions before a pad model is fitted: folds, and sizes that save compiling."""

    position_folds: int = 3  # number of parts of a session's touches, each predicted from the others
    # Up to this number of sessions, a quick compilation of their registrations pays; it may change last digits.
    few_sessions: int = 5
    # Minimum number of touches in a session, filled up with repeated ones, so that one compilation serves most
    # sessions.
    min_touches: int = 36


_REGISTRATION = SessionRegistration()  # default registration of recorded sessions before a pad is fitted


class _Positions(NamedTuple):
    """Ends of left-out touches, predicted by a registration from other touches."""

    indentation: Float[np.ndarray, " n"]  # m, indentation past the predicted contact, without the arm's yielding
    nominal: Float[np.ndarray, " n"]  # m, indentation of the nominal layer
    variance: Float[np.ndarray, " n"]  # m^2, variance of the predicted contact due to the pose's uncertainty
    hit: Bool[np.ndarray, " n"]  # whether the predicted touch meets the object


class ObjectTouches(NamedTuple):
    """Touches of one skin on known objects: data set, mask of the touches used, surfaces by object name, and source."""

    dataset: Dataset  # data set with measured forces
    rows: Bool[np.ndarray, " n"]  # mask of the touches that are used
    surfaces: Mapping[str, Surface]  # surfaces of the touched objects, by name
    made_from: str = "touches at hand"  # run, data set or file from which the touches come, for messages


@dataclass(frozen=True)
class ContactModel:
    """Options of a pad model, which predicts the reading of any contact.

    Attributes:
        errors: Assumed errors of the objects' believed poses.
        limits: Limits at which the touches were pressed.
        prior: Prior of the readings, from other pads.
    """

    errors: SimulationErrors
    limits: PressLimits
    prior: ReadingPrior = READING_PRIOR

    def fit(self, key: Key[Array, ""], data: ObjectTouches) -> KnownPad:
        """Fit a pad model to touches of objects with known surfaces.

        Args:
            key: Random key of the registrations.
            data: The touches of one skin.

        Returns:
            The pad model with its skin; R2 and errors are those of left-out touches.

        Raises:
            ValueError: The touches do not determine how soft the pad is.
        """
        dataset, rows, _, made_from = data
        touches = dataset.touches
        objects = tuple(dataset.objects[i] for i in np.unique(touches.object[rows]))
        pad = dataset.pads[int(touches.pad[rows][0])]
        digests = tuple(touch_digests(dataset.select(rows)))
        origin = PadOrigin(pad, dataset.source, objects, int(rows.sum()), made_from, digests)
        return KnownPad(self._fit(key, data), dataset.board, origin)

    def _fit(self, key: Key[Array, ""], data: ObjectTouches) -> PadModel:
        errors, limits, touches = self.errors, self.limits, data.dataset.touches
        sessions, often = _register_sessions(key, data, errors)
        layer = _choose_layer(sessions, touches, data.dataset.board, self.prior, limits.overtravel)
        used, nominal, pressed = _pressed_touches(sessions, touches, layer, limits.overtravel)
        load = np.asarray(pressed.pressure.load)
        travel = touches.travel[used] - load / limits.stiffness
        if not (np.isfinite(nominal * travel).all() and nominal.any()):
            raise ValueError(
                "the softness of the pad cannot be determined from these touches; leave out those whose travel or "
                "force is not finite, and add some that press a known object"
            )
        softness = float(np.sum(nominal * travel) / np.sum(nominal**2))
        leave_out = partial(_leave_positions_out, layer=layer, errors=errors, limits=limits, often=often)
        folds = map_in_threads(leave_out, product(sessions, range(_REGISTRATION.position_folds)))
        positions = jax.tree.map(lambda *parts: np.concatenate(parts), *folds)
        position = _position_errors(positions, softness, limits)
        fitted = fit_readings(pressed, layer, data.dataset.board, softness=softness, discrepancy=self.prior.discrepancy)
        return _pad_model(fitted, pressed.reading, position, limits)


def fit_oracle_pad_model(
    dataset: Dataset,
    rows: Bool[np.ndarray, " n"],
    pad_model: PadModel,
    limits: PressLimits,
    *,
    discrepancy: GPHyperparameters = DISCREPANCY,
) -> PadModel:
    """Fit the pad model that the same simulated touches would give without errors of pose and reading.

    It is a bound, not a method.

    Args:
        dataset: Simulated touches with their truth.
        rows: `(n,)` mask of the touches that are used.
        pad_model: The pad model fitted to these touches, which provides the mechanics.
        limits: Limits at which the touches were pressed.
        discrepancy: As for `i2t.skin_models.reading_model.fit_readings`.

    Returns:
        The pad model; its errors are those of predicting the recorded readings.
    """
    touches = jax.tree.map(lambda x: x[np.flatnonzero(rows)], dataset.touches)
    own, likelihood = pad_model.reading_model, pad_model.likelihood
    exact = press_at_truth(touches.truth, own.layer)
    fitted = fit_readings(exact, own.layer, dataset.board, softness=float(own.softness), discrepancy=discrepancy)
    recorded = np.asarray(touches.reading)
    fitted = fitted._replace(leave_one_out=fitted.leave_one_out + recorded - exact.reading)
    position = ScaleMixture(np.asarray(likelihood.position_std), np.asarray(likelihood.position_share))
    return _pad_model(fitted, recorded, position, limits)


def press_at_truth(truth: Truth, layer: Layer) -> PressedTouches:
    """Press a layer at the true contacts of simulated touches.

    Args:
        truth: True contacts of n touches.
        layer: The layer that is pressed.

    Returns:
        The contact pressures, with the noise-free readings.
    """
    exact = PressureModelConfig(pitch=VIEW_WINDOW / VIEW_PIXELS, smooth=False, tilt=0.0, cell=CELL_GRID.spacing)
    pressed = predict_pressures(exact, truth.view, truth.force, truth.indentation, layer_pad(layer))
    return PressedTouches(pressed, np.asarray(truth.reading))


class _SessionContacts(NamedTuple):
    """Touches of one session, filled up with repeated ones, so that one compilation serves most sessions."""

    touches: Touches
    T_w_contact: Float[np.ndarray, "m 4 4"]  # poses at first contact
    met: Bool[np.ndarray, " m"]  # False for repeated touches
    own: int  # number of touches that are not repeated


def _session_contacts(touches: Touches, here: np.ndarray) -> _SessionContacts:
    padded = np.resize(here, max(_REGISTRATION.min_touches, len(here)))
    some = select_rows(touches, padded)
    T_w_contact, met = contact_poses(some)
    return _SessionContacts(some, T_w_contact, met & (np.arange(len(padded)) < len(here)), len(here))


class _Session(NamedTuple):
    """A session whose object is registered."""

    rows: np.ndarray  # indices of the session's touches
    key: Array
    surface: Surface
    contacts: _SessionContacts
    pose: PoseEstimate


def _register_sessions(
    key: Key[Array, ""], data: ObjectTouches, errors: SimulationErrors
) -> tuple[list["_Session"], bool]:
    """Register the objects of all sessions; also return whether a slow compilation pays for them."""
    touches = data.dataset.touches
    unregistered = []
    for session in np.unique(touches.session[data.rows]):
        here = np.flatnonzero(data.rows & (touches.session == session))
        surface = data.surfaces[data.dataset.objects[int(touches.object[here[0]])]]
        unregistered.append((here, jax.random.fold_in(key, int(session)), surface, _session_contacts(touches, here)))
    often = len(unregistered) > _REGISTRATION.few_sessions
    register = partial(_register_session, errors=errors, often=often)
    calls = ((key, surface, contacts, contacts.met) for _, key, surface, contacts in unregistered)
    poses = map_in_threads(register, calls)
    sessions = [_Session(*session, pose) for session, pose in zip(unregistered, poses, strict=True)]
    return sessions, often


def _pressed_touches(
    sessions: Sequence[_Session], touches: Touches, layer: Layer, overtravel: float
) -> tuple[np.ndarray, np.ndarray, PressedTouches]:
    """Press a layer onto the registered objects. Return the rows of the touches that met one, the layer's indentations
    (m), and the touches.
    """
    calls = (
        (session.surface, session.pose.T_w_o, session.contacts.T_w_contact, session.contacts.touches.force, layer, True)
        for session in sessions
    )
    press = partial(_press, overtravel=overtravel)
    parts = [
        (session.rows, pressed.indentation[: session.contacts.own], pressed.newtons[: session.contacts.own])
        for session, pressed in zip(sessions, map_in_threads(press, calls), strict=True)
    ]
    rows, nominal, newtons = (np.concatenate(part) for part in zip(*parts, strict=True))
    met = np.isfinite(nominal)
    load = np.maximum(touches.force[rows[met]], MIN_LOAD_N)
    shape = (-1, CELL_GRID.cells, CELL_GRID.cells)
    pressed = ContactPressure(jnp.asarray(newtons[met].reshape(shape)), jnp.asarray(load))
    return rows[met], nominal[met], PressedTouches(pressed, touches.reading[rows[met]])


def _choose_layer(
    sessions: Sequence[_Session], touches: Touches, board: Board, prior: ReadingPrior, overtravel: float
) -> Layer:
    """Choose the layer from some sessions, because the touches are pressed onto every layer."""
    shuffled = [sessions[i] for i in np.random.default_rng(0).permutation(len(sessions))]
    counts = np.cumsum([len(session.rows) for session in shuffled])
    enough = int(np.searchsorted(counts, AVERAGING.max_touches)) + 1
    some = shuffled[:enough]
    pressed = [_pressed_touches(some, touches, layer, overtravel)[2] for layer in prior.layers]
    return prior.layers[choose_layer(pressed, prior.layers, board, prior.discrepancy)]


def _register_session(
    key: Key[Array, ""],
    surface: Surface,
    contacts: _SessionContacts,
    met: Bool[np.ndarray, " m"],
    *,
    errors: SimulationErrors,
    often: bool,
) -> PoseEstimate:
    """Estimate the object's pose from the contacts that met it, or from some of them."""
    return register_by_touch(
        key, surface, contacts.touches.T_w_o[0], contacts.T_w_contact, met,
        translation_std=errors.placement, rotation_std=errors.placement_angle, often=often,
    )  # fmt: skip


def _leave_positions_out(
    session: _Session, which: int, *, layer: Layer, errors: SimulationErrors, limits: PressLimits, often: bool
) -> _Positions:
    """Predict the ends of the touches of one fold of a session from the touches of its other folds."""
    _, key, surface, contacts, _ = session
    fold = np.arange(len(contacts.met)) % _REGISTRATION.position_folds
    # All folds use the same starts and draws, so that they differ only in their touches.
    key = jax.random.clone(key)
    pose = _register_session(key, surface, contacts, contacts.met & (fold != which), errors=errors, often=often)
    force = np.maximum(contacts.touches.force, np.float32(MIN_LOAD_N))
    T_w_t, overtravel = contacts.touches.T_w_t, limits.overtravel
    predicted = jax.device_get(_press(surface, pose.T_w_o, T_w_t, force, layer, False, overtravel=overtravel))
    # A press ends at the pose that it reports, which is its site here; contact lies before it by the indentation.
    indentation = -predicted.distance - force / limits.stiffness
    variance = np.einsum("ni,ij,nj->n", predicted.jacobian, np.asarray(pose.covariance), predicted.jacobian)
    rows = np.asarray(contacts.met) & (fold == which)
    nominal = np.where(predicted.hit, predicted.indentation, 0.0)
    return _Positions(indentation[rows], nominal[rows], variance[rows], predicted.hit[rows])


def _position_errors(positions: _Positions, softness: float, limits: PressLimits) -> ScaleMixture:
    expected = softness * positions.nominal
    error = positions.indentation - expected
    variance = positions.variance + (TOUCH_ERRORS.indentation_error * expected) ** 2
    density = TOUCH_ERRORS.outlier_rate / outlier_range(limits.overtravel)
    return fit_position_errors(error[positions.hit], variance[positions.hit], outlier_density=density)


class _Pressed(NamedTuple):
    """Presses of a layer on an object."""

    distance: Float[Array, " n"]  # m, from the pose to first contact
    jacobian: Float[Array, "n 6"]  # derivative of that distance along the twist of the object's pose
    hit: Bool[Array, " n"]  # whether the press meets the object
    indentation: Float[Array, " n"]  # m, indentation of the skin; infinite if there is nothing to press on
    newtons: Float[Array, "n cells"]  # N, force on each cell


@jit_quickly
@full_precision
def _press(
    surface: Surface,
    T_w_o: Array,
    T_w_t: Array,
    force: Array,
    layer: Layer,
    at_once: bool | Array,
    *,
    overtravel: float | Array,
) -> _Pressed:
    """Press a layer where it meets an object along z of each pose, or at the pose itself (`at_once`). Both use the same
    compiled program.
    """

    def press(T: Array, f: Array) -> _Pressed:
        (T_o_t, distance, hit), jacobian = approach(surface, T_w_o, jnp.zeros(6), T, overtravel)
        T_o_t = jnp.where(at_once, inverse(T_w_o) @ T, T_o_t)
        pressed, indentation = surface_pressure(layer_pad(layer), surface, T_o_t, f[None])
        met = hit & jnp.isfinite(indentation[0])
        return _Pressed(distance, jnp.where(met, jacobian, 0.0), met, indentation[0], pressed.pressure.reshape(-1))

    return jax.vmap(press)(T_w_t, force)


def _pad_model(fitted: FittedReadings, recorded: np.ndarray, position: ScaleMixture, limits: PressLimits) -> PadModel:
    """Combine a reading model with its leave-one-out errors, and with the errors (m) of where presses end."""
    errors, model = fitted.leave_one_out, fitted.model
    likelihood = fit_likelihood(
        errors, model.scale, model.loads,
        overtravel=limits.overtravel, position_std=position, stiffness=limits.stiffness,
    )  # fmt: skip
    around = np.asarray(recorded) - np.mean(np.asarray(recorded), axis=0)
    r2 = float(1 - np.sum(errors**2) / np.sum(around**2))
    return PadModel(model, likelihood, around.std(axis=0), r2, errors)
