"""Calibrations: from arrays, in files, for any board, and refusals of wrong input."""

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from i2t.errors import SerializationError
from i2t.files import serialization
from i2t.skin import boards
from i2t.skin.files import load_pad
from i2t.skin_models import FORCE_HYPERPARAMETERS, Calibration, calibrate, load_calibration
from i2t.skin_models.calibration import FILE_KIND, CalibrationRecord
from i2t.skin_models.tip_gp import population

rng = np.random.default_rng(0)
POSITIONS, TRAVEL = rng.uniform(-10e-3, 10e-3, (30, 2)), rng.uniform(0, 4e-3, 30)
FORCE = 1e3 * TRAVEL
READINGS = rng.normal(scale=30, size=(30, 15))
BOARD = boards.reskin_board()


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    return calibrate(POSITIONS, TRAVEL, READINGS, load_kind="travel", metadata={"skin": "made up"})


@pytest.fixture(scope="module")
def structured() -> Calibration:
    """A calibration with a single kernel, from given hyperparameters."""
    given = {"board": BOARD, "hyperparameters": FORCE_HYPERPARAMETERS, "metadata": {"skin": "made up"}}
    return calibrate(POSITIONS, FORCE, READINGS, load_kind="force", **given)


@pytest.fixture(scope="module")
def unknown() -> Calibration:
    """A calibration without any load."""
    return calibrate(POSITIONS, None, READINGS, load_kind="none")


BOTH_KINDS = pytest.mark.parametrize(("which", "load"), [("calibration", TRAVEL), ("structured", FORCE)])


def assert_same_predictions(first: Calibration, second: Calibration, *given, **more) -> None:
    for a, b in zip(first.predict(*given, **more), second.predict(*given, **more), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5)


@BOTH_KINDS
def test_a_saved_calibration_loads_unchanged(which, load, request, tmp_path):
    original = request.getfixturevalue(which)
    original.save(tmp_path / "skin.npz")
    again = load_calibration(tmp_path / "skin.npz")
    assert (again.metadata, again.load_kind) == ({"skin": "made up"}, original.load_kind)
    assert_same_predictions(original, again, POSITIONS, load)
    assert original.predict(POSITIONS, load)[0].shape == (30, 15)
    mean, std = again.predict(POSITIONS[0], load[0])
    assert mean.shape == std.shape == (15,)
    assert (std > 0).all()
    with pytest.raises(SerializationError, match="not a i2t pad"):
        load_pad(tmp_path / "skin.npz")


@pytest.mark.parametrize("load", ["depth", "travel"])
def test_a_file_may_call_travel_depth(calibration, load, tmp_path):
    """As earlier files do."""
    about = {"load": load, "boards": list(calibration.boards), "about": {}}
    record = CalibrationRecord(calibration.gp, calibration.interval_scaling)
    serialization.save(tmp_path / "skin.npz", FILE_KIND, record, about)
    again = load_calibration(tmp_path / "skin.npz")
    assert again.load_kind == "travel"
    assert_same_predictions(calibration, again, POSITIONS, TRAVEL)


def by_travel(position=POSITIONS, load=TRAVEL, readings=READINGS, **given):
    return calibrate(position, load, readings, load_kind="travel", **given)


@pytest.mark.parametrize(
    ("call", "word"),
    [
        (lambda model, _: model.predict(POSITIONS, TRAVEL[:3]), "do not go with"),
        (lambda model, _: model.predict(1e3 * POSITIONS, TRAVEL), "give metres"),
        (lambda model, _: model.predict(POSITIONS, -TRAVEL - 1), "between 0 and"),
        (lambda *_: by_travel(readings=np.where(READINGS > 0, np.nan, READINGS)), "not finite"),
        (lambda *_: by_travel(POSITIONS[:4]), "do not belong together"),
        (lambda _, unknown: by_travel(previous_session=unknown), "other channels or another kind of load"),
        (lambda *_: by_travel(board=boards.grid_board(4, 4)), "16 chips"),
        (lambda *_: calibrate(None, None, READINGS, load_kind="none"), "cannot predict another press"),
        (lambda _, unknown: unknown.predict(POSITIONS[:4], TRAVEL[:4]), "loads do not match this calibration"),
    ],
)
def test_wrong_input_is_refused(calibration, unknown, call, word):
    with pytest.raises(ValueError, match=word):
        call(calibration, unknown)


def test_files_of_earlier_versions_are_refused_with_a_remedy(calibration, tmp_path):
    """Earlier files had terms for the temperature, or members without a board."""
    path = tmp_path / "old.npz"
    terms = {"load": "travel", "boards": list(calibration.boards), "about": {"linear_terms": ["temperature"]}}
    record = CalibrationRecord(calibration.gp, calibration.interval_scaling)
    no_board = record._replace(gp=record.gp._replace(components=record.gp.components._replace(board=None)))
    for form in (record, no_board):
        serialization.save(path, FILE_KIND, form, terms)
        with pytest.raises(SerializationError, match=r"calibrate again|make it again"):
            load_calibration(path)


@pytest.mark.full
def test_loads_and_boards_are_optional(unknown, tmp_path):
    both = np.column_stack([TRAVEL, FORCE])
    fitted = calibrate(
        POSITIONS, both, READINGS, load_kind="both", board=boards.eflesh_board(),
        previous_session=calibrate(POSITIONS, both, READINGS, load_kind="both"),
    )  # fmt: skip
    fitted.save(tmp_path / "skin.npz")
    again = load_calibration(tmp_path / "skin.npz")
    assert_same_predictions(fitted, again, POSITIONS[1:4], both[1:4])
    alone = again.predict(POSITIONS[2], both[2])
    np.testing.assert_allclose(alone[0], fitted.predict(POSITIONS[1:4], both[1:4])[0][1], rtol=1e-6)
    nowhere = calibrate(None, TRAVEL, READINGS, load_kind="travel")
    assert nowhere.predict(None, TRAVEL[:4])[0].shape == (4, 15)
    assert nowhere.predict(None, 1e-3)[0].shape == (15,)
    assert unknown.predict(POSITIONS[:4])[0].shape == (4, 15)


def test_few_presses_are_fitted_with_one_blas_thread_which_is_undone_afterwards(monkeypatch):
    """Waiting threads cost many times more than small matrices."""
    seen, fit = [], population.fit_population

    def fitting(*args, **more):
        seen.extend(blas_threads())
        return fit(*args, **more)

    def blas_threads() -> list[int]:
        return [library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"]

    monkeypatch.setattr(population, "fit_population", fitting)
    with threadpool_limits(2, user_api="blas"):
        before = blas_threads()
        by_travel(POSITIONS[:5], TRAVEL[:5], READINGS[:5])
        assert blas_threads() == before
    assert set(seen) == {1}


def test_a_press_is_located_by_its_reading():
    """Presses between those of the fit, with the noise that the calibration expects, lie within the stated errors."""
    eflesh, draw = load_calibration("eflesh"), np.random.default_rng(1)
    at = draw.uniform(-10e-3, 10e-3, (60, 2))
    mean, std = eflesh.predict(at, np.full(60, 2.5e-3))
    located = [eflesh.locate(row) for row in mean + std * draw.normal(size=std.shape)]
    errors = np.array([press.position for press in located]) - at
    stds = np.array([press.position_std for press in located])
    inside = np.abs(errors) < 2 * stds
    assert inside.mean() > 0.9
    assert np.sqrt(np.mean(errors**2)) < 2e-3
    assert 0.3 < np.median([press.misfit for press in located]) < 2
    assert eflesh.locate(np.full(15, 2000.0)).misfit > 10
    with pytest.raises(ValueError, match="give the 15 values"):
        eflesh.locate(np.zeros(12))


def test_a_press_is_located_without_any_load(unknown):
    press = unknown.locate(READINGS[0])
    assert press.load.shape == (0,)
    assert np.isfinite(press.position).all()


def test_a_press_is_located_with_travels_and_forces_of_any_combination():
    both = calibrate(POSITIONS, np.stack([TRAVEL, FORCE[::-1]], -1), READINGS, load_kind="both")
    loads = both._press_grid[1]
    assert len(np.unique(loads, axis=0)) == 36
    assert both.locate(READINGS[0]).load.shape == (2,)


def test_a_calibration_without_positions_locates_nothing():
    blind = calibrate(None, TRAVEL, READINGS, load_kind="travel")
    with pytest.raises(ValueError, match="without positions"):
        blind.locate(READINGS[0])
