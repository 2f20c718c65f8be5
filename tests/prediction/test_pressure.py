"""Predicted contact pressure against the contact solver, symmetry and averages written out."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2t.prediction.pressure import PressureModelConfig, heights, predict_pressure
from i2t.skin.contact import solve, solve_force
from i2t.skin.pad import nominal_pad

PIXELS, PITCH = 54, 0.5e-3  # a view of 27 mm
CFG = PressureModelConfig(pitch=PITCH, smooth=False, tilt=0.0, cell=1e-3)
PAD = nominal_pad()
SOLVER = 1e-3  # tolerance of the contact solver, relative to the deepest deflection
run = jax.jit(predict_pressure, static_argnums=0)
X, Y = np.meshgrid(*[(np.arange(PIXELS) - (PIXELS - 1) / 2) * PITCH] * 2)
AT = np.meshgrid(CFG.grid.centres, CFG.grid.centres)


def press(cfg: PressureModelConfig, view: np.ndarray, force: float = 1.0, depth: float = 0.2e-3) -> np.ndarray:
    return np.asarray(run(cfg, PAD, jnp.float32(view), jnp.float32(force), jnp.float32(depth)).pressure)


def tilted(right: float, down: float, x: np.ndarray = X, y: np.ndarray = Y) -> np.ndarray:
    """A plane: bilinear sampling of its pixels is exact."""
    return 2e-3 + right * x + down * y


def close(pressure: np.ndarray, reference: np.ndarray, tolerance: float = 3 * SOLVER) -> None:
    # Two runs of the solver, each within its tolerance of the optimum, where pressure goes with deflection.
    np.testing.assert_allclose(pressure, reference, atol=tolerance * np.abs(reference).max())


@pytest.mark.parametrize("force", [0.5, 6.0])
def test_the_load_is_the_measured_force(force):
    bowl = (X**2 + Y**2) / 40e-3
    imagined = run(replace(CFG, tilt=0.01), PAD, jnp.float32(bowl), jnp.float32(force), jnp.float32(jnp.nan))
    # Sums of 9 x 400 float32 terms.
    np.testing.assert_allclose(imagined.load, force, rtol=60 * np.finfo(np.float32).eps)
    np.testing.assert_allclose(imagined.pressure.sum(), force, rtol=60 * np.finfo(np.float32).eps)
    assert (np.asarray(imagined.pressure) >= 0).all()


def test_a_symmetric_view_gives_a_symmetric_pressure():
    pressure = press(replace(CFG, tilt=0.01), (X**2 + Y**2) / 40e-3)
    for image in (pressure[::-1], pressure[:, ::-1], pressure.T):
        close(image, pressure)


@pytest.mark.full
@pytest.mark.parametrize(("right", "down"), [(0.0, 0.0), (0.004, -0.01)])
def test_force_control_is_the_contact_solver(right, down):
    direct = solve_force(PAD, jnp.float32(tilted(right, down, *AT)), jnp.float32(2.0), CFG.grid)
    close(press(CFG, tilted(right, down), force=2.0), np.asarray(direct.pressure) * 1e-6)  # Pa on 1 mm^2


@pytest.mark.full
def test_depth_control_is_the_contact_solver():
    height = tilted(0.004, 0.0, *AT)
    direct = solve(PAD, jnp.float32(height - height.min()), jnp.float32(50e-6), CFG.grid)
    by_depth = replace(CFG, control="depth")
    close(press(by_depth, tilted(0.004, 0.0), force=np.nan, depth=50e-6), np.asarray(direct.pressure) * 1e-6)
    nothing = run(by_depth, PAD, jnp.float32(X * 0), jnp.float32(jnp.nan), jnp.float32(-1e-3))
    assert not nothing.pressure.any()
    assert nothing.load == np.float32(CFG.floor)


def test_a_weak_or_wrong_force_counts_as_the_floor():
    assert abs(press(CFG, X * 0, force=-0.3).sum() - CFG.floor) < 60 * np.finfo(np.float32).eps * CFG.floor


def test_a_softer_layer_takes_on_the_shape_of_a_larger_force():
    """The contact of a layer four times as soft is that of four times the force, with a quarter of the pressure."""
    bowl = (X**2 + Y**2) / 40e-3
    close(press(replace(CFG, softness=4.0), bowl, 0.5), press(CFG, bowl, 2.0) / 4)


@pytest.mark.parametrize("softness", [0.0, -1.0, np.nan])
def test_a_layer_of_no_stiffness_is_refused(softness):
    with pytest.raises(ValueError, match="softness is"):
        replace(CFG, softness=softness)


@pytest.mark.full
def test_cells_are_summed_to_millimetres():
    fine = press(replace(CFG, cell=0.5e-3), tilted(0.004, 0.002))
    direct = solve_force(
        PAD, jnp.float32(tilted(0.004, 0.002, *np.meshgrid(*[replace(CFG, cell=0.5e-3).grid.centres] * 2))), 1.0
    )
    sums = np.asarray(direct.pressure).reshape(20, 2, 20, 2).sum((1, 3)) * 0.25e-6
    close(fine, sums)


def test_tilts_are_averaged():
    tilt, force = 0.008, 1.5
    nodes, weights = np.polynomial.hermite_e.hermegauss(3)
    weights = weights / weights.sum()
    view = (X**2 + 0.3 * Y**2) / 60e-3
    average = sum(
        w * v * press(CFG, view + tilt * (a * X + b * Y), force)
        for a, w in zip(nodes, weights, strict=True)
        for b, v in zip(nodes, weights, strict=True)
    )
    close(press(replace(CFG, tilt=tilt), view, force), average)


def test_a_cropped_view_goes_on_at_its_rim():
    view = (X**2 + 2 * Y**2) / 40e-3
    crop = slice(10, -10)  # 17 mm are known
    cropped = np.full_like(view, np.nan)
    cropped[crop, crop] = view[crop, crop]
    close(press(CFG, cropped), press(CFG, np.pad(view[crop, crop], 10, mode="edge")))
    assert np.isfinite(press(replace(CFG, smooth=True), cropped)).all()


def test_smoothing_leaves_a_plane_and_takes_noise_off():
    noise = 0.2e-3 * np.random.default_rng(0).normal(size=X.shape)
    sample = jax.jit(partial(heights, replace(CFG, smooth=True)))
    exact = tilted(0.02, 0.01, *AT)
    # All cells lie at least five pixels from the rim, where planes stay to the rounding of sums of 121 heights.
    np.testing.assert_allclose(sample(jnp.float32(tilted(0.02, 0.01))), exact, atol=121 * 2**-23 * exact.max())
    error = np.asarray(sample(jnp.float32(tilted(0.02, 0.01) + noise))) - exact
    # 61 effective pixels leave 1 / 7.8 of the noise; robust weights see fewer, but never so few as a fourth.
    assert error.std() < 0.2e-3 / 7.8 * 2


def test_a_batch_is_its_examples():
    views = jnp.float32(np.stack([tilted(0.01, 0.0), (X**2 + Y**2) / 40e-3, tilted(0.0, 0.0)]))
    force, depth = jnp.float32([0.5, 1.0, 4.0]), jnp.zeros(3)
    together = jax.jit(jax.vmap(partial(predict_pressure, CFG, PAD)))(views, force, depth).pressure
    for i in range(3):
        close(np.asarray(together[i]), press(CFG, views[i], float(force[i])))


@pytest.mark.parametrize(("cell", "window"), [(0.4e-3, 20e-3), (1e-3, 20.5e-3), (3e-3, 21e-3)])
def test_cells_that_do_not_tile_the_skin_are_refused(cell, window):
    with pytest.raises(ValueError, match="does not divide"):
        PressureModelConfig(pitch=PITCH, cell=cell, window=window)


@pytest.mark.full
def test_a_recordings_own_signs_and_heights_are_undone():
    """A force that it counts negative, and depths from 0.3 mm too low, give the pressure of the press that it was."""
    bowl = (X**2 + Y**2) / 40e-3
    close(press(replace(CFG, force_sign=-1.0), bowl, force=-1.5), press(CFG, bowl, force=1.5), 1e-6)
    by_depth = replace(CFG, control="depth")
    moved = press(replace(by_depth, depth_offset=0.3e-3), bowl, depth=0.0)
    assert moved.max() > 0
    close(moved, press(by_depth, bowl, depth=0.3e-3), 1e-6)
    assert press(by_depth, bowl, depth=0.0).max() == 0
