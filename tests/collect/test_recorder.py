"""Touches are complete files with correct dates, even if the disk, the clock or the process fails."""

import errno
import os
import stat
from unittest.mock import Mock

import numpy as np
import pytest
from helpers.closed_form import GAIN, HEIGHT, WALL, listed, make, names, site

from i2t import dataset
from i2t.collect import folder_notes, recorder
from i2t.collect.recorder import Recorder, StorageError, list_touches, read_raw, touch_time
from i2t.errors import DataError, DeviceError
from i2t.files.writing import unwritable
from i2t.types import ReturnCode
from tests.faults.closed_form import SettableClock


@pytest.fixture
def lab(tmp_path):
    """A procedure and a recorder of a folder."""
    procedure = make(clock=SettableClock(WALL))
    with Recorder(tmp_path / "set", names(procedure), procedure.clock) as recording:
        yield procedure, recording


def test_a_touch_is_read_back_unchanged_with_the_whole_press_in_unix_time(lab):
    procedure, recording = lab
    (outcome,) = procedure.run(listed(site(3)), recording)
    (path,) = list_touches(recording.folder)
    record, touched = dataset.read_touch(path), outcome.touch
    touches = record.touch.touches
    assert touches.code[0] == ReturnCode.SKIN
    np.testing.assert_allclose(touches.reading[0], touched.force * GAIN, rtol=1e-3)
    np.testing.assert_allclose(touches.T_w_t[0], touched.T_w_t, atol=1e-7)
    assert record.touch.source == "simulated"
    assert record.counters["site"] == recorder.site_number_of(path) == 3
    np.testing.assert_allclose(record.images["depth"].values * record.images["depth"].scale, 0.104, atol=5e-5)
    np.testing.assert_array_equal(record.images["colour"].values, 0)
    np.testing.assert_allclose(record.series["ambient"].values[0], touched.skins[""].ambient, rtol=1e-6)
    assert [text for _, text in record.events][:3] == ["site 3, attempt 1", "look", "prepare"]
    for name in (".under-way", recorder.INTERRUPTED):  # no raw file is left
        assert not (recording.folder / name).exists()

    tactile, pose, wrench = (record.series[name] for name in ("tactile", "pose", "wrench"))
    events = {text: time for time, text in record.events}
    assert touches.time == tactile.time[-1]
    for series in (tactile, pose, wrench):
        assert WALL < series.time[0] < series.time[-1] <= touch_time(path)
        assert (np.diff(series.time) > 0).all()
    during = (tactile.time > events["press"]) & (tactile.time < events["stopped by skin"])
    # A line: the change of every sample is that of the force of the spring at the tool's height then.
    height = np.interp(tactile.time, pose.time, pose.values[:, 11])
    force = 10e3 * np.maximum(0, HEIGHT - height)
    change = tactile.values - record.series["ambient"].values
    np.testing.assert_allclose(change[during], force[during, None] * GAIN, atol=0.02 * np.abs(GAIN).max())
    assert during.sum() >= 0.98 * 400 * (events["stopped by skin"] - events["press"])
    at = np.interp(wrench.time, tactile.time, force)
    np.testing.assert_allclose(-wrench.values[:, 2], at, atol=0.05)


def test_the_raw_file_of_an_interrupted_touch_is_kept_and_readable_at_any_cut(lab):
    procedure, recording = lab
    approach = procedure.arm.approach

    def interrupted(*motion, **options):
        approach(*motion, **options)
        raise KeyboardInterrupt

    procedure.arm.approach = interrupted
    with pytest.raises(KeyboardInterrupt):
        list(procedure.run(listed(site(0)), recording))
    assert not list_touches(recording.folder)
    (raw,) = (recording.folder / recorder.INTERRUPTED).iterdir()
    entries = list(read_raw(raw))
    assert entries[0] == ("event", [entries[0][1][0], "site 0, attempt 1"])
    assert entries[-1][1][1] == "ended by KeyboardInterrupt"
    assert sum(len(rows) for kind, rows in entries if kind == "skin") > 400
    assert any(kind == "arm" for kind, _ in entries)
    whole = raw.read_bytes()
    ends = np.cumsum([len(line) for line in whole.splitlines(keepends=True)])[1:]
    assert ends[-1] == len(whole)
    for cut in (len(whole) - 1, len(whole) // 2, ends[3], ends[3] - 1, ends[3] + 2, whole.index(b"\n") + 1):
        raw.write_bytes(whole[:cut])
        read = list(read_raw(raw))
        assert len(read) == sum(end <= cut for end in ends)
        for (kind, value), (whole_kind, whole_value) in zip(read, entries, strict=False):
            assert kind == whole_kind
            assert np.array_equal(value, whole_value) if kind != "event" else value == whole_value
    for text, message in (
        ("something", "not a raw file"),
        ('{"touch": "i2t raw", "version": 1}\n', "by an earlier version"),
    ):
        raw.write_text(text)
        with pytest.raises(DataError, match=message):
            list(read_raw(raw))


def test_an_unusable_folder_and_a_nearly_full_disk_are_found_before_any_motion(tmp_path):
    (tmp_path / "file").write_text("")
    procedure = make()
    with pytest.raises(DeviceError, match="choose a folder you may write to"):
        Recorder(tmp_path / "file" / "data", names(procedure), procedure.clock)
    with Recorder(tmp_path, names(procedure), procedure.clock, reserve=2**60) as recording:
        with pytest.raises(StorageError, match="another collection"):
            Recorder(tmp_path, names(procedure), procedure.clock)
        with pytest.raises(StorageError, match="free some space"):
            list(procedure.run(listed(site(0)), recording))
    assert procedure.clock.now() < 0.1


@pytest.mark.parametrize(
    ("where", "code", "sentence"), [("raw", errno.ENOSPC, "No space left"), ("touch", errno.EROFS, "Read-only")]
)
def test_a_failure_of_the_disk_is_one_sentence_and_the_arm_stops(lab, monkeypatch, where, code, sentence):
    procedure, recording = lab
    list(procedure.run(listed(site(0)), recording))
    error, write, states = OSError(code, os.strerror(code)), recorder.EventLog._write, []

    def failing(log, entry):
        states.extend(entry[:1] if entry[0] == "arm" else [])
        if len(states) > 20:  # in the middle of an approach
            raise recorder._not_kept(recording.folder, error)
        write(log, entry)

    if where == "raw":
        monkeypatch.setattr(recorder.EventLog, "_write", failing)
    else:
        monkeypatch.setattr(recorder.dataset, "write_touch", Mock(side_effect=unwritable(recording.folder, error)))
    acknowledged = []
    with pytest.raises(StorageError, match=sentence) as ended:
        acknowledged.extend(procedure.run(listed(site(1)), recording))
    assert "\n" not in str(ended.value)
    assert not acknowledged
    assert recording.saved == list_touches(recording.folder)
    assert not procedure.arm.state().moving
    assert np.linalg.norm(procedure.arm.state().wrench[:3]) == 0
    assert len(dataset.load_dataset(recording.folder)) == 1


def test_a_clock_that_is_set_during_a_touch_ends_the_session_and_keeps_the_touch(lab):
    procedure, recording = lab
    capture = procedure.camera.capture

    def jumped():
        procedure.clock.jump = -3600.0
        return capture()

    list(procedure.run(listed(site(0)), recording))
    procedure.camera.capture = jumped
    for sentence in (r"jumped by -3600\.0 s; the touch is saved", "behind the newest touch"):
        with pytest.raises(StorageError, match=sentence):
            list(procedure.run(listed(site(1)), recording))
    first, second = list_touches(recording.folder)
    assert 5 < touch_time(second) - touch_time(first) < 30
    assert any("jumped" in text for _, text in dataset.read_touch(second).events)


def test_names_of_touches_ascend_even_if_the_clock_goes_back(lab):
    """The clock is set back by 0.3 s between the check and the date of a later touch, which would sort it first."""
    procedure, recording = lab
    (outcome,) = procedure.run(listed(site(0)), recording)
    clock = procedure.clock
    state = procedure.arm.state()
    for number in range(1, 4):
        log = recording.begin(site(number), 0)
        for at in (2, 0, 3, 1, 2):
            log.state(state._replace(time=float(at), wrench=np.full(6, at), joints=np.full(7, 0.1 * at)))
        back = 0.3 if number > 1 else 0.0  # less than a jump that ends the session, and more than a touch is long here
        clock.jump -= back
        recording._offset -= back
        recording.save(outcome.touch._replace(site=site(number)))
        clock.jump += back + 1e-3
    files = list_touches(recording.folder)
    assert [recorder.site_number_of(path) for path in files] == [0, 1, 2, 3]
    assert (np.diff([touch_time(path) for path in files]) > 0).all()
    series = dataset.read_touch(files[1]).series
    for name in ("wrench", "pose", "joints"):
        np.testing.assert_allclose(np.diff(series[name].time), 1.0, atol=1e-6)
    np.testing.assert_array_equal(series["wrench"].values[:, 2], [0, 1, 2, 3])
    assert series["joints"].values.shape == (4, 7)  # an arm may have any number of joints


def test_files_reach_the_disk_before_their_names_do_and_then_the_folder(lab, monkeypatch):
    """Acknowledged data are synchronised: first the contents, then the rename, then the folder that holds the file."""
    procedure, recording = lab
    (outcome,) = procedure.run(listed(site(0)), recording)
    done, rename = [], os.replace

    def synced(descriptor):
        done.append("folder" if stat.S_ISDIR(os.fstat(descriptor).st_mode) else "file")

    monkeypatch.setattr(os, "fsync", synced)
    monkeypatch.setattr(os, "replace", lambda *paths: done.append("rename") or rename(*paths))
    recording.begin(site(1), 0).state(procedure.arm.state())
    done.clear()
    recording.save(outcome.touch)
    assert done[:3] == ["file", "rename", "folder"]
    done.clear()
    folder_notes.write_notes(recording.folder, {"seed": 0})
    assert done == ["file", "rename", "folder"]
