"""A pad fitted by physics: its design against the simulator, and simulated pads found again."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from i2t.calibration import physics
from i2t.calibration.physics import Presses, RoundTip, parse_tip
from i2t.skin import boards
from i2t.skin.elasticity import Grid
from i2t.skin.pad import POISSON_RATIO, press, sample_pad

COARSE = Grid(20, 32)  # a quarter of the dipoles; pads are made and fitted on the same
TIP = RoundTip("sphere", 4e-3)
BOARD = boards.reskin_board()


@pytest.mark.full
def test_the_design_gives_what_the_simulator_reads():
    tip, board = RoundTip("cylinder", 2e-3), boards.grid_board(2, 2)
    rng = np.random.default_rng(0)
    weights = rng.normal(size=(3, physics.MODES, physics.MODES))
    waves = physics.cosine_basis()
    pad = sample_pad(jax.random.key(1), board=board)
    layer = physics.layer_prior().median._replace(
        thickness=pad.thickness,
        gap=-pad.board.chips[0, 2] - pad.thickness,
        young=pad.young,
        mount_compliance=pad.mount_compliance,
    )
    pad = pad._replace(
        magnetization=jnp.float32(1e3 * np.einsum("ia,jb,cab->ijc", waves, waves, weights)),
        gains=jnp.ones(3 * len(board.chips)),
        poisson=jnp.asarray(POISSON_RATIO),  # which the layer of the fit takes as known
    )
    position = jnp.float32([1e-3, -2e-3])
    expected = press(pad, tip.height(position, COARSE), 0.2e-3, grid=COARSE).reading
    designed = physics.design_matrix(layer, pad.board, tip, position, jnp.float32(0.2e-3), by_force=False, grid=COARSE)
    got = 1e3 * np.einsum("ocab,cab->o", np.float64(designed), weights)
    # Both are differences of fields a hundred times as large, in single precision.
    np.testing.assert_allclose(got, expected, atol=5e-3 * np.abs(expected).max())


@pytest.mark.full
def test_a_pad_is_found_again_and_says_how_far_it_is_off():
    """Sixty presses of a simulated pad with a ball, with 1 uT of noise: it is fitted to half of them."""
    pad, rng = sample_pad(jax.random.key(2)), np.random.default_rng(2)
    presses = Presses(jnp.float32(rng.uniform(-7e-3, 7e-3, (60, 2))), jnp.float32(rng.uniform(0.2e-3, 0.8e-3, 60)))

    @jax.jit
    def read(pad, at, depth):
        return jax.vmap(lambda x, d: press(pad, TIP.height(x, COARSE), d, grid=COARSE).reading)(at, depth)

    readings = np.asarray(read(pad, *presses) + jnp.float32(rng.normal(size=(60, 15))))
    known, (at, depth), held = Presses(*(part[:30] for part in presses)), (part[30:] for part in presses), readings[30:]
    fitted = physics.fit_pad(
        known,
        jnp.float32(readings[:30]),
        tip=TIP,
        board=BOARD,
        by_force=False,
        grid=COARSE,
        max_layer_presses=16,
        linearizations=2,
    )
    # The fitted pad, pressed by the simulator, reads what the true one does.
    again = read(fitted.pad, at + fitted.layer.tip_offset[None], depth - fitted.layer.contact_offset)
    off = np.sqrt(np.mean((held - again) ** 2))
    assert off < np.sqrt(0.15) * np.sqrt(np.mean((held - held.mean(0)) ** 2))
    truth = np.asarray(pad.magnetization)
    assert np.sum((truth - fitted.pad.magnetization) ** 2) < 0.7 * np.sum(truth**2)
    assert abs(fitted.layer.thickness - pad.thickness) < 0.5e-3
    # What it says of presses left out is what it does on presses that it has not seen.
    assert 0.5 * off < np.sqrt(np.mean((readings[:30] - fitted.leave_one_out) ** 2)) < 2 * off


def test_left_out_is_what_leaving_out_gives():
    rng = np.random.default_rng(3)
    phi, y, noise = rng.normal(size=(6, 15, 20)), rng.normal(size=(6, 15)), 0.5
    whole = jax.jit(physics.bayesian_linear_regression)(jnp.float32(phi), jnp.float32(y), jnp.float32(noise))
    rows, values = phi[1:].reshape(-1, 20), y[1:].ravel()
    covariance = np.linalg.inv(np.eye(20) + rows.T @ rows / noise**2)  # of the weights, known from the others
    expected = phi[0] @ covariance @ rows.T @ values / noise**2
    np.testing.assert_allclose(whole.leave_one_out[0], expected, atol=2e-3)
    normal = stats.multivariate_normal(expected, phi[0] @ covariance @ phi[0].T + noise**2 * np.eye(15))
    np.testing.assert_allclose(whole.log_density[0], normal.logpdf(y[0]), rtol=2e-3)


def test_a_dipoles_field_is_the_textbooks_and_every_parameter_grows_with_its_coordinate():
    moment, point = np.array([0.3, -1.0, 2.0]), np.array([4e-3, -3e-3, 1e-3])
    at = np.random.default_rng(4).normal(scale=2e-3, size=(3, 2, 2))
    away = point - np.moveaxis(at, 0, -1)
    distance = np.linalg.norm(away, axis=-1, keepdims=True)
    expected = 1e-7 * (3 * away * (away @ moment)[..., None] / distance**5 - moment / distance**3)
    found = np.einsum("abij,b->ija", physics._dipole_tensor(jnp.float32(point), jnp.float32(at)), moment)
    np.testing.assert_allclose(found, expected, rtol=1e-4)

    prior = physics.layer_prior()
    low, middle, high = (
        physics.parameters_at(jax.tree.map(lambda x, step=step: jnp.full(x.shape, step), prior.std), prior)
        for step in (-1.0, 0.0, 1.0)
    )
    jax.tree.map(np.testing.assert_array_equal, middle, prior.median)
    jax.tree.map(np.testing.assert_array_less, low, middle)
    jax.tree.map(np.testing.assert_array_less, middle, high)


def test_tips_are_told_by_their_shape_and_radius():
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
        with pytest.raises(ValueError, match=f'"{wrong}" is no tip'):
            parse_tip(wrong)
