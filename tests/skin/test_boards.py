"""Boards: their chips, and pads, noise and faults on any of them."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2t.collect.stopping import nonuniform_field
from i2t.skin import faults
from i2t.skin.boards import (
    BOARDS,
    board_note,
    eflesh_board,
    grid_board,
    make_board,
    name_of_board,
    silent_chips,
    without_silent_chips,
)
from i2t.skin.faults import Faults
from i2t.skin.files import load_pad, save_pad
from i2t.skin.noise import Noise, add_sensor_noise
from i2t.skin.pad import press, sample_pad
from i2t.types import Board


@pytest.mark.parametrize("name", [*BOARDS, "grid-2x3"])
def test_turning_to_the_tool_and_back_is_the_identity(name):
    board = make_board(name)
    assert name_of_board(board) == name
    readings = np.random.default_rng(0).normal(size=(2, board.num_readings))
    field = board.to_tool(readings)
    assert field.shape == (2, board.num_chips, 3)
    np.testing.assert_allclose(board.to_board(field), readings, rtol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(field), np.linalg.norm(readings), rtol=1e-6)


def test_a_grid_has_a_chip_below_the_middle_of_each_cell():
    chips = make_board("grid-2x2").chips
    assert len(np.unique(chips, axis=0)) == 4
    np.testing.assert_allclose(np.abs(chips[:, :2]), 5e-3, rtol=1e-6)
    np.testing.assert_allclose(chips[:2, 1], -5e-3, rtol=1e-6)  # rows along y come first
    np.testing.assert_allclose(grid_board(1, 3, 2e-3, 4e-3).chips, [[-2e-3, 0, -4e-3], [0, 0, -4e-3], [2e-3, 0, -4e-3]])
    assert not eflesh_board(depth=0.0).chips[:, 2].any()  # chips may lie in the surface, as in simulated lattices
    with pytest.raises(ValueError, match=r"depth: is -0\.001; give metres below the surface, 0 or more"):
        eflesh_board(depth=-1e-3)


@pytest.mark.full
def test_a_pad_on_any_board_is_pressed_and_saved_and_a_chip_measures_the_same_on_each(tmp_path):
    """The field at a place does not depend on the other chips, so a grid of 16 includes the readings of any four."""
    sixteen, corners = make_board("grid-4x4"), np.array([0, 3, 12, 15])
    pad = sample_pad(jax.random.key(0), board=sixteen)
    some = Board(pad.board.chips[corners], pad.board.rotations[corners])
    four = pad._replace(board=some, gains=pad.gains.reshape(16, 3)[corners].ravel())
    height = jnp.full((40, 40), jnp.inf).at[8, 12].set(0.0)
    reading, some = (np.asarray(press(skin, height, 0.5e-3).reading) for skin in (pad, four))
    np.testing.assert_allclose(reading.reshape(16, 3)[corners].ravel(), some, rtol=1e-4, atol=1e-3)
    change = np.linalg.norm(np.asarray(sixteen.to_tool(reading)), axis=1)
    place = np.array([(12.5 / 40 - 0.5) * 20e-3, (8.5 / 40 - 0.5) * 20e-3])
    near = np.argsort(np.linalg.norm(sixteen.chips[:, :2] - place, axis=1))
    assert np.argmax(change) in near[:5]  # the chips below the press change most
    save_pad(tmp_path / "pad.npz", pad)
    jax.tree.map(np.testing.assert_array_equal, load_pad(tmp_path / "pad.npz"), pad)


@pytest.mark.full
def test_noise_and_faults_have_the_channels_of_the_board():
    board, keys = make_board("grid-2x2"), jax.random.split(jax.random.key(0), 4)
    assert add_sensor_noise(keys[0], jnp.zeros(12), board, Noise()).shape == (12,)
    poses, kind = jnp.tile(jnp.eye(4), (6, 1, 1)), Faults.typical()
    felt = faults.apply(keys[2], jnp.ones((6, 12)), poses, board, kind, key_board=keys[3], rest=jnp.zeros(12))
    assert felt.shape == (6, 12)
    assert np.isfinite(felt).all()


def test_the_reskin_board_is_rotated_as_recorded():
    x, y, z = 18.0, -7.0, -41.0  # on chip 0, whose axes are the tool's
    recorded = [[x, y, z], [y, -x, z], [x, y, z], [-y, x, z], [-x, -y, z]]
    uniform = make_board("reskin").to_board(np.tile([x, y, z], (5, 1)))
    np.testing.assert_allclose(np.reshape(uniform, (5, 3)), recorded, atol=1e-6)


ANYSKIN_SCREEN = {"left": (-1, 0), "right": (1, 0), "up": (0, 1), "down": (0, -1)}  # chips in the makers' viewer


def test_the_anyskin_board_is_rotated_as_published():
    """Screen coordinates by the viewer's formula: (x, y down) = R(angle) (x, y) of the chip, `chip_xy_rotations`."""
    board = make_board("anyskin")
    published = np.radians([-90.0, -90, 180, 90, 0])
    own = np.random.default_rng(0).normal(size=(5, 3))
    x, y, _ = own.T
    cosine, sine = np.cos(published), np.sin(published)
    screen = np.column_stack([cosine * x - sine * y, sine * x + cosine * y])
    field = np.asarray(board.to_tool(own.ravel()))
    np.testing.assert_allclose(field[:, :2], screen * [1, -1], atol=1e-6)
    np.testing.assert_allclose(np.linalg.det(board.rotations), 1.0, atol=1e-6)  # chips' axes are right-handed
    np.testing.assert_allclose(board.chips[1:, :2], 7e-3 * np.array(list(ANYSKIN_SCREEN.values())), atol=1e-9)
    assert "chip_xy_rotations" in board_note("anyskin")
    uniform = np.asarray(board.to_board(np.tile([18.0, -7, -41], (5, 1))))
    np.testing.assert_allclose(nonuniform_field(uniform, board), 0, atol=1e-5)
    assert np.linalg.norm(nonuniform_field(uniform, make_board("eflesh"))) > 20  # aligned chips would read five fields


def board_file(path, text):
    path = path / "mine.toml"
    path.write_text(text)
    return str(path)


def test_a_board_is_read_from_a_file(tmp_path):
    chips = "chips = [[0, 0, -0.003], [0.006, 0, -0.003], [0, 0.006, -0.003]]\n"
    turned = make_board(board_file(tmp_path, chips + "turns = [0, 90, -90]\n"))
    np.testing.assert_allclose(turned.chips[1], [6e-3, 0, -3e-3], atol=1e-9)
    np.testing.assert_allclose(turned.to_tool(np.tile([1.0, 0, 5], 3)), [[1, 0, 5], [0, 1, 5], [0, -1, 5]], atol=1e-6)
    over = "[[1, 0, 0], [0, -1, 0], [0, 0, -1]]"
    given = make_board(board_file(tmp_path, chips + f"rotations = [{over}, {over}, {over}]\n"))
    np.testing.assert_allclose(given.to_tool(np.tile([1.0, 2, 3], 3)), [[1, -2, -3]] * 3, atol=1e-6)


@pytest.mark.parametrize(("text", "message"), [
    ("turns = [0]", "chips is missing"),
    ("chips = [[0, 0]]\nturns = [0]", "chips is 1 x 2 numbers; give x, y and z of 1 to 25 chips"),
    ("chips = [[0, 0, -3.5]]\nturns = [0]", "give metres within 0.1"),
    ("chips = [[0, 0, 0.003]]\nturns = [0]", "and z below the surface"),
    ("chips = [[0, 0, -0.003], [0, 0, -0.003]]\nturns = [0, 0]", "two chips lie in one place"),
    ("chips = [[0, 0, -0.003]]", "give either turns or rotations"),
    ("chips = [[0, 0, -0.003]]\nturns = [0, 90]", "turns is 2 numbers; give one number for each of 1 chips"),
    ("chips = [[0, 0, -0.003]]\nturns = [1.5708]", "give degrees"),
    ("chips = [[0, 0, -0.003]]\nrotations = [[[1, 0, 0], [0, 2, 0], [0, 0, 1]]]", "chip 0 is not a rotation"),
    ("chips = [[0, 0, -0.003]]\nturn = [0]", "'turn' is not a key of a board"),
    ("chips = [[0, 0, nan]]\nturns = [0]", "chips is 1 x 3 numbers; give lists of numbers"),
    ("chips = [", "mine.toml"),
])  # fmt: skip
def test_a_file_without_a_valid_board_is_refused_in_one_sentence(tmp_path, text, message):
    with pytest.raises(ValueError, match=re.escape(message)) as refused:
        make_board(board_file(tmp_path, text))
    assert "mine.toml" in str(refused.value)
    assert "\n" not in str(refused.value)


def test_an_unknown_board_is_refused():
    for name in ("five", "grid-0x2", "grid-6x6", "grid-2x2x2"):
        with pytest.raises(ValueError, match="not known; choose one of reskin, anyskin"):
            make_board(name)
    with pytest.raises(ValueError, match=r"nowhere.toml: cannot be read \(No such file"):
        make_board("nowhere.toml")


def test_three_exact_zeros_of_a_chip_are_not_a_reading():
    readings = np.random.default_rng(0).normal(size=(8, 15))
    silent = np.zeros((8, 5), bool)
    silent[1], silent[3, 2], silent[4, 0] = True, True, True
    readings[np.repeat(silent, 3, axis=1)] = 0.0
    for differences in (False, True):
        np.testing.assert_array_equal(silent_chips(readings, differences=differences), silent)
        missing = np.isnan(without_silent_chips(readings, differences=differences))
        np.testing.assert_array_equal(missing, np.repeat(silent, 3, axis=1))


def test_a_difference_rounded_to_zero_is_a_reading():
    readings = np.random.default_rng(0).normal(size=(8, 15))
    readings[2, 3:6] = 0.0, -0.0, 0.0
    readings[4, 6:9] = 0.0
    readings[5, 7:9] = 0.0
    assert silent_chips(readings).sum() == 2
    assert not silent_chips(readings, differences=True).any()
