"""LeRobotDataset v3.0: what is written comes back value by value, and is what LeRobot's own reader expects."""

import json
import subprocess
import sys

import numpy as np
import pytest
from helpers.random_touches import assert_equal, make

from i2t.convert.commands import main
from i2t.convert.lerobot import read_lerobot, write_lerobot
from i2t.dataset import load_dataset, save_dataset
from i2t.errors import DataError, MissingExtraError

pq = pytest.importorskip("pyarrow.parquet")


@pytest.mark.parametrize(("truth", "wide", "board"), [(False, False, "reskin"), (True, True, "grid-1x2")])
def test_every_value_comes_back(tmp_path, truth, wide, board):
    dataset = make(7, truth=truth, wide=wide, board=board, pixels=6)
    back = read_lerobot(write_lerobot(tmp_path / "out", dataset))
    assert_equal(back, dataset)
    assert_same_touches(back, dataset)


def assert_same_touches(back, dataset):
    for name, values in dataset.touches._asdict().items():
        if name != "truth":
            np.testing.assert_array_equal(getattr(back.touches, name), values, err_msg=name)
    for name, values in dataset.touches.truth._asdict().items() if dataset.touches.truth else ():
        np.testing.assert_array_equal(getattr(back.touches.truth, name), values, err_msg=name)
    for one, other in zip(back.board, dataset.board, strict=True):
        np.testing.assert_array_equal(one, other)


def test_the_command_writes_and_reads_back(tmp_path, capsys):
    dataset = make(5, pixels=6)
    save_dataset(tmp_path / "set.h5", dataset)
    assert main(["lerobot", str(tmp_path / "set.h5"), str(tmp_path / "out")]) == 0
    assert main(["lerobot", str(tmp_path / "set.h5"), str(tmp_path / "out")]) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert main(["lerobot", str(tmp_path / "set.h5"), str(tmp_path / "out"), "--overwrite"]) == 0
    assert main(["lerobot", str(tmp_path / "out"), str(tmp_path / "back")]) == 0
    assert_same_touches(load_dataset(tmp_path / "back"), dataset)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["back", "out", "set.h5"]


def test_frames_are_counted_as_the_format_wants(tmp_path):
    dataset = make(9, pixels=6)
    folder = write_lerobot(tmp_path / "out", dataset)
    info = json.loads((folder / "meta/info.json").read_text())
    table = pq.read_table(folder / "data/chunk-000/file-000.parquet")
    episodes = pq.read_table(folder / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert set(table.column_names) == set(info["features"])
    assert table["index"].to_pylist() == list(range(9))
    assert (info["total_frames"], info["total_episodes"]) == (9, len(episodes))
    for number, episode in enumerate(episodes):
        rows = range(episode["dataset_from_index"], episode["dataset_to_index"])
        assert [table["episode_index"][i].as_py() for i in rows] == [number] * episode["length"]
        assert [table["frame_index"][i].as_py() for i in rows] == list(range(episode["length"]))
    stats = json.loads((folder / "meta/stats.json").read_text())
    np.testing.assert_allclose(stats["observation.tactile"]["mean"], dataset.touches.reading.mean(0), rtol=1e-4)
    assert stats["touch.force"]["max"][0] == pytest.approx(np.nanmax(dataset.touches.force))


def test_episodes_are_spread_over_files(tmp_path, monkeypatch):
    monkeypatch.setattr("i2t.convert.lerobot.FILE_SIZE_MB", 1e-3)
    dataset = make(9, pixels=6)
    folder = write_lerobot(tmp_path / "out", dataset)
    assert len(list((folder / "data").rglob("*.parquet"))) > 1
    assert_same_touches(read_lerobot(folder), dataset)


def test_sets_of_others_and_damage_are_refused_in_a_sentence(tmp_path):
    folder = write_lerobot(tmp_path / "out", make(3, pixels=6))
    data = folder / "data/chunk-000/file-000.parquet"
    whole = data.read_bytes()
    data.write_bytes(whole[:-200])
    with pytest.raises(DataError, match=r"file-000\.parquet: is no table"):
        read_lerobot(folder)
    data.write_bytes(whole)
    note = json.loads((folder / "meta/i2t.json").read_text())
    (folder / "meta/i2t.json").write_text(json.dumps(note | {"objects": []}))
    with pytest.raises(DataError, match="not an index into the 0 object names"):
        read_lerobot(folder)
    (folder / "meta/i2t.json").unlink()
    with pytest.raises(DataError, match="another program"):
        read_lerobot(folder)
    (folder / "meta/info.json").write_text('{"codebase_version": "v2.1"}')
    with pytest.raises(DataError, match=r"version v2\.1"):
        read_lerobot(folder)


def test_without_pyarrow_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(MissingExtraError, match=r"imagine2touch\[lerobot\]"):
        write_lerobot(tmp_path / "out", make(2, pixels=6))
    assert not list(tmp_path.iterdir())


READER = """
import json, sys
from pathlib import Path
import datasets, numpy as np, pandas
root = Path(sys.argv[1])
info = json.loads((root / "meta/info.json").read_text())
def kind(f):
    shape = tuple(f["shape"])
    if shape == (1,):
        return datasets.Value(f["dtype"])
    if len(shape) == 1:
        return datasets.Sequence(datasets.Value(f["dtype"]), length=shape[0])
    return datasets.Array2D(shape, f["dtype"])
features = datasets.Features({name: kind(f) for name, f in info["features"].items()})
paths = [str(path) for path in sorted((root / "data").glob("*/*.parquet"))]
found = datasets.Dataset.from_parquet(paths, features=features, cache_dir=sys.argv[2]).with_format("numpy")
np.savez(sys.argv[3], patch=np.stack(found["observation.patch"][:]), tactile=np.stack(found["observation.tactile"][:]),
         row=found["touch.row"][:])
tasks = pandas.read_parquet(root / "meta/tasks.parquet")
assert list(tasks.columns) == ["task_index"] and tasks.loc["touch star"].task_index == 0
datasets.Dataset.from_parquet([str(p) for p in (root / "meta/episodes").rglob("*.parquet")], cache_dir=sys.argv[2])
"""


@pytest.mark.full
def test_the_library_that_lerobot_reads_with_reads_it(tmp_path):
    """As LeRobotDataset does: Hugging Face's `datasets` with the features of info.json, pandas for the tasks."""
    pytest.importorskip("datasets")
    pytest.importorskip("pandas")
    dataset = make(6, wide=True)
    folder = write_lerobot(tmp_path / "out", dataset)
    words = [sys.executable, "-c", READER, str(folder), str(tmp_path / "cache"), str(tmp_path / "found.npz")]
    done = subprocess.run(words, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    found = np.load(tmp_path / "found.npz")
    np.testing.assert_array_equal(found["patch"], dataset.touches.patch[found["row"]])
    np.testing.assert_array_equal(found["tactile"], dataset.touches.reading[found["row"]])


@pytest.mark.full
def test_lerobot_itself_reads_it(tmp_path):
    lerobot = pytest.importorskip("lerobot.datasets.lerobot_dataset")
    dataset = make(6)
    folder = write_lerobot(tmp_path / "out", dataset)
    found = lerobot.LeRobotDataset("i2t/touches", root=folder)
    assert len(found) == len(dataset)
    for frame in found:
        row = int(frame["touch.row"])
        np.testing.assert_array_equal(frame["observation.tactile"].numpy(), dataset.touches.reading[row])
        np.testing.assert_array_equal(frame["observation.patch"].numpy(), dataset.touches.patch[row])
