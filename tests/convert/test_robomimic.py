"""robomimic's HDF5 and the table of touches: what is written comes back value by value."""

import csv
import errno
import inspect
import json
from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers.random_touches import assert_equal, make

from i2t.convert.commands import main
from i2t.convert.robomimic import read_robomimic, write_robomimic
from i2t.convert.touch_table import read_table, write_table
from i2t.dataset import load_dataset, save_dataset
from i2t.errors import DataError


def assert_same(back, dataset):
    assert_equal(back, dataset)
    for name, values in dataset.touches._asdict().items():
        if name != "truth":
            np.testing.assert_array_equal(getattr(back.touches, name), values, err_msg=name)
    for name, values in dataset.touches.truth._asdict().items() if dataset.touches.truth else ():
        np.testing.assert_array_equal(getattr(back.touches.truth, name), values, err_msg=name)
    for one, other in zip(back.board, dataset.board, strict=True):
        np.testing.assert_array_equal(one, other)


CASES = [(False, False, "reskin"), (True, True, "grid-1x2")]


@pytest.mark.parametrize(("truth", "wide", "board"), CASES)
def test_every_value_comes_back_from_robomimic(tmp_path, truth, wide, board):
    dataset = make(7, truth=truth, wide=wide, board=board, pixels=6)
    assert_same(read_robomimic(write_robomimic(tmp_path / "out.hdf5", dataset)), dataset)


@pytest.mark.parametrize(("truth", "wide", "board"), CASES)
def test_every_value_comes_back_from_a_table(tmp_path, truth, wide, board):
    dataset = make(7, truth=truth, wide=wide, board=board, pixels=4)  # as many as a pose has rows
    dataset.touches.nearest[0] = np.inf  # nothing was met
    assert_same(read_table(write_table(tmp_path / "out", dataset)), dataset)


@pytest.mark.parametrize(("command", "name"), [("robomimic", "out.hdf5"), ("csv", "out")])
def test_the_commands_write_and_read_back(tmp_path, capsys, command, name):
    dataset = make(5, pixels=6)
    save_dataset(tmp_path / "set.h5", dataset)
    words = [command, str(tmp_path / "set.h5"), str(tmp_path / name)]
    assert main(words) == 0
    assert main(words) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert main([*words, "--overwrite"]) == 0
    assert main([command, str(tmp_path / name), str(tmp_path / "back")]) == 0
    assert_same(load_dataset(tmp_path / "back"), dataset)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(["back", name, "set.h5"])


def test_a_file_is_laid_out_as_robomimic_wants(tmp_path):
    dataset = make(60, pixels=4)
    with h5py.File(write_robomimic(tmp_path / "out.hdf5", dataset)) as file:
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
    folder = write_table(tmp_path / "out", dataset)
    with (folder / "touches.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["object"] for row in rows] == [dataset.objects[i] for i in dataset.touches.object]
    np.testing.assert_allclose([float(row["b1z_uT"]) for row in rows], dataset.touches.reading[:, 5], rtol=1e-6)
    assert [row["force_N"] == "" for row in rows] == np.isnan(dataset.touches.force).tolist()


def test_files_of_others_and_damage_are_refused_in_a_sentence(tmp_path):
    path = write_robomimic(tmp_path / "out.hdf5", make(3, pixels=4))
    with h5py.File(path, "a") as file:
        del file["i2t"]
    with pytest.raises(DataError, match=r"out\.hdf5: is of another program"):
        read_robomimic(path)
    path.write_bytes(path.read_bytes()[:3000])
    with pytest.raises(DataError, match=r"out\.hdf5: is no file of robomimic"):
        read_robomimic(path)
    folder = write_table(tmp_path / "out", make(3, pixels=4))
    text = (folder / "touches.csv").read_text()
    for wrong, said in (
        (text.replace("b0x_uT", "b0x"), "no table of touches"),
        (text + "1,2\n", "do not have the same columns"),
        ("", "do not have the same columns"),
    ):
        (folder / "touches.csv").write_text(wrong)
        with pytest.raises(DataError, match=said):
            read_table(folder)


def test_a_folder_of_others_is_not_replaced(tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "letter.txt").write_text("mine")
    with pytest.raises(DataError, match="another folder"):
        write_table(tmp_path / "out", make(2, pixels=4), overwrite=True)
    assert (tmp_path / "out" / "letter.txt").read_text() == "mine"


@pytest.mark.parametrize("failure", [OSError(errno.EIO, "Input/output error"), KeyboardInterrupt()])
def test_an_export_that_cannot_take_the_place_of_another_leaves_it(tmp_path, monkeypatch, failure):
    before = make(3, pixels=6)
    folder = write_table(tmp_path / "out", before)
    rename = Path.rename

    def fail_at_the_new(path, target):
        if target == folder and (path / "touches.csv").read_text().count("\n") == 3:
            raise failure
        return rename(path, target)

    monkeypatch.setattr(Path, "rename", fail_at_the_new)
    with pytest.raises(DataError if isinstance(failure, OSError) else KeyboardInterrupt):
        write_table(folder, make(2, pixels=6), overwrite=True)
    assert_same(read_table(folder), before)
    assert list(tmp_path.iterdir()) == [folder]
    monkeypatch.undo()
    after = make(2, pixels=6)
    assert_same(read_table(write_table(folder, after, overwrite=True)), after)
    assert list(tmp_path.iterdir()) == [folder]


@pytest.mark.full
def test_robomimic_itself_reads_it(tmp_path):
    reader = pytest.importorskip("robomimic.utils.dataset")
    dataset = make(12)
    path = write_robomimic(tmp_path / "out.hdf5", dataset)
    words = {"hdf5_cache_mode": None, "hdf5_use_swmr": False, "load_next_obs": False}
    if "action_keys" in inspect.signature(reader.SequenceDataset).parameters:  # since 0.4
        words |= {"action_keys": ("actions",), "action_config": {"actions": {"normalization": None}}}
    found = reader.SequenceDataset(
        str(path), obs_keys=("reading", "patch", "row"), dataset_keys=("actions", "rewards", "dones"), **words
    )
    assert len(found) == len(dataset)
    rows = []
    for item in map(found.__getitem__, range(len(found))):
        row = int(item["obs"]["row"][0])
        np.testing.assert_array_equal(item["obs"]["reading"][0], dataset.touches.reading[row])
        np.testing.assert_array_equal(item["obs"]["patch"][0], dataset.touches.patch[row])
        rows.append(row)
    assert sorted(rows) == list(range(len(dataset)))
