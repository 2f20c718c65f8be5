"""The pretrained network: its last layer against dense algebra, and what other skins are worth."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2t.calibration import Presses, baseline_network, lattice


@pytest.mark.full
def test_the_last_layer_is_bayesian_ridge():
    rng = np.random.default_rng(0)
    presses = Presses(jnp.float32(rng.normal(size=(12, 2))), jnp.float32(rng.uniform(size=12)))
    readings = rng.normal(scale=30, size=(12, 15))
    trained = baseline_network.init(jax.random.key(0), 1.0, 1.0)._replace(log_noise=jnp.float32(-1.0))
    head = baseline_network.fit_head(trained, presses, jnp.float32(readings))
    mean, std = baseline_network.predict(trained, head, presses)
    phi, noise = np.float64(baseline_network.features(trained, presses)), np.exp(-1.0)
    system = phi @ phi.T + (noise + 1e-4) * np.eye(12)
    np.testing.assert_allclose(mean, phi @ phi.T @ np.linalg.solve(system, readings), atol=0.05)
    variance = np.diag(phi @ phi.T - phi @ phi.T @ np.linalg.solve(system, phi @ phi.T)) + noise
    np.testing.assert_allclose(std[:, 0] / head.scale, np.sqrt(variance), rtol=1e-2)
    # Presses that are not used say nothing.
    used = jnp.float32(np.arange(12) < 5)
    some = baseline_network.fit_head(trained, presses, jnp.float32(readings), used)
    few = baseline_network.fit_head(trained, Presses(presses.position[:5], presses.load[:5]), jnp.float32(readings[:5]))
    np.testing.assert_allclose(some.weights, few.weights, atol=1e-3)


@pytest.mark.full
def test_other_skins_help():
    presses, readings = jax.jit(lambda key: lattice.sample_skins(key, 24, 40, half_edge=15e-3, max_depth=4e-3))(
        jax.random.key(0)
    )
    assert np.isfinite(readings).all()
    np.testing.assert_allclose(np.sqrt(np.mean(np.square(readings), axis=(1, 2))), 50, rtol=0.01)
    trained, path = baseline_network.pretrain(
        jax.random.key(1), Presses(presses.position[4:], presses.load[4:]), readings[4:], steps=150, counts=(10, 20)
    )
    assert np.mean(path[-20:]) < 0.8 * np.mean(path[:20])
    fresh = baseline_network.init(jax.random.key(1), trained.max_position, trained.unit_load)

    def error(one: baseline_network.PressFeatures) -> float:
        total = 0.0
        for i in range(4):  # skins that it has not seen
            known, rest = (
                Presses(presses.position[i, rows], presses.load[i, rows]) for rows in (slice(20), slice(20, 40))
            )
            head = baseline_network.fit_head(one, known, readings[i, :20])
            total += float(jnp.sum((readings[i, 20:] - baseline_network.predict(one, head, rest)[0]) ** 2))
        return total

    assert error(trained) < 0.8 * error(fresh)
