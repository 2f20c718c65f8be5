"""Pad models in files, and the skins they belong to."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2t.contact.pressure import ContactPressure
from i2t.errors import DataError, SerializationError
from i2t.files import serialization
from i2t.skin import boards
from i2t.skin.pad import nominal_pad
from i2t.skin_models.layer import Layer
from i2t.skin_models.likelihood import fit_likelihood
from i2t.skin_models.pad_model import (
    PAD_MODEL_KIND,
    KnownPad,
    PadModel,
    PadOrigin,
    _Record,
    load_pad_model,
    require_skin,
    same_board,
)
from i2t.skin_models.reading_model import LinearReadingModel
from i2t.types import Board

CHANNELS, CELLS = 15, 9
BOARD = boards.reskin_board()


@pytest.fixture(scope="module")
def skin() -> KnownPad:
    rng = np.random.default_rng(0)
    loads, scale = jnp.float32([0.3, 0.9, 2.7]), jnp.full(CHANNELS, 30, jnp.float32)
    errors = rng.normal(size=(40, CHANNELS))
    likelihood = fit_likelihood(errors, scale, loads, overtravel=6e-3, position_std=1e-4)
    mean, root = rng.normal(size=(3, CELLS, CHANNELS)), rng.normal(size=(3, CELLS, 4))
    reading_model = LinearReadingModel(*(jnp.float32(part) for part in (loads, mean, root, scale, 1.1)))
    model = PadModel(reading_model, likelihood, np.full(CHANNELS, 20.0), 0.5, errors)
    return KnownPad(model, BOARD, PadOrigin("skin A", "real", ("hexagon", "mug"), 300, "DATA/known"))


def test_a_saved_pad_model_loads_with_its_skin(skin, tmp_path):
    skin.save(tmp_path / "pad_model.npz")
    again = load_pad_model(tmp_path / "pad_model.npz")
    assert again.origin == skin.origin
    digests = replace(skin.origin, used_touches=("00aa", "11bb"))
    skin._replace(origin=digests).save(tmp_path / "digests.npz")
    assert load_pad_model(tmp_path / "digests.npz").origin == digests
    record, about = serialization.load(tmp_path / "pad_model.npz", PAD_MODEL_KIND, _Record)
    del about["used_touches"]  # as in older files
    serialization.save(tmp_path / "older.npz", PAD_MODEL_KIND, record, about)
    assert load_pad_model(tmp_path / "older.npz").origin.used_touches is None
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6), again.model, skin.model)
    np.testing.assert_allclose(again.board.chips, BOARD.chips, atol=1e-9)


def test_predictions_use_the_map_of_the_load_and_the_leave_one_out_errors(skin):
    model, likelihood = skin.model.reading_model, skin.model.likelihood
    newtons = np.random.default_rng(1).uniform(size=(3, 3, 3)).astype(np.float32)
    loads = np.asarray(model.loads)
    newtons *= (loads / newtons.sum((1, 2)))[:, None, None]
    mean, std = skin.predict(ContactPressure(jnp.asarray(newtons), jnp.asarray(loads)))
    flat = newtons.reshape(3, CELLS)
    np.testing.assert_allclose(mean, np.einsum("lx,lxc->lc", flat, model.mean), rtol=1e-4, atol=1e-4)
    variance = np.sum(np.einsum("lx,lxr->lr", flat, model.root) ** 2, axis=1)[:, None] * np.asarray(model.scale) ** 2
    whiten = np.linalg.inv(np.asarray(likelihood.whiten, np.float64))
    np.testing.assert_allclose(std, np.sqrt(np.diag(whiten @ whiten.T) + variance), rtol=1e-3)


def test_parts_that_do_not_fit_each_other_are_refused(skin, tmp_path):
    path = tmp_path / "pad_model.npz"
    soft = skin.model.reading_model._replace(layer=Layer(young=np.nan))
    for broken, message in (
        (skin._replace(board=boards.grid_board(2, 2)), r"reading_model.mean is not \(3, 9, 12\) finite numbers"),
        (skin._replace(model=skin.model._replace(reading_std=np.full(CHANNELS, np.nan))), "reading_std"),
        (skin._replace(model=skin.model._replace(reading_model=soft)), r"layer.young is not \(\) finite numbers"),
    ):
        broken.save(path)
        with pytest.raises(SerializationError, match=message):
            load_pad_model(path)
    serialization.save(path, "i2t pad", nominal_pad())
    with pytest.raises(SerializationError, match="holds a i2t pad, not a i2t pad model"):
        load_pad_model(path)


def test_another_skin_is_refused_by_name_and_another_board_always(skin):
    assert require_skin(skin, ["skin A"], BOARD, "DATA/new") is None
    with pytest.raises(DataError, match=r'DATA/new: the skin is "skin B", and .* DATA/known is of "skin A"'):
        require_skin(skin, ["skin A", "skin B"], BOARD, "DATA/new")
    warning = require_skin(skin, ["skin B"], BOARD, "DATA/new", other_skin=True)
    assert warning is not None
    assert all(words in warning for words in ("ANOTHER SKIN: ", '"skin B"', '"skin A"'))
    for other in (boards.anyskin_board(), boards.grid_board(4, 4)):
        with pytest.raises(DataError, match=r"5 chips, the first at .* mm, turned by 0, 90, 0, -90"):
            require_skin(skin, ["skin A"], other, "DATA/new", other_skin=True)


def test_boards_are_the_same_up_to_the_depth_of_their_chips():
    fitted = nominal_pad(board=BOARD).board
    assert same_board(BOARD, Board(*(np.asarray(part) for part in fitted)))
    assert not same_board(BOARD, BOARD._replace(chips=BOARD.chips[::-1]))
