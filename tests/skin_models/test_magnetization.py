"""A pad fitted by physics: its design matrices against the simulator, and simulated pads recovered."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from i2t.skin import boards
from i2t.skin.elasticity import Grid
from i2t.skin.pad import press, press_force, sample_pad
from i2t.skin_models import magnetic_layer as physics
from i2t.skin_models.magnetic_layer import RoundTip, parse_tip
from i2t.skin_models.magnetization import MagnetizationModel, TipReadings, bayesian_linear_regression

COARSE = Grid(20, 32)  # a quarter of the dipoles; pads are made and fitted on the same
TIP = RoundTip("sphere", 4e-3)
BOARD = boards.reskin_board()


@pytest.mark.full
def test_the_design_matrix_agrees_with_the_simulator():
    tip, board = RoundTip("cylinder", 2e-3), boards.grid_board(2, 2)
    rng = np.random.default_rng(0)
    weights = rng.normal(size=(3, physics.MODES, physics.MODES))
    waves = physics.cosine_basis()
    pad = sample_pad(jax.random.key(1), board=board)
    layer = physics.layer_prior(board.num_readings).median._replace(
        thickness=pad.thickness,
        gap=-pad.board.chips[0, 2] - pad.thickness,
        young=pad.young,
        mount_compliance=pad.mount_compliance,
        poisson=pad.poisson,
        board_offset=jnp.float32([0.4e-3, -0.2e-3]),
        board_rotation=jnp.float32([0.02, -0.01, 0.05]),
        gains=jnp.ones(3 * len(board.chips)),
        tip_scale=jnp.asarray(1.0),
    )
    magnetization = jnp.float32(1e3 * np.einsum("ia,jb,cab->ijc", waves, waves, weights))
    pad = physics.make_pad(layer, board, magnetization)._replace(friction=pad.friction)
    position = jnp.float32([1e-3, -2e-3])
    expected = press(pad, tip.height(position, COARSE), 0.2e-3, grid=COARSE).reading
    designed = physics.design_matrix(layer, board, tip, position, jnp.float32(0.2e-3), by_force=False, grid=COARSE)
    got = 1e3 * np.einsum("ocab,cab->o", np.float64(designed), weights)
    # Both are differences of fields that are a hundred times larger, in single precision.
    np.testing.assert_allclose(got, expected, atol=5e-3 * np.abs(expected).max())


@pytest.mark.full
def test_a_pad_is_recovered_and_its_errors_are_estimated():
    """A simulated pad is pressed sixty times with a sphere, with 1 uT of noise, and fitted to half of the presses."""
    pad, rng = sample_pad(jax.random.key(2)), np.random.default_rng(2)
    presses = jnp.float32(rng.uniform(-7e-3, 7e-3, (60, 2))), jnp.float32(rng.uniform(0.2e-3, 0.8e-3, 60))

    @jax.jit
    def read(pad, at, travel):
        return jax.vmap(lambda x, d: press(pad, TIP.height(x, COARSE), d, grid=COARSE).reading)(at, travel)

    readings = np.asarray(read(pad, *presses) + jnp.float32(rng.normal(size=(60, 15))))
    pressed, (at, travel), held = (part[:30] for part in presses), (part[30:] for part in presses), readings[30:]
    model = MagnetizationModel(TIP, by_force=False, grid=COARSE, max_layer_presses=16)
    fitted = model.fit(None, TipReadings(*pressed, jnp.float32(readings[:30]), BOARD))
    # Pressed by the simulator, the fitted pad reads what the true one reads.
    layer = fitted.posterior.layer
    again = read(fitted.pad, at + layer.tip_offset[None], travel - layer.contact_offset)
    error = np.sqrt(np.mean((held - again) ** 2))
    assert error < np.sqrt(0.15) * np.sqrt(np.mean((held - held.mean(0)) ** 2))
    truth = np.asarray(pad.magnetization)
    assert np.sum((truth - fitted.pad.magnetization) ** 2) < 0.7 * np.sum(truth**2)
    for name in ("thickness", "poisson"):
        low, high = (float(getattr(part, name)) for part in fitted.posterior[1:3])
        assert low < float(getattr(pad, name)) < high
    # Leave-one-out errors are comparable to the errors on new presses.
    assert 0.5 * error < np.sqrt(np.mean(fitted.leave_one_out**2)) < 2 * error


@pytest.mark.full
def test_a_pad_is_recovered_from_presses_by_force_at_symmetric_places():
    """The ranges contain the truth, and the fit has at most half the error of the prior's layer."""
    pad, rng = sample_pad(jax.random.key(1003)), np.random.default_rng(0)
    position = jnp.float32(1e-3 * np.round(rng.uniform(-6, 6, (40, 2))))  # corners of four cells
    presses = position, jnp.float32(rng.uniform(0.1, 1.5, 40))

    @jax.jit
    def read(presses):
        return jax.lax.map(lambda at: press_force(pad, TIP.height(at[0], COARSE), at[1], grid=COARSE).reading, presses)

    readings = read(presses) + jnp.float32(rng.normal(size=(40, 15)))
    model = partial(MagnetizationModel, TIP, by_force=True, grid=COARSE)
    fitted, start = (
        model(**options).fit(None, TipReadings(*presses, readings, BOARD))
        for options in ({"max_layer_presses": 24}, {"max_layer_presses": 0})
    )
    assert fitted.posterior.converged
    for name in ("thickness", "young"):
        low, high = (float(getattr(part, name)) for part in fitted.posterior[1:3])
        assert low < float(getattr(pad, name)) < high < 1.3 * low
    errors = [np.sum(pad_fit.leave_one_out**2) for pad_fit in (fitted, start)]
    assert errors[0] < 0.5 * errors[1]


def test_presses_that_are_not_finite_are_refused():
    pressed = TipReadings(jnp.zeros((6, 2)), jnp.ones(6), jnp.ones((6, 15)), BOARD)
    model = MagnetizationModel(TIP, by_force=True)
    for given, name in (
        (pressed._replace(position=pressed.position.at[2, 1].set(jnp.nan)), "positions"),
        (pressed._replace(load=pressed.load.at[2].set(jnp.inf)), "loads"),
        (pressed._replace(reading=pressed.reading.at[2, 3].set(jnp.nan)), "readings"),
    ):
        with pytest.raises(ValueError, match=f"1 presses have {name} that are not finite, the first in row 2"):
            model.fit(None, given)


@pytest.mark.parametrize("group", [None, np.array([2, 0, 1, 0, 2, 2])], ids=["presses", "places"])
def test_leave_one_out_predictions_agree_with_refitting(group):
    rng = np.random.default_rng(3)
    phi, y, noise = rng.normal(size=(6, 15, 20)), rng.normal(size=(6, 15)), 0.5
    whole = bayesian_linear_regression(phi, y, noise, group=group)
    for number in range(6 if group is None else 3):
        own = np.arange(6) == number if group is None else group == number
        rows, values = phi[~own].reshape(-1, 20), y[~own].ravel()
        covariance = np.linalg.inv(np.eye(20) + rows.T @ rows / noise**2)  # of the weights, given the other groups
        tested = phi[own].reshape(-1, 20)
        expected = tested @ covariance @ rows.T @ values / noise**2
        np.testing.assert_allclose(whole.leave_group_out[own].ravel(), expected, rtol=1e-8, atol=1e-10)
        normal = stats.multivariate_normal(expected, tested @ covariance @ tested.T + noise**2 * np.eye(len(tested)))
        np.testing.assert_allclose(whole.log_density[number], normal.logpdf(y[own].ravel()), rtol=1e-8)


def test_the_dipole_field_is_the_textbooks_and_parameters_grow_with_their_coordinates():
    moment, point = np.array([0.3, -1.0, 2.0]), np.array([4e-3, -3e-3, 1e-3])
    at = np.random.default_rng(4).normal(scale=2e-3, size=(3, 2, 2))
    away = point - np.moveaxis(at, 0, -1)
    distance = np.linalg.norm(away, axis=-1, keepdims=True)
    expected = 1e-7 * (3 * away * (away @ moment)[..., None] / distance**5 - moment / distance**3)
    field = np.einsum("abij,b->ija", physics._dipole_tensor(jnp.float32(point), jnp.float32(at)), moment)
    np.testing.assert_allclose(field, expected, rtol=1e-4)

    prior = physics.layer_prior(15)
    low, middle, high = (
        physics.parameters_at(jax.tree.map(lambda x, step=step: jnp.full(x.shape, step), prior.std), prior)
        for step in (-1.0, 0.0, 1.0)
    )
    jax.tree.map(np.testing.assert_array_equal, middle, prior.median)
    jax.tree.map(np.testing.assert_array_less, low, middle)
    jax.tree.map(np.testing.assert_array_less, middle, high)


def test_tips_are_parsed_from_shape_and_radius():
    assert parse_tip("sphere:4.0") == TIP
    assert parse_tip("Sphere: 4.0") == TIP
    assert parse_tip("cylinder:2") == RoundTip("cylinder", 2e-3)
    for wrong in (
        "tip",
        "sphere",
        "sphere:x",
        "sphere:-1",
        "sphere:80",
        "cone:2",
        "sphere:nan",
        "sphere:4mm",
        "sphere:0.004",
    ):
        with pytest.raises(ValueError, match=f'"{wrong}" is not a tip'):
            parse_tip(wrong)
