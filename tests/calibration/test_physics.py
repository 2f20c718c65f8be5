"""A pad fitted by physics: its design against the simulator, and simulated pads found again."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2t.calibration import Presses, physics
from i2t.calibration.physics import RoundTip
from i2t.skin import boards
from i2t.skin.elasticity import Grid
from i2t.skin.pad import POISSON_RATIO, press, sample_pad

COARSE = Grid(20, 32)  # a quarter of the dipoles; pads are made and fitted on the same
TIP = RoundTip("sphere", 4e-3)
BOARD = boards.reskin_board()


def simulated(seed: int, n: int) -> tuple:
    pad, rng = sample_pad(jax.random.key(seed)), np.random.default_rng(seed)
    presses = Presses(jnp.float32(rng.uniform(-7e-3, 7e-3, (n, 2))), jnp.float32(rng.uniform(0.2e-3, 0.8e-3, n)))

    def reading(position: jax.Array, depth: jax.Array) -> jax.Array:
        return press(pad, TIP.height(position, COARSE), depth, grid=COARSE).reading

    read = jax.jit(jax.vmap(reading))
    return pad, presses, read(*presses) + jnp.float32(rng.normal(size=(n, 15)))


@pytest.mark.full
@pytest.mark.parametrize(
    ("tip", "deep", "board"),
    [(RoundTip("cylinder", 2e-3), 0.2e-3, BOARD), (TIP, 0.5e-3, boards.grid_board(2, 2))],
)
def test_the_design_gives_what_the_simulator_reads(tip, deep, board):
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
    expected = press(pad, tip.height(position, COARSE), deep, grid=COARSE).reading
    designed = physics.design_matrix(layer, pad.board, tip, position, jnp.float32(deep), by_force=False, grid=COARSE)
    got = 1e3 * np.einsum("ocab,cab->o", np.float64(designed), weights)
    # Both are differences of fields a hundred times as large, in single precision.
    np.testing.assert_allclose(got, expected, atol=5e-3 * np.abs(expected).max())


@pytest.mark.full
def test_a_pad_is_found_again():
    pad, presses, readings = simulated(2, 60)
    known, held = jax.tree.map(lambda part: part[:30], (presses, readings)), readings[30:]
    other = jax.tree.map(lambda part: part[30:], presses)
    fitted = physics.fit_pad(
        *known, tip=TIP, board=BOARD, by_force=False, grid=COARSE, max_layer_presses=16, linearizations=2
    )
    mean, std = physics.predict_pad(fitted, other, tip=TIP, by_force=False, grid=COARSE)
    total = np.sum((held - jnp.mean(held, axis=0, keepdims=True)) ** 2)
    assert 1 - np.sum((held - mean) ** 2) / total > 0.85
    assert 0.75 < np.mean(np.abs(held - mean) < 1.645 * std) < 0.98
    truth = np.asarray(pad.magnetization)
    assert np.sum((truth - fitted.pad.magnetization) ** 2) < 0.7 * np.sum(truth**2)
    assert abs(fitted.layer.thickness - pad.thickness) < 4 * fitted.layer_std.thickness
    # The fitted pad, pressed by the simulator, reads what the fit says.
    again = press(fitted.pad, TIP.height(other.position[0] + fitted.layer.tip_offset, COARSE),
                  other.load[0] - fitted.layer.contact_offset, grid=COARSE).reading  # fmt: skip
    np.testing.assert_allclose(again, mean[0], atol=0.02 * np.abs(mean[0]).max())


@pytest.mark.full
def test_left_out_is_what_leaving_out_gives():
    rng = np.random.default_rng(3)
    phi, y = jnp.float32(rng.normal(size=(6, 15, 20))), jnp.float32(rng.normal(size=(6, 15)))
    whole = physics.bayesian_linear_regression(phi, y, jnp.float32(0.5))
    less = physics.bayesian_linear_regression(phi[1:], y[1:], jnp.float32(0.5))
    np.testing.assert_allclose(whole.leave_one_out[0], phi[0] @ less.weights, atol=2e-3)
    half = jax.scipy.linalg.solve_triangular(less.precision_cholesky, phi[0].T, lower=True)
    covariance = np.float64(half.T @ half + 0.25 * jnp.eye(15))
    error = np.float64(y[0] - whole.leave_one_out[0])
    density = -0.5 * (error @ np.linalg.solve(covariance, error) + np.linalg.slogdet(2 * np.pi * covariance)[1])
    np.testing.assert_allclose(whole.log_density[0], density, rtol=2e-3)
