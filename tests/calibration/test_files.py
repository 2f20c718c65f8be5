"""What a user holds: a calibration from arrays, on disk and back, any board, and what is refused."""

from collections import namedtuple

import numpy as np
import pytest
from i2t.calibration.files import PressedSkin, calibrated_presses, fit_pressed_pad, parse_tip

from i2t import serialization
from i2t.calibration import FORCE_HYPERPARAMETERS, Calibration, calibrate, load_calibration
from i2t.calibration.model import CalibrationRecord
from i2t.calibration.physics import RoundTip
from i2t.errors import SerializationError
from i2t.skin import boards
from i2t.skin.files import load_pad

rng = np.random.default_rng(0)
POSITIONS, DEPTH = rng.uniform(-10e-3, 10e-3, (30, 2)), rng.uniform(0, 4e-3, 30)
FORCE = 1e3 * DEPTH
READINGS = rng.normal(scale=30, size=(30, 15))
BOARD, BALL = boards.reskin_board(), RoundTip("sphere", 4e-3)


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    return calibrate(POSITIONS, DEPTH, READINGS, load_kind="depth", metadata={"skin": "made up"})


@pytest.fixture(scope="module")
def structured() -> Calibration:
    """A structured process, which given hyperparameters mean."""
    given = {"board": BOARD, "hyperparameters": FORCE_HYPERPARAMETERS, "metadata": {"skin": "made up"}}
    return calibrate(POSITIONS, FORCE, READINGS, load_kind="force", **given)


@pytest.fixture(scope="module")
def unknown() -> Calibration:
    """Made without any load."""
    return calibrate(POSITIONS, None, READINGS, load_kind="none")


BOTH_KINDS = pytest.mark.parametrize(
    ("which", "load"), [("calibration", DEPTH), pytest.param("structured", FORCE, marks=pytest.mark.full)]
)


def assert_same_predictions(one: Calibration, other: Calibration, *given, **more) -> None:
    for a, b in zip(one.predict(*given, **more), other.predict(*given, **more), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5)


@BOTH_KINDS
def test_it_comes_back_as_it_was(which, load, request, tmp_path):
    made = request.getfixturevalue(which)
    made.save(tmp_path / "skin.npz")
    again = load_calibration(tmp_path / "skin.npz")
    assert (again.metadata, again.load_kind) == ({"skin": "made up"}, made.load_kind)
    assert_same_predictions(made, again, POSITIONS, load)
    assert made.predict(POSITIONS, load)[0].shape == (30, 15)
    mean, std = again.predict(POSITIONS[0], load[0])
    assert mean.shape == std.shape == (15,)
    assert (std > 0).all()
    with pytest.raises(SerializationError, match="not a i2t pad"):
        load_pad(tmp_path / "skin.npz")


def depths(position=POSITIONS, load=DEPTH, readings=READINGS, **given):
    return calibrate(position, load, readings, load_kind="depth", **given)


FEW = PressedSkin(POSITIONS[:3], DEPTH[:3], READINGS[:3], BOARD, by_force=False)


@pytest.mark.parametrize(
    ("call", "word"),
    [
        (lambda made, _: made.predict(POSITIONS, DEPTH[:3]), "do not go with"),
        (lambda made, _: made.predict(1e3 * POSITIONS, DEPTH), "give metres"),
        (lambda made, _: made.predict(POSITIONS, -DEPTH - 1), "between 0 and"),
        (lambda *_: depths(readings=np.where(READINGS > 0, np.nan, READINGS)), "not finite"),
        (lambda *_: depths(POSITIONS[:4]), "do not belong together"),
        (lambda *_: depths(previous_readings=READINGS[:5]), "does not go with 30 presses"),
        (lambda _, unknown: depths(previous_session=unknown), "other channels or another kind of load"),
        (lambda *_: depths(board=boards.grid_board(4, 4)), "16 chips"),
        (lambda *_: calibrate(None, None, READINGS, load_kind="none"), "say nothing about another press"),
        (lambda _, unknown: unknown.predict(POSITIONS[:4], temperature=20.0), "made without temperature"),
        (lambda _, unknown: unknown.predict(POSITIONS[:4], DEPTH[:4]), "loads are missing or not known"),
        (lambda _, unknown: calibrated_presses(unknown, BOARD), "knows no depth and no force"),
        (lambda made, _: calibrated_presses(made, boards.grid_board(4, 4)), "has 15 values a reading"),
        (lambda *_: fit_pressed_pad(FEW, BALL), "3 presses are too few"),
    ],
)
def test_what_cannot_be_is_refused(calibration, unknown, call, word):
    with pytest.raises(ValueError, match=word):
        call(calibration, unknown)


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
def test_a_file_of_the_first_version_still_loads(structured, tmp_path):
    path = tmp_path / "old.npz"
    record = as_first_version(CalibrationRecord(structured.gp, structured.interval_scaling))
    serialization.save(path, "i2t calibration", record, {"load": "force", "about": {"skin": "old"}})
    # As recorded from a file that the first version wrote.
    recorded = {"process.cholesky", "process.raised.place", "process.hyper.steady", "process.chips", "widening"}
    with np.load(path) as file:
        assert recorded <= set(file.files)
    again = load_calibration(path)
    assert again.metadata == {"skin": "old"}
    assert_same_predictions(structured, again, POSITIONS, FORCE)


@pytest.mark.full
def test_what_is_known_of_presses_may_be_more_or_less(unknown, tmp_path):
    both = np.column_stack([DEPTH, FORCE])
    before = np.concatenate([np.full((1, 15), np.nan), READINGS[:-1]])
    fitted = calibrate(
        POSITIONS, both, READINGS, load_kind="both", board=boards.eflesh_board(), previous_readings=before,
        temperature=20 + DEPTH, previous_session=calibrate(POSITIONS, both, READINGS, load_kind="both"),
    )  # fmt: skip
    fitted.save(tmp_path / "skin.npz")
    again = load_calibration(tmp_path / "skin.npz")
    known = {"previous_readings": before[1:4], "temperature": 20 + DEPTH[1:4]}
    assert_same_predictions(fitted, again, POSITIONS[1:4], both[1:4], **known)
    alone = again.predict(POSITIONS[2], both[2], previous_readings=before[2], temperature=20 + DEPTH[2])
    np.testing.assert_allclose(alone[0], fitted.predict(POSITIONS[1:4], both[1:4], **known)[0][1], rtol=1e-6)
    nowhere = calibrate(None, DEPTH, READINGS, load_kind="depth")
    assert nowhere.predict(None, DEPTH[:4])[0].shape == (4, 15)
    assert nowhere.predict(None, 1e-3)[0].shape == (15,)
    assert unknown.predict(POSITIONS[:4])[0].shape == (4, 15)


@BOTH_KINDS
def test_a_calibration_holds_the_readings_that_it_was_given(which, load, request):
    """A structured process gives them back as the product of the system's factor with its weights."""
    pressed = calibrated_presses(request.getfixturevalue(which), BOARD)
    np.testing.assert_allclose(pressed.readings, READINGS, atol=0.2)
    np.testing.assert_allclose(pressed.position, POSITIONS, atol=1e-8)
    np.testing.assert_allclose(pressed.load, load, rtol=1e-6)
    assert pressed.by_force == (which == "structured")


def test_tips_are_told_by_their_shape_and_radius():
    assert parse_tip("sphere:4.0") == BALL
    assert parse_tip("cylinder:2") == RoundTip("cylinder", 2e-3)
    for wrong in ("tip", "sphere", "sphere:x", "sphere:-1", "sphere:80", "cone:2", "sphere:nan"):
        with pytest.raises(ValueError, match=f'"{wrong}" is no tip'):
            parse_tip(wrong)
