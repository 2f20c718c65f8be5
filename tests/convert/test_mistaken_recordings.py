"""Recordings with wrong units, signs or axes are corrected with a sentence, or converted as stated on request."""

import gzip
import json
from pathlib import Path

import numpy as np
import pytest
from helpers import authors_layout
from helpers.damage import VARIANTS, Recorded, press
from helpers.recordings import READING_NAMES, converted, run, write_session, write_table

from i2t.dataset import load_dataset
from i2t.errors import DataError
from i2t.recordings import diagnose as unknowns
from i2t.recordings.log import ReadingLog
from i2t.recordings.sets import corrected_dataset
from i2t.types import ReturnCode

N = 12
FORCES = "star/star_forces/experiment_1_forces_torques"


def findings_in(dataset):
    (text,) = (text for key, text in dataset.meta.items() if key.startswith("unknowns of "))
    return [unknowns.Finding(**entry) for entry in json.loads(text)]


def change(path, function):
    authors_layout.save(path, function(np.load(path)))


def test_pulling_forces_in_the_authors_layout_are_corrected(tmp_path, capsys):
    truth = authors_layout.write(tmp_path / "src", "star", "1", N)
    converted("imagine2touch", tmp_path / "src", tmp_path / "sound")
    assert "corrected" not in capsys.readouterr().out
    change(tmp_path / "src" / FORCES, np.negative)
    corrected = converted("imagine2touch", tmp_path / "src", tmp_path / "corrected").touches
    output = capsys.readouterr().out
    assert "corrected" in output
    assert "as if they pulled" in output
    np.testing.assert_allclose(corrected.force, truth.force, atol=1e-5)


def test_a_recording_is_taken_as_stated_on_request_and_its_times_are_kept(tmp_path, capsys):
    truth = authors_layout.write(tmp_path / "src", "star", "1", N)
    change(tmp_path / "src" / FORCES, np.negative)
    touches = converted("imagine2touch", tmp_path / "src", tmp_path / "dst", "--as-stated").touches
    np.testing.assert_allclose(touches.force, -truth.force, atol=1e-5)
    assert "corrected" not in capsys.readouterr().out
    stored = np.load(tmp_path / "src/star/star_tactile/experiment_1_reskin", allow_pickle=True)
    np.testing.assert_array_equal(touches.time, [sample[0] for sample in stored[:, 0]])


def write_presses(path, recorded: Recorded, sign=1.0):
    """A table of presses, at seconds of Unix time."""
    travel = sign * np.maximum(-1e3 * recorded.height, 0)
    time = 1.7e9 + np.arange(len(travel))
    rows = np.column_stack([1e3 * recorded.position, travel, recorded.force, recorded.readings, time])
    return write_table(path, ["x_mm", "y_mm", "travel_mm", "force_N", *READING_NAMES, "time_s"], rows)


def test_a_mistake_in_a_table_of_presses_is_corrected(tmp_path, capsys):
    options = ("--indenter", "sphere:4", "--window-mm", 40)
    sound = press(0, 28, free=0.0)
    expected = converted("presses", write_presses(tmp_path / "sound.csv", sound), tmp_path / "sound", *options).touches
    assert "corrected" not in capsys.readouterr().out
    np.testing.assert_array_equal(expected.time, 1.7e9 + np.arange(28))
    for mistake in ("force that pulls", "travels negative", "readings in millitesla"):
        negative = mistake == "travels negative"
        wrong = sound if negative else VARIANTS[mistake](sound)
        path = write_presses(tmp_path / f"{mistake}.csv", wrong, -1.0 if negative else 1.0)
        corrected = converted("presses", path, tmp_path / mistake, *options)
        assert "corrected" in capsys.readouterr().out
        for name in ("reading", "force", "travel", "T_w_o"):
            ours, theirs = getattr(corrected.touches, name), getattr(expected, name)
            np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-5, err_msg=name)
        assert {finding.name for finding in findings_in(corrected)} >= {"units", "height zero"}


def test_a_set_of_mostly_pulling_forces_is_corrected_once(tmp_path, capsys):
    """85 % of the forces pull; the saved set is corrected and is not corrected again."""
    sound = press(0, 60, free=0.0)
    force = np.where(np.arange(60) % 20 < 17, -sound.force, sound.force)
    path = write_presses(tmp_path / "pulling.csv", sound._replace(force=force))
    dataset = converted("presses", path, tmp_path / "data", "--indenter", "sphere:4", "--window-mm", 40)
    np.testing.assert_allclose(dataset.touches.force, -force, rtol=1e-5, atol=1e-5)
    assert "as if they pulled: their sign is reversed" in capsys.readouterr().out
    assert corrected_dataset(dataset) == (dataset, ())


@pytest.mark.parametrize("level", [False, True])
def test_a_table_in_metres_under_names_in_millimetres_is_corrected_as_a_whole(level, tmp_path, capsys):
    """24 presses; if all go to one height, only the stated zero shows that their travel is too small."""
    sound = press(0, 24, free=0.0)
    if level:
        sound = sound._replace(height=np.full(24, -4.07e-4))
    options = ("--indenter", "sphere:4", "--window-mm", 40)
    expected = converted("presses", write_presses(tmp_path / "mm.csv", sound), tmp_path / "mm", *options).touches
    printed = capsys.readouterr().out
    assert "doubtful" not in printed
    assert "corrected" not in printed
    small = sound._replace(position=1e-3 * sound.position, height=1e-3 * sound.height)
    dataset = converted("presses", write_presses(tmp_path / "m.csv", small), tmp_path / "m", *options)
    assert "all lengths are multiplied by 1000" in capsys.readouterr().out
    for name in ("T_w_o", "travel"):
        np.testing.assert_allclose(getattr(dataset.touches, name), getattr(expected, name), rtol=1e-5, atol=1e-9)
    notes = dataset.meta["notes"]
    assert "not tested in session: Lag of the labels: not identifiable, because 24 presses are too few" in notes


def test_a_press_beside_the_window_is_kept_if_its_patch_shows_the_tip(tmp_path, capsys):
    sound = press(0, 24, free=0.0)
    distance = np.abs(sound.position).max(1)
    assert np.sum(distance > 8.5e-3) > 5
    path = write_presses(tmp_path / "presses.csv", sound)
    dataset = converted("presses", path, tmp_path / "data", "--indenter", "sphere:4")
    assert len(dataset) == np.sum(distance < 12.4e-3)
    beside = np.abs(dataset.touches.T_w_o[:, :2, 3]).max(1) > 8.5e-3
    assert beside.any()
    assert (dataset.touches.patch[beside] < dataset.reach).any((1, 2)).all()
    assert "presses whose tip is outside the window of 17 mm" in capsys.readouterr().out


def test_the_names_of_columns_are_quoted_as_the_file_spells_them(tmp_path, capsys):
    path = write_presses(tmp_path / "presses.csv", press(0, 5, free=0.0))
    header, rows = path.read_text().split("\n", 1)
    header = header.replace("x_mm", "X (mm)").replace("travel_mm", "depth (mm)")
    path.write_text(f"{header}\n{rows}")
    words = ("presses", path, tmp_path / "data", "--indenter", "sphere:4")
    assert run(*words) == 0
    assert "depth (mm) is read as travel" in capsys.readouterr().out.splitlines()
    path.write_text(f"{header.replace('b0x_uT', 'Bx [uT]')}\n{rows}")
    assert run(*words, "--overwrite") == 2
    stated = "column b0x_uT is missing (its first line names X (mm), y_mm, depth (mm), force_N, Bx [uT], b0y_uT ...)"
    assert stated in capsys.readouterr().err


@pytest.mark.full
def test_presses_to_one_height_have_no_depth_but_keep_frame_and_times(shared_data, tmp_path, capsys):
    """The presses are those of a real session to 142.6 mm."""
    folder = next((shared_data / "eflesh" / "spatial").iterdir())
    states, values = (
        np.loadtxt(gzip.decompress((folder / f"{name}.csv.gz").read_bytes()).decode().splitlines(), delimiter=",")
        for name in ("states", "sensor_post_baselines")
    )
    level = np.abs(states[:, 3] - 142.6) < 0.15
    states[:, 3] = 142.6
    write_session(tmp_path / "src" / "late", states[level, 1:], values[level, 1:])
    dataset = converted("eflesh", tmp_path / "src", tmp_path / "dst")
    assert np.isnan(dataset.touches.travel).all()
    assert (dataset.touches.code == ReturnCode.UNDEFINED).all()
    # In float64: a float32 tells Unix time to two minutes.
    np.testing.assert_array_equal(dataset.touches.time, 1.7e9 + 4.25 * np.arange(level.sum()) + 1e-3)
    assert f"time ({level.sum()})" in (tmp_path / "dst" / "README.md").read_text()
    assert "all presses go to one height" in capsys.readouterr().out
    reference = json.loads(dataset.meta["reference of late"])
    assert reference["zero_m"] is None
    np.testing.assert_allclose(reference["lowest_z_m"], 0.1426)
    assert not unknowns.find(findings_in(dataset), "height zero").identifiable
    given = converted("eflesh", tmp_path / "src", tmp_path / "given", "--z0-mm", 145, "--as-stated")
    np.testing.assert_allclose(given.touches.travel, 2.4e-3, atol=1e-8)


def test_the_default_output_is_brief_and_the_data_set_holds_every_note(tmp_path, capsys):
    """Changes come first, and doubts share a line."""
    log = ReadingLog(skip_bad=True, unit="presses")
    for line in ("a 1", "a 2", "a 2"):
        log.change("a", line)
    log.info("only a note")
    log.finding(unknowns.Finding("units", "They fit.", identifiable=True), " in s")
    log.finding(unknowns.Finding("height zero", "It is unknown.", identifiable=False), " in s")
    assert log.brief() == [
        "a 1 (and 1 more of this kind)",
        "doubtful in s: It is unknown; continue if travel counts from first contact.",
    ]
    log.finding(unknowns.Finding("lag", "It is 2 rows.", identifiable=True, wrong=True), kept=True)
    log.skip_row(DataError("line 3 is damaged"))
    damaged = "left out: 1 damaged rows; the first: line 3 is damaged"
    assert log.brief() == [
        "a 1 (and 1 more of this kind)",
        damaged,
        "doubtful: height zero (continue if travel counts from first contact), lag",
    ]
    log.change("b", "b 1")
    log.change("c", "c 1")
    assert len(log.brief()) == 4
    later = ReadingLog(skip_bad=True)
    later.include(log)
    assert set(later.sentences()) == set(log.sentences())
    assert list(later.doubts) == ["height zero", "lag"]

    presses = Path(__file__).parents[2] / "examples" / "data" / "presses.csv"
    words = ("presses", presses, tmp_path / "brief", "--indenter", "sphere:4.0")
    assert run(*words) == 0
    brief = capsys.readouterr().out.splitlines()
    assert len(brief) <= 6
    assert brief[-3:] == [
        f"wrote 100 touches (1 object, 1 skin, 1 session) to {tmp_path / 'brief' / 'touches.h5'}",
        f"next: i2t view {tmp_path / 'brief'}",
        f"      python -m experiments.calibrate --dataset {tmp_path / 'brief'}",
    ]
    notes = load_dataset(tmp_path / "brief").meta["notes"].split(" | ")
    assert brief[-4] == f"--verbose prints all {len(notes)} notes on the conversion"
    assert any(note.startswith("found in session: ") for note in notes)
    assert not any(line.startswith("found") for line in brief)
