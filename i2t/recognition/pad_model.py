"""Pad models: readings of one pad at a contact and the errors of their prediction, fitted to recorded touches.

Each recorded session's object is registered by its own contacts first (`i2t.registration.touch`): the contact is then
known ten times better than from the camera's view. The contact's pressure on the nominal layer, at the measured force,
and the reading condition a Gaussian process (`i2t.prediction.gp`); its leave-one-out errors fit the likelihood of
`i2t.recognition.belief`.

Where presses end is predicted worse than the contacts that a pose was fitted to suggest. So each session is registered
once more from a part of its touches, and the errors of predicting where the others ended, less what the pose's own
uncertainty and that of an indentation make, give the distribution of a position's error, tails included
(`fit_position_errors`).

Metres, newtons, microtesla.
"""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key

from i2t.dataset import Dataset
from i2t.geometry import inverse
from i2t.prediction import gp
from i2t.prediction.gp import ContactPressure
from i2t.prediction.pressure import PressureModelConfig, predict_pressures
from i2t.recognition import belief, outcomes
from i2t.recognition.belief import INDENTATION_ERROR, OUTLIER_RATE, Likelihood, ScaleMixture, outlier_range
from i2t.recognition.outcomes import MIN_LOAD_N, PRESSURE_GRID, LinearReadingModel, PredictedContact
from i2t.registration import touch as registration
from i2t.registration.estimate import PoseEstimate
from i2t.simulation.press import PressLimits
from i2t.simulation.touches import SimulationErrors
from i2t.types import Surface, Touches, Truth, in_one_line
from i2t.windows import WIDE_PIXELS, WIDE_WINDOW

# Standard deviations of which a position's error is mixed: from the repeatability of an arm to a missed edge.
POSITION_STDS_M = (0.05e-3, 0.1e-3, 0.2e-3, 0.4e-3, 0.8e-3, 1.6e-3)
POSITION_FOLDS = 3  # of a session's touches, each predicted from the others
EM_STEPS = 300
PRIOR_TOUCHES = 0.5  # of each standard deviation, as if they had been seen: no tail is impossible
REGISTERED_TOUCHES = 36  # of a session at least, filled up with repeated ones: one compilation serves most sessions


@in_one_line
class PadModel(NamedTuple):
    """Model of a pad from its touches of known objects."""

    reading_model: LinearReadingModel  # the reading of a contact
    likelihood: Likelihood  # of readings and positions
    reading_std: Float[np.ndarray, " c"]  # uT, of the readings
    r2: float  # of held-out touches; NaN where there were none
    held_out_errors: Float[np.ndarray, "n c"]  # uT, measured minus predicted


class _Positions(NamedTuple):
    """Ends of left-out touches, by a registration from others."""

    indentation: Float[np.ndarray, " n"]  # m past the predicted contact, less what the arm yields
    nominal: Float[np.ndarray, " n"]  # m, indentation of the nominal layer there
    variance: Float[np.ndarray, " n"]  # m^2, of the predicted contact, as the pose is uncertain
    hit: Bool[np.ndarray, " n"]  # whether the object was there at all


def fit_pad_model(
    key: Key[Array, ""],
    dataset: Dataset,
    rows: Bool[np.ndarray, " n"],
    surfaces: dict[str, Surface],
    *,
    errors: SimulationErrors,
    limits: PressLimits,
) -> PadModel:
    """Fit a pad model to touches of objects whose surfaces are known.

    Args:
        key: Of the registrations.
        dataset: Touches with measured forces.
        rows: Which of them are used.
        surfaces: Of their objects, by name.
        errors: How far objects may be from where they are believed.
        limits: How the touches were pressed.

    Returns:
        The pad model; its r2 and errors are those of left-out touches.
    """
    touches = dataset.touches
    pressure = np.zeros((len(dataset), PRESSURE_GRID.cells**2), np.float32)
    nominal = np.full(len(dataset), np.nan)  # m, indentation of the nominal layer
    left_out: list[_Positions] = []
    for session in np.unique(touches.session[rows]):
        here = np.flatnonzero(rows & (touches.session == session))
        surface = surfaces[dataset.objects[int(touches.object[here[0]])]]
        key_session = jax.random.fold_in(key, int(session))
        contacts = _session_contacts(touches, here)
        nominal[here], pressure[here] = _pressed_contacts(key_session, contacts, surface, errors)
        left_out.append(_left_out_positions(jax.random.clone(key_session), contacts, surface, errors, limits))
    used = np.flatnonzero(rows & np.isfinite(nominal))
    load = np.maximum(touches.force[used], MIN_LOAD_N)
    shape = (-1, PRESSURE_GRID.cells, PRESSURE_GRID.cells)
    pressed = ContactPressure(jnp.asarray(pressure[used].reshape(shape)), jnp.asarray(load))
    readings = jnp.asarray(touches.reading[used])
    depth = touches.depth[used] - load / limits.stiffness
    softness = float(np.sum(nominal[used] * depth) / np.sum(nominal[used] ** 2))
    positions = jax.tree.map(lambda *parts: np.concatenate(parts), *left_out)
    position = _position_errors(positions, softness, limits)
    sessions = touches.session[used]
    return _fit(pressed, readings, readings, sessions, softness=softness, position=position, limits=limits)


def fit_position_errors(
    errors: Float[np.ndarray, " n"],
    variance: Float[np.ndarray, " n"],
    *,
    outlier_density: float = 0.0,
    stds: Sequence[float] = POSITION_STDS_M,
) -> ScaleMixture:
    """The distribution of errors, a scale mixture of normals with given standard deviations, whose shares are found by
    expectation maximisation (Laird, JASA 73, 1978).

    Args:
        errors: Of predictions (m).
        variance: The part of each error's variance (m^2) that is known and no part of the distribution.
        outlier_density: Share of outliers over the length (1/m) on which they may be.
        stds: Standard deviations (m) that are mixed.

    Returns:
        The mixture; standard deviations that no error asks for keep a small share.
    """
    std = np.asarray(stds, float)
    total = std[None] ** 2 + np.asarray(variance, float)[:, None]
    density = np.exp(-0.5 * np.asarray(errors, float)[:, None] ** 2 / total) / np.sqrt(2 * np.pi * total)
    share = np.full(len(std), 1 / len(std))
    for _ in range(EM_STEPS):
        joint = share * density
        belonging = joint / (joint.sum(1, keepdims=True) + outlier_density + np.finfo(float).tiny)
        share = belonging.sum(0) + PRIOR_TOUCHES
        share = share / share.sum()
    return ScaleMixture(std, share)


def fit_oracle_pad_model(
    dataset: Dataset, rows: Bool[np.ndarray, " n"], pad_model: PadModel, limits: PressLimits
) -> PadModel:
    """Fit the pad model that the same simulated touches would give without errors of pose and reading: a bound, not a
    method.

    Args:
        dataset: Simulated touches with their truth.
        rows: Which of them are used.
        pad_model: What was fitted to them; gives the mechanics.
        limits: How the touches were pressed.

    Returns:
        The pad model; its errors are those of predicting the recorded readings.
    """
    used = np.flatnonzero(rows)
    touches = jax.tree.map(lambda x: x[used], dataset.touches)
    truth: Truth = touches.truth
    exact = PressureModelConfig(pitch=WIDE_WINDOW / WIDE_PIXELS, smooth=False, tilt=0.0, cell=PRESSURE_GRID.spacing)
    pressed = predict_pressures(exact, truth.wide, truth.force, truth.indentation)
    likelihood = pad_model.likelihood
    return _fit(
        pressed, jnp.asarray(truth.reading), jnp.asarray(touches.reading), touches.session,
        softness=float(pad_model.reading_model.softness),
        position=ScaleMixture(np.asarray(likelihood.position_std), np.asarray(likelihood.position_share)),
        limits=limits,
    )  # fmt: skip


def with_press_errors(model: PadModel, error_std: float) -> PadModel:
    """A pad model whose errors of readings include those of the pad that its touches were simulated with.

    Args:
        model: Fitted to touches simulated with a pad.
        error_std: uT, root mean square of what that pad leaves of presses it was not fitted to; 0 where it is unknown.

    Returns:
        The pad model with a larger inflation of its errors.
    """
    own = float(np.mean(np.asarray(model.held_out_errors, np.float64) ** 2))
    return inflated(model, float(np.sqrt(1 + error_std**2 / own)))


def inflated(model: PadModel, factor: float) -> PadModel:
    """A pad model whose errors of readings are larger.

    Args:
        model: As fitted.
        factor: By which its errors' standard deviation grows.

    Returns:
        The pad model with a larger inflation.
    """
    likelihood = model.likelihood
    return model._replace(likelihood=likelihood._replace(inflation=likelihood.inflation * np.float32(factor)))


class _SessionContacts(NamedTuple):
    """Touches of one session, filled up with repeated ones so that one compilation serves most sessions."""

    touches: Touches
    T_w_contact: Float[Array, "m 4 4"]  # at first contact
    met: Bool[Array, " m"]  # no repeated one
    own: int  # number of touches that are not repeated


def _session_contacts(touches: Touches, here: np.ndarray) -> _SessionContacts:
    padded = np.resize(here, max(REGISTERED_TOUCHES, len(here)))
    some = jax.tree.map(lambda x: jnp.asarray(x[padded]), touches)
    T_w_contact, met = registration.contact_poses(some)
    return _SessionContacts(some, T_w_contact, met & (np.arange(len(padded)) < len(here)), len(here))


def _pressed_contacts(
    key: Array, contacts: _SessionContacts, surface: Surface, errors: SimulationErrors
) -> tuple[np.ndarray, np.ndarray]:
    """Register the object of one session and press the nominal layer onto it at each contact: indentations (m) and
    newtons on each cell, of its touches.
    """
    found = _register_session(key, contacts, surface, errors, contacts.met)
    T_o_t = inverse(found.T_w_o)[None] @ contacts.T_w_contact
    indentation, newtons = _press(surface, T_o_t, contacts.touches.force)
    return np.asarray(indentation)[: contacts.own, 0], np.asarray(newtons)[: contacts.own, 0]


def _register_session(
    key: Array, contacts: _SessionContacts, surface: Surface, errors: SimulationErrors, weight: Array
) -> PoseEstimate:
    return _register(
        key, surface, contacts.touches.T_w_o[0], contacts.T_w_contact, weight,
        translation_std=errors.placement, rotation_std=errors.placement_angle,
    )  # fmt: skip


def _left_out_positions(
    key: Array, contacts: _SessionContacts, surface: Surface, errors: SimulationErrors, limits: PressLimits
) -> _Positions:
    """Ends of the touches of one session that met something, each predicted from those of the other folds."""
    fold = np.arange(len(contacts.met)) % POSITION_FOLDS
    parts = []
    for which in range(POSITION_FOLDS):
        # The same starts and draws in every fold, so that they differ in their touches alone.
        found = _register_session(jax.random.clone(key), contacts, surface, errors, contacts.met & (fold != which))
        force = jnp.maximum(contacts.touches.force, MIN_LOAD_N)
        predicted = _predict_end(surface, found, contacts.touches.T_w_t, force, overtravel=limits.overtravel)
        # A press ends at the pose it reports, which is its site here: contact lies as far before it.
        indentation = -predicted.approach_distance - force / limits.stiffness
        variance = jnp.einsum("ni,ij,nj->n", predicted.jacobian, found.covariance, predicted.jacobian)
        rows = np.asarray(contacts.met) & (fold == which)
        found_here = (indentation, predicted.indentation[:, 0], variance, predicted.hit)
        parts.append(_Positions(*(np.asarray(values)[rows] for values in found_here)))
    return jax.tree.map(lambda *x: np.concatenate(x), *parts)


def _position_errors(positions: _Positions, softness: float, limits: PressLimits) -> ScaleMixture:
    expected = softness * positions.nominal
    error = positions.indentation - expected
    variance = positions.variance + (INDENTATION_ERROR * expected) ** 2
    density = OUTLIER_RATE / outlier_range(limits.overtravel)
    return fit_position_errors(error[positions.hit], variance[positions.hit], outlier_density=density)


_register = jax.jit(registration.register_by_touch)


@partial(jax.jit, static_argnames=("overtravel",))
def _predict_end(
    surface: Surface, found: PoseEstimate, T_w_t: Array, force: Array, overtravel: float
) -> PredictedContact:
    def one(T: Array, f: Array) -> PredictedContact:
        return outcomes.predict_contact(surface, found.T_w_o, jnp.zeros(6), T, f[None], overtravel=overtravel)

    return jax.vmap(one)(T_w_t, force)._replace(newtons=jnp.zeros(()))


@jax.jit
def _press(surface: Surface, T_o_t: Array, force: Array) -> tuple[Array, Array]:
    return jax.vmap(lambda T, f: outcomes.contact_pressures(surface, T, f[None]))(T_o_t, force)


def _fit(
    contacts: ContactPressure,
    readings: Array,
    recorded: Array,
    sessions: np.ndarray,
    *,
    softness: float,
    position: ScaleMixture,
    limits: PressLimits,
) -> PadModel:
    """Condition a process on `readings`; the errors of predicting those `recorded` come from left-out touches. With the
    softness of the pad's layer over the nominal one's, and errors (m) of where presses end.
    """
    process = gp.condition(contacts, readings, sessions, seed=0)
    errors = gp.leave_one_out_errors(process) + np.asarray(recorded - readings)
    reading_model = outcomes.linear_reading_model(process, softness)
    likelihood = belief.fit_likelihood(
        errors, process.scale, reading_model.loads,
        overtravel=limits.overtravel, position_std=position, stiffness=limits.stiffness,
    )  # fmt: skip
    around = np.asarray(recorded) - np.mean(np.asarray(recorded), axis=0)
    r2 = float(1 - np.sum(errors**2) / np.sum(around**2))
    return PadModel(reading_model, likelihood, around.std(axis=0), r2, errors)
