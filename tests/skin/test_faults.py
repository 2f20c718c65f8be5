"""Faults: size zero is the identity, other sizes have their stated effect, and faults are independent."""

from dataclasses import fields, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from i2t.skin import faults
from i2t.skin.boards import reskin_board
from i2t.skin.faults import Faults
from i2t.skin.noise import Noise

BOARD = reskin_board()
N = 60
READINGS = jnp.asarray(np.random.default_rng(0).normal(size=(N, 15)) * 40, jnp.float32)
ZERO = jnp.zeros_like(READINGS)
REST = jnp.asarray(np.random.default_rng(1).normal(size=15) * 2000, jnp.float32)
ROTATIONS = Rotation.random(N, rng=np.random.default_rng(2)).as_matrix()
POSES = jnp.asarray(np.tile(np.eye(4), (N, 1, 1)), jnp.float32).at[:, :3, :3].set(jnp.asarray(ROTATIONS, jnp.float32))
GAINS = np.random.default_rng(5).normal(1, 0.05, (200, 15)).astype(np.float32)
BOARDS = [faults.board_key(gains) for gains in jnp.asarray(GAINS[:5])]
ROUNDING = 1e-5  # of a value, after some ten operations in float32
RARE = 1e-6  # probability of a false alarm in each statistical test, for random keys
SIZES = [field.name for field in fields(Faults)[:8]]
ALONE = {
    "softening": 0.1, "relaxation": 0.05, "hysteresis": 0.3, "earth": 48.0, "room": 10.0,
    "warming": 10.0, "range_xy": 2000.0, "range_z": 500.0,
}  # fmt: skip


@partial(jax.jit, static_argnames="kind")
def _recorded(key, readings, poses, board, before, kind):
    return faults.apply(key, readings, poses, BOARD, kind, key_board=board, rest=REST, presses_before=before)


def _apply(kind: Faults, seed: int = 0, *, readings=READINGS, poses=POSES, board=BOARDS[0], before=0) -> np.ndarray:
    """Record a session. Tests compare runs with the same key, whose reuse is an error, so each call makes it anew."""
    key_board = jax.random.clone(board)
    return np.asarray(_recorded(jax.random.key(seed), readings, poses, key_board, before, kind), float)


@pytest.mark.full
def test_size_zero_is_the_identity_and_each_fault_alone_changes_the_run():
    """No fault needs another one: every size is a switch of its own."""
    off = Faults(ambient_every=10)
    assert sorted(ALONE) == sorted(SIZES)
    assert not any(getattr(off, name) for name in SIZES)
    np.testing.assert_array_equal(_apply(off), READINGS)
    for name, size in ALONE.items():
        changed = _apply(replace(off, **{name: size}))
        assert np.all(np.isfinite(changed)), name
        assert np.abs(changed - READINGS).max() > 0.1, name


def test_a_used_skin_is_softer_also_over_sessions():
    worn = 1 + 0.1 * (1 - np.exp(-1))
    for presses, factor in ((0, 1), (int(faults.FAULT_MODEL.wear_presses), worn), (100_000, 1.1)):
        softened = faults.mullins_softening(READINGS[0], presses, 0.1)
        np.testing.assert_allclose(softened, factor * READINGS[0], rtol=ROUNDING)
    # Two sessions equal a single long one: each reading is softened by the presses before it.
    kind, ones = Faults(softening=0.1), jnp.ones_like(READINGS)
    both = np.concatenate([_apply(kind, readings=ones, before=before)[:, 0] for before in (0, N)])
    expected = 1 + 0.1 * (1 - np.exp(-np.arange(2 * N) / faults.FAULT_MODEL.wear_presses))
    np.testing.assert_allclose(both, expected, rtol=ROUNDING)


def test_stress_relaxes_like_maxwell_elements_and_creep_is_that_of_springs_in_series():
    """Three springs behind dashpots are integrated in time, next to one spring that does not relax."""
    size, times, decay = 0.3, np.array([0.1, 1.0, 5.0, 100.0]), -1 / np.array(faults.FAULT_MODEL.prony_times)
    arms = solve_ivp(lambda _, s: decay * s, (0, 100), np.full(3, size / 3), t_eval=times, rtol=1e-9, atol=1e-12)
    stress = 1 - size + arms.y.sum(axis=0)
    np.testing.assert_allclose([faults.remaining_stress(float(t), size) for t in times], stress, rtol=ROUNDING)
    assert faults.remaining_stress(0.0, size) == 1
    for yielding in (0.0, 0.2, 0.7, 1.0):
        # If the arm's force equals the layer's, arm (travel - d) = stress d: the share of the travel that is d.
        arm, travel = 1 - yielding, yielding
        indented = [1.0 if yielding == 0 else arm / (arm + travel * s) if arm else 1 / s for s in (1.0, stress[2])]
        grown = faults.creep(READINGS[0], 5.0, size, yielding)
        np.testing.assert_allclose(grown, READINGS[0] * (indented[1] / indented[0]), rtol=ROUNDING)
        np.testing.assert_array_equal(faults.creep(READINGS[0], 0.0, size, yielding), READINGS[0])


def test_hysteresis_adds_the_previous_press_to_one_random_chip():
    remembering = np.asarray(faults.apply_hysteresis(jax.random.key(0), READINGS, 0.3)).reshape(N, 5, 3)
    plain = np.asarray(READINGS).reshape(N, 5, 3)
    [chip] = np.unique(np.nonzero(remembering != plain)[1])
    np.testing.assert_array_equal(remembering[0], plain[0])
    expected = plain[1:, chip] + np.float32(0.3) * plain[:-1, chip]
    np.testing.assert_allclose(remembering[1:, chip], expected, rtol=ROUNDING, atol=1e-4)
    keys = jax.random.split(jax.random.key(5), 500)
    ones = jax.vmap(lambda key: faults.apply_hysteresis(key, jnp.ones((2, 15)), 1.0)[1])(keys)
    counts = np.asarray(ones - 1).reshape(500, 5, 3)[:, :, 0].sum(axis=0)
    assert counts.sum() == 500
    assert stats.chisquare(counts).pvalue > RARE


def test_the_field_of_a_place_has_the_dip_of_the_earth_and_a_random_bearing():
    def fields_of(seed, earth, room):
        keys = jax.random.split(jax.random.key(seed), 2000)
        return np.asarray(jax.vmap(lambda key: faults.ambient_field(key, earth, room))(keys), float)

    earth = fields_of(3, 48.0, 0.0)
    np.testing.assert_allclose(np.linalg.norm(earth, axis=1), 48, rtol=ROUNDING)
    np.testing.assert_allclose(earth[:, 2], -48 * np.sin(faults.FAULT_MODEL.earth_dip), rtol=ROUNDING)
    assert stats.kstest(np.arctan2(earth[:, 1], earth[:, 0]) / (2 * np.pi) % 1, "uniform").pvalue > RARE
    assert stats.kstest(fields_of(4, 0.0, 10.0).ravel() / 10, "norm").pvalue > RARE


def test_only_changes_since_the_ambient_are_left():
    values = jnp.cumsum(READINGS, axis=0)
    before = values - 1.5
    left = np.asarray(faults.subtract_ambient(values, before, 7))
    for start in range(0, N, 7):
        np.testing.assert_array_equal(left[start : start + 7], values[start : start + 7] - before[start : start + 1])
    for every, expected in ((1, values - before), (0, values - before[:1]), (N, values - before[:1])):  # 0: a session
        np.testing.assert_array_equal(faults.subtract_ambient(values, before, every), expected)


def test_the_ambient_field_turns_with_the_tool():
    kind = Faults(earth=48.0, room=10.0, ambient_every=10)
    added = np.asarray(BOARD.to_tool(_apply(kind) - READINGS), float)
    # All chips read the same vector, from which the rotations of the run determine the field up to rounding.
    np.testing.assert_allclose(added, np.broadcast_to(added[:, :1], added.shape), atol=ROUNDING * 200)
    turns = ROTATIONS.transpose(0, 2, 1)
    turns = turns - turns[np.arange(N) // 10 * 10]
    field, *_ = np.linalg.lstsq(turns.reshape(-1, 3), added[:, 0].ravel(), rcond=None)
    np.testing.assert_allclose(turns @ field, added[:, 0], atol=ROUNDING * 200)
    assert 10 < np.linalg.norm(field) < 48 + 10 * 5
    np.testing.assert_array_equal(_apply(replace(kind, ambient_every=1)), READINGS)
    np.testing.assert_array_equal(_apply(kind, poses=jnp.broadcast_to(POSES[3], POSES.shape)), READINGS)


def test_chips_warm_unevenly():
    def kelvin(touches=N, warming=10.0, *lag):
        return np.asarray(faults.temperature_drift(jax.random.key(0), touches, 5, warming, *lag))

    warmed = kelvin()
    np.testing.assert_array_equal(warmed[0], np.zeros(5))
    assert np.all(np.diff(warmed, axis=0) > 0)
    assert np.all(np.abs(warmed[-1] / (10 * (1 - np.exp(-3))) - 1) <= faults.FAULT_MODEL.warming_spread)
    assert 0 < np.ptp(warmed[-1]) <= 2.5  # kelvins between chips, as recorded
    np.testing.assert_array_equal(kelvin(1), np.zeros((1, 5)))
    np.testing.assert_array_equal(kelvin(N, 0.0), np.zeros((N, 5)))
    np.testing.assert_allclose(kelvin(N, 10.0, 1.0)[:-1], warmed[1:], rtol=ROUNDING)  # a touch later


def test_warm_magnets_are_weaker_and_drift_between_an_ambient_and_its_reading_stays():
    kelvin, offset = jnp.asarray([0.0, 1, 2, 5, 10]), jnp.linspace(-1.0, 1, 15)
    reading, drift = faults.apply_warming(READINGS[0], REST, kelvin, offset, gain=-1.2e-3, drift=0.2)
    warmer = np.repeat(np.asarray(kelvin), 3)
    np.testing.assert_allclose(reading, READINGS[0] * (1 - 1.2e-3 * warmer), rtol=ROUNDING)
    np.testing.assert_allclose(drift, warmer * (-1.2e-3 * REST + 0.2 * offset), rtol=ROUNDING, atol=1e-5)
    # An ambient at the moment of its reading removes the drift of the zero, and the weaker magnets stay.
    ratio = _apply(Faults(warming=10.0, ambient_lag=0.0)) / np.asarray(READINGS)
    np.testing.assert_array_equal(ratio[0], np.ones(15))
    assert np.all((ratio[-1] > 1 - 1.2e-2 * 1.12) & (ratio[-1] < 1 - 1.2e-2 * 0.83))
    np.testing.assert_allclose(_apply(Faults(warming=10.0, ambient_lag=0.0), readings=ZERO), ZERO, atol=1e-3)
    # However often it is measured, a fifth of the way to the next touch is left, mostly at the cold start. The drift
    # is a / b (1 - exp(-b t)): its growth in a fifth of a touch is slightly more than a fifth of that in a whole one.
    left = _apply(Faults(warming=10.0), readings=ZERO)
    step = np.diff(_apply(Faults(warming=10.0, ambient_every=0, ambient_lag=0.0), readings=ZERO), axis=0)
    ratio, b = np.linalg.norm(left[:-1], axis=1) / np.linalg.norm(step, axis=1), 3 / (N - 1)
    np.testing.assert_allclose(ratio, (1 - np.exp(-0.2 * b)) / (1 - np.exp(-b)), rtol=2e-2)  # roundings of 2000 uT
    assert np.abs(left[0]).max() > 0.2


@pytest.mark.full
def test_properties_of_a_board_stay_over_its_sessions():
    """The chip with hysteresis and the place of a board differ from those of other boards."""
    for kind in (Faults(hysteresis=0.3), Faults(earth=48.0, ambient_every=10)):
        first = _apply(kind, 3)
        np.testing.assert_array_equal(first, _apply(kind, 4))
        assert max(np.abs(_apply(kind, 3, board=board) - first).max() for board in BOARDS[1:]) > 1
    # The warming of a chip differs between sessions, but not the direction of its drift, which differs between boards.
    kind = Faults(warming=10.0, ambient_every=0)
    first, second, *others = [
        _apply(kind, seed, readings=ZERO, board=BOARDS[i])[-1] for seed, i in ((3, 0), (4, 0), (5, 1), (6, 2))
    ]
    magnets = 10 * -1.2e-3 * np.asarray(REST)  # the part of the drift that the pad's own field explains
    assert np.corrcoef(first - magnets, second - magnets)[0, 1] > 0.8
    assert np.abs(first - second).max() > 0.01
    assert max(np.linalg.norm(other - first) for other in others) > 2 * np.linalg.norm(second - first)


def test_the_converter_saturates_at_its_full_scale():
    low, high = -4915.0, 4915.0
    rest = jnp.asarray([0.0, 4900.0, 7900.0] * 4 + [6000.0, -6000.0, 0.0])
    reading = jnp.asarray([10.0, 10.0, 20.0, 6000.0, 40.0, 50.0, -6000.0, -10.0, -20.0, 0, -20000, 0, 5.0, 5.0, 9000.0])
    limited = np.asarray(faults.saturate(reading, rest))
    ends = np.tile([high, high, 7930.0], 5)
    expected = np.clip(rest + reading, -ends, ends) - np.clip(rest, -ends, ends)
    np.testing.assert_allclose(limited, expected, atol=2e-3)  # roundings of totals of 15 000
    np.testing.assert_array_equal(limited[[0, 1, 2, 7, 8]], reading[np.array([0, 1, 2, 7, 8])])  # in range: unchanged
    np.testing.assert_array_equal(limited[[12, 13]], [0, 0])  # already saturated: no change
    assert limited[6] == low
    # 16 bits of the steps recorded on real boards.
    np.testing.assert_allclose([high, 7930.0], 2**15 * Noise().steps(5)[1:3], atol=1)


@pytest.mark.full
def test_the_full_scale_limits_the_sum_of_all_other_faults():
    recorded = _apply(replace(Faults.typical(), ambient_every=10, room=1e5))
    total, ends = np.asarray(REST) + recorded, np.tile([4915.0, 4915.0, 7930.0], 5)
    assert np.all(np.abs(total) <= ends + 0.05)  # roundings of fields of thousands of uT
    assert np.mean(np.abs(total) > ends - 1) > 0.1


@pytest.mark.full
def test_typical_faults_have_the_size_of_real_ones():
    """The error is some tens of microtesla if the field turned since the ambient, and else a tenth of the reading."""
    error = np.linalg.norm(_apply(replace(Faults.typical(), ambient_every=10)) - READINGS, axis=1) / np.sqrt(15)
    assert 5 < np.median(error) < 100
    error = np.linalg.norm(_apply(Faults.typical()) - READINGS, axis=1) / np.linalg.norm(READINGS, axis=1)
    assert 0.05 < np.median(error) < 0.3


@pytest.mark.full
def test_faults_are_differentiable():
    """The derivative of a fault is finite for touches that missed, and equals a difference elsewhere."""
    kind = Faults.typical()

    def total(readings):
        key_board = jax.random.clone(BOARDS[0])
        return jnp.sum(faults.apply(jax.random.key(0), readings, POSES, BOARD, kind, key_board=key_board, rest=REST))

    assert np.all(np.isfinite(jax.jit(jax.grad(total))(READINGS.at[4].set(0.0))))
    with jax.enable_x64(True):
        here, way = np.asarray(READINGS, float), np.random.default_rng(6).normal(size=(N, 15))
        gradient, value = np.asarray(jax.jit(jax.grad(total))(here)), jax.jit(total)
        difference = (value(here + 1e-3 * way) - value(here - 1e-3 * way)) / 2e-3
    np.testing.assert_allclose(np.sum(gradient * way), difference, rtol=1e-3)  # required accuracy
