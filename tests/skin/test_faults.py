"""Faults: off is the identity, on does what its size says, and none disturbs another."""

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
from i2t.types import Board

BOARD = reskin_board()
N = 60
READINGS = jnp.asarray(np.random.default_rng(0).normal(size=(N, 15)) * 40, jnp.float32)
REST = jnp.asarray(np.random.default_rng(1).normal(size=15) * 2000, jnp.float32)
ROTATIONS = Rotation.random(N, rng=np.random.default_rng(2)).as_matrix()
POSES = jnp.asarray(np.tile(np.eye(4), (N, 1, 1)), jnp.float32).at[:, :3, :3].set(jnp.asarray(ROTATIONS, jnp.float32))
ROUNDING = 1e-5  # of a value, after some ten operations in float32

ALONE = [
    Faults(softening=0.1),
    Faults(relaxation=0.05),
    Faults(hysteresis=0.3),
    Faults(ferrous=7.0),
    Faults(earth=48.0, ambient_every=10),
    Faults(room=10.0, ambient_every=10),
    Faults(warming=10.0),
    Faults(gain=0.05),
    Faults(range_xy=2000.0),
    Faults(range_z=500.0),
    Faults(dead=1),
    Faults(stale=0.2),
]


@partial(jax.jit, static_argnames="kind")
def _recorded(key, readings, poses, board, before, kind):
    again = jax.random.clone(board)
    felt = faults.apply(key, readings, poses, BOARD, kind, key_board=board, rest=REST, presses_before=before)
    return faults.record(jax.random.key(77), felt, kind, key_board=again)


def _board_key() -> jax.Array:
    """Of the board of most tests."""
    return faults.board_key(jnp.asarray(np.linspace(0.9, 1.1, 15, dtype=np.float32)))  # to the bit, also inside of jit


def _key(seed: int = 0) -> jax.Array:
    """A new key of the same numbers: tests compare runs of one key, whose reuse is an error."""
    return jax.random.key(seed)


def _apply(kind: Faults, key=None, readings=READINGS, poses=POSES, *, board=None, before: int = 0) -> np.ndarray:
    board = _board_key() if board is None else jax.random.clone(board)
    return np.asarray(_recorded(_key() if key is None else key, readings, poses, board, before, kind))


def _sizes(kind: Faults) -> list[str]:
    return [field.name for field in fields(kind)[:12] if getattr(kind, field.name) != 0]


@pytest.mark.full
def test_off_is_the_identity():
    assert _sizes(Faults()) == []
    np.testing.assert_array_equal(_apply(Faults()), READINGS)
    np.testing.assert_array_equal(
        _apply(Faults(ambient_every=10, presses_before=500, hold_time=60.0, layer_share=1.0)), READINGS
    )
    off = faults.apply(_key(), READINGS, POSES, BOARD, Faults(), key_board=_board_key())
    np.testing.assert_array_equal(off, READINGS)


@pytest.mark.parametrize("kind", ALONE, ids=lambda kind: _sizes(kind)[0])
def test_each_alone_changes_the_run(kind):
    """And none needs another: every size has its own switch."""
    changed = _apply(kind)
    assert np.all(np.isfinite(changed))
    assert np.abs(changed - READINGS).max() > 0.1
    assert len(_sizes(kind)) == 1


def test_every_size_is_tried_alone():
    assert sorted(name for kind in ALONE for name in _sizes(kind)) == sorted(f.name for f in fields(Faults)[:12])


@pytest.mark.full
def test_a_used_skin_is_softer():
    reading = READINGS[0]
    np.testing.assert_array_equal(faults.mullins_softening(reading, 0, 0.1), reading)
    np.testing.assert_allclose(faults.mullins_softening(reading, 100_000, 0.1), 1.1 * reading, rtol=ROUNDING)
    one = 1 + 0.1 * (1 - np.exp(-1))
    np.testing.assert_allclose(
        faults.mullins_softening(reading, int(faults.WEAR_PRESSES), 0.1), one * reading, rtol=ROUNDING
    )
    later = _apply(Faults(softening=0.1, presses_before=100_000))
    np.testing.assert_allclose(later, 1.1 * READINGS, rtol=ROUNDING)


def test_stress_relaxes_as_maxwell_elements_do():
    """Three springs behind dashpots, integrated in time, beside one spring that holds."""
    size, times = 0.3, np.array([0.1, 1.0, 10.0, 100.0])
    arms = solve_ivp(
        lambda _, s: -s / np.array(faults.PRONY_TIMES_S),
        (0, 100),
        np.full(3, size / 3),
        t_eval=times,
        rtol=1e-9,
        atol=1e-12,
    )
    left = [faults.stress_left(float(t), size) for t in times]
    np.testing.assert_allclose(left, 1 - size + arms.y.sum(axis=0), rtol=ROUNDING)
    assert faults.stress_left(0.0, size) == 1


@pytest.mark.parametrize("yielding", [0.0, 0.2, 0.7, 1.0])
def test_creep_is_that_of_springs_in_series(yielding):
    size, seconds, travel = 0.3, 5.0, 1e-3
    layer = 1.0
    left = float(faults.stress_left(seconds, size))

    def indentation(stress: float) -> float:
        """Where the arm's force equals the layer's: arm (travel - d) = layer stress d."""
        if yielding == 0:
            return travel
        if yielding == 1:
            return 1e-3 / (layer * stress)  # a held force
        arm = layer * (1 - yielding) / yielding
        return arm * travel / (arm + layer * stress)

    grown = faults.creep(READINGS[0], seconds, size, yielding)
    np.testing.assert_allclose(grown, READINGS[0] * indentation(left) / indentation(1.0), rtol=ROUNDING)
    np.testing.assert_array_equal(faults.creep(READINGS[0], 0.0, size, yielding), READINGS[0])


def test_one_chip_remembers_the_press_before():
    remembering = np.asarray(faults.apply_hysteresis(_key(), READINGS, 0.3)).reshape(N, 5, 3)
    plain = np.asarray(READINGS).reshape(N, 5, 3)
    [chip] = np.unique(np.nonzero(remembering != plain)[1])
    np.testing.assert_array_equal(remembering[0], plain[0])
    expected = plain[1:, chip] + np.float32(0.3) * plain[:-1, chip]
    np.testing.assert_allclose(remembering[1:, chip], expected, rtol=ROUNDING, atol=1e-4)
    np.testing.assert_array_equal(np.delete(remembering, chip, axis=1), np.delete(plain, chip, axis=1))


def test_the_remembering_chip_is_any():
    keys = jax.random.split(jax.random.key(5), 500)
    ones = jax.vmap(lambda key: faults.apply_hysteresis(key, jnp.ones((2, 15)), 1.0)[1])(keys)
    counts = np.asarray(ones - 1).reshape(500, 5, 3)[:, :, 0].sum(axis=0)
    assert counts.sum() == 500
    assert stats.chisquare(counts).pvalue > 1e-6


def test_a_steel_ball_leaves_no_field_along_its_surface():
    """Outside a highly permeable ball the field stands on its surface: induced and uniform field cancel along it."""
    normals = np.random.default_rng(4).normal(size=(5, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    place, radius, uniform = np.array([1e-3, -2e-3, 3e-3]), 2e-3, np.array([30.0, -10.0, 45.0])
    around = Board(
        jnp.asarray(place + radius * normals, jnp.float32), jnp.asarray(np.tile(np.eye(3), (5, 1, 1)), jnp.float32)
    )
    extra = faults.induced(jnp.asarray(place, jnp.float32), jnp.asarray(uniform, jnp.float32), radius, around)
    total = np.asarray(around.to_tool(extra)) + uniform
    # Places are rounded to 2e-10 m, 1e-7 of the radius, and a dipole's field changes three times as fast.
    np.testing.assert_allclose(np.cross(normals, total), np.zeros((5, 3)), atol=1e-5 * np.linalg.norm(uniform))
    np.testing.assert_allclose(np.sum(total * normals, axis=1), 3 * normals @ uniform, atol=1e-4 * 55)


def test_a_steel_tip_multiplies_the_touch():
    one, two = (faults.ferrous(x, jnp.asarray([1.0, -2, 0.5]), BOARD, 7.0) - x for x in (READINGS[0], READINGS[1]))
    norms = np.linalg.norm(READINGS[:2], axis=1)
    np.testing.assert_allclose([np.linalg.norm(one), np.linalg.norm(two)], 7 * norms, rtol=10 * ROUNDING)
    np.testing.assert_allclose(one / norms[0], two / norms[1], atol=ROUNDING * 7)  # one pattern, that of the ball
    ball = faults.induced(jnp.asarray([0, 0, 1e-3]), jnp.asarray([2.0, -4, 1]), 1e-3, BOARD)
    np.testing.assert_allclose(np.dot(one, ball), np.linalg.norm(one) * np.linalg.norm(ball), rtol=10 * ROUNDING)
    assert np.argmax(np.linalg.norm(one.reshape(5, 3), axis=1)) == 0  # the chip below the tip


def test_the_field_of_a_place():
    earth = np.asarray(
        jax.vmap(lambda key: faults.ambient_field(key, 48.0, 0.0))(jax.random.split(_key(3), 4000)), float
    )
    np.testing.assert_allclose(np.linalg.norm(earth, axis=1), 48, rtol=ROUNDING)
    np.testing.assert_allclose(earth[:, 2], -48 * np.sin(faults.EARTH_DIP_RAD), rtol=ROUNDING)
    bearing = np.arctan2(earth[:, 1], earth[:, 0]) / (2 * np.pi) % 1
    assert stats.kstest(bearing, "uniform").pvalue > 1e-6
    room = np.asarray(
        jax.vmap(lambda key: faults.ambient_field(key, 0.0, 10.0))(jax.random.split(_key(4), 4000)), float
    )
    assert stats.kstest(room.ravel() / 10, "norm").pvalue > 1e-6


def test_the_world_s_field_turns_with_the_tool():
    field = jnp.asarray([10.0, -20.0, 40.0])
    upright = np.asarray(BOARD.to_tool(faults.ambient(jnp.eye(4).at[:3, 3].set(0.5), field, BOARD)))
    np.testing.assert_allclose(upright, np.tile(field, (5, 1)), rtol=ROUNDING)  # one vector, wherever the tool is
    for pose, rotation in zip(POSES[:5], ROTATIONS, strict=False):
        seen = BOARD.to_tool(faults.ambient(pose, field, BOARD))
        np.testing.assert_allclose(seen, np.tile(rotation.T @ np.asarray(field), (5, 1)), atol=ROUNDING * 50)


def test_only_what_changed_since_the_ambient_is_left():
    values = jnp.cumsum(READINGS, axis=0)
    np.testing.assert_array_equal(faults.subtract_ambient(values, values, 1), np.zeros((N, 15)))
    before = values - 1.5
    np.testing.assert_array_equal(faults.subtract_ambient(values, before, 1), values - before)
    left = np.asarray(faults.subtract_ambient(values, before, 7))
    for start in range(0, N, 7):
        np.testing.assert_array_equal(left[start : start + 7], values[start : start + 7] - before[start : start + 1])
    np.testing.assert_array_equal(faults.subtract_ambient(values, before, 0), values - before[:1])  # once a session
    np.testing.assert_array_equal(faults.subtract_ambient(values, before, N), values - before[:1])


@pytest.mark.full
def test_the_world_s_field_in_a_run():
    kind = Faults(earth=48.0, room=10.0, ambient_every=10)
    added = np.asarray(BOARD.to_tool(_apply(kind) - READINGS), float)
    # The same vector on every chip, of which the run's rotations tell the field: what is left over is rounding.
    np.testing.assert_allclose(added, np.broadcast_to(added[:, :1], added.shape), atol=ROUNDING * 200)
    turns = ROTATIONS.transpose(0, 2, 1)
    turns = turns - turns[np.arange(N) // 10 * 10]
    field, *_ = np.linalg.lstsq(turns.reshape(-1, 3), added[:, 0].ravel(), rcond=None)
    np.testing.assert_allclose(turns @ field, added[:, 0], atol=ROUNDING * 200)
    assert 10 < np.linalg.norm(field) < 48 + 10 * 5
    np.testing.assert_array_equal(_apply(replace(kind, ambient_every=1)), READINGS)
    still = jnp.broadcast_to(POSES[3], POSES.shape)
    np.testing.assert_array_equal(_apply(kind, poses=still), READINGS)


def test_chips_warm_unevenly():
    kelvin = np.asarray(faults.temperature_drift(_key(), N, 5, 10.0))
    np.testing.assert_array_equal(kelvin[0], np.zeros(5))
    assert np.all(np.diff(kelvin, axis=0) > 0)
    end = 10 * (1 - np.exp(-3))
    assert np.all(np.abs(kelvin[-1] / end - 1) <= faults.WARMING_SPREAD)
    assert 0 < np.ptp(kelvin[-1]) <= 2.5  # kelvins apart, as recorded
    np.testing.assert_array_equal(faults.temperature_drift(_key(), 1, 5, 10.0), np.zeros((1, 5)))
    np.testing.assert_array_equal(faults.temperature_drift(_key(), N, 5, 0.0), np.zeros((N, 5)))
    later = np.asarray(faults.temperature_drift(_key(), N, 5, 10.0, 1.0))
    np.testing.assert_allclose(later[:-1], kelvin[1:], rtol=ROUNDING)  # a touch later


@pytest.mark.full
def test_warm_magnets_are_weaker():
    kelvin, offset = jnp.asarray([0.0, 1, 2, 5, 10]), jnp.linspace(-1.0, 1, 15)
    reading, drift = faults.apply_warming(READINGS[0], REST, kelvin, offset, gain=-1.2e-3, drift=0.2)
    warmer = np.repeat(np.asarray(kelvin), 3)
    np.testing.assert_allclose(reading, READINGS[0] * (1 - 1.2e-3 * warmer), rtol=ROUNDING)
    np.testing.assert_allclose(drift, warmer * (-1.2e-3 * REST + 0.2 * offset), rtol=ROUNDING, atol=1e-5)
    # An ambient at the moment of its reading takes the drift of the zero away, and the weaker magnets stay.
    ratio = _apply(Faults(warming=10.0, ambient_lag=0.0)) / np.asarray(READINGS)
    np.testing.assert_array_equal(ratio[0], np.ones(15))
    assert np.all((ratio[-1] > 1 - 1.2e-2 * 1.12) & (ratio[-1] < 1 - 1.2e-2 * 0.83))
    drifted = _apply(Faults(warming=10.0, ambient_every=0)) - _apply(Faults(warming=10.0))
    assert np.abs(drifted[-1]).max() > 10  # 10 K of 0.12 % of some 2000 uT


def test_what_drifts_between_an_ambient_and_its_reading_stays():
    """However often the ambient is measured: a fifth of the way to the next touch, most at the cold start."""
    zero = jnp.zeros_like(READINGS)
    left = _apply(Faults(warming=10.0), readings=zero)
    whole = _apply(Faults(warming=10.0, ambient_every=0, ambient_lag=0.0), readings=zero)
    step = np.diff(whole, axis=0)  # of the drift, from touch to touch
    # The drift is a / b (1 - exp(-b t)): its growth in a fifth of a touch is a fifth of that in one, and a little more.
    ratio = np.linalg.norm(left[:-1], axis=1) / np.linalg.norm(step, axis=1)
    b = 3 / (N - 1)
    np.testing.assert_allclose(ratio, (1 - np.exp(-0.2 * b)) / (1 - np.exp(-b)), rtol=2e-2)  # roundings of 2000 uT
    assert np.abs(left[0]).max() > 0.2
    np.testing.assert_allclose(_apply(Faults(warming=10.0, ambient_lag=0.0), readings=zero), zero, atol=1e-3)


BOARDS = [
    faults.board_key(gains) for gains in jnp.asarray(np.random.default_rng(5).normal(1, 0.05, (4, 15)), jnp.float32)
]


@pytest.mark.parametrize(
    "kind",
    [Faults(hysteresis=0.3), Faults(gain=0.05), Faults(dead=3), Faults(earth=48.0, room=10.0, ambient_every=10)],
    ids=lambda kind: _sizes(kind)[0],
)
def test_what_belongs_to_a_board_stays_over_its_sessions(kind):
    """The chip that remembers, gains, dead axes and where the board is used; other boards have others."""
    first, second = (_apply(kind, _key(seed)) for seed in (3, 4))
    np.testing.assert_array_equal(first, second)
    others = [_apply(kind, _key(3), board=board) for board in BOARDS]
    assert np.abs(np.stack(others) - first).max() > 1


def test_chips_drift_their_way_in_every_session():
    """How warm each gets differs, which way it drifts does not: correlated over sessions, and not over boards."""
    still = jnp.zeros_like(READINGS)
    kind = Faults(warming=10.0, ambient_every=0)
    one, two, *others = [
        _apply(kind, _key(seed), readings=still, board=board)[-1]
        for seed, board in ((3, BOARDS[0]), (4, BOARDS[0]), (5, BOARDS[1]), (6, BOARDS[2]))
    ]
    magnets = 10 * -1.2e-3 * np.asarray(REST)  # the part of the drift that the pad's own field explains
    assert np.corrcoef(one - magnets, two - magnets)[0, 1] > 0.8
    assert np.abs(one - two).max() > 0.01
    assert max(np.linalg.norm(other - one) for other in others) > 2 * np.linalg.norm(two - one)


def test_boards_are_told_apart_by_their_gains():
    gains = np.random.default_rng(5).normal(1, 0.05, (200, 15)).astype(np.float32)
    gains[1] = gains[0, ::-1]
    keys = np.asarray(jax.vmap(lambda each: jax.random.key_data(faults.board_key(each)))(jnp.asarray(gains)))
    assert len(np.unique(keys, axis=0)) == 200
    np.testing.assert_array_equal(jax.random.key_data(faults.board_key(jnp.asarray(gains[0]))), keys[0])


def test_softening_goes_on_over_sessions():
    """Two sessions are one long one: each reading is softer by the presses before it."""
    kind, ones = Faults(softening=0.1), jnp.ones_like(READINGS)
    both = np.concatenate([_apply(kind, readings=ones, before=before)[:, 0] for before in (0, N)])
    expected = 1 + 0.1 * (1 - np.exp(-np.arange(2 * N) / faults.WEAR_PRESSES))
    np.testing.assert_allclose(both, expected, rtol=ROUNDING)


def test_gains_spread_as_asked():
    found = np.asarray(jax.vmap(lambda key: faults.gains(key, 15, 0.05))(jax.random.split(_key(), 1000))) - 1
    assert np.abs(found).max() <= 0.15 + 1e-6
    assert stats.kstest(found.ravel() / 0.05, stats.truncnorm(-3, 3).cdf).pvalue > 1e-6
    ratio = _apply(Faults(gain=0.05)) / np.asarray(READINGS)
    np.testing.assert_allclose(ratio, np.broadcast_to(ratio[:1], ratio.shape), rtol=ROUNDING)  # one set for the run


def test_the_converter_ends_at_its_full_scale():
    low, high = -4915.0, 4915.0
    rest = jnp.asarray([0.0, 4900.0, 7900.0] * 4 + [6000.0, -6000.0, 0.0])
    reading = jnp.asarray([10.0, 10.0, 20.0, 6000.0, 40.0, 50.0, -6000.0, -10.0, -20.0, 0, -20000, 0, 5.0, 5.0, 9000.0])
    found = np.asarray(faults.saturate(reading, rest))
    ends = np.tile([high, high, 7930.0], 5)
    expected = np.clip(rest + reading, -ends, ends) - np.clip(rest, -ends, ends)
    np.testing.assert_allclose(found, expected, atol=2e-3)  # roundings of totals of 15 000
    np.testing.assert_array_equal(found[[0, 1, 2, 7, 8]], reading[np.array([0, 1, 2, 7, 8])])  # in range: left as it is
    np.testing.assert_array_equal(found[[12, 13]], [0, 0])  # already beyond: stuck
    assert found[6] == low
    np.testing.assert_array_equal(faults.saturate(reading, rest, 0.0, 0.0), reading)
    # 16 bits of the steps recorded on real boards.
    np.testing.assert_allclose([high, 7930.0], 2**15 * Noise().steps(5)[1:3], atol=1)


@pytest.mark.full
def test_dead_axes_stay_dead_and_the_others_alive():
    for count in (0, 1, 4, 15):
        recorded = _apply(Faults(dead=count))
        gone = np.all(recorded == 0, axis=0)
        assert gone.sum() == count
        np.testing.assert_array_equal(recorded[:, ~gone], READINGS[:, ~gone])
    often = np.asarray(jax.vmap(lambda key: faults.dead_axes(key, 15, 2))(jax.random.split(_key(), 3000))).sum(axis=0)
    assert stats.chisquare(often).pvalue > 1e-6


def test_stale_rows_repeat_the_recorded_one():
    n, size = 5000, 0.2
    rows = jnp.broadcast_to(jnp.arange(n, dtype=jnp.float32)[:, None], (n, 15))
    recorded = np.asarray(faults.stale_rows(_key(), rows, size))[:, 0]
    assert recorded[0] == 0
    own, repeated = recorded[1:] == np.arange(1, n), recorded[1:] == recorded[:-1]
    assert np.all(own ^ repeated)
    assert abs(repeated.mean() - size) < 5 * np.sqrt(size * (1 - size) / n)
    np.testing.assert_array_equal(faults.stale_rows(_key(), rows, 1.0), np.zeros((n, 15)))


@pytest.mark.full
def test_faults_do_not_disturb_one_another_s_draws():
    """Which axes are dead, which rows stale and which chip remembers stays the same when others are switched on."""
    every = replace(Faults.typical(), ferrous=7.0, gain=0.05)
    dead = np.all(_apply(Faults(dead=3)) == 0, axis=0)
    np.testing.assert_array_equal(np.all(_apply(replace(every, dead=3)) == 0, axis=0), dead)
    stale = np.all(np.diff(_apply(Faults(stale=0.2)), axis=0) == 0, axis=1)
    assert stale.any()
    np.testing.assert_array_equal(np.all(np.diff(_apply(replace(every, stale=0.2)), axis=0) == 0, axis=1), stale)


@pytest.mark.full
def test_they_compose_in_the_order_of_physics():
    """A dead axis does not feel the earth, gains act on its field, and a full scale ends all of it."""
    kind = Faults(earth=48.0, ambient_every=10, gain=0.2)
    gains = _apply(Faults(gain=0.2)) / np.asarray(READINGS)
    np.testing.assert_allclose(
        _apply(kind), gains * _apply(replace(kind, gain=0.0)), atol=1e-2
    )  # of gains of small ones
    recorded = _apply(replace(Faults.typical(), ambient_every=10, ferrous=1e3, dead=2))
    total = np.asarray(REST) + recorded
    ends = np.tile([4915.0, 4915.0, 7930.0], 5)
    assert np.all(np.abs(total) <= ends + 0.05)  # roundings of fields of up to 150 000 uT
    assert np.mean(np.abs(total) > ends - 1) > 0.1


@pytest.mark.full
def test_typical_boards_are_wrong_by_what_was_seen():
    """Some tens of microtesla where the field turned since the ambient, a tenth of the reading where it could not."""
    error = np.linalg.norm(_apply(replace(Faults.typical(), ambient_every=10)) - READINGS, axis=1) / np.sqrt(15)
    assert 5 < np.median(error) < 100
    error = np.linalg.norm(_apply(Faults.typical()) - READINGS, axis=1) / np.linalg.norm(READINGS, axis=1)
    assert 0.05 < np.median(error) < 0.3
    assert set(_sizes(Faults.typical())) == {
        "softening",
        "relaxation",
        "hysteresis",
        "earth",
        "room",
        "warming",
        "range_xy",
        "range_z",
    }


@pytest.mark.full
def test_runs_of_a_batch_are_independent():
    kind = replace(Faults.typical(), gain=0.05, dead=1, stale=0.1)
    run = jax.jit(jax.vmap(lambda key: _recorded(key, READINGS, POSES, _board_key(), 0, kind)))
    together = np.asarray(run(jax.random.split(_key(9), 3)))
    for key, one in zip(jax.random.split(_key(9), 3), together, strict=True):
        np.testing.assert_allclose(_apply(kind, key), one, atol=5e-3)  # roundings of drifts of fields of 5000 uT
    assert np.abs(together[0] - together[1]).max() > 0.1  # how long touches are held, how the chips warm
    np.testing.assert_array_equal(_apply(kind, _key(7)), _apply(kind, _key(7)))


@pytest.mark.full
def test_readings_can_be_fitted_through_faults():
    """The derivative of a fault is finite where a touch missed, and equals a difference elsewhere."""
    kind = replace(Faults.typical(), ferrous=1.0, gain=0.05)

    def total(readings):
        return jnp.sum(faults.apply(_key(), readings, POSES, BOARD, kind, key_board=_board_key(), rest=REST))

    assert np.all(np.isfinite(jax.jit(jax.grad(total))(READINGS.at[4].set(0.0))))
    with jax.enable_x64(True):
        here, way = np.asarray(READINGS, float), np.random.default_rng(6).normal(size=(N, 15))
        gradient = np.asarray(jax.jit(jax.grad(total))(here))
        value = jax.jit(total)
        difference = (value(here + 1e-3 * way) - value(here - 1e-3 * way)) / 2e-3
    np.testing.assert_allclose(np.sum(gradient * way), difference, rtol=1e-3)  # the figure asked
