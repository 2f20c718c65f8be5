"""Faults are found, unanswerable questions are not identifiable, and sound recordings raise no alarm."""

import numpy as np
import pytest
from helpers.damage import VARIANTS, Recorded, press

from i2t.recordings import diagnose
from i2t.recordings.diagnose import Finding, FindingName
from i2t.recordings.diagnose.board import STAGES
from i2t.recordings.presses import Presses
from i2t.skin.boards import eflesh_board, reskin_board


@pytest.mark.parametrize(
    ("find", "enough"),
    [
        (diagnose.find_lag, 28),
        (diagnose.find_height_axis, 20),
        (diagnose.find_height_zero, 30),
        (lambda few: diagnose.find_board(few, reskin_board()), 25),
    ],
)
def test_a_finding_on_too_few_presses_states_how_many_are_enough(find, enough):
    rng = np.random.default_rng(0)
    place, travel, readings = rng.uniform(-8e-3, 8e-3, (30, 2)), rng.uniform(1e-3, 4e-3, 30), rng.normal(size=(30, 15))
    recorded = {n: Presses(place[:n], readings[:n], height=-travel[:n]) for n in (enough - 1, enough)}
    findings = {n: find(some) for n, some in recorded.items()}
    assert [findings[n].untested for n in recorded] == [True, False]
    sentences = {n: finding.sentence for n, finding in findings.items()}
    assert f"{enough - 1} presses are too few ({enough} are enough)" in sentences[enough - 1]
    assert "too few" not in sentences[enough]


def presses(recorded: Recorded) -> Presses:
    return Presses(recorded.position, recorded.readings, height=recorded.height, force=recorded.force)


def damaged(name: str, seed: int = 0, n: int = 140) -> Presses:
    return presses(VARIANTS[name](press(seed, n)))


def test_a_lag_of_a_few_rows_is_found_and_corrected():
    recording = presses(press(1, 90))
    for rows in (-3, 0, 1):
        late = Presses(np.roll(recording.position, rows, 0), recording.readings, height=np.roll(recording.height, rows))
        finding = diagnose.find_lag(late)
        assert finding.identifiable
        assert (finding.estimate, finding.wrong) == (rows, rows != 0)
        put_right = diagnose.corrected_presses(late, [finding])
        inner = slice(4, len(put_right.readings) - 4)
        at = np.abs(put_right.position[inner][:, None] - recording.position[None]).sum(-1).argmin(1)
        np.testing.assert_array_equal(put_right.readings[inner], recording.readings[at])


def test_wrong_signs_and_units_are_found_and_corrected():
    sound = damaged("sound")

    def findings_in(recording: Presses) -> dict[str, Finding]:
        return {
            "height": diagnose.find_height_axis(recording),
            "force": diagnose.find_force_sign(recording.force, recording.readings),
            "units": diagnose.find_units(recording.position, recording.readings),
        }

    assert not any(finding.wrong for finding in findings_in(sound).values())
    for name, which, field in (
        ("height into the skin", "height", "height"),
        ("force that pulls", "force", "force"),
        ("positions in millimetres", "units", "position"),
        ("readings in millitesla", "units", "readings"),
    ):
        recording = damaged(name)
        finding = findings_in(recording)[which]
        assert finding.wrong, name
        put_right = diagnose.corrected_presses(recording, [finding])
        np.testing.assert_allclose(getattr(put_right, field), getattr(sound, field), rtol=1e-12)


def test_lengths_of_one_unit_are_corrected_together_and_nearly_equal_positions_are_doubtful():
    sound = damaged("sound")
    travel, readings = sound.height.max() - sound.height, np.repeat(100 * np.sin(200 * sound.position), 6, axis=1)

    def units(position: float, load: float | None) -> Finding:
        loads = None if load is None else load * travel
        return diagnose.find_units(position * sound.position, readings, travel=loads)

    assert units(1e-3, 1e-3).correction == {"length_factor": 1e3, "travel_factor": 1e3}
    for finding, factor in ((units(1, 1e-3), "travel"), (units(8e-4, 1), "length")):
        assert list(finding.correction) == [f"{factor}_factor"]
        assert "alone" in finding.sentence
    one_place = units(1e-5, 1)
    assert (one_place.identifiable, one_place.wrong) == (False, False)
    assert "unit is doubtful" in one_place.sentence
    assert "one place" in one_place.advice
    assert units(1, 1).identifiable


def test_unanswerable_questions_are_reported_as_not_identifiable():
    """Similar rows show no lag, forces of both signs no sign, and presses to one height no height zero."""
    height = 1e-3 * np.cos(np.linspace(0, 6 * np.pi, 600))
    readings = np.outer(np.maximum(-height, 0) ** 1.5, np.linspace(-3e6, 3e6, 15))
    alike = diagnose.find_lag(Presses(np.zeros((600, 2)), readings, height=height))
    both_ways = diagnose.find_force_sign(np.random.default_rng(0).normal(size=100))
    one_height = diagnose.find_height_zero(damaged("one height", n=600))
    no_height = diagnose.find_height_zero(Presses(np.zeros((600, 2)), readings))
    for finding, words in (
        (alike, "nearly alike"), (both_ways, "axes"), (one_height, "one height"), (no_height, "no height"),
    ):  # fmt: skip
        assert not finding.identifiable
        assert not finding.wrong
        assert words in finding.sentence
    assert one_height.estimate is None


def test_too_few_complete_rows_give_no_findings():
    recording = damaged("sound")
    lost = np.where(np.arange(140)[:, None] < 3, recording.position, np.nan)
    assert diagnose.diagnose(Presses(lost, recording.readings, height=recording.height), None) == []


def test_approaches_show_first_contact():
    rng = np.random.default_rng(2)
    down = np.concatenate([np.full(20, 2e-3), np.linspace(2e-3, -3e-3, 120)])
    height = np.concatenate([down, down[::-1]] * 3) + 0.25
    pattern = rng.normal(0, 100, 15)
    readings = np.outer((np.maximum(0.2504 - height, 0) / 1e-3) ** 1.5, pattern) + rng.normal(0, 2, (len(height), 15))
    approaches = diagnose.find_approaches(height, readings)
    assert len(approaches) == 3
    np.testing.assert_allclose(approaches, 0.2504, atol=0.1e-3)
    recording = Presses(np.zeros((len(height), 2)), readings, height=height)
    finding = diagnose.find_height_zero(recording)
    assert finding.identifiable
    assert [diagnose.find_height_zero(recording, stated=finding.estimate + off).wrong for off in (0, 1e-3)] == [
        False,
        True,
    ]
    assert finding.estimate == np.median(approaches)
    assert not len(diagnose.find_approaches(rng.permutation(height), readings))


def test_a_rotated_board_measures_the_same_field():
    board = reskin_board()
    for matrix in STAGES.values():
        turned = diagnose.rotate_board(board, matrix.astype(float))
        # In the stage's axes a chip lies where the matrix maps to its place on the board.
        np.testing.assert_allclose(turned.chips[:, :2] @ matrix.T, board.chips[:, :2], atol=1e-9)
        back = diagnose.rotate_board(turned, np.linalg.inv(matrix))
        np.testing.assert_allclose(back.rotations, board.rotations, atol=1e-6)


def anyskin_like():
    """Describe the board of the helper's skin: positions of ReSkin's chips, with the axes of the tool."""
    board = reskin_board()
    return board._replace(rotations=np.tile(np.eye(3, dtype=np.float32), (5, 1, 1)))


@pytest.mark.full
def test_height_zero_is_found_if_presses_lie_on_both_sides():
    recording = damaged("another height zero", 0, 320)
    finding = diagnose.find_height_zero(recording, stated=0.1430)
    assert finding.identifiable
    assert finding.wrong
    assert abs(finding.estimate - 0.1426) < 0.1e-3
    below = recording.rows(recording.height < 0.1426)
    assert not diagnose.find_height_zero(below).identifiable


@pytest.mark.full
def test_a_mirrored_stage_is_never_accepted_as_correct():
    finding = diagnose.find_board(damaged("x mirrored"), reskin_board(), growth=None)
    assert finding.wrong or not finding.identifiable
    if finding.wrong:
        np.testing.assert_array_equal(finding.correction["board_from_stage"], STAGES["x mirrored"])


@pytest.mark.full
@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("sound", set()),
        ("labels a row late", {FindingName.LAG}),
        ("five heights", set()),
    ],
)
def test_a_damaged_recording_is_diagnosed(name, expected):
    findings = diagnose.diagnose(damaged(name, n=200), anyskin_like())
    wrong = {finding.name for finding in findings if finding.wrong}
    assert expected <= wrong
    assert expected or wrong <= {FindingName.HEIGHT_ZERO}
    assert len(diagnose.metrics_of(findings)) == len(findings)


@pytest.mark.full
@pytest.mark.parametrize("kind", ["spatial", "normal"])
def test_sound_real_recordings_raise_no_alarm(shared_data, kind):
    for folder in sorted((shared_data / "eflesh" / kind).iterdir()):
        states, values = (
            np.loadtxt(folder / f"{name}.csv.gz", delimiter=",") for name in ("states", "sensor_post_baselines")
        )
        at = 1e-3 * states[:, 1:4]
        middle = (at.min(0) + at.max(0)) / 2
        recording = Presses(at[:, :2] - middle[:2], values[:, 1:16], height=at[:, 2])
        board = diagnose.rotate_board(eflesh_board(), STAGES["turned by +90 degrees"].astype(float))
        findings = diagnose.diagnose(recording, board)
        assert not [finding.sentence for finding in findings if finding.wrong]
