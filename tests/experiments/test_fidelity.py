"""The fidelity report on recordings of every kind and in every state: it reports what it can and never fails."""

import json
from dataclasses import replace

import numpy as np
import pytest
from helpers import random_touches
from helpers.skin_presses import presses_of_a_skin

from experiments.calibrate.methods import BASELINES, CALIBRATED
from experiments.fidelity import __main__ as fidelity
from experiments.fidelity import curves, describe, dynamics, forward, heads, run
from experiments.fidelity.config import FidelityPreset
from experiments.fidelity.forward import press_set
from experiments.fidelity.sections import CannotTellError, Section, written
from i2t.heads.heads import load_head
from i2t.heads.regression import HeadBudget
from i2t.recordings.diagnose import diagnose_labels
from i2t.recordings.read import SkinRecording, from_dataset

FEW = HeadBudget(selection_rows=40, known_rows=60, rows=80)
TINY = FidelityPreset(counts=(5,), draws=1, test_rows=15, forward_rows=40, heads=FEW)
SKIN = presses_of_a_skin(90)
PARTS = ("Overview", "Checks", "Noise and drift", "Hysteresis and creep", "Repeatability", "Calibration curves")


def _targets(**changed):
    return {name: values for name, values in {**SKIN.targets, **changed}.items() if values is not None}


def _stream(n=240, strokes=6, channels=15):
    """Strokes in and out at one place, with a force that is read every other row."""
    rng = np.random.default_rng(0)
    phase = np.linspace(0, np.pi, n // strokes)
    travel = np.tile(3e-3 * np.sin(phase) ** 2, strokes)
    inward = np.tile(phase < np.pi / 2, strokes)
    signal = (travel / 3e-3) ** 1.5 * np.where(inward, 1.0, 1.06)
    readings = 200 * signal[:, None] * rng.normal(size=channels) + rng.normal(size=(n, channels))
    force = np.where(np.arange(n) % 2, np.nan, 1e6 * travel**2)
    force[travel < 1e-4] = 0
    session = np.repeat(np.arange(strokes), n // strokes)
    return SkinRecording(
        name="stream",
        readings=readings,
        targets={
            "position": np.zeros((n, 2)),
            "travel": travel[:, None],
            "force": force[:, None],
            "contact": np.where(force > 0.1, 1.0, np.where(force < 0.02, 0.0, np.nan))[:, None],
        },
        session=session,
        time=0.05 * np.arange(n) + 2.0 * session,
        baseline=np.linspace(0, 30, n)[:, None] * np.ones(channels),
    )


HOSTILE = {
    "as it is": SKIN,
    "forces that pull": replace(SKIN, targets=_targets(travel=None, force=-1e3 * SKIN.targets["travel"])),
    "nothing but readings": replace(SKIN, targets={}),
    "one press": SKIN.rows(slice(1)),
    "a dead channel": replace(SKIN, readings=SKIN.readings * (np.arange(15) != 4)),
    "a dead board": replace(SKIN, readings=np.zeros_like(SKIN.readings)),
    "enormous values, each row a session": replace(
        SKIN, readings=1e7 * SKIN.readings + 1e15 * np.eye(90, 15), session=np.arange(90)
    ),
    "a line, travels known of a few, times that stand still": replace(
        SKIN,
        targets=_targets(
            travel=np.where(np.arange(90)[:, None] % 9 == 0, SKIN.targets["travel"], np.nan),
            position=SKIN.targets["position"] * [1, 0],
        ),
        time=np.zeros(90),
    ),
    "a stream of one chip, without air": _stream(channels=3).rows(
        np.flatnonzero(_stream().targets["travel"][:, 0] > 1e-3)
    ),
    "objects with views": from_dataset(random_touches.make(60, pixels=8), "objects")[0],
}
FAST = ("nothing but readings", "one press", "a dead board")


@pytest.fixture(autouse=True)
def _labels_alone(monkeypatch):
    """Skip findings that are not about labels; they take seconds and are tested with their module."""
    monkeypatch.setattr(describe, "diagnose", lambda presses, board=None: diagnose_labels(presses))


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name in FAST else pytest.mark.full) for name in HOSTILE]
)
def test_no_part_fails_on_any_recording(name):
    recording = HOSTILE[name]
    sections = list(run.sections_of(recording, TINY, 0))
    assert [section.title for section in sections][: len(PARTS)] == list(PARTS)
    failed = {section.title: section.numbers.get("failures") for section in sections if section.numbers.get("failures")}
    assert not failed
    for section in sections:
        assert section.status in ("found", "cannot tell")
        assert section.sentences or section.tables
    assert sections[0].status == "found"
    json.dumps([section.numbers for section in sections], default=str)
    if name == "nothing but readings":
        by_title = {section.title: section for section in sections}
        assert by_title["Calibration curves"].status == by_title["Heads"].status == "cannot tell"
        assert "Neither position nor load" in by_title["Calibration curves"].sentences[0]
        assert any(said.startswith("No head for force") for said in by_title["Heads"].sentences)


def written_table(path, reverse=False):
    """The presses as a user's table."""
    header = "x_mm,y_mm,travel_mm," + ",".join(f"b{i}{axis}_uT" for i in range(5) for axis in "xyz")
    rows = np.column_stack([1e3 * SKIN.targets["position"], 1e3 * SKIN.targets["travel"], SKIN.readings])
    np.savetxt(path, rows[::-1] if reverse else rows, delimiter=",", header=header, comments="")
    return str(path)


@pytest.mark.full
def test_the_report_compares_sessions_and_is_kept_as_text(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(run, "choose_preset", lambda presets, name: TINY)
    tables = written_table(tmp_path / "mine <b>.csv"), written_table(tmp_path / "other.csv", reverse=True)
    args = ["--dataset", *tables, "--out", str(tmp_path / "out")]
    assert fidelity.main(args) == 0
    said = (tmp_path / "out" / "report.txt").read_text()
    assert "mine <b>" in said
    assert "R2, mean of the draws [95 %]" in said
    assert (tmp_path / "out" / "calibration_curves_1.png").exists()
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["source"] == ["real"]
    assert set(metrics["recordings"]) == {"mine <b>", "other", "Across sessions"}
    r2 = metrics["recordings"]["mine <b>"]["Calibration curves"]["r2"]
    assert {"random presses", "later in time"} <= set(r2)
    assert set(r2["random presses"]) == {*BASELINES, CALIBRATED}
    across = metrics["recordings"]["Across sessions"]["Predictions across sessions"]["r2"]
    assert across["mine <b> -> other"]["predicted from the other session"] > 0.9  # they are the same presses
    capsys.readouterr()
    assert fidelity.main(args) not in (0, None)
    assert "finished run" in capsys.readouterr().err


def test_a_failed_part_does_not_affect_the_others(capsys):
    def broken(section):
        section.sentences.append("so far")
        raise ZeroDivisionError("by nothing")

    section = written("title", broken)
    assert section.status == "failed"
    assert section.sentences[0] == "so far."
    assert "ZeroDivisionError: by nothing" in section.numbers["failures"][0]
    assert "Traceback" in capsys.readouterr().err

    def silent(section):
        raise CannotTellError("There is nothing.")

    assert written("title", silent).sentences == ["There is nothing."]


def test_injected_mistakes_are_found():
    def found(recording):
        section = Section("Checks")
        describe.check(recording, section, [])
        assert "failures" not in section.numbers
        return section.numbers

    sound = found(SKIN)
    assert sound["warnings"] == []
    dead = found(HOSTILE["a dead channel"])
    assert dead["constant_channels"] == [4]
    assert any("as if they pulled" in sentence for sentence in found(HOSTILE["forces that pull"])["warnings"])
    copied = SKIN.readings.copy()
    copied[:, 7] = copied[:, 2]
    assert found(replace(SKIN, readings=copied))["equal_channels"] == [(2, 7)]
    step = 0.3
    steps = np.round(SKIN.readings / step)
    steps[40:, 5] += np.where(np.arange(40, 90) % 2, 65536, 0)
    assert found(replace(SKIN, readings=step * steps))["wrapped_channels"] == [5]


@pytest.mark.full
def test_calibration_is_measured_on_the_recording_put_right(monkeypatch):
    """Labels of another row and positions in millimetres score as well as the sound recording, and are reported."""
    for part in ("noise", "hysteresis", "repeatability"):
        monkeypatch.setattr(dynamics, part, lambda *args: None)
    tiny = replace(TINY, counts=(40,))
    late = {name: np.roll(values, 2, axis=0) for name, values in SKIN.targets.items()}
    wrong = replace(SKIN, targets=late | {"position": 1e3 * late["position"]})
    curves_of = []
    for recording in (SKIN, wrong):
        sections = {}
        for section in run.sections_of(recording, tiny, 0):
            sections[section.title] = section
            if section.title == "Calibration curves":
                break
        curves_of.append(sections["Calibration curves"].numbers["r2"]["random presses"]["i2t.calibrate"][40]["mean"])
    assert any("Corrections: units, lag of the labels" in sentence for sentence in sections["Checks"].sentences)
    assert curves_of[1] > curves_of[0] - 0.1 > 0.5


def test_too_few_rows_are_refused_with_the_number_needed():
    """With a fifth held out, 24 rows leave 19 for a head or a calibration that needs 20; 25 are enough."""
    few, share = presses_of_a_skin(24), 0.2
    assert heads.rows_enough(share) == 25
    with pytest.raises(ValueError, match=r"has position in 24 rows, too few .*; 25 are enough"):
        heads.test_heads(few, "position", FEW, share=share, seed=0)
    preset = replace(TINY, counts=(20,), held_out_share=share)
    with pytest.raises(CannotTellError, match=r"24 presses leave 19 .* and 20 are needed; 25 are enough"):
        curves.calibration_curves(few, preset, 0, Section("Calibration curves"))
    with pytest.raises(CannotTellError, match=r"14 presses are too few .*; 15 are enough"):
        curves.hold_out_presses(press_set(presses_of_a_skin(14)), preset, 0)
    assert curves.hold_out_presses(press_set(presses_of_a_skin(15)), preset, 0)


def test_a_difference_within_chance_is_not_reported_as_a_loss():
    rng = np.random.default_rng(0)
    own = rng.exponential(size=200)
    assert not forward.loses_beyond_chance(own, own * rng.uniform(0.5, 1.5, 200))
    assert forward.loses_beyond_chance(own, 0.7 * own)
    errors = {"i2t.calibrate": {5: [own]}, "k nearest presses": {5: [0.7 * own]}}
    lost = curves.compare_with_baselines("so", errors)
    assert lost == "Held out so: i2t.calibrate loses to a baseline at 5 presses (k nearest presses)."
    errors["k nearest presses"][5] = [rng.permutation(own)]
    assert "no baseline beats i2t.calibrate" in curves.compare_with_baselines("so", errors)


def test_a_range_that_covers_too_few_rows_is_reported():
    score = heads.HeadScore(rows=40, rmse=0.2, median=0.1, r2=0.9, inside_90=0.68, unfamiliar=0.0)
    (sentence,) = heads.missed_ranges("force", {"random rows": score, "later": score._replace(inside_90=0.85)})
    assert sentence == "force, random rows: the 90 % range holds 68 % of 40 rows; do not rely on it there."


@pytest.mark.parametrize(
    ("inside", "rows", "too_wide"),
    [
        (20, 20, False),
        (30, 30, True),
        (29, 30, False),
        (97, 100, True),
        (95, 100, False),
        (970, 1000, True),
        (5, 5, False),
    ],
)
def test_a_90_percent_range_is_too_wide_only_beyond_chance(inside, rows, too_wide):
    score = heads.HeadScore(rows, rmse=0.2, median=0.1, r2=0.9, inside_90=inside / rows, unfamiliar=0.0)
    sentences = heads.missed_ranges("travel", {"random rows": score})
    assert bool(sentences) == too_wide
    assert all(f"holds {100 * inside / rows:.0f} % of {rows} rows; it is too wide" in text for text in sentences)


@pytest.mark.parametrize(("factor", "unit"), [(1.0, "uT"), (1e-3, "mT"), (0.01, "gauss")])
def test_the_unit_is_predicted_from_the_steps(factor, unit):
    steps = np.tile([0.300 * 4, 0.300 * 4, 0.484 * 4], 5)
    big = presses_of_a_skin(400)
    section = Section("Overview")
    values = np.round(big.readings / steps) * steps
    describe.describe(replace(big, readings=factor * values), section)
    if factor < 0.01:
        assert section.numbers.get("unit") in (unit, None)
    else:
        assert section.numbers["unit"] == unit
    if unit != "uT" and "unit" in section.numbers:
        assert any("multiply" in sentence for sentence in section.sentences)


def test_injected_noise_and_hysteresis_are_measured():
    stream = _stream(600, 6)
    noise, hysteresis = Section("Noise"), Section("Hysteresis")
    dynamics.noise(stream, noise)
    dynamics.hysteresis(stream, TINY, hysteresis)
    assert noise.numbers["noise"]["xy_uT"] == pytest.approx(1.0, abs=0.25)
    assert noise.numbers["drift"]["median_uT"] == pytest.approx(27, abs=1.5)
    loops = hysteresis.numbers["hysteresis"]["loop_share"]
    assert len(loops) == 6
    # Outwards it reads 1.06 times as much: over the middle of the range some 3 % of the height.
    assert 0.015 < np.mean(loops) < 0.05


def test_the_limit_is_that_of_the_noise_put_in():
    rng = np.random.default_rng(0)
    once = presses_of_a_skin(120, noise_ut=0)
    twice = once.rows(np.tile(np.arange(120), 2))
    noisy = replace(twice, readings=twice.readings + 4.0 * rng.normal(size=twice.readings.shape))
    section = Section("Repeatability")
    dynamics.repeatability(noisy, replace(TINY, forward_rows=200), section)
    total = np.mean(np.sum((noisy.readings - noisy.readings.mean(0)) ** 2, axis=1))
    assert section.numbers["r2_repeatability_limit"] == pytest.approx(
        1 - 15 * 4.0**2 / total, abs=0.3 * 15 * 4.0**2 / total
    )
    assert section.numbers["r2_leave_one_out_gp"] < section.numbers["r2_repeatability_limit"]


def test_the_one_chip_with_hysteresis_is_named():
    big = presses_of_a_skin(300)
    readings = big.readings.copy()
    readings[1:, 6:9] += 0.3 * big.readings[:-1, 6:9]
    section = Section("hysteresis")
    dynamics.hysteresis(replace(big, readings=readings), replace(TINY, forward_rows=300), section)
    kept = section.numbers["hysteresis_of_chips"]["by_chip"]
    assert int(np.argmax(np.abs(kept))) == 2
    assert kept[2] == pytest.approx(0.3, abs=0.06)
    assert section.numbers["hysteresis_of_chips"]["beyond_chance"][2]


def test_held_out_rows_are_never_fitted():
    presses = press_set(SKIN)
    for pool, test in curves.hold_out_presses(presses, TINY, 0).values():
        assert not set(pool) & set(test)
    rows = heads.held_out_rows(SKIN, 0.2, 0)
    assert set(rows) == {heads.RANDOM_SPLIT, heads.GROUP_SPLIT, heads.LATER_SPLIT}
    assert rows[heads.LATER_SPLIT].tolist() == [False] * 72 + [True] * 18
    masked = heads._known_of(SKIN, "travel", np.arange(10))
    assert masked.known_rows("travel").sum() == 10
    assert SKIN.known_rows("travel").all()


def test_heads_are_fitted_by_one_command(tmp_path, capsys):
    from experiments.calibrate import __main__ as calibrate

    table = written_table(tmp_path / "mine.csv")
    assert calibrate.main(["--dataset", table, "--targets", "colour", "--out", str(tmp_path / "out")]) not in (0, None)
    assert "is no target" in capsys.readouterr().err
    out = tmp_path / "heads"
    assert calibrate.main(["--dataset", table, "--targets", "position", "--preset", "debug", "--out", str(out)]) == 0
    predicted = load_head(out / "position.npz").predict(SKIN.readings)
    assert np.median(np.linalg.norm(predicted.mean - SKIN.targets["position"], axis=1)) < 1e-3
    tests = json.loads((out / "metrics.json").read_text())["heads"]["position"]
    assert tests["random rows"]["kept"]["rmse"] < tests["random rows"]["baselines"]["linear"]["rmse"]


@pytest.mark.full
def test_the_report_of_a_real_session(shared_data, tmp_path):
    args = [
        "--dataset",
        str(shared_data / "eflesh" / "spatial"),
        "--preset",
        "debug",
        "--out",
        str(tmp_path / "out"),
    ]
    assert fidelity.main(args) == 0
    for chapter in json.loads((tmp_path / "out" / "metrics.json").read_text())["recordings"].values():
        assert all(section["status"] != "failed" and "failures" not in section for section in chapter.values())
