"""Predicted contact pressure against the contact solver, symmetry and averages written out."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.compilations import compilations

from i2t.contact.pressure import PressureModelConfig, heights, predict_pressure, predict_pressures
from i2t.skin.contact import solve, solve_force
from i2t.skin.pad import nominal_pad

PIXELS, PITCH = 54, 0.5e-3  # a view of 27 mm
CFG = PressureModelConfig(pitch=PITCH, smooth=False, tilt=0.0, cell=1e-3)
PAD = nominal_pad()
SOLVER = 1e-3  # tolerance of the contact solver, relative to the deepest deflection
run = jax.jit(predict_pressure)
X, Y = np.meshgrid(*[(np.arange(PIXELS) - (PIXELS - 1) / 2) * PITCH] * 2)
BOWL = (X**2 + Y**2) / 40e-3
TILTED = replace(CFG, tilt=0.008)
smoothed = jax.jit(partial(heights, replace(CFG, smooth=True)))
AT = np.meshgrid(CFG.grid.centres, CFG.grid.centres)


def press(cfg: PressureModelConfig, view: np.ndarray, force: float = 1.0, depth: float = 0.2e-3) -> np.ndarray:
    return np.asarray(run(cfg, PAD, jnp.float32(view), jnp.float32(force), jnp.float32(depth)).pressure)


def tilted(right: float, down: float, x: np.ndarray = X, y: np.ndarray = Y) -> np.ndarray:
    """A plane: bilinear sampling of its pixels is exact."""
    return 2e-3 + right * x + down * y


def close(pressure: np.ndarray, reference: np.ndarray, tolerance: float = 3 * SOLVER) -> None:
    # Two runs of the solver, each within its tolerance of the optimum, where pressure goes with deflection.
    np.testing.assert_allclose(pressure, reference, atol=tolerance * np.abs(reference).max())


def test_the_load_is_the_measured_force_and_a_symmetric_view_gives_a_symmetric_pressure():
    imagined = run(TILTED, PAD, jnp.float32(BOWL), jnp.float32(6.0), jnp.float32(jnp.nan))
    # Sums of 9 x 400 float32 terms.
    np.testing.assert_allclose(imagined.load, 6.0, rtol=60 * np.finfo(np.float32).eps)
    pressure = np.asarray(imagined.pressure)
    np.testing.assert_allclose(pressure.sum(), 6.0, rtol=60 * np.finfo(np.float32).eps)
    assert (pressure >= 0).all()
    for image in (pressure[::-1], pressure[:, ::-1], pressure.T):
        close(image, pressure)


def test_other_numbers_of_the_model_compile_nothing_and_without_a_tilt_one_press_is_the_mean():
    views, force, depth = np.float32(BOWL)[None], np.float32([2.0]), np.float32([0.2e-3])
    predict_pressures(CFG, views, force, depth)
    with compilations() as compiled:
        changes = {"tilt": 0.01, "pitch": 0.9 * PITCH, "floor": 0.1, "softness": 2.0}
        predict_pressures(replace(CFG, **changes), views, force, depth)
        slightly = predict_pressures(replace(CFG, tilt=1e-9), views, force, depth)
    assert compiled == []
    close(np.asarray(slightly.pressure), np.asarray(predict_pressures(CFG, views, force, depth).pressure))


@pytest.mark.full
def test_force_control_is_the_contact_solver():
    direct = solve_force(PAD, jnp.float32(tilted(0.004, -0.01, *AT)), jnp.float32(2.0), CFG.grid)
    close(press(CFG, tilted(0.004, -0.01), force=2.0), np.asarray(direct.pressure) * 1e-6)  # Pa on 1 mm^2
    # A weak or wrong force counts as the floor.
    assert abs(press(CFG, X * 0, force=-0.3).sum() - CFG.floor) < 60 * np.finfo(np.float32).eps * CFG.floor


@pytest.mark.full
def test_depth_control_is_the_contact_solver():
    height = tilted(0.004, 0.0, *AT)
    direct = solve(PAD, jnp.float32(height - height.min()), jnp.float32(50e-6), CFG.grid)
    by_depth = replace(CFG, control="depth")
    close(press(by_depth, tilted(0.004, 0.0), force=np.nan, depth=50e-6), np.asarray(direct.pressure) * 1e-6)
    nothing = run(by_depth, PAD, jnp.float32(X * 0), jnp.float32(jnp.nan), jnp.float32(-1e-3))
    assert not nothing.pressure.any()
    assert nothing.load == np.float32(CFG.floor)


def test_a_softer_layer_takes_on_the_shape_of_a_larger_force():
    """The contact of a layer four times as soft is that of four times the force, with a quarter of the pressure."""
    close(press(replace(CFG, softness=4.0), BOWL, 0.5), press(CFG, BOWL, 2.0) / 4)


def test_tilts_are_averaged():
    nodes, weights = np.polynomial.hermite_e.hermegauss(3)
    weights = weights / weights.sum()
    view = (X**2 + 0.3 * Y**2) / 60e-3
    average = sum(
        w * v * press(CFG, view + TILTED.tilt * (a * X + b * Y), 1.5)
        for a, w in zip(nodes, weights, strict=True)
        for b, v in zip(nodes, weights, strict=True)
    )
    close(press(TILTED, view, 1.5), average)


def test_a_cropped_view_goes_on_at_its_rim():
    view = (X**2 + 2 * Y**2) / 40e-3
    crop = slice(10, -10)  # 17 mm are known
    cropped = np.full_like(view, np.nan)
    cropped[crop, crop] = view[crop, crop]
    close(press(CFG, cropped), press(CFG, np.pad(view[crop, crop], 10, mode="edge")))
    assert np.isfinite(smoothed(jnp.float32(cropped))).all()


@pytest.mark.parametrize(
    ("change", "words"),
    [({"cell": 3e-3, "window": 21e-3}, "does not divide"), ({"softness": np.nan}, "softness is")],
)
def test_impossible_layers_and_cells_are_refused(change, words):
    with pytest.raises(ValueError, match=words):
        replace(CFG, **change)
