"""Findings correct a recording before anything is fitted to it."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.damage import VARIANTS, press

from i2t.recordings.diagnose import Finding, diagnose_labels
from i2t.recordings.presses import Presses
from i2t.recordings.read import SkinRecording, corrected_recording


def as_recording(recorded):
    n = len(recorded.readings)
    targets = {"position": recorded.position, "travel": -recorded.height[:, None], "force": recorded.force[:, None]}
    return SkinRecording("made", recorded.readings, targets, session=np.zeros(n, int), time=np.arange(n, dtype=float))


SOUND = press(3, 90, free=0.0)
EXPECTED = as_recording(SOUND)


def put_right(variant):
    recording = as_recording(VARIANTS[variant](SOUND))
    position, travel, force = (recording.targets[name] for name in ("position", "travel", "force"))
    presses = Presses(position, recording.readings, height=-travel[:, 0], force=force[:, 0])
    return recording, corrected_recording(recording, diagnose_labels(presses))


@pytest.mark.parametrize(
    "mistake", ["force that pulls", "height into the skin", "positions in millimetres", "readings in millitesla"]
)
def test_a_wrong_column_is_corrected(mistake):
    corrected = put_right(mistake)[1]
    np.testing.assert_allclose(corrected.readings, EXPECTED.readings)
    for name in ("position", "force"):
        np.testing.assert_allclose(corrected.targets[name], EXPECTED.targets[name])
    # Turned travels keep their differences; from where they count is another question.
    assert np.ptp(corrected.targets["travel"] - EXPECTED.targets["travel"]) < 1e-12
    assert corrected.targets["travel"].min() >= 0


@pytest.mark.parametrize("mistake", ["labels a row late", "labels two rows early"])
def test_shifted_labels_return_to_their_readings(mistake):
    recording, corrected = put_right(mistake)
    assert len(recording) > len(corrected) >= len(recording) - 2
    at = np.abs(corrected.readings[:, None] - SOUND.readings[None]).sum(-1).argmin(1)
    np.testing.assert_allclose(corrected.targets["position"], SOUND.position[at])
    np.testing.assert_allclose(corrected.targets["force"][:, 0], SOUND.force[at])
    np.testing.assert_array_equal(np.diff(corrected.time), 1)


def test_a_sound_recording_is_unchanged_and_baselines_are_scaled_with_readings():
    recording, same = put_right("sound")
    assert same is recording
    finding = Finding("units", "", True, wrong=True, correction={"field_factor": 1e3})
    corrected = corrected_recording(replace(EXPECTED, baseline=np.ones((90, 15))), [finding])
    np.testing.assert_array_equal(corrected.baseline, 1e3)
