"""What a user holds: a calibration from arrays, on disk and back, and what is refused."""

import numpy as np
import pytest

from i2t.calibration import Calibration, calibrate, load_calibration
from i2t.errors import SerializationError
from i2t.skin import boards
from i2t.skin.files import load_pad

rng = np.random.default_rng(0)
POSITIONS, DEPTH = rng.uniform(-10e-3, 10e-3, (30, 2)), rng.uniform(0, 4e-3, 30)
READINGS = rng.normal(scale=30, size=(30, 15))


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    return calibrate(POSITIONS, DEPTH, READINGS, load_kind="depth", metadata={"skin": "made up"})


def test_it_comes_back_as_it_was(calibration, tmp_path):
    calibration.save(tmp_path / "skin.npz")
    again = load_calibration(tmp_path / "skin.npz")
    assert again.metadata == {"skin": "made up"}
    assert again.load_kind == "depth"
    for a, b in zip(calibration.predict(POSITIONS, DEPTH), again.predict(POSITIONS, DEPTH), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6)
        assert a.shape == (30, 15)
    mean, std = again.predict(POSITIONS[0], DEPTH[0])
    assert mean.shape == std.shape == (15,)
    assert (std > 0).all()
    with pytest.raises(SerializationError, match="holds a i2t calibration, not a i2t pad"):
        load_pad(tmp_path / "skin.npz")


def test_chips_give_each_channel_its_own_amplitude(tmp_path):
    fitted = calibrate(POSITIONS, 1e3 * DEPTH, READINGS, load_kind="force", board=boards.reskin_board())
    fitted.save(tmp_path / "skin.npz")
    again = load_calibration(tmp_path / "skin.npz")
    assert again.gp.cholesky.shape == (5, 30, 30)
    np.testing.assert_allclose(
        again.predict(POSITIONS, 1e3 * DEPTH)[0], fitted.predict(POSITIONS, 1e3 * DEPTH)[0], rtol=1e-5
    )


def test_what_cannot_be_is_refused(calibration):
    with pytest.raises(ValueError, match="do not go with"):
        calibration.predict(POSITIONS, DEPTH[:3])
    with pytest.raises(ValueError, match="give metres"):
        calibration.predict(1e3 * POSITIONS, DEPTH)
    with pytest.raises(ValueError, match="between 0 and"):
        calibration.predict(POSITIONS, -DEPTH - 1)
    with pytest.raises(ValueError, match="not finite"):
        calibrate(POSITIONS, DEPTH, np.where(READINGS > 0, np.nan, READINGS), load_kind="depth")
    with pytest.raises(ValueError, match="do not belong together"):
        calibrate(POSITIONS[:4], DEPTH, READINGS, load_kind="depth")
