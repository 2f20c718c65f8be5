"""All models of a skin share one interface: fit, predict, leave_one_out, save and load."""

from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import i2t
from i2t import skin_models
from i2t.contact.press import PressLimits
from i2t.contact.pressure import ContactPressure
from i2t.dataset.digests import touch_digests
from i2t.errors import SerializationError
from i2t.files import serialization
from i2t.objects import catalogue
from i2t.simulation.touches import SimulationErrors
from i2t.skin.boards import reskin_board
from i2t.skin.contact import solve
from i2t.skin.elasticity import CELL_GRID
from i2t.skin.pad import nominal_pad, press
from i2t.skin_models.base import FittedSkinModel
from i2t.skin_models.calibration import TipModel, TipPresses
from i2t.skin_models.magnetic_layer import RoundTip
from i2t.skin_models.magnetization import MagnetizationModel, TipReadings
from i2t.skin_models.pad_fit import ContactModel, ObjectTouches
from i2t.skin_models.pressure_gp import PressureModel, PressureTouches
from i2t.types import Pad

BOARD, TIP = reskin_board(), RoundTip("sphere", 4e-3)
PRESSES, NEW = 40, 40
FITTED_ROWS, NEW_ROWS = slice(PRESSES), slice(PRESSES, None)


class Presses(NamedTuple):
    """Presses of a sphere."""

    position: jax.Array  # m
    load: jax.Array  # m, travel


class Pressed(NamedTuple):
    """Presses of a simulated pad with a sphere, and their readings with 0.5 uT of noise."""

    presses: Presses
    readings: np.ndarray


@jax.jit
def pressures(pad: Pad, presses: Presses) -> ContactPressure:
    """Solve the pressures of the sphere on a pad."""

    def newtons(row: Presses) -> jax.Array:
        return solve(pad, TIP.height(row.position, CELL_GRID), row.load, CELL_GRID).pressure * CELL_GRID.spacing**2

    pressure = jax.lax.map(newtons, presses)
    return ContactPressure(pressure, jnp.sum(pressure, axis=(1, 2)))


def rows_of(tree: Any, rows: slice) -> Any:
    return jax.tree.map(lambda leaf: leaf[rows], tree)


@pytest.fixture(scope="module")
def pressed() -> Pressed:
    rng, pad, count = np.random.default_rng(0), i2t.sample_pad(jax.random.key(3)), PRESSES + NEW
    position, travel = rng.uniform(-6e-3, 6e-3, (count, 2)), rng.uniform(0.3e-3, 0.9e-3, count)
    presses = Presses(jnp.float32(position), jnp.float32(travel))

    @jax.jit
    def read(presses: Presses) -> jax.Array:
        return jax.lax.map(
            lambda row: press(pad, TIP.height(row.position, CELL_GRID), row.load, grid=CELL_GRID).reading, presses
        )

    readings = np.asarray(read(presses))
    return Pressed(presses, readings + rng.normal(scale=0.5, size=readings.shape).astype(np.float32))


def tip_case(pressed: Pressed) -> tuple[Any, Any]:
    at, load = (np.asarray(part, np.float64)[FITTED_ROWS] for part in pressed.presses)
    return TipModel("travel"), TipPresses(at, load, pressed.readings[FITTED_ROWS], BOARD)


def pressure_case(pressed: Pressed) -> tuple[Any, Any]:
    pressure = pressures(nominal_pad(), rows_of(pressed.presses, FITTED_ROWS))
    return PressureModel(), PressureTouches(pressure, pressed.readings[FITTED_ROWS], np.arange(PRESSES) % 5)


def pad_case(pressed: Pressed) -> tuple[Any, Any]:
    model = MagnetizationModel(TIP, by_force=False, grid=CELL_GRID, max_layer_presses=0)
    return model, TipReadings(*rows_of(pressed.presses, FITTED_ROWS), jnp.float32(pressed.readings[FITTED_ROWS]), BOARD)


def assert_common_interface(fitted: Any, contact: tuple[Any, ...], path: Path) -> None:
    assert isinstance(fitted, FittedSkinModel)
    fitted.save(path)
    again = skin_models.load(path)
    assert type(again) is type(fitted)
    np.testing.assert_allclose(again.leave_one_out, fitted.leave_one_out, rtol=1e-5, atol=1e-4)
    for loaded, original in zip(again.predict(*contact), fitted.predict(*contact), strict=True):
        np.testing.assert_allclose(loaded, original, rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("make", [tip_case, pressure_case, pad_case])
def test_a_model_of_a_skin_has_the_common_interface(make, pressed, tmp_path):
    model, data = make(pressed)
    fitted = model.fit(jax.random.key(0), data)
    new, truth = rows_of(pressed.presses, NEW_ROWS), pressed.readings[NEW_ROWS]
    own = fitted.pad if make is pad_case else nominal_pad()
    contact = tuple(np.asarray(part, np.float64) for part in new) if make is tip_case else (pressures(own, new),)
    assert_common_interface(fitted, contact, tmp_path / "skin.npz")
    mean, std = (np.asarray(part) for part in fitted.predict(*contact))
    assert mean.shape == std.shape == truth.shape
    assert (std > 0).all()
    assert fitted.leave_one_out.shape == (PRESSES, truth.shape[1])
    squared_error = np.mean((mean - truth) ** 2)
    assert squared_error < 0.7 * np.mean((truth - pressed.readings[FITTED_ROWS].mean(0)) ** 2)
    # Leave-one-out errors are comparable to the errors on new presses.
    assert 0.25 < np.mean(fitted.leave_one_out**2) / squared_error < 4


@pytest.mark.full
def test_a_pad_model_has_the_common_interface(tmp_path):
    pad, limits, errors = i2t.sample_pad(jax.random.key(0)), PressLimits(), SimulationErrors()
    surface = i2t.prepare_surface(catalogue.make_object("hexagon").mesh)
    touches = i2t.simulate_touches(jax.random.key(1), [surface], pad, errors, 36)
    dataset = i2t.Dataset.simulated(touches, ("hexagon",), pad)
    data = ObjectTouches(dataset, np.ones(36, bool), {"hexagon": surface}, "DATA")
    newtons = jnp.zeros((3, 20, 20)).at[:, 8:12, 8:12].set(jnp.float32([0.02, 0.05, 0.1])[:, None, None])
    contact = ContactPressure(newtons, jnp.sum(newtons, axis=(1, 2)))
    fitted = ContactModel(errors, limits).fit(jax.random.key(2), data)
    assert fitted.origin.used_touches == tuple(touch_digests(dataset))
    assert_common_interface(fitted, (contact,), tmp_path / "pad_model.npz")
    mean, _ = fitted.predict(contact)
    assert (np.diff(np.linalg.norm(mean, axis=1)) > 0).all()  # a larger load gives a larger reading


def test_a_file_of_another_kind_is_refused(tmp_path):
    serialization.save(tmp_path / "other.npz", "i2t kernel prior", Presses(np.zeros((1, 2)), np.zeros(1)))
    with pytest.raises(SerializationError, match="holds a i2t kernel prior, which is not a model of a skin"):
        skin_models.load(tmp_path / "other.npz")


def test_a_fitted_pad_loads_as_a_pad_and_a_pad_alone_is_not_a_fit(pressed, tmp_path):
    model, data = pad_case(pressed)
    fitted = model.fit(None, data)
    fitted.save(tmp_path / "pad.npz")
    np.testing.assert_array_equal(i2t.load_pad(tmp_path / "pad.npz").magnetization, fitted.pad.magnetization)
    with np.load(tmp_path / "pad.npz") as arrays:  # names in the file stay, because earlier files are read
        np.testing.assert_array_equal(arrays["left_out"], fitted.leave_one_out)
        np.testing.assert_array_equal(arrays["left_out_places"], fitted.leave_one_place_out)
    i2t.save_pad(tmp_path / "alone.npz", fitted.pad)
    with pytest.raises(
        SerializationError, match=r"alone\.npz: holds a pad without its fit; read it with i2t\.load_pad"
    ):
        skin_models.load(tmp_path / "alone.npz")
