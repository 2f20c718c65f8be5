"""LeRobot's format: LeRobot's own reader reads every value."""

import json
import sys

import numpy as np
import pytest
from helpers.random_touches import make
from helpers.recordings import refused, run

from i2t.convert import lerobot
from i2t.dataset import save_dataset
from i2t.errors import DataError, MissingExtraError

pq = pytest.importorskip("pyarrow.parquet")


@pytest.mark.parametrize(("truth", "view", "board"), [(False, False, "reskin"), (True, True, "grid-1x2")])
def test_frames_hold_every_value_and_are_counted_as_lerobot_requires(tmp_path, truth, view, board):
    dataset = make(9, truth=truth, view=view, board=board, pixels=6)
    folder = lerobot.write(tmp_path / "out", dataset)
    info, stats, note = (json.loads((folder / f"meta/{name}.json").read_text()) for name in ("info", "stats", "i2t"))
    table = pq.read_table(folder / "data/chunk-000/file-000.parquet")
    episodes = pq.read_table(folder / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert set(table.column_names) == set(info["features"])
    row = table["touch.row"].to_pylist()
    absent = {"truth"} | ({"view"} if not view else set())
    fields = {k: v for k, v in dataset.touches._asdict().items() if k not in absent and v is not None}
    fields |= {f"truth_{name}": values for name, values in dataset.touches.truth._asdict().items()} if truth else {}
    for name, values in fields.items():
        column = table[lerobot.LEROBOT_COLUMNS.get(name, f"touch.{name}")]
        np.testing.assert_array_equal(np.array(column.to_pylist(), values.dtype), values[row], err_msg=name)
    assert table["index"].to_pylist() == list(range(9))
    assert (info["total_frames"], info["total_episodes"]) == (9, len(episodes))
    for number, episode in enumerate(episodes):
        rows = slice(episode["dataset_from_index"], episode["dataset_to_index"])
        assert table["episode_index"].to_pylist()[rows] == [number] * episode["length"]
        assert table["frame_index"].to_pylist()[rows] == list(range(episode["length"]))
        assert len(set(dataset.touches.session[row][rows])) == 1
    np.testing.assert_allclose(stats["observation.tactile"]["mean"], dataset.touches.reading.mean(0), rtol=1e-4)
    assert stats["touch.force"]["max"][0] == pytest.approx(np.nanmax(dataset.touches.force))
    assert (tuple(note["objects"]), note["source"], note["window"]) == (dataset.objects, "simulated", 0.017)


def test_the_command_replaces_its_own_folder_on_request_and_no_other(tmp_path, capsys):
    save_dataset(tmp_path / "set.h5", make(5, pixels=6))
    words = ("lerobot", tmp_path / "set.h5", tmp_path / "out")
    assert run(*words) == 0
    assert "--overwrite" in refused(capsys, *words)
    assert run(*words, "--overwrite") == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "set.h5"]
    (tmp_path / "out/meta/i2t.json").unlink()
    assert "another folder" in refused(capsys, *words, "--overwrite")
    (tmp_path / "out/letter.txt").write_text("mine")
    assert "holds letter.txt" in refused(capsys, *words, "--overwrite")
    with pytest.raises(DataError, match="another folder"):
        lerobot.write(tmp_path / "out", make(2, pixels=4))
    assert (tmp_path / "out/letter.txt").read_text() == "mine"


def test_without_pyarrow_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(MissingExtraError, match=r'pip install -e "\.\[lerobot\]"'):
        lerobot.write(tmp_path / "out", make(2, pixels=6))
    assert not list(tmp_path.iterdir())


@pytest.mark.full
def test_lerobot_itself_reads_it(tmp_path):
    theirs = pytest.importorskip("lerobot.datasets.lerobot_dataset")
    dataset = make(6)
    loaded = theirs.LeRobotDataset("i2t/touches", root=lerobot.write(tmp_path / "out", dataset))
    assert len(loaded) == len(dataset)
    for frame in loaded:
        row = int(frame["touch.row"])
        np.testing.assert_array_equal(frame["observation.tactile"].numpy(), dataset.touches.reading[row])
        np.testing.assert_array_equal(frame["observation.patch"].numpy(), dataset.touches.patch[row])
