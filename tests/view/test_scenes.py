"""States of the page's scenes, without a browser: each event changes the state as the library says."""

import ast
import re
from dataclasses import replace

import numpy as np
import pytest
from helpers.random_touches import make

import i2t
from i2t.hardware.protocols import Samples, SkinCounters
from i2t.objects.named import read_object
from i2t.skin.boards import make_board
from i2t.skin.pad import pad_from_seed
from i2t.view import explore, live, recognize, replay
from i2t.view.contents import Contents, read_contents

UP = np.array([0.0, 0.0, 1.0])
BOARD = make_board("reskin")


@pytest.fixture(scope="module")
def predictor():
    return i2t.load_predictor("nominal")


@pytest.fixture(scope="module")
def star(predictor):
    pads = {"nominal": pad_from_seed(0), "grid-3x3": pad_from_seed(0, board=make_board("grid-3x3"))}
    return explore.begin(read_object("star", None), {"nominal": predictor}, pads)


@pytest.fixture(scope="module")
def pressed(star):
    return explore.update(star, explore.ObjectClicked((2e-3, 1e-3, 0.3), -UP))


def test_a_click_gives_the_reading_of_the_pose_that_contact_pose_gives(predictor, star, pressed):
    mesh = star.object.mesh
    np.testing.assert_allclose(pressed.T_o_t, i2t.contact_pose(mesh, pressed.T_o_t[:3, 3]), atol=1e-9)
    np.testing.assert_allclose(pressed.T_o_t[:3, 3], (2e-3, 1e-3, np.max(mesh.vertices[:, 2])), atol=1e-6)
    mean, std = predictor.predict_touch(mesh, pressed.T_o_t, force=star.load)
    np.testing.assert_allclose(pressed.readings["predicted"].mean, mean, rtol=1e-5)
    np.testing.assert_allclose(pressed.readings["predicted"].std, std, rtol=1e-5)
    simulated = pressed.readings["simulated"].mean
    assert np.linalg.norm(simulated - mean) < np.linalg.norm(simulated)
    assert "star, 0.96 N" in pressed.message
    text = explore.describe(pressed)
    shown = [ast.literal_eval(part) for part in re.findall(r"\[\[.*?\]\]", text, re.DOTALL)]
    np.testing.assert_allclose(shown[0], pressed.T_o_t, atol=1e-7)
    np.testing.assert_allclose(np.ravel(shown[1]), mean, atol=0.051)


def test_a_harder_press_reads_more(pressed):
    harder = explore.update(pressed, explore.Loaded(2.0))
    for name, reading in pressed.readings.items():
        assert np.linalg.norm(harder.readings[name].mean) > np.linalg.norm(reading.mean)


@pytest.mark.full
def test_a_load_is_taken_as_the_chosen_predictor_takes_it(star, pressed):
    """A predictor of presses by travel takes millimetres from the slider; the one by force takes its usual force."""
    dataset = i2t.load_dataset("nominal")
    touches = dataset.touches._replace(force=np.full(len(dataset), np.nan))
    by_travel = i2t.fit_predictor(replace(dataset, touches=touches), method="gp")
    state = explore.begin(star.object, {"travel": by_travel, "nominal": star.predictors["nominal"]}, star.pads)
    state = explore.update(state, explore.Moved(pressed.T_o_t))
    assert state.load == by_travel.default_travel
    state = explore.update(state, explore.Loaded(0.3))
    assert state.load == pytest.approx(0.3e-3)
    assert "star, 0.30 mm of travel" in state.message
    assert "the touch is not simulated" in state.message
    assert explore.update(state, explore.Chosen("nominal", "nominal")).load == star.load


def test_a_click_beside_the_object_changes_nothing(pressed):
    assert explore.update(pressed, explore.ObjectClicked((0.5, 0.5, 0.3), -UP)) is pressed


def test_a_pose_away_from_the_object_is_refused_with_the_reason(pressed):
    T_o_t = pressed.T_o_t.copy()
    for moved, why in (
        ((0, 0, 0.05), "in front of the skin"),
        ((0, 0, -0.012), "behind the skin"),
        ((0.2, 0, 0), "nothing lies"),
    ):
        T_o_t[:3, 3] = pressed.T_o_t[:3, 3] + moved
        refused = explore.update(pressed, explore.Moved(T_o_t))
        assert refused.message.startswith(explore.REFUSED)
        assert why in refused.message
        assert not refused.readings
    assert explore.update(refused, explore.Moved(pressed.T_o_t)).readings


def test_a_place_that_an_arm_would_not_touch_is_named(star):
    with pytest.warns(UserWarning, match="stands out"):
        side = explore.update(star, explore.ObjectClicked((0.0, -0.3, 0.02), (0.0, 1.0, 0.0)))
    assert "An arm would not touch here, on a table at z = 0: its normal is" in side.message
    assert "would meet the table" in side.message


def test_a_pad_of_another_board_is_drawn_alone(pressed):
    other = explore.update(pressed, explore.Chosen("nominal", "grid-3x3"))
    assert set(other.readings) == {"simulated"}
    assert other.board.num_chips == 9
    assert "different boards" in other.message
    assert set(explore.update(other, explore.Chosen("nominal", explore.NO_PAD)).readings) == {"predicted"}


@pytest.fixture(scope="module")
def episode():
    meshes = {name: i2t.make_object(name).mesh for name in ("star", "cylinder")}
    return recognize.begin(meshes, i2t.load_pad_model("nominal"), pad_from_seed(0), "star")


def test_touches_where_the_belief_asks_recognise_the_object(episode):
    state = episode
    assert state.probability.tolist() == [0.5, 0.5]
    for _ in range(recognize.CONFIG.max_touches):
        asked = state.recognizer.choose_touch(state.states[-1])
        if asked is None:
            break
        state = recognize.update(state, recognize.Touch())
        assert state.states[-1].touched[asked.number]
    assert list(state.meshes)[state.probability.argmax()] == "star"
    assert "no further touch" in state.message
    assert recognize.update(state, recognize.Touch()).steps == state.steps
    begun = recognize.update(state, recognize.TouchesShown(0))
    assert begun.probability.tolist() == [0.5, 0.5]
    assert len(begun.steps) == len(state.steps)
    assert recognize.update(state, recognize.Begun("cylinder")).steps == ()
    again = recognize.update(begun, recognize.Touch())  # from the state that is shown
    assert len(again.steps) == 1
    assert again.states[-1].touches == 1


def test_a_clicked_site_is_touched_once(episode):
    number = int(np.nanargmax(episode.recognizer.expected_information(episode.states[0])))
    state = recognize.update(episode, recognize.Touch(number))
    assert state.states[-1].touched[number]
    with pytest.raises(ValueError, match="touched already"):
        recognize.update(state, recognize.Touch(number))


@pytest.mark.full
def test_the_beliefs_of_a_recorded_session_are_those_of_recognize():
    dataset, pad_model = i2t.load_dataset("nominal"), i2t.load_pad_model("nominal")
    dataset = dataset.select(np.isin(dataset.touches.session, (0, 9)))
    meshes = {name: i2t.make_object(name).mesh for name in ("hexagon", "cylinder")}
    state = recognize.begin_recorded(meshes, dataset, pad_model)
    expected = i2t.recognize(meshes, dataset, pad_model)
    for row in (0, 1):
        state = recognize.update(state, recognize.Begun(expected.sessions[row]))
        np.testing.assert_allclose(state.probability, expected.probability[row, -1])
        assert state.touched == expected.touched[row]


def test_filters_and_order_choose_the_touches():
    state = replay.begin(Contents(None, make(40, seed=3), (), None), None)
    labels = state.labels
    chosen = replay.update(state, replay.Filtered(("star", replay.EVERY, "skin"), False))
    assert chosen.rows.tolist() == np.flatnonzero((labels[0] == "star") & (labels[2] == "skin")).tolist()
    with pytest.raises(ValueError, match="choose others"):
        replay.update(state, replay.Filtered(("star", "none", replay.EVERY), False))
    state = state._replace(error=np.where(np.arange(40) % 3 == 0, np.nan, np.arange(40.0)))
    worst = replay.update(state, replay.Filtered((replay.EVERY,) * 3, True))
    assert worst.rows[:3].tolist() == [38, 37, 35]
    assert replay.update(worst, replay.TouchShown(1)).row == 37
    assert replay.update(worst, replay.TouchStepped(1)).row == 37
    assert replay.update(worst, replay.TouchStepped(-1)).row == 38
    assert replay.update(worst, replay.TouchShown(99)).at == 39
    assert replay.update(worst, replay.TouchClicked(35)).at == 2


def test_readings_are_compared_with_the_prediction(predictor):
    contents = read_contents(i2t.models.ready_path("nominal", "touches.h5"), max_touches=12)
    state = replay.begin(contents, predictor)
    score = predictor.score(contents.dataset, np.flatnonzero(np.isfinite(state.error)))
    assert len(score.measured) == np.sum(contents.dataset.touches.code != i2t.ReturnCode.AIR)
    rows = np.flatnonzero(np.isfinite(state.error))
    np.testing.assert_allclose(
        state.error[rows], np.sqrt(np.mean((score.predicted.mean - score.measured) ** 2, axis=1)), rtol=1e-5
    )
    other = replace(contents, dataset=replace(contents.dataset, board=make_board("anyskin")))
    assert np.isnan(replay.begin(other, predictor).error).all()


def samples(reading, count=20):
    return Samples(np.arange(count), np.arange(count) / 400, np.tile(reading, (count, 1)), np.full((count, 5), 25.0))


def test_a_running_skin_shows_its_change_its_rate_and_its_losses():
    rest = np.linspace(-50, 50, 15)
    counters = SkinCounters(samples=900, lost=100, rate=399.6)
    state = live.Live("the skin (emulated)", BOARD, None)
    state = live.update(state, live.Ticked(samples(rest), counters, 30.0))
    assert state.change is None
    noise = np.random.default_rng(0).normal(size=(120, 15))
    state = live.update(state, live.Zeroed(samples(rest, 120)._replace(reading=rest + 3 * noise)))
    state = live.update(state, live.Ticked(samples(rest + 3 * noise.mean(0) + 8), counters, 30.0))
    np.testing.assert_allclose(state.change, 8.0, atol=1e-9)
    assert "healthy at rest" in state.message
    assert "400 Hz, 900 samples, lost 100 (10.00 %), 30 updates a second" in state.message
    assert f"{8 * np.sqrt(15):.1f} µT" in state.message
    gone = live.update(live.update(state, live.Recorded("a.csv holds 9 samples")), live.Lost("is gone"))
    assert gone.change is None
    assert "is gone" in gone.message
    assert "a.csv holds 9 samples" in gone.message


def test_a_chip_that_does_not_answer_is_named():
    reading = np.arange(15.0)
    reading[6:9] = np.nan
    noise = 3 * np.random.default_rng(0).normal(size=(120, 15))
    state = live.Live("the skin", BOARD, i2t.load_calibration("eflesh"))
    state = live.update(state, live.Zeroed(samples(reading, 120)._replace(reading=reading + noise)))
    state = live.update(state, live.Ticked(samples(reading + 40), SkinCounters(), 30.0))
    assert "no answer from chip 2" in state.message
    assert f"change of all chips: {40 * np.sqrt(12):.0f}"[:-1] in state.message  # of four chips
    assert "no position, because a chip does not answer" in state.message


def test_a_contact_has_the_place_that_the_calibration_gives():
    calibration = i2t.load_calibration("eflesh")
    state = live.Live("the skin (real)", BOARD, calibration, rest=np.zeros(15))
    for place in np.array([[4e-3, -6e-3], [-8e-3, 2e-3]]):
        reading = calibration.predict(place, 2e-3)[0]
        state = live.update(state, live.Ticked(samples(reading), SkinCounters(), 30.0))
        np.testing.assert_allclose(state.place.position, place, atol=1.5e-3)
        assert f"contact at x {1e3 * state.place.position[0]:.1f} ±" in state.message
    state = live.update(state, live.Ticked(samples(np.tile([900.0, -900, 900], 5)), SkinCounters(), 30.0))
    assert "no position: the reading differs" in state.message
