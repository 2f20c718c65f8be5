"""Predicted contact pressure against the contact solver, symmetry and averages written out."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.compilations import compilations

from i2t.contact.approach import first_contact
from i2t.contact.pressure import (
    PressureModelConfig,
    centre_of_pressure,
    heights,
    newtons_on_cells,
    predict_pressure,
    predict_pressures,
    press_heights,
    surface_pressure,
)
from i2t.geometry import inverse
from i2t.objects import make_object
from i2t.rendering.render import prepare_surface, render_heights
from i2t.skin.contact import CELL_GRID, FINE_GRID, GRID, solve, solve_force
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


def press(cfg: PressureModelConfig, view: np.ndarray, force: float = 1.0, travel: float = 0.2e-3) -> np.ndarray:
    return np.asarray(run(cfg, PAD, jnp.float32(view), jnp.float32(force), jnp.float32(travel)).pressure)


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
    views, force, travel = np.float32(BOWL)[None], np.float32([2.0]), np.float32([0.2e-3])
    predict_pressures(CFG, views, force, travel)
    with compilations() as compiled:
        changes = {"tilt": 0.01, "pitch": 0.9 * PITCH, "floor": 0.1, "softness": 2.0}
        predict_pressures(replace(CFG, **changes), views, force, travel)
        slightly = predict_pressures(replace(CFG, tilt=1e-9), views, force, travel)
    assert compiled == []
    close(np.asarray(slightly.pressure), np.asarray(predict_pressures(CFG, views, force, travel).pressure))


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
    by_travel = replace(CFG, control="travel")
    close(press(by_travel, tilted(0.004, 0.0), force=np.nan, travel=50e-6), np.asarray(direct.pressure) * 1e-6)
    nothing = run(by_travel, PAD, jnp.float32(X * 0), jnp.float32(jnp.nan), jnp.float32(-1e-3))
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


def test_a_cropped_view_is_continued_beyond_its_rim():
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


def test_a_mesh_and_its_view_give_the_same_pressure():
    surface = prepare_surface(make_object("hammer").mesh)
    above = jnp.float32([[1, 0, 0, 0.02], [0, -1, 0, 0], [0, 0, -1, 0.06], [0, 0, 0, 1]])
    T = first_contact(surface, above, beyond=0.1).T_w_t
    loads = jnp.float32([0.5, 0.0, 4.0])
    pressed, indentation = jax.jit(surface_pressure)(PAD, surface, T, loads)
    np.testing.assert_allclose(pressed.load, [0.5, CFG.floor, 4.0])
    assert indentation[1] < indentation[0] < indentation[2]
    pixels = CELL_GRID.cells + 6  # of 1 mm, so that the skin's cells are pixels of the view
    view = jnp.minimum(render_heights(surface, inverse(T), pixels * CELL_GRID.spacing, pixels), 0.1)
    for i, load in enumerate(loads):
        close(run(replace(CFG, pitch=1e-3), PAD, view, load, jnp.nan).pressure, pressed.pressure[i])
    nothing, deep = surface_pressure(PAD, surface, T.at[0, 3].set(0.5), loads)
    assert not nothing.pressure.any()
    assert np.isinf(deep).all()


@pytest.mark.parametrize("grid", [CELL_GRID, GRID, FINE_GRID])
def test_newtons_and_centre_of_a_pressure_do_not_depend_on_its_grid(grid):
    x, y = np.meshgrid(grid.centres, grid.centres)
    ball = jnp.float32(((x - 2e-3) ** 2 + (y + 1e-3) ** 2) / 30e-3)
    pressure, _ = press_heights(PAD, ball - ball.min(), 2.0, grid)
    newtons = newtons_on_cells(pressure, grid)
    assert newtons.shape == (CELL_GRID.cells, CELL_GRID.cells)
    assert float(newtons.sum()) == pytest.approx(2.0, rel=1e-5)
    both = centre_of_pressure(jnp.stack([pressure, 0 * pressure]), grid)
    np.testing.assert_allclose(both, [[2e-3, -1e-3], [0, 0]], atol=0.02e-3)  # the layer's edge is far


def test_presses_of_several_loads_need_no_start_from_the_load_before():
    """Steps from any start meet the tolerance as well as steps from the next smaller load."""
    height = jnp.float32(((AT[0] - 3e-3) ** 2 + AT[1] ** 2) / 20e-3)
    height, start = height - height.min(), None
    for load in (0.25, 0.8, 2.5, 8.0):
        exact = solve_force(PAD, height, load, CELL_GRID)
        chained = solve_force(PAD, height, load, CELL_GRID, start=start, tolerance=SOLVER, max_steps=40)
        pressure, indentation = press_heights(PAD, height, load)
        close(pressure, exact.pressure)
        assert float(indentation) == pytest.approx(float(exact.indentation), abs=0.2e-6)
        close(pressure, chained.pressure)
        start = chained.pressure
