"""Estimation of an unknown board from presses, and its place in messages and files."""

import numpy as np
import pytest

from i2t.skin.boards import anyskin_board, grid_board, reskin_board
from i2t.skin_models import Calibration, calibrate, load_calibration
from i2t.skin_models.tip_gp.candidates import board_candidates

QUARTER = np.array([[0.0, -1.0], [1.0, 0.0]])


def pressed(chips: np.ndarray, n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Make presses whose signal falls with the distance from its chip, over 5 mm."""
    rng = np.random.default_rng(seed)
    position, force = rng.uniform(-8e-3, 8e-3, (n, 2)), rng.uniform(0.2, 1.5, n)
    waves, phase = np.random.default_rng(99).normal(size=(40, 2)) / 4e-3, np.linspace(0, 6, 40)
    size = np.random.default_rng(98).normal(size=(40, 3 * len(chips)))
    near = np.exp(-((position[:, None] - chips) ** 2).sum(-1) / 2 / 5e-3**2).repeat(3, axis=1)
    readings = 20 * near * force[:, None] * (np.cos(position @ waves.T + phase) @ size)
    return position, force, readings + rng.normal(size=readings.shape)


def chips_of(board) -> np.ndarray:
    return np.asarray(board.chips[:, :2], np.float64)


@pytest.mark.parametrize(
    ("chips", "name"),
    [
        (chips_of(reskin_board()), "reskin"),
        (chips_of(anyskin_board()), "anyskin"),
        (chips_of(reskin_board()) @ QUARTER.T, "reskin turned by 90 degrees"),
        (chips_of(grid_board(2, 2)), "grid-2x2"),
    ],
)
def test_the_board_is_found_by_where_each_chip_reads(chips, name):
    position, _, readings = pressed(chips, 30)
    candidates = board_candidates(position, readings)
    assert next(iter(candidates)) == name
    assert len(candidates) <= 2
    np.testing.assert_allclose(candidates[name], chips, atol=1e-9)


def test_readings_of_an_unknown_board_or_from_one_place_have_no_candidate():
    rng = np.random.default_rng(0)
    for spread, channels in ((1, 14), (1, 30), (0, 15)):
        assert board_candidates(spread * rng.normal(size=(20, 2)), rng.normal(size=(20, channels))) == {}


@pytest.fixture(scope="module")
def given_board() -> Calibration:
    return calibrate(*pressed(chips_of(reskin_board()), 40), load_kind="force", board=reskin_board())


def test_an_unknown_board_is_chosen_and_named(given_board, tmp_path):
    model = calibrate(*pressed(chips_of(reskin_board()), 40), load_kind="force")
    shares = model.board_shares
    assert shares["reskin"] == max(shares.values()) > 0.5
    assert sum(shares.values()) == pytest.approx(1)
    assert "board reskin by evidence" in repr(model)
    model.save(tmp_path / "skin.npz")
    again = load_calibration(tmp_path / "skin.npz")
    assert again.board_shares == shares
    position, force, readings = pressed(chips_of(reskin_board()), 60, seed=1)
    mean, _ = model.predict(position, force)
    np.testing.assert_allclose(again.predict(position, force)[0], mean, rtol=1e-6)
    # The predictions are as good as those with the given board.
    missed = [((estimate - readings) ** 2).sum() for estimate in (mean, given_board.predict(position, force)[0])]
    assert missed[0] < 1.05 * missed[1]


def test_a_given_board_is_tried_alone_and_may_be_overruled():
    wrong = calibrate(*pressed(chips_of(reskin_board()), 40), load_kind="force", board=anyskin_board())
    assert set(wrong.board_shares) == {"none", "the given board"}
    assert wrong.board_shares["none"] > 0.5
