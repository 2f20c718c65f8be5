"""Loads of recordings, and causes of poor predictors trained on them."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from helpers.baselines import placed_dataset, round_tip

from experiments.fidelity import causes
from experiments.fidelity.causes import SOFTNESS
from experiments.fidelity.config import FIDELITY_PRESETS
from experiments.fidelity.sections import written
from i2t.contact.pressure import PressureModelConfig
from i2t.dataset import save_dataset
from i2t.prediction.loads import press_load, rows_with_load
from i2t.recordings.diagnose import FindingName
from i2t.skin import boards

FORCED = PressureModelConfig(pitch=1e-3)


def recording(n=200, force=None, travel=None, seed=0):
    """A round tip at random positions of a skin, whose readings depend on load and position."""
    rng = np.random.default_rng(seed)
    place = rng.uniform(-6e-3, 6e-3, (n, 2))
    load = rng.uniform(0.5, 2.0, n)
    board = boards.reskin_board()
    near = np.exp(-((place[:, None] - board.chips[:, :2]) ** 2).sum(-1) / 2 / 5e-3**2)
    reading = 40 * load[:, None] * np.repeat(near, 3, axis=1) * rng.choice([-1, 1], 15)
    reading = reading + rng.normal(size=(n, 15))
    loads = {"force": load if force is None else force} | ({} if travel is None else {"travel": travel})
    return placed_dataset(place, round_tip(place, 24), reading, board=board, source="simulated", **loads)


UNKNOWN, NIL, RISING = np.full(200, np.nan), np.zeros(200), np.linspace(1e-4, 2e-3, 200)


@pytest.mark.parametrize(
    ("force", "travel", "control", "said"),
    [
        (None, None, "force", ""),
        (NIL, None, None, "forces are zero or negative"),
        (NIL, RISING, "travel", "forces are zero or negative"),
        (UNKNOWN, NIL, "travel", "100 % of the travels are zero"),
        (UNKNOWN, UNKNOWN, None, "predicted for 1 N in all touches"),
        (np.where(np.arange(200) % 2, 1.0, np.nan), UNKNOWN, None, "force is missing at 100 and travel at 200 of 200"),
    ],
)
def test_the_source_of_loads_is_reported_before_anything_is_computed(force, travel, control, said):
    found = press_load(recording(force=force, travel=travel).touches)
    assert found.control == (control if "1 N" not in said else found.control)
    assert said in "".join(found.notes[:1])
    assert found.constant == ("1 N" in said)


def test_a_few_touches_without_a_load_are_left_out():
    force = np.ones(200)
    force[::40] = np.nan
    rows, said = rows_with_load(recording(force=force))
    assert (rows.sum(), said) == (195, ("left out: 5 touches whose force is not known",))
    force[::2] = np.nan
    assert rows_with_load(recording(force=force))[0].all()


@pytest.mark.parametrize("lag", [0, 1, -2])
def test_late_labels_are_found(lag):
    made = recording(400)
    late = np.roll(made.touches.reading, -lag, axis=0)
    shifted = replace(made, touches=made.touches._replace(reading=late))
    (found,) = causes.late_rows(shifted)
    assert (found.name, found.wrong) == (FindingName.LAG, lag != 0)
    if lag:
        assert f"shifted by {lag:+d} rows" in found.sentence


def test_findings_and_omissions_are_recorded_in_the_data_set(tmp_path):
    """The findings are a section of the report of fidelity, on real touches that were split as for training."""
    made = recording(400)
    sessions = tuple(f"run {i}" for i in range(20))
    late = made.touches._replace(reading=np.roll(made.touches.reading, -1, axis=0), session=np.arange(400) // 20)
    save_dataset(tmp_path / "late.h5", replace(made, touches=late, sessions=sessions, source="real"))
    section = written("causes", partial(causes.cause_section, tmp_path / "late.h5", FIDELITY_PRESETS["debug"], 0))
    assert section.status == "found"
    said = "\n".join(section.sentences)
    assert "shifted by +1 rows" in said
    assert "Could not be tested: height zero" in said
    assert {each["name"] for each in section.numbers["causes"] if each["wrong"]} >= {FindingName.LAG}

    save_dataset(tmp_path / "simulated.h5", made)
    other = partial(causes.cause_section, tmp_path / "simulated.h5", FIDELITY_PRESETS["debug"], 0)
    assert written("causes", other).status == "cannot tell"


def test_a_skin_softer_than_the_nominal_one_is_named_with_its_option(monkeypatch):
    made, every, groups = recording(40), np.ones(40, bool), np.arange(40) // 8

    def explained(seen, cfg):
        return 0.5 if np.allclose(seen.force, 4 * made.touches.force) else 0.3

    monkeypatch.setattr(causes, "explained", explained)
    found = {one.name: one for one in causes.tried_changes(made, every, groups, FORCED)}
    assert [cause for cause, one in found.items() if one.wrong] == [SOFTNESS]
    assert "with a layer 4 times as soft (--softness 4) predicted pressures explain 0.50" in found[SOFTNESS].sentence


@pytest.mark.full
def test_a_changed_sign_or_height_is_found_by_trying_it():
    """The Gaussian process on predicted pressures shows which change explains the readings."""
    made = recording(160)
    every, groups = np.ones(160, bool), np.arange(160) // 8
    sound = causes.tried_changes(
        made, every, groups, replace(FORCED, pitch=17e-3 / 24, smooth=False, tilt=0.0, cell=1e-3)
    )
    assert not any(found.wrong for found in sound)
    pulled = replace(made, touches=made.touches._replace(force=-made.touches.force))
    cfg = replace(FORCED, pitch=17e-3 / 24, smooth=False, tilt=0.0, cell=1e-3)
    found = {one.name: one for one in causes.tried_changes(pulled, every, groups, cfg)}
    assert found[FindingName.FORCE_SIGN].wrong
