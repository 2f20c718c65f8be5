"""Recognition of recorded sessions: sessions that count, what the result shows, and touches that are refused."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.random_touches import sessions_of

import i2t
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


def test_each_session_is_listed_with_its_object_and_the_number_recognised(dataset, monkeypatch):
    """The parallelogram and the screwdriver are no candidates, and every other session is taken for the star."""
    seen = {}

    def believe(surfaces, sites, episodes, particles, models, *, overtravel, label):
        seen.update(episodes=episodes, particles=particles, overtravel=overtravel)
        e, t = episodes.site.shape
        return {"fused": np.tile(np.eye(4)[1], (e, t, 1)) * 0.9 + 0.025}

    monkeypatch.setattr(sessions, "believe", believe)
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
    assert said.endswith("recognised 3 of 12: 0.25 [0.08, 0.53], chance 0.25")
    assert repr(result) == "RecognizedSessions(18 sessions, 4 objects, simulated)"


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
