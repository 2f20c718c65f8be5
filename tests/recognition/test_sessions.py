"""Recognition of recorded sessions: sessions that count, what the result shows, and touches that are refused."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.random_touches import sessions_of

import i2t
from i2t.dataset.digests import touch_digests
from i2t.errors import DataError
from i2t.recognition import sessions
from i2t.recognition.sessions import choose_sessions

NAMES = ("hexagon", "star", "cylinder", "hammer")


def test_every_long_enough_session_counts_and_the_limit_is_reported():
    dataset = sessions_of(36, 12, 4, 20)
    chosen = choose_sessions(dataset, 10, None)
    assert (chosen.names, chosen.touches) == (("run 0", "run 1", "run 3"), 12)
    assert "left out, with too few: run 2 (4)" in chosen.describe()
    chosen = choose_sessions(dataset, 10, 20)
    assert (chosen.names, chosen.touches) == (("run 0", "run 3"), 20)
    with pytest.raises(DataError, match="no session has 40 touches with a measured force; the longest has 36"):
        choose_sessions(dataset, 10, 40)
    chosen = choose_sessions(sessions_of(3, 2), 10, None)
    assert chosen.names == ("run 0",)
    assert "1 sessions of 3 usable touches; no session has the 10 that were asked for" in chosen.describe()


@pytest.fixture
def dataset():
    return i2t.load_dataset("nominal")


@pytest.fixture
def seen(monkeypatch):
    """What the belief is given, which takes every session for the star; the position alone for the hammer."""
    seen = {}

    def believe(surfaces, sites, episodes, particles, models, *, overtravel, label):
        seen.update(episodes=episodes, particles=particles, overtravel=overtravel)
        e, t = episodes.site.shape
        star, hammer = (np.tile(np.eye(len(NAMES))[i], (e, t, 1)) * 0.9 + 0.025 for i in (1, 3))
        return {"fused": star, "readings": star, "position and presence": hammer}

    monkeypatch.setattr(sessions, "believe", believe)
    return seen


def test_each_session_is_listed_with_its_object_and_the_number_recognised(dataset, seen):
    """The parallelogram and the screwdriver are no candidates, and every other session is taken for the star."""
    meshes = {name: i2t.make_object(name).mesh for name in NAMES}
    config = i2t.RecognizerConfig(num_particles=8, overtravel=2e-3)
    result = i2t.recognize(meshes, dataset, i2t.load_pad_model("nominal"), config=config, touches=4)
    assert result.probability.shape == (18, 4, 4)
    assert len(seen["particles"].twist) == 8
    assert seen["overtravel"] == 2e-3
    np.testing.assert_array_equal(seen["episodes"].truth, np.repeat([0, -1, 1, 2, 3, -1], 3))
    assert result.touched == tuple(np.repeat(dataset.objects, 3))
    assert set(result.recognized) == {"star"}
    said = str(result)
    assert said.startswith("18 sessions of 4 touches, 4 objects (simulated)\n")
    assert "session 003  parallelogram (no candidate)  star           0.93" in said
    rate, kinds, record, also = said.splitlines()[-4:]
    assert rate == "recognised 3 of 12 sessions: 0.25 (95 % interval [0.01, 0.89] over 4 objects; chance 0.25)"
    assert kinds == "by kind of evidence: all 0.25, position and presence 0.25, readings 0.25"
    assert record == "whether these sessions were used in the fit of the pad model is not recorded"
    assert also == "the pad model was also fitted to touches of hexagon"
    assert repr(result) == "RecognizedSessions(18 sessions, 4 objects, simulated)"


def test_sessions_of_the_fit_do_not_count_in_the_rate(dataset, seen):
    known, numbers = i2t.load_pad_model("nominal"), dataset.touches.session
    meshes = {name: i2t.make_object(name).mesh for name in NAMES}

    def recognize(*used: str) -> i2t.RecognizedSessions:
        rows = np.isin(numbers, [dataset.sessions.index(name) for name in used]) & (np.arange(len(dataset)) % 2 == 0)
        digests = tuple(touch_digests(dataset.select(rows)))
        pad = known._replace(origin=replace(known.origin, objects=("star",), used_touches=digests))
        return i2t.recognize(meshes, dataset, pad, touches=4)

    result = recognize("session 000", "session 006")  # of hexagon and star
    assert np.flatnonzero(result.in_fit).tolist() == [0, 6]
    said = str(result).splitlines()
    assert said[2].endswith("  used in the fit")
    assert not any("used in the fit" in line for line in said[3:8])
    assert said[-4].startswith("recognised 2 of 10 sessions that were not used in the fit: 0.20 (95 % interval [")
    assert said[-4].endswith("] over 4 objects; chance 0.25)")
    assert said[-3] == "by kind of evidence: all 0.20, position and presence 0.30, readings 0.20"
    assert said[-2] == "2 of the 18 sessions were used in the fit of the pad model"
    assert said[-1] == "the pad model was also fitted to touches of star"
    of_two = [name for name, shape in zip(dataset.sessions, result.touched, strict=True) if shape in ("star", "hammer")]
    rest = sorted(set(dataset.sessions) - set(of_two))
    assert "recognised 3 of 6 sessions that were not used in the fit: 0.50 (no interval: 2 objects;" in str(
        recognize(*rest)
    )
    assert "recognised" not in str(recognize(*dataset.sessions))
    assert "0 of the" not in (none := str(recognize()))
    assert "not recorded" not in none


def test_presses_of_an_indenter_hold_no_object_to_recognise(dataset):
    upright = dataset.touches._replace(T_w_t=np.tile(np.eye(4, dtype=np.float32), (len(dataset), 1, 1)))
    presses = replace(dataset, touches=upright, objects=("sphere:4.0", *dataset.objects[1:]))
    with pytest.raises(DataError, match=r"DATA: holds presses of an indenter \(sphere:4\.0, .*no object to recognise"):
        sessions.require_objects_touched(presses, "DATA")
    sessions.require_objects_touched(dataset)


def test_touches_of_another_skin_are_refused_or_noted(dataset):
    other = replace(dataset, pads=("skin A",))
    meshes = {name: i2t.make_object(name).mesh for name in NAMES}
    known = i2t.load_pad_model("nominal")
    with pytest.raises(DataError, match=r'the skin is "skin A", and the pad model of .* is of "simulated pad 0"'):
        i2t.recognize(meshes, other, known)
    assert sessions.session_touches(other, known, enough=4, other_skin=True).warning.startswith("ANOTHER SKIN: ")


@pytest.mark.full
def test_the_shipped_touches_are_recognised(dataset):
    some = dataset.select(np.isin(dataset.touches.session % 3, [0]))
    meshes = {name: i2t.make_object(name).mesh for name in dataset.objects}
    result = i2t.recognize(meshes, some, i2t.load_pad_model("nominal"))
    assert result.recognized == result.touched == dataset.objects
