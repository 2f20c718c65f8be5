"""What is found wrong in a recording is put right before anything is fitted to it."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.damage import VARIANTS, press

from i2t.calibration.heads import SkinRecording, corrected_recording
from i2t.unknowns import Finding, RecordedPresses, estimate_labels


def as_recording(one):
    n = len(one.readings)
    return SkinRecording(
        name="made",
        readings=one.readings,
        targets={"position": one.position, "depth": -one.height[:, None], "force": one.force[:, None]},
        session=np.zeros(n, int),
        time=np.arange(n, dtype=float),
    )


def estimated(recording):
    presses = RecordedPresses(
        recording.targets["position"],
        recording.readings,
        height=-recording.targets["depth"][:, 0],
        force=recording.targets["force"][:, 0],
    )
    return estimate_labels(presses)


SOUND = press(3, 90, free=0.0)
MISTAKES = ("force that pulls", "height into the skin", "positions in millimetres", "readings in millitesla")


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistaken_column_is_put_right(mistake):
    recording = as_recording(VARIANTS[mistake](SOUND))
    found = corrected_recording(recording, estimated(recording))
    expected = as_recording(SOUND)
    np.testing.assert_allclose(found.readings, expected.readings)
    for name in ("position", "force"):
        np.testing.assert_allclose(found.targets[name], expected.targets[name])
    # Turned depths keep their differences; from where they count is another question.
    difference = found.targets["depth"] - expected.targets["depth"]
    assert np.ptp(difference) < 1e-12
    assert found.targets["depth"].min() >= 0


@pytest.mark.parametrize("mistake", ["labels a row late", "labels two rows early"])
def test_labels_of_another_row_come_back_to_their_readings(mistake):
    recording = as_recording(VARIANTS[mistake](SOUND))
    found = corrected_recording(recording, estimated(recording))
    assert len(recording) > len(found) >= len(recording) - 2
    at = np.abs(found.readings[:, None] - SOUND.readings[None]).sum(-1).argmin(1)
    np.testing.assert_allclose(found.targets["position"], SOUND.position[at])
    np.testing.assert_allclose(found.targets["force"][:, 0], SOUND.force[at])
    np.testing.assert_array_equal(np.diff(found.time), 1)


def test_chips_in_disorder_are_put_in_order():
    recording = as_recording(SOUND)
    signs = np.ones(15)
    signs[4] = -1
    baseline = np.arange(15.0) * np.ones((90, 1))
    swapped = recording.readings.reshape(-1, 5, 3)[:, [0, 3, 2, 1, 4]].reshape(-1, 15)
    found = corrected_recording(
        replace(recording, readings=swapped, baseline=baseline),
        [Finding("chips", "", True, wrong=True, correction={"chip_order": [0, 3, 2, 1, 4], "channel_signs": signs})],
    )
    np.testing.assert_allclose(found.readings, recording.readings * signs)
    assert found.baseline[0, 3] == 9


def test_a_sound_recording_stays_as_it_is():
    recording = as_recording(SOUND)
    assert corrected_recording(recording, estimated(recording)) is recording
