"""Heads: predictions, their uncertainty, refusals, and recordings in all formats and states."""

import gzip
from dataclasses import replace

import numpy as np
import pytest
from helpers.skin_presses import presses_of_a_skin
from scipy.stats import norm
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, DotProduct, WhiteKernel
from sklearn.neighbors import KNeighborsRegressor

from i2t.errors import DataError, SerializationError
from i2t.files import serialization
from i2t.heads import regression as methods
from i2t.heads.heads import FILE_KIND_OF_HEAD, fit_head, hold_out_groups, load_head, target_rows
from i2t.heads.regression import BASELINE_HEADS, HeadBudget
from i2t.recordings.read import SkinRecording, is_stream, read_recordings

SMALL = HeadBudget(selection_rows=150, known_rows=250)


@pytest.fixture(scope="module")
def recording() -> SkinRecording:
    return presses_of_a_skin(300)


@pytest.fixture(scope="module")
def position_head(recording):
    return fit_head(recording.rows(slice(0, 200)), "position", budget=SMALL)


def test_a_head_predicts_new_positions_better_than_the_baselines(recording, position_head):
    predicted, truth = position_head.predict(recording.readings[200:]), recording.targets["position"][200:]
    assert np.median(np.linalg.norm(predicted.mean - truth, axis=1)) < 0.4e-3  # the range is 20 mm
    assert 0.8 < np.mean(np.abs(predicted.mean - truth) < 1.645 * predicted.std) <= 1.0
    validation = position_head.validation
    assert validation[position_head.method] == min(validation.values())
    assert validation[position_head.method] < 0.5 * min(validation[name] for name in BASELINE_HEADS)


def test_untouched_rows_are_not_used_for_positions(recording):
    """Without travel and contact, a shear force of zero shows that the skin is not touched."""
    touched = np.arange(len(recording)) % 3 > 0
    place = {"position": recording.targets["position"]}
    shear = np.where(touched[:, None], [[0.1, -0.2]], 0.0)
    shear[-1] = np.nan
    for targets, rows in (
        ({"contact": touched[:, None] * 1.0}, np.flatnonzero(touched)),
        ({"shear": shear}, np.flatnonzero(touched)[:-1]),
        ({"shear": shear, "travel": recording.targets["travel"]}, np.arange(len(recording))),
    ):
        np.testing.assert_array_equal(target_rows(replace(recording, targets=place | targets), "position"), rows)


def test_a_changed_skin_is_unfamiliar_and_a_failed_chip_gives_nan(recording, position_head):
    readings = recording.readings[200:].copy()
    assert not position_head.predict(readings).unfamiliar.any()
    assert position_head.predict(readings + 500).unfamiliar.mean() > 0.95
    readings[1, 3] = np.nan
    predicted = position_head.predict(readings[:3])
    assert np.isfinite(predicted.mean[[0, 2]]).all()
    assert np.isnan(predicted.mean[1]).all()
    assert predicted.unfamiliar[1]


def test_the_mean_is_predicted_if_readings_hold_no_information(recording):
    rng = np.random.default_rng(1)
    deaf = replace(recording, readings=rng.normal(size=recording.readings.shape))
    head = fit_head(deaf, "travel", budget=SMALL)
    truth = recording.targets["travel"]
    assert head.validation[head.method] <= head.validation["mean"]
    predicted = head.predict(rng.normal(size=(100, 15)))
    np.testing.assert_allclose(predicted.mean.mean(), truth.mean(), rtol=0.15)
    # Its spread is that of the travels themselves.
    np.testing.assert_allclose(np.median(predicted.std), truth.std(), rtol=0.35)


@pytest.mark.parametrize("target", ["depth", "travel"])
def test_a_file_may_call_travel_depth(recording, target, tmp_path):
    """As earlier files do."""
    head = fit_head(recording, "travel", budget=SMALL, methods=())
    about = {"target": target, "validation": head.validation, "about": head.metadata}
    serialization.save(tmp_path / "head.npz", FILE_KIND_OF_HEAD, head.record, about)
    again = load_head(tmp_path / "head.npz")
    assert again.target == "travel"
    np.testing.assert_array_equal(again.predict(recording.readings).mean, head.predict(recording.readings).mean)


def presses_at_sites(side: int = 12, touches: int = 4) -> tuple[SkinRecording, np.ndarray]:
    """Touch each site of a grid several times by one travel; return the recording and the number of each press's site.

    Readings have an offset that is the same for all presses of a site.
    """
    rng = np.random.default_rng(0)
    along = np.linspace(-9e-3, 9e-3, side)
    sites = np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)
    site = rng.permutation(np.repeat(np.arange(len(sites)), touches))
    centres = rng.uniform(-15e-3, 15e-3, (20, 2))
    maps = np.exp(-((sites[:, None] - centres) ** 2).sum(-1) / 2 / 9e-3**2) @ rng.normal(scale=60, size=(20, 15))
    offset = 12 * rng.normal(size=(len(sites), 15))
    n = len(site)
    readings = (maps + offset)[site] + 0.5 * rng.normal(size=(n, 15))
    return SkinRecording("sites", readings, {"position": sites[site]}, np.zeros(n, int), np.full(n, np.nan)), site


@pytest.mark.parametrize("sites_repeat", [True, False])
def test_a_head_beats_nearest_readings_whether_or_not_sites_repeat(sites_repeat, tmp_path):
    recording, site = presses_at_sites()
    rng = np.random.default_rng(1)
    held = np.isin(site, rng.permutation(144)[:28])
    if sites_repeat:
        held = rng.permutation(held)
    train, asked, truth = recording.rows(~held), recording.readings[held], recording.targets["position"][held]
    head = fit_head(train, "position", budget=SMALL)
    neighbours = fit_head(train, "position", budget=SMALL, methods=(methods.NEAREST_READINGS,))
    missed = [np.sum((fitted.predict(asked).mean - truth) ** 2) for fitted in (head, neighbours)]
    assert missed[0] < missed[1]
    assert " near, " in head.method
    assert head.method.endswith(" far")
    head.save(tmp_path / "head.npz")
    again = load_head(tmp_path / "head.npz")
    assert (again.target, again.method, again.validation) == ("position", head.method, head.validation)
    for before, after in zip(head.predict(asked), again.predict(asked), strict=True):
        np.testing.assert_array_equal(before, after)
    for channels in (6, 30):
        with pytest.raises(ValueError, match="channels"):
            again.predict(np.tile(asked, 2)[:, :channels])
    (tmp_path / "head.npz").write_bytes(b"x")
    with pytest.raises(SerializationError, match="damaged"):
        load_head(tmp_path / "head.npz")


def test_ranges_hold_on_strokes_that_err_alike():
    """Each stroke has its own gain: rows of one stroke err alike, and there are few strokes."""
    inside = []
    stroke, travel = np.repeat(np.arange(12), 25), np.tile(np.linspace(0.2, 4, 25), 12)
    train, time = stroke < 8, 0.1 * np.arange(300) + 5.0 * stroke
    for seed in range(6):
        rng = np.random.default_rng(seed)
        gain = np.exp(0.15 * rng.normal(size=12))[stroke]
        readings = 40 * (gain * travel)[:, None] * np.linspace(-1, 1, 15) + rng.normal(size=(300, 15))
        recording = SkinRecording("strokes", readings, {"force": travel[:, None]}, stroke, time)
        head = fit_head(
            recording.rows(train), "force", methods=("linear", "k nearest readings"), budget=SMALL, history=0
        )
        predicted = head.predict(readings[~train], stroke[~train])
        inside.append(np.mean(np.abs(predicted.mean - travel[~train, None]) <= 1.645 * predicted.std))
    assert np.mean(inside) > 0.88


def test_neighbours_and_gp_match_scikit_learn(recording):
    x, y = recording.readings[:120], recording.targets["position"][:120]
    at = recording.readings[200:220]
    near = methods.fit_regression(methods.NEAREST_READINGS, (0.0, 4.0), x, y)
    judge = KNeighborsRegressor(4, weights=lambda d: 1 / (d + 1e-6)).fit(near.features(x), y)
    np.testing.assert_allclose(methods.predict_regression(near, at), judge.predict(near.features(at)), atol=1e-9)
    fitted = methods.fit_regression(methods.READINGS_GP, (1.0, 0.7, 1e-2, np.inf, 1.0), x, y)
    kernel = RBF(0.7) + DotProduct(1e-6, "fixed") + WhiteKernel(1e-2)
    judge = GaussianProcessRegressor(kernel, optimizer=None, normalize_y=True).fit(fitted.features(x), y)
    predicted = methods.predict_regression(fitted, at)
    np.testing.assert_allclose(predicted, judge.predict(fitted.features(at)), rtol=1e-5, atol=1e-8)


def test_blocks_are_held_out_of_presses_and_strokes_of_a_stream():
    flat = presses_of_a_skin(80)
    assert 9 <= hold_out_groups(flat).max() + 1 <= 25
    large = replace(flat, targets={"position": 6 * flat.targets["position"]})  # of 6 mm there too
    assert hold_out_groups(large).max() + 1 > 60
    along = np.column_stack([np.linspace(0, 1e-2, 80), np.zeros(80)])
    line = replace(flat, targets={"position": along}, session=np.arange(80) // 10, time=0.1 * np.arange(80))
    np.testing.assert_array_equal(hold_out_groups(line), line.session)
    assert is_stream(line)
    assert not is_stream(flat)


@pytest.mark.parametrize(
    ("target", "change", "message"),
    [
        ("travel", {"readings": np.ones((300, 15))}, "no channel changes"),
        ("colour", {}, "not a target of a head"),
        ("force", {}, "has no known force"),
        ("travel", {"travel": np.full((300, 1), 2e-3)}, "has only one value of travel"),
        ("travel", {"travel": np.r_[np.arange(10.0), np.full(290, np.nan)][:, None]}, "20 are needed"),
        ("contact", {"contact": np.ones((300, 1))}, "not a target of a head"),
    ],
)
def test_unusable_recordings_are_refused_in_a_sentence(recording, target, change, message):
    readings = change.get("readings", recording.readings)
    with pytest.raises(ValueError, match=message):
        fit_head(replace(recording, readings=readings, targets=recording.targets | change), target, budget=SMALL)


def _session(folder, rows=60):
    """A session of eFlesh: strokes down and up at one place."""
    rng = np.random.default_rng(0)
    folder.mkdir()
    time = 1.7e9 + 0.05 * np.arange(rows) + 2.0 * (np.arange(rows) // 20)
    travel = 3 * np.abs(np.sin(np.pi * (np.arange(rows) % 20) / 19))
    grams = np.where(np.arange(rows) % 2, -1.0, 100 * travel)
    states = np.column_stack([time, np.full(rows, 10.0), np.full(rows, -5.0), 140 - travel, grams])
    readings = travel[:, None] * rng.normal(size=15) * 40 + rng.normal(size=(rows, 15))
    values = np.column_stack([time + 2e-3, readings])
    np.savetxt(folder / "states.csv", states, delimiter=",")
    np.savetxt(folder / "sensor_post_baselines.csv", values, delimiter=",")
    return states, values


def test_sessions_of_eflesh_are_read_as_recorded(tmp_path):
    states, values = _session(tmp_path / "one")
    (recording,) = read_recordings(tmp_path)
    np.testing.assert_allclose(recording.readings, values[:, 1:])
    np.testing.assert_allclose(
        recording.targets["travel"][:, 0], 1e-3 * (states[:, 3].max() - states[:, 3]), atol=1e-12
    )
    assert recording.known_rows("force").sum() == 30
    np.testing.assert_allclose(np.nanmax(recording.targets["force"]), 9.80665e-3 * states[::2, 4].max(), rtol=1e-12)
    assert len(np.unique(recording.session)) == 3
    assert is_stream(recording)
    assert {0.0, 1.0} <= set(recording.targets["contact"][:, 0])


def test_sound_rows_of_a_damaged_session_are_kept_and_an_empty_one_is_refused(tmp_path):
    _, values = _session(tmp_path / "one")
    path, states = (tmp_path / "one" / f"{name}.csv" for name in ("sensor_post_baselines", "states"))
    lines = path.read_text().splitlines()
    lines[3], lines[7] = lines[3].replace(",", ",nan,", 1), "what,is,this"
    lines[11] = ",".join([lines[11].split(",")[0], "ERR", *lines[11].split(",")[2:]])
    path.write_text("\n".join(lines[:-5]) + "\n")
    with gzip.open(tmp_path / "one" / "states.csv.gz", "wt") as file:
        file.write(states.read_text())
    states.unlink()
    (recording,) = read_recordings(tmp_path)
    assert 50 <= len(recording) <= 53
    assert any("not finite" in note for note in recording.notes)
    first_values = {round(row, 9) for row in values[:, 1]}
    assert all(round(row, 9) in first_values for row in recording.readings[:, 0][:2])
    path.write_text("")
    with pytest.raises(DataError, match="holds no row"):
        read_recordings(tmp_path)


def test_a_table_of_any_board_is_read(tmp_path):
    path = tmp_path / "mine.csv"
    path.write_text(
        "time_s,x_mm,y_mm,force_N,slip,session,b0x_uT,b0y_uT,b0z_uT,b1x_uT,b1y_uT,b1z_uT\n"
        "0,1,2,0.5,0,a,1,2,3,4,5,6\n0.1,1,2,,1,a,2,3,4,5,6,x\n0.2,-1,2,0.7,1,b,3,4,5,6,7,8\n"
    )
    (recording,) = read_recordings(path)
    np.testing.assert_array_equal(recording.readings, [[1, 2, 3, 4, 5, 6], [3, 4, 5, 6, 7, 8]])
    np.testing.assert_allclose(recording.targets["position"], [[1e-3, 2e-3], [-1e-3, 2e-3]])
    np.testing.assert_allclose(recording.targets["force"][:, 0], [0.5, 0.7])
    np.testing.assert_array_equal(recording.targets["slip"][:, 0], [0, 1])
    np.testing.assert_array_equal(recording.session, [0, 1])
    assert any("row" in note for note in recording.notes)
    path.write_text("x_mm,y_mm\n1,2\n")
    with pytest.raises(DataError, match="b0x_uT"):
        read_recordings(path)


@pytest.mark.full
def test_ranges_hold_on_blocks_of_a_real_skin(shared_data):
    (recording,) = read_recordings(shared_data / "eflesh" / "spatial")
    groups = hold_out_groups(recording)
    held = np.isin(groups, np.random.default_rng(1).permutation(groups.max() + 1)[:8])
    head = fit_head(recording.rows(~held), "position", budget=HeadBudget(200, 600))
    predicted, truth = head.predict(recording.readings[held]), recording.targets["position"][held]
    assert np.median(np.linalg.norm(predicted.mean - truth, axis=1)) < 0.8e-3
    assert 0.8 < np.mean(np.abs(predicted.mean - truth) < norm.ppf(0.95) * predicted.std) < 0.97
