"""The structured GP against dense algebra in double precision and on skins it should find; known data faults."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2t.calibration import (
    DEPTH_HYPERPARAMETERS,
    Presses,
    StructuredGPHyperparameters,
    check_presses,
    structured_gp,
)

CHANNELS = 15
CHIPS = np.array([[0, 0], [6, 0], [-6, 0], [0, 6], [0, -6]]) * 1e-3
fit, predict = jax.jit(structured_gp.fit), jax.jit(structured_gp.predict)
FLAT = DEPTH_HYPERPARAMETERS._replace(height_std=0.0)
EVERY = DEPTH_HYPERPARAMETERS._replace(static_variance=0.2, constant_variance=0.1, height_std=0.0)  # all terms


def presses(rng: np.random.Generator, n: int, half: float = 15e-3) -> Presses:
    return Presses(jnp.float32(rng.uniform(-half, half, (n, 2))), jnp.float32(rng.uniform(0, 4e-3, n)))


def dense(h: StructuredGPHyperparameters, a: Presses, b: Presses, chip: np.ndarray | None = None) -> np.ndarray:
    """The covariance by the formula of the module."""
    (x, d), (z, e) = (tuple(np.asarray(part, np.float64) for part in at) for at in (a, b))
    square = ((x[:, None] - z) ** 2).sum(-1)
    f = (np.outer(d + h.load_offset, e + h.load_offset) / (h.unit_load + h.load_offset) ** 2) ** h.load_power
    g = np.exp(-square / 2 / h.map_length**2)
    bent = np.exp(-square / 2 / h.bend_length**2 - (d[:, None] - e) ** 2 / 2 / h.bend_load_width**2)
    K = f * (h.map_variance * g + h.bend_variance * bent) + h.static_variance * g + h.constant_variance
    if chip is None:
        return K
    near = (np.exp(-((at - chip) ** 2).sum(1) / 2 / h.chip_reach**2) for at in (x, z))
    return K * np.outer(*(h.far_amplitude + (1 - h.far_amplitude) * one for one in near))


@pytest.mark.full
@pytest.mark.parametrize("chips", [None, CHIPS])
def test_mean_and_spread_of_a_dense_process(chips):
    rng = np.random.default_rng(0)
    known, other = presses(rng, 25), presses(rng, 10)
    readings = rng.normal(scale=50, size=(25, CHANNELS))
    process = fit(EVERY, known, jnp.float32(readings), None if chips is None else jnp.float32(chips))
    mean, std = predict(process, other)
    noise = EVERY.noise_variance + structured_gp.JITTER
    square = np.empty(CHANNELS)
    for c in range(CHANNELS):
        chip = None if chips is None else chips[c // 3]
        K, k = dense(EVERY, known, known, chip), dense(EVERY, other, known, chip)
        inverse = np.linalg.inv(K + noise * np.eye(25))
        variance = np.diag(dense(EVERY, other, other, chip) - k @ inverse @ k.T) + EVERY.noise_variance
        square[c] = readings[:, c] @ inverse @ readings[:, c]
        # float32 solves lose a condition number of digits, at most trace K / noise; weights are y / noise at most.
        loss = np.finfo(np.float32).eps * (np.trace(K) / noise + 1)
        np.testing.assert_allclose(mean[:, c], k @ inverse @ readings[:, c], atol=loss * 50 * 25 / np.sqrt(noise))
        np.testing.assert_allclose(std[:, c] / process.scale[c], np.sqrt(variance), rtol=loss / noise)
    shrunk = (square + structured_gp.SHARED_SCALE_PRESSES * square.mean() / 25) / (
        25 + structured_gp.SHARED_SCALE_PRESSES
    )
    np.testing.assert_allclose(process.scale, np.sqrt(shrunk), rtol=1e-3)


@pytest.mark.full
def test_left_out_is_what_leaving_out_gives():
    rng = np.random.default_rng(1)
    known = presses(rng, 12)
    readings = jnp.float32(rng.normal(scale=50, size=(12, CHANNELS)))
    found = jax.jit(structured_gp.leave_one_out)(EVERY, known, readings, jnp.float32(CHIPS))
    step = 0.02e-3
    for i in (0, 7):
        rest = np.arange(12) != i
        one = fit(EVERY, Presses(known.position[rest], known.load[rest]), readings[rest], jnp.float32(CHIPS))
        position = jnp.repeat(known.position[i][None], 3, 0)
        mean, std = predict(one, Presses(position, known.load[i] + step * jnp.arange(-1, 2)))
        np.testing.assert_allclose(found.mean[i], mean[1], atol=0.1)  # of 50; float32 at a condition of some 1e4
        np.testing.assert_allclose(found.std[i] / found.scale, std[1] / one.scale, rtol=5e-3)
        slope = (mean[2] - mean[0]) / (2 * step / EVERY.unit_load)
        # Rounding of two means (1e-3) over the step of 0.02 unit loads; curvature is smaller.
        np.testing.assert_allclose(found.slope[i], slope, atol=0.02 * np.abs(slope).max() + 0.2)


def skin(rng: np.random.Generator, rough: float):
    """A skin f(d) g(x) with heights of `rough` m that vary over 3 mm: a function from presses to readings."""
    position = rng.uniform(-20e-3, 20e-3, (40, 2))
    size = rng.normal(size=(40, CHANNELS))
    waves, phase = rng.normal(size=(60, 2)) / 3e-3, rng.uniform(0, 2 * np.pi, 60)

    def read(at: Presses) -> np.ndarray:
        x, d = np.float64(at.position), np.float64(at.load)
        height = rough * np.sqrt(2 / 60) * np.cos(x @ waves.T + phase).sum(1)
        g = np.exp(-((x[:, None] - position) ** 2).sum(-1) / 2 / 8e-3**2) @ size
        return 60 * g * (np.maximum(d + height + 3e-3, 0) / 5e-3)[:, None] ** 1.75

    return read


def r2(truth: np.ndarray, mean) -> float:
    return 1 - ((truth - np.asarray(mean)) ** 2).sum() / ((truth - truth.mean(0)) ** 2).sum()


@pytest.mark.parametrize("rough", [0.4e-3, 0.0])
def test_heights_help_where_there_are_any_and_do_no_harm_where_there_are_none(rough):
    rng = np.random.default_rng(3)
    read, known, other = skin(rng, rough), presses(rng, 200), presses(rng, 200)
    readings = jnp.float32(read(known) + rng.normal(size=(200, CHANNELS)))
    without, with_ = (
        r2(read(other), predict(fit(h, known, readings), other)[0]) for h in (FLAT, DEPTH_HYPERPARAMETERS)
    )
    if rough:
        assert 1 - with_ < 0.9 * (1 - without)
    else:
        # Forty bumps of 8 mm hold some (40 / 16)^2 maps' worth of independent positions: 200 presses settle them.
        assert without > 0.98
        assert with_ > without - 5e-3


def session(rng: np.random.Generator, n: int = 600) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    at = presses(rng, n)
    readings = skin(rng, 0.0)(at)
    return np.asarray(at.position), np.asarray(at.load), readings + rng.normal(size=readings.shape)


def test_sound_presses_are_not_accused():
    for seed in range(10):
        warnings = check_presses(*session(np.random.default_rng(100 + seed)))
        assert warnings.messages() == []
        assert np.isfinite(warnings.change_ratio)
    assert check_presses(*session(np.random.default_rng(0), 20)).messages() == []


def test_each_fault_of_a_recording_is_named():
    position, load, readings = session(np.random.default_rng(14))
    repeated = readings.copy()
    repeated[[5, 6, 200]] = readings[4], readings[4], readings[199]
    found = check_presses(position, load, repeated)
    np.testing.assert_array_equal(np.flatnonzero(found.repeated), [5, 6, 200])
    assert "3 rows repeat" in found.messages()[0]

    changed = readings.copy()
    changed[300:, 6:9] += 35  # as much as one chip of a real board remembered of the press before
    found = check_presses(position, load, changed)
    assert not found.changed
    assert found.changed_chips == (2,)
    assert "chip 2" in found.messages()[0]

    moved = position + np.where(np.arange(600)[:, None] < 300, 0, 0.1)  # halves at different places tell nothing
    found = check_presses(moved, load, readings)
    assert not found.changed
    assert np.isnan(found.change_ratio)


def test_a_skin_that_slips_is_found():
    rng = np.random.default_rng(12)
    at = presses(rng, 600)
    slipped = at._replace(position=at.position + jnp.where(jnp.arange(600)[:, None] < 300, 0.0, 4e-3))
    readings = skin(rng, 0.0)(slipped) + rng.normal(size=(600, CHANNELS))
    found = check_presses(np.asarray(at.position), np.asarray(at.load), readings)
    assert found.changed
    assert "slipped" in found.messages()[0]


def test_a_tip_of_steel_is_found_by_its_strength():
    position, depth, readings = session(np.random.default_rng(16), 50)
    force = 300 * depth  # up to 1.2 N
    readings *= 100 / np.median(np.linalg.norm(readings, axis=1) / force)  # uT/N, as real boards
    assert check_presses(position, force, readings, by_force=True).messages() == []
    (sentence,) = check_presses(position, force, 7 * readings, by_force=True).messages()
    assert "steel" in sentence
