"""What one pad reads at a contact, and how far its predictions are off: a pad model fitted to recorded touches.

Each recorded session's object is registered by its own contacts first (`i2t.registration.touch`): the contact is then
known ten times better than from the camera's view. The contact's pressure on the nominal layer, at the measured force,
and the reading condition a Gaussian process (`i2t.prediction.gp`); its leave-one-out errors fit the likelihood of
`i2t.recognition.belief`. Metres, newtons, microtesla.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key

from i2t.dataset import Dataset
from i2t.prediction import gp
from i2t.prediction.gp import ContactPressure
from i2t.prediction.predictor import predict_pressures
from i2t.prediction.pressure import PressureModelConfig
from i2t.recognition import belief, outcomes
from i2t.recognition.belief import Likelihood
from i2t.recognition.outcomes import MIN_LOAD_N, PRESSURE_GRID, LinearReadingModel
from i2t.registration import touch as registration
from i2t.simulation import touches as simulation
from i2t.simulation.press import PressLimits
from i2t.simulation.touches import SimulationErrors
from i2t.types import WIDE_PIXELS, WIDE_WINDOW, Pad, Surface, Touches, Truth

REGISTERED_TOUCHES = 36  # of a session at least, filled up with repeated ones: one compilation serves most sessions


class PadModel(NamedTuple):
    """A pad as its touches of known objects show it."""

    reading_model: LinearReadingModel
    likelihood: Likelihood
    reading_std: Float[np.ndarray, " c"]  # uT, of the readings
    r2: float  # of held-out touches; NaN where there were none
    held_out_errors: Float[np.ndarray, "n c"]  # uT, measured minus predicted


class _Mechanics(NamedTuple):
    """What touches say of the pad's layer and of where presses end."""

    softness: float  # indentation over that of the nominal layer
    position_std: float  # m


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
    for session in np.unique(touches.session[rows]):
        here = np.flatnonzero(rows & (touches.session == session))
        surface = surfaces[dataset.objects[int(touches.object[here[0]])]]
        nominal[here], pressure[here] = _pressed_contacts(
            jax.random.fold_in(key, int(session)), touches, here, surface, errors
        )
    used = np.flatnonzero(rows & np.isfinite(nominal))
    load = np.maximum(touches.force[used], MIN_LOAD_N)
    shape = (-1, PRESSURE_GRID.cells, PRESSURE_GRID.cells)
    contacts = ContactPressure(jnp.asarray(pressure[used].reshape(shape)), jnp.asarray(load))
    readings = jnp.asarray(touches.reading[used])
    depth = touches.depth[used] - load / limits.stiffness
    softness = float(np.sum(nominal[used] * depth) / np.sum(nominal[used] ** 2))
    mechanics = _Mechanics(softness, float(np.std(depth - softness * nominal[used])))
    return _fit(contacts, readings, readings, touches.session[used], mechanics=mechanics, limits=limits)


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
    mechanics = _mechanics_of(pad_model)
    readings, ideal = jnp.asarray(touches.reading), jnp.asarray(touches.truth.reading)
    return _fit(_exact_contacts(touches.truth), ideal, readings, touches.session, mechanics=mechanics, limits=limits)


def fit_simulated_pad_model(
    key: Key[Array, ""],
    pad: Pad,
    surfaces: Sequence[Surface],
    *,
    touches: int,
    limits: PressLimits,
    recorded: PadModel,
) -> PadModel:
    """Fit a pad model to simulated touches, without any error, of a pad that is known, say fitted to a few presses.

    Args:
        key: Of the simulation.
        pad: The pad.
        surfaces: Of the objects to be touched.
        touches: How many, over all objects.
        limits: How they are pressed.
        recorded: Fitted to recorded touches of a pad; gives the mechanics and the errors of predictions.

    Returns:
        The pad model, without an r2 of its own.
    """
    ideal = replace(SimulationErrors.none(), slant=SimulationErrors.slant)
    made = simulation.simulate_touches(key, surfaces, pad, ideal, touches // len(surfaces), limits=limits)
    assert made.truth is not None
    process = gp.condition(_exact_contacts(made.truth), made.reading, np.asarray(made.session), seed=0)
    mechanics = _mechanics_of(recorded)
    reading_model = outcomes.linear_reading_model(process, mechanics.softness)
    likelihood = belief.fit_likelihood(
        recorded.held_out_errors, process.scale, reading_model.loads,
        overtravel=limits.overtravel, position_std=mechanics.position_std, stiffness=limits.stiffness,
    )  # fmt: skip
    return recorded._replace(reading_model=reading_model, likelihood=likelihood, r2=float("nan"))


def _pressed_contacts(
    key: Array, touches: Touches, here: np.ndarray, surface: Surface, errors: SimulationErrors
) -> tuple[np.ndarray, np.ndarray]:
    """Register the object of one session and press the nominal layer onto it at each contact: indentations (m) and
    newtons on each cell, of the touches `here`.
    """
    padded = np.resize(here, max(REGISTERED_TOUCHES, len(here)))
    some = jax.tree.map(lambda x: jnp.asarray(x[padded]), touches)
    T_w_contact, met = registration.contact_poses(some)
    met = met & (np.arange(len(padded)) < len(here))
    found = _register(
        key,
        surface,
        some.T_w_o[0],
        T_w_contact,
        met,
        translation_std=errors.placement,
        rotation_std=errors.placement_angle,
    )
    T_o_t = jnp.linalg.inv(found.T_w_o)[None] @ T_w_contact
    indentation, newtons = _press(surface, T_o_t, some.force)
    return np.asarray(indentation)[: len(here), 0], np.asarray(newtons)[: len(here), 0]


_register = jax.jit(registration.register_by_touch)


@jax.jit
def _press(surface: Surface, T_o_t: Array, force: Array) -> tuple[Array, Array]:
    return jax.vmap(lambda T, f: outcomes.contact_pressures(surface, T, f[None]))(T_o_t, force)


def _exact_contacts(truth: Truth) -> ContactPressure:
    """Pressures of simulated touches whose contacts are known exactly."""
    exact = PressureModelConfig(
        pitch=WIDE_WINDOW / WIDE_PIXELS, smooth=False, tilt=0.0, cell=PRESSURE_GRID.spacing
    )  # fmt: skip
    return predict_pressures(exact, truth.wide, truth.force, truth.indentation)


def _mechanics_of(pad_model: PadModel) -> _Mechanics:
    return _Mechanics(float(pad_model.reading_model.softness), float(pad_model.likelihood.position_std))


def _fit(
    contacts: ContactPressure,
    readings: Array,
    recorded: Array,
    sessions: np.ndarray,
    *,
    mechanics: _Mechanics,
    limits: PressLimits,
) -> PadModel:
    """Condition a process on `readings`; the errors of predicting those `recorded` come from left-out touches."""
    process = gp.condition(contacts, readings, sessions, seed=0)
    errors = gp.leave_one_out_errors(process) + np.asarray(recorded - readings)
    reading_model = outcomes.linear_reading_model(process, mechanics.softness)
    likelihood = belief.fit_likelihood(
        errors, process.scale, reading_model.loads,
        overtravel=limits.overtravel, position_std=mechanics.position_std, stiffness=limits.stiffness,
    )  # fmt: skip
    around = np.asarray(recorded) - np.mean(np.asarray(recorded), axis=0)
    r2 = float(1 - np.sum(errors**2) / np.sum(around**2))
    return PadModel(reading_model, likelihood, around.std(axis=0), r2, errors)
