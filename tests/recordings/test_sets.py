"""A data set is corrected once, when it is read, with one threshold for each fault."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.baselines import placed_dataset, round_tip
from helpers.damage import press

from i2t.recordings.diagnose import find_force_sign
from i2t.recordings.sets import corrected_dataset
from i2t.types import ReturnCode


def touches_of(n=60, travel=None, force=None, seed=0):
    """Presses of a lattice skin as a data set."""
    recorded = press(seed, n, free=0.0)
    given = {
        "travel": -recorded.height if travel is None else travel,
        "force": recorded.force if force is None else force,
    }
    return placed_dataset(recorded.position, round_tip(recorded.position, 24), recorded.readings, **given), recorded


@pytest.mark.parametrize(
    ("pulling", "turned"), [(60, True), (51, True), (40, False), (30, False), (9, False), (0, False)]
)
def test_forces_change_sign_if_four_in_five_pull(pulling, turned):
    """Forces of which 85 % pull change sign."""
    force = np.where(np.arange(60) < pulling, -2.0, 2.0)
    dataset, _ = touches_of(force=force)
    corrected, notes = corrected_dataset(dataset)
    np.testing.assert_allclose(corrected.touches.force, -force if turned else force)
    assert [("their sign is reversed" in note) for note in notes] == [True] * turned
    again, nothing = corrected_dataset(corrected)
    assert again is corrected
    assert nothing == ()


@pytest.mark.parametrize(("presses", "turned"), [(4, False), (5, True), (8, True)])
def test_a_few_pulling_presses_may_be_chance(presses, turned):
    assert find_force_sign(np.full(presses, -2.0)).wrong == turned
    for pulling in (47, 48):
        assert find_force_sign(np.where(np.arange(60) < pulling, -2.0, 2.0)).wrong == (pulling == 48)
    assert not find_force_sign(np.r_[np.full(4, -2.0), 2.0]).wrong
    assert "too few presses" in find_force_sign(np.full(4, -2.0)).sentence


def test_forces_of_both_signs_are_reported_and_kept():
    noisy = find_force_sign(np.random.default_rng(0).normal(size=200))
    assert (noisy.wrong, noisy.identifiable) == (False, False)
    assert "hardly act along tool z" in noisy.sentence


def test_negative_depths_change_sign_and_a_sound_set_is_unchanged():
    sound, recorded = touches_of()
    assert corrected_dataset(sound) == (sound, ())
    turned, notes = corrected_dataset(touches_of(travel=recorded.height)[0])
    np.testing.assert_allclose(turned.touches.travel, sound.touches.travel)
    assert "Travel is negative in 100 %" in notes[0]


def test_depths_from_a_zero_that_is_too_low_count_from_the_highest_press():
    """Presses lie above the stated height of first contact but still read."""
    lowered = 1.5e-3
    _, recorded = touches_of(150)
    height = recorded.height + lowered
    dataset, _ = touches_of(150, travel=np.maximum(-height, 0), force=np.full(150, np.nan))
    code = np.where(height > 0, int(ReturnCode.FREE), int(ReturnCode.UNDEFINED)).astype(dataset.touches.code.dtype)
    touches = dataset.touches._replace(nearest=height.astype(np.float32), code=code)
    corrected, notes = corrected_dataset(replace(dataset, touches=touches))
    np.testing.assert_allclose(corrected.touches.travel, height.max() - height, atol=1e-7)
    np.testing.assert_allclose(corrected.touches.nearest, height - height.max(), atol=1e-7)
    assert not (corrected.touches.code == ReturnCode.FREE).any()
    assert "but still read" in notes[0]
    again, nothing = corrected_dataset(corrected)
    assert again is corrected
    assert nothing == ()
