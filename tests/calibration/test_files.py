"""What a user holds: a calibration from arrays, on disk and back, any board, and what is refused."""

from collections import namedtuple

import jax
import numpy as np
import pytest

from i2t import serialization
from i2t.calibration import FORCE_HYPERPARAMETERS, Calibration, calibrate, check_presses, load_calibration
from i2t.calibration.files import PressedSkin, calibrated_presses, fit_pressed_pad, parse_tip, save_pressed_pad
from i2t.calibration.model import CalibrationRecord
from i2t.calibration.physics import RoundTip
from i2t.errors import SerializationError
from i2t.skin import boards
from i2t.skin.contact import GRID
from i2t.skin.files import load_pad, load_pad_about
from i2t.skin.pad import press_force, sample_pad

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
    with pytest.raises(SerializationError, match="holds a i2t calibrated skin, not a i2t pad"):
        load_pad(tmp_path / "skin.npz")


@pytest.mark.full
def test_given_hyperparameters_are_those_of_a_structured_process(tmp_path):
    fitted = calibrate(
        POSITIONS, 1e3 * DEPTH, READINGS, load_kind="force", board=boards.reskin_board(),
        hyperparameters=FORCE_HYPERPARAMETERS,
    )  # fmt: skip
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


OLD_NAMES = {
    "gp": "process", "interval_scaling": "widening", "hyperparameters": "hyper", "corrected_presses": "raised",
    "chip_positions": "chips", "position": "place", "unit_load": "unit", "load_offset": "offset", "load_power": "power",
    "map_length": "length", "map_variance": "steady", "bend_variance": "bend", "bend_load_width": "bend_width",
    "static_variance": "standing", "constant_variance": "constant", "noise_variance": "noise", "height_std": "height",
    "chip_reach": "reach", "far_amplitude": "floor", "lattice_period": "period", "height_load_width": "height_width",
    "periodic_share": "repeating", "previous_session": "earlier",
}  # fmt: skip


def as_first_version(tree):
    """The same arrays under the names of the first version's files."""
    if not hasattr(tree, "_asdict"):
        return tree
    fields = {OLD_NAMES.get(name, name): as_first_version(value) for name, value in tree._asdict().items()}
    return namedtuple("Old", fields)(**fields)


@pytest.mark.full
def test_what_is_known_of_presses_may_be_more_or_less(tmp_path):
    both = np.column_stack([DEPTH, 1e3 * DEPTH])
    before = np.concatenate([np.full((1, 15), np.nan), READINGS[:-1]])
    earlier = calibrate(POSITIONS, both, READINGS, load_kind="both")
    fitted = calibrate(
        POSITIONS, both, READINGS, load_kind="both", board=boards.eflesh_board(), previous_readings=before,
        temperature=20 + DEPTH, previous_session=earlier, metadata={"skin": "A"},
    )  # fmt: skip
    fitted.save(tmp_path / "skin.npz")
    again = load_calibration(tmp_path / "skin.npz")
    assert again.metadata["skin"] == "A"
    known = {"previous_readings": before[1:4], "temperature": 20 + DEPTH[1:4]}
    mean, std = fitted.predict(POSITIONS[1:4], both[1:4], **known)
    for a, b in zip((mean, std), again.predict(POSITIONS[1:4], both[1:4], **known), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6)
    alone = again.predict(POSITIONS[2], both[2], previous_readings=before[2], temperature=20 + DEPTH[2])
    np.testing.assert_allclose(alone[0], mean[1], rtol=1e-6)
    nowhere = calibrate(None, DEPTH, READINGS, load_kind="depth")
    assert nowhere.predict(None, DEPTH[:4])[0].shape == (4, 15)
    assert nowhere.predict(None, 1e-3)[0].shape == (15,)
    unknown = calibrate(POSITIONS, None, READINGS, load_kind="none")
    assert unknown.predict(POSITIONS[:4])[0].shape == (4, 15)
    with pytest.raises(ValueError, match="say nothing about another press"):
        calibrate(None, None, READINGS, load_kind="none")
    with pytest.raises(ValueError, match="made without temperature"):
        unknown.predict(POSITIONS[:4], temperature=20.0)
    with pytest.raises(ValueError, match="loads are missing or not known"):
        unknown.predict(POSITIONS[:4], DEPTH[:4])
    with pytest.raises(ValueError, match="does not go with 30 presses"):
        calibrate(POSITIONS, DEPTH, READINGS, load_kind="depth", previous_readings=before[:5])
    with pytest.raises(ValueError, match="other channels or another kind of load"):
        calibrate(POSITIONS, DEPTH, READINGS, load_kind="depth", previous_session=earlier)
    with pytest.raises(ValueError, match="knows no depth and no force"):
        calibrated_presses(unknown, boards.reskin_board())


@pytest.mark.full
def test_a_file_of_the_first_version_still_loads(tmp_path):
    path = tmp_path / "old.npz"
    fitted = calibrate(
        POSITIONS, 1e3 * DEPTH, READINGS, load_kind="force", board=boards.reskin_board(),
        hyperparameters=FORCE_HYPERPARAMETERS,
    )  # fmt: skip
    record = CalibrationRecord(fitted.gp, fitted.interval_scaling)
    serialization.save(path, "i2t calibration", as_first_version(record), {"load": "force", "about": {"skin": "old"}})
    with np.load(path) as file:
        names = set(file.files)
    # As recorded from a file that the first version wrote.
    assert {"process.cholesky", "process.raised.place", "process.hyper.steady", "process.chips", "widening"} <= names
    again = load_calibration(path)
    assert again.metadata == {"skin": "old"}
    for a, b in zip(fitted.predict(POSITIONS, 1e3 * DEPTH), again.predict(POSITIONS, 1e3 * DEPTH), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5)


@pytest.mark.full
def test_a_skin_of_sixteen_chips_is_calibrated(tmp_path):
    board = boards.grid_board(4, 4)
    readings = np.tile(READINGS[:, :12], 4)
    fitted = calibrate(POSITIONS, 1e3 * DEPTH, readings, load_kind="force", board=board)
    fitted.save(tmp_path / "skin.npz")
    again = load_calibration(tmp_path / "skin.npz")
    mean, std = again.predict(POSITIONS, 1e3 * DEPTH)
    assert mean.shape == std.shape == (30, 48)
    assert again.gp.chip_positions.shape == (1, 16, 2)
    with pytest.raises(ValueError, match="16 chips"):
        calibrate(POSITIONS, 1e3 * DEPTH, READINGS, load_kind="force", board=board)


def test_data_warnings_name_any_chip():
    rng = np.random.default_rng(2)
    position, load = rng.uniform(-5e-3, 5e-3, (600, 2)), rng.uniform(1e-3, 4e-3, 600)
    # Three of 48 channels change by twice the noise: more than twice a chip's own difference, an eighth of the board's.
    readings = 1e4 * position[:, :1] * load[:, None] + rng.normal(size=(600, 48))
    readings[300:, 36:39] += 2
    assert check_presses(position, load, readings).changed_chips == (12,)


@pytest.mark.full
@pytest.mark.parametrize("load_kind", ["depth", "force"])
def test_a_calibration_holds_the_readings_that_it_was_given(load_kind, calibration):
    """A structured process gives them back as the product of the system's factor with its weights."""
    board = boards.reskin_board()
    if load_kind == "force":
        given = FORCE_HYPERPARAMETERS
        calibration = calibrate(POSITIONS, 1e3 * DEPTH, READINGS, load_kind="force", board=board, hyperparameters=given)
    pressed = calibrated_presses(calibration, board)
    np.testing.assert_allclose(pressed.readings, READINGS, atol=0.2)
    np.testing.assert_allclose(pressed.position, POSITIONS, atol=1e-8)
    np.testing.assert_allclose(pressed.load, DEPTH if load_kind == "depth" else 1e3 * DEPTH, rtol=1e-6)
    assert pressed.by_force == (load_kind == "force")
    with pytest.raises(ValueError, match="has 15 values a reading, and the board 48"):
        calibrated_presses(calibration, boards.grid_board(4, 4))


def test_tips_are_told_by_their_shape_and_radius():
    assert parse_tip("sphere:4.0") == RoundTip("sphere", 4e-3)
    assert parse_tip("cylinder:2") == RoundTip("cylinder", 2e-3)
    for wrong in ("tip", "sphere", "sphere:x", "sphere:-1", "sphere:80", "cone:2", "sphere:nan"):
        with pytest.raises(ValueError, match=f'"{wrong}" is no tip that a pad can be fitted to; pass --tip'):
            parse_tip(wrong)


@pytest.mark.full
def test_a_pad_from_presses_predicts_them_and_says_how_far_it_is_off(tmp_path):
    """Presses of a simulated pad with a ball, with 1 uT of noise: the fitted pad explains what is left out, and the
    file says so.
    """
    tip, board = RoundTip("sphere", 4e-3), boards.reskin_board()
    pad = sample_pad(jax.random.key(3), board=board)
    draw = np.random.default_rng(1)
    position, force = np.float32(draw.uniform(-7e-3, 7e-3, (40, 2))), np.float32(draw.uniform(0.3, 1.0, 40))
    press = jax.jit(lambda at: press_force(pad, tip.height(at[0], GRID), at[1]).reading)
    clean = np.asarray(jax.lax.map(press, (position, force)))
    readings = clean + draw.normal(size=clean.shape)
    found = fit_pressed_pad(PressedSkin(position, force, readings, board, by_force=True), tip)
    assert found.r2 > 0.6
    around = np.sqrt(np.mean((readings - readings.mean(0)) ** 2))
    assert 0.9 < found.error_std < 0.65 * around
    save_pressed_pad(tmp_path / "pad.npz", found, pad="skin A", source="simulated")
    about = load_pad_about(tmp_path / "pad.npz")
    assert about.name == "skin A"
    assert about.made_from == ", fitted to 40 simulated presses"
    assert about.error_std == pytest.approx(found.error_std)
    assert float(load_pad(tmp_path / "pad.npz").thickness) == pytest.approx(float(found.fit.pad.thickness))


def test_few_presses_fit_no_pad():
    pressed = PressedSkin(POSITIONS[:3], DEPTH[:3], READINGS[:3], boards.reskin_board(), by_force=False)
    with pytest.raises(ValueError, match="3 presses are too few to fit a pad to"):
        fit_pressed_pad(pressed, RoundTip("sphere", 4e-3))
