"""Pad models on disk, and which skin they are of."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2t import serialization
from i2t.errors import DataError, SerializationError
from i2t.recognition import belief
from i2t.recognition.outcomes import LinearReadingModel
from i2t.recognition.pad_model import PadModel
from i2t.recognition.pad_model_files import (
    KnownPad,
    PadOrigin,
    load_pad_model,
    require_skin,
    same_board,
    save_pad_model,
)
from i2t.skin import boards
from i2t.skin.pad import nominal_pad
from i2t.types import Board

CHANNELS, CELLS = 15, 9


def known(pad="skin A", board=None) -> KnownPad:
    rng = np.random.default_rng(0)
    loads, scale = jnp.float32([0.3, 0.9, 2.7]), jnp.full(CHANNELS, 30, jnp.float32)
    errors = rng.normal(size=(40, CHANNELS))
    likelihood = belief.fit_likelihood(errors, scale, loads, overtravel=6e-3, position_std=1e-4)
    mean, root = rng.normal(size=(3, CELLS, CHANNELS)), rng.normal(size=(3, CELLS, 4))
    reading_model = LinearReadingModel(
        *(jnp.float32(part) for part in (loads, mean, root, scale, 1.1)),
    )
    model = PadModel(reading_model, likelihood, np.full(CHANNELS, 20.0), 0.5, errors)
    origin = PadOrigin(pad, "real", ("hexagon", "mug"), 300, "DATA/known")
    return KnownPad(model, boards.reskin_board() if board is None else board, origin)


def test_a_pad_model_comes_back_with_its_skin(tmp_path):
    save_pad_model(tmp_path / "pad_model.npz", known())
    again = load_pad_model(tmp_path / "pad_model.npz")
    assert again.origin == known().origin
    assert again.model.r2 == 0.5
    assert again.skin.pad == "skin A"
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6), again.model, known().model)
    np.testing.assert_allclose(again.board.chips, boards.reskin_board().chips, atol=1e-9)


def test_parts_of_different_boards_are_no_pad_model(tmp_path):
    path = tmp_path / "pad_model.npz"
    save_pad_model(path, known(board=boards.grid_board(2, 2)))
    with pytest.raises(SerializationError, match=r"reading_model.mean is not \(3, 9, 12\) finite numbers"):
        load_pad_model(path)
    broken = known()
    save_pad_model(path, broken._replace(model=broken.model._replace(reading_std=np.full(CHANNELS, np.nan))))
    with pytest.raises(SerializationError, match="reading_std"):
        load_pad_model(path)
    serialization.save(path, "i2t pad", nominal_pad())
    with pytest.raises(SerializationError, match="holds a i2t pad, not a i2t pad model"):
        load_pad_model(path)


def test_another_skin_is_refused_by_both_names():
    skin, board = known().skin, boards.reskin_board()
    assert require_skin(skin, ["skin A"], board, "DATA/new") is None
    with pytest.raises(DataError, match=r'DATA/new: the skin is "skin B", and .* DATA/known is of "skin A"'):
        require_skin(skin, ["skin A", "skin B"], board, "DATA/new")
    said = require_skin(skin, ["skin B"], board, "DATA/new", other_skin=True)
    assert said is not None
    assert said.startswith("ANOTHER SKIN: ")
    assert '"skin B"' in said
    assert '"skin A"' in said


@pytest.mark.parametrize("other", [boards.anyskin_board(), boards.grid_board(4, 4)])
def test_another_board_is_refused_whatever_is_asked(other):
    with pytest.raises(DataError, match=r"5 chips, the first at .* mm, turned by 0, 90, 0, -90"):
        require_skin(known().skin, ["skin A"], other, "DATA/new", other_skin=True)


def test_boards_are_the_same_up_to_the_depth_of_their_chips():
    nominal = boards.reskin_board()
    fitted = nominal_pad(board=nominal).board
    assert same_board(nominal, Board(*(np.asarray(part) for part in fitted)))
    assert not same_board(nominal, nominal._replace(chips=nominal.chips[::-1]))
