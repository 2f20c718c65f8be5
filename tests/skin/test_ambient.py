"""The ambient field: found from free poses, predicted elsewhere, and called changed no more often than it may be."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from i2t.emulators.room import RoomField, room_field
from i2t.errors import SerializationError
from i2t.skin.ambient import (
    FreePoses,
    ambient_changed,
    fit_ambient,
    load_ambient,
    predict_ambient,
    save_ambient,
    subtract_ambient,
)
from i2t.skin.boards import make_board

SIGMA = np.array([3.1, 3.1, 4.6])  # uT, of a sample on real boards
COMMON = 0.26  # of its variance, shared by all chips


def turned(rng, count, spread=0.1):
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.random(count, random_state=int(rng.integers(1 << 30))).as_matrix()
    poses[:, :3, 3] = np.array([0.4, 0.0, 0.3]) + rng.uniform(-spread, spread, (count, 3))
    return poses


def measured(rng, board, truth, samples=20, noise=1.0):
    """Samples about true readings (p, c), their slow field another one at each pose."""
    poses, chips = len(truth), board.num_chips
    slow = np.sqrt(COMMON) * SIGMA * rng.standard_normal((poses, 1, 1, 3))
    white = np.sqrt(1 - COMMON) * np.tile(SIGMA, chips) * rng.standard_normal((poses, samples, 3 * chips))
    return truth[:, None] + noise * (white + board.to_board(np.broadcast_to(slow, (poses, 1, chips, 3))))


def uniform(board, poses, earth, offset):
    field = np.einsum("pji,j->pi", poses[:, :3, :3], earth)
    return board.to_board(np.repeat(field[:, None], board.num_chips, axis=1)) + offset


def room(board, poses, gains=1.0, offset=0.0, where=None):
    return np.stack([gains * board.to_board(room_field(where or RoomField(), board, pose)) for pose in poses]) + offset


EARTH = np.array([18.0, 7.0, 41.0])
SKIN = make_board("reskin")


def sampled(rng, board, poses, offset=0.0, samples=10):
    """Free poses in a uniform field, with noise."""
    return FreePoses(poses, measured(rng, board, uniform(board, poses, EARTH, offset), samples))


@pytest.mark.parametrize("name", ["reskin", "grid-1x1", "grid-4x4"])
def test_a_uniform_field_and_offsets_are_found_exactly_without_noise(name):
    board, rng = make_board(name), np.random.default_rng(0)
    poses, new, offset = turned(rng, 8), turned(rng, 5), rng.normal(0.0, 300.0, board.num_readings)
    field = fit_ambient(FreePoses(poses, uniform(board, poses, EARTH, offset)[:, None]), board)
    np.testing.assert_allclose(field.earth, EARTH, atol=1e-6)
    np.testing.assert_allclose(board.to_board(field.offset), offset, atol=1e-6)
    left = subtract_ambient(field, board, new, uniform(board, new, EARTH, offset))
    np.testing.assert_allclose(left, 0.0, atol=1e-6)
    if name == "reskin":  # one chip's x axis is another's y axis: the same field is another reading
        chips = (predict_ambient(field, board, np.eye(4))[0] - offset).reshape(5, 3)
        np.testing.assert_allclose(chips[1], [EARTH[1], -EARTH[0], EARTH[2]], atol=1e-6)
        np.testing.assert_allclose(chips[4], [-EARTH[0], -EARTH[1], EARTH[2]], atol=1e-6)


def test_iron_in_the_room_and_on_the_tool_is_found():
    rng = np.random.default_rng(2)
    poses, new = turned(rng, 30), turned(rng, 10)
    gains = 1 + 0.05 * rng.standard_normal(15)
    near = RoomField(iron_place=(0.4, -0.3, 0.2), iron_moment=(0.5, 0.2, -1.0))
    field = fit_ambient(FreePoses(poses, room(SKIN, poses, gains, where=near)[:, None]), SKIN)
    truth = room(SKIN, new, gains, where=near)
    none = field._replace(gradient=0 * field.gradient, response=0 * field.response)
    assert (
        np.abs(subtract_ambient(field, SKIN, new, truth)).max()
        < 0.6 * np.abs(subtract_ambient(none, SKIN, new, truth)).max()
    )


def test_thirty_orientations_leave_less_than_two_microtesla_with_the_noise_of_real_boards():
    left, raw, wrong = [], [], []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        gains, offset = 1 + 0.05 * rng.standard_normal(15), rng.normal(0.0, 300.0, 15)
        poses, new = turned(rng, 12), turned(rng, 30)
        field = fit_ambient(FreePoses(poses, measured(rng, SKIN, room(SKIN, poses, gains, offset), 200)), SKIN)
        truth = room(SKIN, new, gains, offset)
        read = measured(rng, SKIN, truth, 200).mean(1)
        wrong.append(np.mean(subtract_ambient(field, SKIN, new, truth) ** 2))
        left.append(np.mean(subtract_ambient(field, SKIN, new, read) ** 2))
        raw.append(np.mean((read - read[0]) ** 2))
    assert np.sqrt(np.mean(wrong)) < 1.3
    assert np.sqrt(np.mean(left)) < 2.3  # 1.87 of it is the slow field, another at each pose
    assert np.sqrt(np.mean(raw)) > 25


def test_covariances_cover_what_they_say():
    scores, earth = [], []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        poses, new = turned(rng, 12), turned(rng, 1)[0]
        field = fit_ambient(sampled(rng, SKIN, poses), SKIN)
        predicted, covariance = predict_ambient(field, SKIN, new)
        scores.append((predicted - uniform(SKIN, new[None], EARTH, 0.0)[0]) ** 2 / np.diag(covariance))
        earth.append((field.earth - EARTH) ** 2 / field.earth_std**2)
    assert 0.75 < np.mean(scores) < 1.35
    assert 0.7 < np.mean(earth) < 1.5


def test_a_field_and_a_chip_that_changed_are_told():
    board, seen, chips = make_board("grid-2x2"), 0, 0
    for seed in range(25):
        rng = np.random.default_rng(seed)
        poses, new = turned(rng, 12), turned(rng, 2)
        field = fit_ambient(sampled(rng, board, poses, 50.0), board)
        read = sampled(rng, board, new, 50.0).samples
        moved = read + uniform(board, new, np.array([15.0, 0.0, 0.0]), 0.0)[:, None]
        seen += ambient_changed(field, board, FreePoses(new, moved), false_alarm=0.01).changed
        found = ambient_changed(field, board, FreePoses(new, read + np.eye(12)[7] * 15.0), false_alarm=0.01)
        chips += found.changed and found.chip == 2 and "chip 2" in found.sentence
    assert seen > 21
    assert chips > 22


@pytest.mark.full
def test_the_false_alarm_rate_is_the_one_that_is_asked_for():
    tried, alarms = 150, dict.fromkeys((0.1, 0.01), 0)
    for seed in range(tried):
        rng = np.random.default_rng(seed)
        field = fit_ambient(sampled(rng, SKIN, turned(rng, 12), 50.0), SKIN)
        read = sampled(rng, SKIN, turned(rng, 3), 50.0)
        for share in alarms:
            alarms[share] += ambient_changed(field, SKIN, read, false_alarm=share).changed
    for share, found in alarms.items():
        expected = tried * share
        assert expected - 4 * np.sqrt(expected) <= found <= expected + 3 * np.sqrt(expected)


def test_fewer_samples_than_the_fit_had_are_judged_by_their_own_noise():
    rng, changed = np.random.default_rng(5), 0
    field = fit_ambient(sampled(rng, SKIN, turned(rng, 12), samples=400), SKIN, burst=10)
    np.testing.assert_allclose(field.burst.chip, np.sqrt((1 - COMMON) / 10) * SIGMA, rtol=0.15)
    np.testing.assert_allclose(field.noise.chip, np.sqrt((1 - COMMON) / 400) * SIGMA, rtol=0.15)
    for pose in turned(rng, 40):
        read = sampled(rng, SKIN, pose[None]).samples.mean(1, keepdims=True)
        changed += ambient_changed(field, SKIN, FreePoses(pose[None], read), false_alarm=0.01).changed
    assert changed <= 4


def test_chips_that_are_missing_are_left_out():
    rng = np.random.default_rng(6)
    poses = turned(rng, 12)
    read = sampled(rng, SKIN, poses, rng.normal(0.0, 100.0, 15), 20).samples
    read[:, :, 6:9] = np.nan  # one never answers
    read[3, :, :3] = np.nan  # one not at this pose
    read[5, 2:, 9:12] = np.nan  # one only at times
    field = fit_ambient(FreePoses(poses, read), SKIN)
    np.testing.assert_allclose(field.earth, EARTH, atol=4 * field.earth_std.max())
    assert np.isnan(field.offset[:, 0]).tolist() == [False, False, True, False, False]
    predicted, covariance = predict_ambient(field, SKIN, poses[0])
    assert np.flatnonzero(np.isnan(predicted)).tolist() == [6, 7, 8]
    assert np.isfinite(covariance).all()
    assert not ambient_changed(field, SKIN, FreePoses(poses[:3], read[:3]), false_alarm=0.001).changed


def test_a_field_is_kept_in_a_file(tmp_path):
    rng, path = np.random.default_rng(7), tmp_path / "field.npz"
    poses = turned(rng, 8)
    field = fit_ambient(sampled(rng, SKIN, poses), SKIN)
    save_ambient(path, field, {"skin": "A"})
    again, about = load_ambient(path, SKIN)
    assert about == {"skin": "A"}
    for pose in poses:
        np.testing.assert_array_equal(predict_ambient(again, SKIN, pose)[0], predict_ambient(field, SKIN, pose)[0])
    with pytest.raises(ValueError, match="of 5 chips, and the board has 4"):
        load_ambient(path, make_board("grid-2x2"))
    path.write_bytes(b"damaged")
    with pytest.raises(SerializationError, match="damaged"):
        load_ambient(path)


def test_poses_that_tell_nothing_are_refused():
    poses = turned(np.random.default_rng(8), 8)
    read = uniform(SKIN, poses, EARTH, 0.0)[:, None]
    upright = poses.copy()
    upright[:, :3, :3] = Rotation.from_rotvec(np.linspace(0, 3, 8)[:, None] * [0, 0, 1.0]).as_matrix()
    for free, why in (
        (FreePoses(poses[:3], read[:3]), "at least 4"),
        (FreePoses(upright, read), "hardly turn"),
        (FreePoses(poses, read[:, :, :12]), "give"),
        (FreePoses(poses, np.full_like(read, np.nan)), "no readings"),
    ):
        with pytest.raises(ValueError, match=why):
            fit_ambient(free, SKIN)
