"""The pretrained network: its last layer against dense algebra, and what other skins are worth."""

import jax
import jax.numpy as jnp
import numpy as np

from i2t.calibration import Presses, baseline_network, lattice


def test_the_last_layer_is_bayesian_ridge():
    rng = np.random.default_rng(0)
    presses = Presses(jnp.float32(rng.normal(size=(12, 2))), jnp.float32(rng.uniform(size=12)))
    readings = rng.normal(scale=30, size=(12, 15))
    told = baseline_network.start(jax.random.key(0), 1.0, 1.0)._replace(noise=jnp.float32(-1.0))
    head = baseline_network.adapt(told, presses, jnp.float32(readings))
    mean, std = baseline_network.predict_network(told, head, presses)
    phi, noise = np.float64(baseline_network.features(told, presses)), np.exp(-1.0)
    system = phi @ phi.T + (noise + 1e-4) * np.eye(12)
    np.testing.assert_allclose(mean, phi @ phi.T @ np.linalg.solve(system, readings), atol=0.05)
    variance = np.diag(phi @ phi.T - phi @ phi.T @ np.linalg.solve(system, phi @ phi.T)) + noise
    np.testing.assert_allclose(std[:, 0] / head.scale, np.sqrt(variance), rtol=1e-2)
    # Presses that are not used say nothing.
    used = jnp.float32(np.arange(12) < 5)
    some = baseline_network.adapt(told, presses, jnp.float32(readings), used)
    few = baseline_network.adapt(told, Presses(presses.place[:5], presses.load[:5]), jnp.float32(readings[:5]))
    np.testing.assert_allclose(some.weights, few.weights, atol=1e-3)


def test_other_skins_help():
    presses, readings = jax.jit(lattice.skins, static_argnums=(1, 2, 3, 4))(jax.random.key(0), 24, 40, 15e-3, 4e-3)
    assert np.isfinite(readings).all()
    np.testing.assert_allclose(np.sqrt(np.mean(np.square(readings), axis=(1, 2))), 50, rtol=0.01)
    told, path = baseline_network.pretrain(
        jax.random.key(1), Presses(presses.place[4:], presses.load[4:]), readings[4:], 150, (10, 20)
    )
    assert np.mean(path[-20:]) < 0.8 * np.mean(path[:20])
    fresh = baseline_network.start(jax.random.key(1), told.half, told.unit)

    def error(one: baseline_network.Network) -> float:
        total = 0.0
        for i in range(4):  # skins that it has not seen
            known, rest = (
                Presses(presses.place[i, rows], presses.load[i, rows]) for rows in (slice(20), slice(20, 40))
            )
            head = baseline_network.adapt(one, known, readings[i, :20])
            total += float(jnp.sum((readings[i, 20:] - baseline_network.predict_network(one, head, rest)[0]) ** 2))
        return total

    assert error(told) < 0.8 * error(fresh)
