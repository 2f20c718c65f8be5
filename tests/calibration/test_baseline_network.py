"""The pretrained network: its last layer against dense algebra, and what other skins are worth."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2t.calibration import Presses, baseline_network


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
