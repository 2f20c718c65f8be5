"""The ambient field is taken out of a recording that was zeroed once, while the tool turned."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.random_touches import make
from helpers.recordings import converted, refused
from scipy.spatial.transform import Rotation

from i2t.convert.ambient import without_ambient
from i2t.dataset import save_dataset
from i2t.errors import DataError
from i2t.skin.ambient import FreePoses, fit_ambient, save_ambient

EARTH = np.array([18.0, 7.0, 41.0])
BASE_TURN = (0.1, -0.4, 1.2)  # of the base in the world, rad


def felt(board, turns):
    """(n, c) uT, of a uniform field in the base."""
    fields = np.repeat((turns.swapaxes(-1, -2) @ EARTH)[:, None], board.num_chips, axis=1)
    return np.asarray(board.to_board(fields))


@pytest.fixture(scope="module")
def recorded():
    """A recording with the turn of the field in it, the readings without, and the field."""
    clean = make(8, board="grid-2x2")
    in_base = Rotation.from_rotvec(BASE_TURN).as_matrix().T @ clean.touches.T_w_t[:, :3, :3].astype(float)
    seen = felt(clean.board, in_base)
    first = np.array([np.flatnonzero(clean.touches.session == session)[0] for session in clean.touches.session])
    bent = clean.touches._replace(reading=clean.touches.reading + (seen - seen[first]).astype(np.float32))
    poses = np.tile(np.eye(4), (12, 1, 1))
    poses[:, :3, :3] = Rotation.random(12, random_state=0).as_matrix()
    free = FreePoses(poses, felt(clean.board, poses[:, :3, :3])[:, None])
    return replace(clean, touches=bent), clean.touches.reading, fit_ambient(free, clean.board, model="uniform")


def test_the_turn_of_the_field_is_subtracted_and_stated_and_a_missing_chip_stays_missing(recorded, tmp_path, capsys):
    dataset, truth, field = recorded
    assert np.abs(dataset.touches.reading - truth).max() > 30
    reading = dataset.touches.reading.copy()
    reading[2, 3:6] = np.nan
    gone = replace(dataset, touches=dataset.touches._replace(reading=reading))
    found = without_ambient(gone, field, "field", base_turn=BASE_TURN).dataset.touches.reading
    assert np.isnan(found[2, 3:6]).all()
    np.testing.assert_allclose(np.delete(found, 2, axis=0), np.delete(truth, 2, axis=0), atol=1e-3)
    save_dataset(tmp_path / "set.h5", dataset)
    save_ambient(tmp_path / "field.npz", field)
    words = ("ambient", tmp_path / "set.h5", tmp_path / "out")
    again = converted(*words, "--field", tmp_path / "field.npz", "--base-turn", *BASE_TURN)
    assert "relative to the first touch of each session" in capsys.readouterr().out
    np.testing.assert_allclose(again.touches.reading, truth, atol=1e-3)
    assert "was subtracted" in again.meta["ambient field"]
    with pytest.raises(DataError, match="already"):
        without_ambient(again, field, "field")
    assert "no such file" in refused(capsys, *words[:2], tmp_path / "other", "--field", tmp_path / "none.npz")


def test_what_cannot_be_corrected_is_refused(recorded):
    dataset, _, field = recorded
    lost = dataset.touches.T_w_t.copy()
    lost[3] = np.nan
    for wrong, why in (
        (replace(dataset, meta={"made by": "i2t.collect.session"}), "already"),
        (replace(dataset, touches=dataset.touches._replace(T_w_t=lost)), "1 of 8 touches have no pose"),
        (make(3, board="grid-1x1"), "name the field of this skin"),
    ):
        with pytest.raises(DataError, match=why):
            without_ambient(wrong, field, "field")
