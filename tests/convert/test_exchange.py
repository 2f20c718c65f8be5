"""Formats of others: what is written comes back value by value, and their own readers read it."""

import csv
import errno
import inspect
import json
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers.random_touches import assert_equal, make
from helpers.recordings import converted, refused, run

from i2t.convert import lerobot, robomimic, touch_table
from i2t.dataset import save_dataset
from i2t.errors import DataError, MissingExtraError

pq = pytest.importorskip("pyarrow.parquet")

FORMATS = {
    "lerobot": ("out", lerobot.write, lerobot.read),
    "robomimic": ("out.hdf5", robomimic.write, robomimic.read),
    "csv": ("out", touch_table.write, touch_table.read),
}


@pytest.mark.parametrize(("truth", "wide", "board"), [(False, False, "reskin"), (True, True, "grid-1x2")])
@pytest.mark.parametrize("form", FORMATS)
def test_every_value_comes_back(tmp_path, form, truth, wide, board):
    name, write, read = FORMATS[form]
    dataset = make(7, truth=truth, wide=wide, board=board, pixels=4)  # as many as a pose has rows
    if form == "csv":
        dataset.touches.nearest[0] = np.inf  # nothing was met
    assert_equal(read(write(tmp_path / name, dataset)), dataset)


@pytest.mark.parametrize("form", FORMATS)
def test_the_commands_write_and_read_back(tmp_path, capsys, form):
    name = FORMATS[form][0]
    dataset = make(5, pixels=6)
    save_dataset(tmp_path / "set.h5", dataset)
    words = (form, tmp_path / "set.h5", tmp_path / name)
    assert run(*words) == 0
    assert "--overwrite" in refused(capsys, *words)
    assert run(*words, "--overwrite") == 0
    assert_equal(converted(form, tmp_path / name, tmp_path / "back"), dataset)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(["back", name, "set.h5"])


def test_frames_are_counted_as_lerobot_wants(tmp_path):
    dataset = make(9, pixels=6)
    folder = lerobot.write(tmp_path / "out", dataset)
    info = json.loads((folder / "meta/info.json").read_text())
    table = pq.read_table(folder / "data/chunk-000/file-000.parquet")
    episodes = pq.read_table(folder / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert set(table.column_names) == set(info["features"])
    assert table["index"].to_pylist() == list(range(9))
    assert (info["total_frames"], info["total_episodes"]) == (9, len(episodes))
    for number, episode in enumerate(episodes):
        rows = slice(episode["dataset_from_index"], episode["dataset_to_index"])
        assert table["episode_index"].to_pylist()[rows] == [number] * episode["length"]
        assert table["frame_index"].to_pylist()[rows] == list(range(episode["length"]))
    stats = json.loads((folder / "meta/stats.json").read_text())
    np.testing.assert_allclose(stats["observation.tactile"]["mean"], dataset.touches.reading.mean(0), rtol=1e-4)
    assert stats["touch.force"]["max"][0] == pytest.approx(np.nanmax(dataset.touches.force))


def test_a_file_is_laid_out_as_robomimic_wants(tmp_path):
    dataset = make(60, pixels=4)
    with h5py.File(robomimic.write(tmp_path / "out.hdf5", dataset)) as file:
        demos = sorted(file["data"])
        assert demos == [f"demo_{i}" for i in range(4)]
        assert {demo.decode() for demo in file["mask/train"]} == set(demos)
        assert sum(file["data"][demo].attrs["num_samples"] for demo in demos) == file["data"].attrs["total"] == 60
        assert {"env_name", "type", "env_kwargs"} == set(json.loads(file["data"].attrs["env_args"]))
        for demo in demos:
            group = file["data"][demo]
            n = group.attrs["num_samples"]
            assert group["actions"].shape == (n, 7)
            np.testing.assert_allclose(np.linalg.norm(group["actions"][:, 3:], axis=1), 1, rtol=1e-6)
            assert group["dones"][()].tolist() == [0] * (n - 1) + [1]
            assert all(len(values) == n for values in group["obs"].values())


def test_a_table_reads_as_plain_numbers(tmp_path):
    dataset = make(4, pixels=4)
    with (touch_table.write(tmp_path / "out", dataset) / "touches.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["object"] for row in rows] == [dataset.objects[i] for i in dataset.touches.object]
    np.testing.assert_allclose([float(row["b1z_uT"]) for row in rows], dataset.touches.reading[:, 5], rtol=1e-6)
    assert [row["force_N"] == "" for row in rows] == np.isnan(dataset.touches.force).tolist()


def no_objects(path):
    path.write_text(json.dumps(json.loads(path.read_text()) | {"objects": []}))


def without_group(path):
    with h5py.File(path, "a") as file:
        del file["i2t"]


def edited(change):
    return lambda path: path.write_text(change(path.read_text()))


@pytest.mark.parametrize(
    ("form", "name", "damage", "sentence"),
    [
        ("lerobot", "data/chunk-000/file-000.parquet", lambda path: path.write_bytes(path.read_bytes()[:-200]),
         r"file-000\.parquet: is no table"),
        ("lerobot", "meta/i2t.json", no_objects, "not an index into the 0 object names"),
        ("lerobot", "meta/i2t.json", Path.unlink, "another program"),
        ("lerobot", "meta/info.json", edited(lambda _: '{"codebase_version": "v2.1"}'), r"version v2\.1"),
        ("robomimic", "", without_group, r"out\.hdf5: is of another program"),
        ("robomimic", "", lambda path: path.write_bytes(path.read_bytes()[:3000]), r"out\.hdf5: is no file of robomi"),
        ("csv", "touches.csv", edited(lambda text: text.replace("b0x_uT", "b0x")), "no table of touches"),
        ("csv", "touches.csv", edited(lambda text: text + "1,2\n"), "do not have the same columns"),
        ("csv", "touches.csv", edited(lambda _: ""), "do not have the same columns"),
    ],
)  # fmt: skip
def test_files_of_others_and_damage_are_refused_in_a_sentence(tmp_path, form, name, damage, sentence):
    out, write, read = FORMATS[form]
    path = write(tmp_path / out, make(3, pixels=4))
    damage(path / name if name else path)
    with pytest.raises(DataError, match=sentence):
        read(path)


def test_without_pyarrow_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(MissingExtraError, match=r"imagine2touch\[lerobot\]"):
        lerobot.write(tmp_path / "out", make(2, pixels=6))
    assert not list(tmp_path.iterdir())


def test_a_folder_of_others_is_not_replaced(tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "letter.txt").write_text("mine")
    with pytest.raises(DataError, match="another folder"):
        touch_table.write(tmp_path / "out", make(2, pixels=4), overwrite=True)
    assert (tmp_path / "out" / "letter.txt").read_text() == "mine"


@pytest.mark.parametrize("failure", [OSError(errno.EIO, "Input/output error"), KeyboardInterrupt()])
def test_an_export_that_cannot_take_the_place_of_another_leaves_it(tmp_path, monkeypatch, failure):
    before, after = make(3, pixels=6), make(2, pixels=6)
    folder = touch_table.write(tmp_path / "out", before)
    rename = Path.rename

    def fail_at_the_new(path, target):
        if target == folder and (path / "touches.csv").read_text().count("\n") == 3:
            raise failure
        return rename(path, target)

    monkeypatch.setattr(Path, "rename", fail_at_the_new)
    with pytest.raises(DataError if isinstance(failure, OSError) else KeyboardInterrupt):
        touch_table.write(folder, after, overwrite=True)
    assert_equal(touch_table.read(folder), before)
    assert list(tmp_path.iterdir()) == [folder]
    monkeypatch.undo()
    assert_equal(touch_table.read(touch_table.write(folder, after, overwrite=True)), after)
    assert list(tmp_path.iterdir()) == [folder]


@pytest.mark.full
def test_lerobot_itself_reads_it(tmp_path):
    theirs = pytest.importorskip("lerobot.datasets.lerobot_dataset")
    dataset = make(6)
    found = theirs.LeRobotDataset("i2t/touches", root=lerobot.write(tmp_path / "out", dataset))
    assert len(found) == len(dataset)
    for frame in found:
        row = int(frame["touch.row"])
        np.testing.assert_array_equal(frame["observation.tactile"].numpy(), dataset.touches.reading[row])
        np.testing.assert_array_equal(frame["observation.patch"].numpy(), dataset.touches.patch[row])


@pytest.mark.full
def test_robomimic_itself_reads_it(tmp_path):
    reader = pytest.importorskip("robomimic.utils.dataset")
    dataset = make(12)
    path = robomimic.write(tmp_path / "out.hdf5", dataset)
    words = {"hdf5_cache_mode": None, "hdf5_use_swmr": False, "load_next_obs": False}
    if "action_keys" in inspect.signature(reader.SequenceDataset).parameters:  # since 0.4
        words |= {"action_keys": ("actions",), "action_config": {"actions": {"normalization": None}}}
    found = reader.SequenceDataset(
        str(path), obs_keys=("reading", "patch", "row"), dataset_keys=("actions", "rewards", "dones"), **words
    )
    observed = [found[i]["obs"] for i in range(len(found))]
    rows = [int(each["row"][0]) for each in observed]
    assert sorted(rows) == list(range(len(dataset)))
    np.testing.assert_array_equal([each["reading"][0] for each in observed], dataset.touches.reading[rows])
    np.testing.assert_array_equal([each["patch"][0] for each in observed], dataset.touches.patch[rows])
