"""The ambient field: found from free poses, predicted elsewhere, and called changed no more often than it may be."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from i2t.emulators.room import RoomField, room_field
from i2t.errors import SerializationError
from i2t.skin.ambient import (
    MODELS,
    FreePoses,
    ambient_changed,
    fit_ambient,
    load_ambient,
    predict_ambient,
    save_ambient,
    subtract_ambient,
    subtract_offsets,
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


@pytest.mark.parametrize("name", ["reskin", "grid-1x1", "grid-2x2", "grid-4x4"])
def test_a_uniform_field_and_offsets_are_found_exactly_without_noise(name):
    board, rng = make_board(name), np.random.default_rng(0)
    poses, offset = turned(rng, 8), rng.normal(0.0, 300.0, board.num_readings)
    field = fit_ambient(FreePoses(poses, uniform(board, poses, EARTH, offset)[:, None]), board, model="uniform")
    np.testing.assert_allclose(field.earth, EARTH, atol=1e-6)
    np.testing.assert_allclose(board.to_board(field.offset), offset, atol=1e-6)
    new = turned(rng, 5)
    left = subtract_ambient(field, board, new, uniform(board, new, EARTH, offset))
    np.testing.assert_allclose(left, 0.0, atol=1e-6)
    alone, shared = subtract_offsets(field, board, uniform(board, new, EARTH, offset)[0])
    np.testing.assert_allclose(alone, 0.0, atol=1e-6)
    np.testing.assert_allclose(shared, new[0, :3, :3].T @ EARTH, atol=1e-6)


def test_the_rotations_of_the_chips_are_those_of_the_board():
    """One chip's x axis is another's y axis on ReSkin's board: the same field is another reading."""
    board = make_board("reskin")
    poses = turned(np.random.default_rng(1), 6)
    field = fit_ambient(FreePoses(poses, uniform(board, poses, EARTH, 0.0)[:, None]), board, model="uniform")
    chips = predict_ambient(field, board, np.eye(4))[0].reshape(5, 3)
    np.testing.assert_allclose(chips[1], [EARTH[1], -EARTH[0], EARTH[2]], atol=1e-6)
    np.testing.assert_allclose(chips[4], [-EARTH[0], -EARTH[1], EARTH[2]], atol=1e-6)


def test_iron_in_the_room_and_on_the_tool_is_found_where_it_matters():
    board, rng = make_board("reskin"), np.random.default_rng(2)
    poses, new = turned(rng, 30), turned(rng, 10)
    gains = 1 + 0.05 * rng.standard_normal(15)
    near = RoomField(iron_place=(0.4, -0.3, 0.2), iron_moment=(0.5, 0.2, -1.0))
    errors = {}
    for model in MODELS:
        free = FreePoses(poses, room(board, poses, gains, where=near)[:, None])
        field = fit_ambient(free, board, model=model)
        assert field.model == model
        errors[model] = np.abs(subtract_ambient(field, board, new, room(board, new, gains, where=near))).max()
    assert errors["both"] < 0.8 * min(errors["gradient"], errors["response"])
    assert max(errors["gradient"], errors["response"]) < errors["uniform"]


def test_terms_are_kept_only_where_left_out_poses_ask_for_them():
    board, rng = make_board("reskin"), np.random.default_rng(3)
    poses = turned(rng, 16)
    plain = fit_ambient(FreePoses(poses, measured(rng, board, uniform(board, poses, EARTH, 0.0))), board)
    assert plain.model == "uniform"
    assert not plain.gradient.any()
    assert not plain.response.any()
    assert np.isfinite(plain.left_out).all()
    gains = 1 + 0.1 * rng.standard_normal(15)
    bent = fit_ambient(FreePoses(poses, measured(rng, board, room(board, poses, gains))), board)
    assert bent.model == "response"
    at_one_place = poses.copy()
    at_one_place[:, :3, 3] = 0.3
    still = fit_ambient(FreePoses(at_one_place, measured(rng, board, room(board, at_one_place, gains))), board)
    assert np.isnan(still.left_out[[1, 3]]).all()  # no gradient can be told from one place


def test_thirty_orientations_leave_less_than_two_microtesla_with_the_noise_of_real_boards():
    board, left, raw, wrong = make_board("reskin"), [], [], []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        gains, offset = 1 + 0.05 * rng.standard_normal(15), rng.normal(0.0, 300.0, 15)
        poses, new = turned(rng, 12), turned(rng, 30)
        free = FreePoses(poses, measured(rng, board, room(board, poses, gains, offset), 200))
        field = fit_ambient(free, board)
        truth = room(board, new, gains, offset)
        read = measured(rng, board, truth, 200).mean(1)
        wrong.append(np.mean(subtract_ambient(field, board, new, truth) ** 2))
        left.append(np.mean(subtract_ambient(field, board, new, read) ** 2))
        raw.append(np.mean((read - read[0]) ** 2))
    assert np.sqrt(np.mean(wrong)) < 1.3
    assert np.sqrt(np.mean(left)) < 2.3  # 1.87 of it is the slow field, another at each pose
    assert np.sqrt(np.mean(raw)) > 25


def test_covariances_cover_what_they_say():
    board, scores, earth = make_board("reskin"), [], []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        poses, new = turned(rng, 12), turned(rng, 1)[0]
        free = FreePoses(poses, measured(rng, board, uniform(board, poses, EARTH, 0.0), 10))
        field = fit_ambient(free, board, model="uniform")
        predicted, covariance = predict_ambient(field, board, new)
        error = predicted - uniform(board, new[None], EARTH, 0.0)[0]
        scores.append(error**2 / np.diag(covariance))
        earth.append((field.earth - EARTH) ** 2 / field.earth_std**2)
    assert 0.75 < np.mean(scores) < 1.35
    assert 0.7 < np.mean(earth) < 1.5


def test_a_field_that_has_not_changed_is_seldom_called_changed():
    board, alarms, seen, chips = make_board("grid-2x2"), 0, 0, 0
    for seed in range(50):
        rng = np.random.default_rng(seed)
        poses, new = turned(rng, 12), turned(rng, 2)
        free = FreePoses(poses, measured(rng, board, uniform(board, poses, EARTH, 50.0), 10))
        field = fit_ambient(free, board, model="uniform")
        truth = uniform(board, new, EARTH, 50.0)
        read = measured(rng, board, truth, 10)
        alarms += ambient_changed(field, board, FreePoses(new, read), false_alarm=0.1).changed
        moved = read + uniform(board, new, np.array([15.0, 0.0, 0.0]), 0.0)[:, None]
        seen += ambient_changed(field, board, FreePoses(new, moved), false_alarm=0.01).changed
        jumped = read + np.eye(12)[7] * 15.0
        found = ambient_changed(field, board, FreePoses(new, jumped), false_alarm=0.01)
        chips += found.changed and found.chip == 2 and "chip 2" in found.sentence
    assert alarms <= 13  # 5 expected: four standard deviations
    assert seen > 44
    assert chips > 46


@pytest.mark.full
@pytest.mark.parametrize("share", [0.1, 0.01])
def test_the_false_alarm_rate_is_the_one_that_is_asked_for(share):
    board, alarms, tried = make_board("reskin"), 0, 1500
    for seed in range(tried):
        rng = np.random.default_rng(seed)
        poses, new = turned(rng, 12), turned(rng, 3)
        free = FreePoses(poses, measured(rng, board, uniform(board, poses, EARTH, 50.0), 10))
        field = fit_ambient(free, board, model="uniform")
        read = measured(rng, board, uniform(board, new, EARTH, 50.0), 10)
        alarms += ambient_changed(field, board, FreePoses(new, read), false_alarm=share).changed
    assert alarms <= tried * share + 3 * np.sqrt(tried * share)
    assert alarms >= tried * share - 4 * np.sqrt(tried * share)


def test_fewer_samples_than_the_fit_had_are_judged_by_their_own_noise():
    board, rng = make_board("reskin"), np.random.default_rng(5)
    poses = turned(rng, 12)
    free = FreePoses(poses, measured(rng, board, uniform(board, poses, EARTH, 0.0), 400))
    field = fit_ambient(free, board, model="uniform", burst=10)
    np.testing.assert_allclose(field.burst.chip, np.sqrt((1 - COMMON) / 10) * SIGMA, rtol=0.15)
    np.testing.assert_allclose(field.noise.chip, np.sqrt((1 - COMMON) / 400) * SIGMA, rtol=0.15)
    changed = 0
    for pose in turned(rng, 40):
        read = measured(rng, board, uniform(board, pose[None], EARTH, 0.0), 10).mean(1)
        changed += ambient_changed(field, board, FreePoses(pose[None], read[:, None]), false_alarm=0.01).changed
    assert changed <= 4


def test_chips_that_are_missing_are_left_out():
    board, rng = make_board("reskin"), np.random.default_rng(6)
    poses, offset = turned(rng, 12), rng.normal(0.0, 100.0, 15)
    read = measured(rng, board, uniform(board, poses, EARTH, offset))
    read[:, :, 6:9] = np.nan  # one never answers
    read[3, :, :3] = np.nan  # one not at this pose
    read[5, 2:, 9:12] = np.nan  # one only at times
    field = fit_ambient(FreePoses(poses, read), board)
    np.testing.assert_allclose(field.earth, EARTH, atol=4 * field.earth_std.max())
    assert np.isnan(field.offset[2]).all()
    assert np.isfinite(np.delete(field.offset, 2, axis=0)).all()
    predicted, covariance = predict_ambient(field, board, poses[0])
    assert np.isnan(predicted[6:9]).all()
    assert np.isfinite(np.delete(predicted, np.s_[6:9])).all()
    assert np.isfinite(covariance).all()
    assert not ambient_changed(field, board, FreePoses(poses[:3], read[:3]), false_alarm=0.001).changed


def test_a_field_is_kept_in_a_file(tmp_path):
    board, rng = make_board("reskin"), np.random.default_rng(7)
    poses = turned(rng, 8)
    free = FreePoses(poses, measured(rng, board, uniform(board, poses, EARTH, 0.0)))
    field = fit_ambient(free, board, model="both")
    save_ambient(tmp_path / "field.npz", field, {"skin": "A"})
    again, about = load_ambient(tmp_path / "field.npz", board)
    assert about == {"skin": "A"}
    assert again.model == "both"
    for pose in poses:
        np.testing.assert_array_equal(predict_ambient(again, board, pose)[0], predict_ambient(field, board, pose)[0])
    with pytest.raises(ValueError, match="of 5 chips, and the board has 4"):
        load_ambient(tmp_path / "field.npz", make_board("grid-2x2"))
    (tmp_path / "field.npz").write_bytes(b"damaged")
    with pytest.raises(SerializationError, match="damaged"):
        load_ambient(tmp_path / "field.npz")


def test_poses_that_tell_nothing_are_refused():
    board, rng = make_board("reskin"), np.random.default_rng(8)
    poses = turned(rng, 8)
    read = uniform(board, poses, EARTH, 0.0)[:, None]
    upright = poses.copy()
    upright[:, :3, :3] = Rotation.from_rotvec(np.linspace(0, 3, 8)[:, None] * [0, 0, 1.0]).as_matrix()
    for free, why in (
        (FreePoses(poses[:3], read[:3]), "at least 4"),
        (FreePoses(upright, read), "hardly turn"),
        (FreePoses(poses, read[:, :, :12]), "give"),
        (FreePoses(poses, np.full_like(read, np.nan)), "no readings"),
    ):
        with pytest.raises(ValueError, match=why):
            fit_ambient(free, board)
