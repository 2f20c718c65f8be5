"""Rigs that are nearly always a mistake: the list of mistakes, as far as a file alone shows them."""

from dataclasses import replace

import numpy as np
import pytest

from i2t.hardware.rig import Rig
from i2t.hardware.rig_checks import compare_lens, implausible_values, require_plausible
from i2t.objects.catalogue import make_object
from tests.faults.rig_mistakes import MISTAKES, right_rig

# What a file does not show, and only camera, arm and skin can contradict (tests/collect/test_first_touch.py).
LEFT_TO_THE_FIRST_TOUCH = {
    "TCP 50 mm too long", "TCP 50 mm too short", "TCP 10 mm too long", "TCP 10 mm too short", "TCP 50 mm aside",
    "TCP 20 mm aside", "TCP transposed", "TCP: degrees for radians", "TCP turned by half a turn about z",
    "TCP tilted by 15 degrees", "payload a kilogram too much", "hand-eye transposed",
    "camera turned by a quarter about its axis", "camera mounted the other way round",
    "hand-eye: degrees for radians", "hand-eye: radians for degrees", "camera 50 mm too far back",
    "camera 20 mm aside", "fx and fy swapped", "base 20 mm too low", "base 100 mm aside", "object on its head",
    "object 100 mm off along x", "object 100 mm off along y", "object 30 mm aside", "object 10 mm too high",
    "object inverted",
}  # fmt: skip


@pytest.fixture(scope="module")
def vertices():
    return make_object("star").mesh.vertices


def test_mistakes_are_numerous_and_correct_rigs_are_plausible(vertices):
    names = [mistake.name for mistake in MISTAKES]
    assert len(names) == len(set(names)) >= 53
    assert set(names) >= LEFT_TO_THE_FIRST_TOUCH
    for rig in (Rig(), right_rig()):
        assert implausible_values(rig) == implausible_values(rig, vertices) == []
        require_plausible(rig, vertices)
        assert compare_lens(rig.camera, rig.camera) == ""


@pytest.mark.parametrize("mistake", MISTAKES, ids=lambda mistake: mistake.name)
def test_a_mistake_is_refused_in_one_sentence_or_left_to_the_first_touch(mistake, vertices):
    right = right_rig()
    try:
        wrong = mistake.make(right)
        doubts = implausible_values(wrong, vertices)
        lens = compare_lens(wrong.camera, right.camera)
        doubts = [*doubts, *([lens] if lens else [])]
    except ValueError as error:
        doubts = [str(error)]
    assert bool(doubts) != (mistake.name in LEFT_TO_THE_FIRST_TOUCH)
    for sentence in doubts:
        assert "\n" not in sentence
        assert 25 < len(sentence) < 260


def test_an_implausible_rig_is_refused_with_the_flag_that_accepts_it(vertices):
    wrong = replace(Rig(), T_world_object=np.diag([1.0, -1.0, -1.0, 1.0]))
    with pytest.raises(ValueError, match=r"below the table: is it upside down.*--accept-unusual-rig"):
        require_plausible(wrong, vertices)
    (doubt,) = implausible_values(Rig(), 1e-3 * vertices)
    assert "check --unit" in doubt
