"""What a run on recorded touches keeps for recognition, and what it says where that is nothing."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from helpers.random_touches import make

from experiments.recognize import trained_run
from experiments.train import recognition_data
from experiments.train.arguments import TrainArgs
from experiments.train.recognition_data import MeshFile, keep, known_touches, read
from i2t.dataset import Dataset
from i2t.errors import DataError
from i2t.objects import catalogue
from i2t.types import ReturnCode

CORNERS = ((0, 0, 0), (0, 20, 0), (20, 0, 0), (0, 0, 20))
FACES = ((0, 1, 2), (0, 2, 3), (0, 3, 1), (2, 1, 3))


def recorded(n: int = 40, objects=("star", "mug"), **changed) -> Dataset:
    """Touches that are all of one skin, measured, and ended by the skin."""
    dataset = make(n, objects=objects, pixels=8)
    own = {
        "pad": np.zeros(n), "code": np.full(n, ReturnCode.SKIN), "force": np.full(n, 1.0), "depth": np.full(n, 1e-4),
        "object": np.arange(n) % len(objects), "session": np.arange(n) % 4,
    }  # fmt: skip
    return replace(dataset, touches=dataset.touches._replace(**(own | changed)))


@pytest.fixture
def mug(tmp_path):
    path = tmp_path / "mug.stl"
    trimesh.Trimesh(CORNERS, FACES).export(path)
    return path


def everything(dataset: Dataset) -> np.ndarray:
    return np.ones(len(dataset), bool)


def test_training_touches_come_back_as_seen_from_the_object(tmp_path, mug):
    dataset = recorded()
    rows = everything(dataset)
    rows[:4] = False
    out = tmp_path / "run"
    out.mkdir()
    said = keep(out, dataset, rows, {"mug": MeshFile(mug, "mm")})
    assert '36 training touches of star, mug (simulated) make a pad model of "pad é"' in said
    kept = read(out)
    assert len(kept.dataset) == 36
    touches = dataset.touches
    T_o_t = np.linalg.inv(touches.T_w_o[rows]) @ touches.T_w_t[rows]
    np.testing.assert_allclose(kept.dataset.touches.T_w_t, T_o_t, atol=1e-6)
    np.testing.assert_array_equal(kept.dataset.touches.T_w_o, np.broadcast_to(np.eye(4), (36, 4, 4)))
    np.testing.assert_array_equal(kept.dataset.touches.reading, touches.reading[rows])
    np.testing.assert_array_equal(
        kept.meshes["star"].vertices, catalogue.make_object("star").mesh.vertices
    )  # fmt: skip
    np.testing.assert_allclose(np.ptp(kept.meshes["mug"].vertices, axis=0), 0.02, atol=1e-6)
    about = json.loads((out / recognition_data.RECOGNITION_ABOUT).read_text())
    assert about["objects"]["star"] == "catalogue"
    assert about["source"] == "simulated"


def test_a_mesh_that_has_changed_is_refused(tmp_path, mug):
    out = tmp_path / "run"
    out.mkdir()
    dataset = recorded()
    keep(out, dataset, everything(dataset), {"mug": MeshFile(mug, "mm")})
    copy = out / "meshes" / "mug.stl"
    trimesh.Trimesh(1.05 * np.array(CORNERS), FACES).export(copy)
    with pytest.raises(DataError, match="is not the mesh that the run kept of mug"):
        read(out)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"code": np.full(40, ReturnCode.AIR)}, "no press among them was ended by the skin or the force"),
        ({"force": np.full(40, np.nan)}, "no press has a measured force, depth and pose"),
        ({"pad": np.arange(40) % 2}, r"of several skins \(pad b, pad é\), and a pad model is of one"),
        ({"session": np.zeros(40)}, "40 usable touches in 1 sessions are too few"),
        ({"code": np.where(np.arange(40) < 12, ReturnCode.SKIN, ReturnCode.AIR)}, "12 usable touches in 4 sessions"),
    ],
)
def test_why_touches_make_no_pad_model(changed, said, tmp_path):
    dataset = recorded(objects=("star", "hammer"), **changed)
    with pytest.raises(DataError, match=said):
        known_touches(dataset, everything(dataset), {}, "DATA")
    assert "recognition cannot use this run" in keep(tmp_path, dataset, everything(dataset), {})
    with pytest.raises(DataError, match=said):
        read(tmp_path)


def test_objects_without_a_mesh_are_left_out_or_named():
    dataset = recorded(80)
    touches = known_touches(dataset, everything(dataset), {}, "DATA")
    assert list(touches.meshes) == ["star"]
    assert len(touches.dataset) == 40
    nameless = recorded(objects=("mug", "cup"))
    with pytest.raises(DataError, match="there is no mesh of cup, mug; pass --objects FILE"):
        known_touches(nameless, everything(nameless), {}, "DATA")


def test_mesh_files_need_a_unit_and_names_of_their_own(tmp_path, mug):
    other = tmp_path / "mug.obj"
    other.write_text("")
    for files, unit, said in (
        ((mug,), None, "--unit mm"),
        ((tmp_path / "cup.stl",), "mm", "cup.stl"),
        ((mug, other), "mm", "are both called mug"),
    ):
        with pytest.raises(ValueError, match=said):
            TrainArgs(dataset=tmp_path, objects=files, unit=unit).check()


def test_names_of_the_catalogue_and_mesh_files_mix(tmp_path, mug):
    meshes = trained_run.load_meshes([*map(Path, ["star", "hammer"]), mug], "mm")
    assert list(meshes) == ["star", "hammer", "mug"]
    assert list(trained_run.load_meshes([Path("star"), Path("hammer")], None)) == ["star", "hammer"]
    star = tmp_path / "star.stl"
    star.write_bytes(mug.read_bytes())
    for names, unit, said in (
        (["star", str(mug)], None, "--unit mm"),
        (["star", str(star)], "mm", "are both called star"),
        (["star"], None, "at least two"),
        (["star", "cup"], "mm", "cup: is neither a mesh file nor an object of the catalogue"),
    ):
        with pytest.raises(ValueError, match=said):
            trained_run.load_meshes([Path(name) for name in names], unit)


def test_a_run_on_recorded_touches_says_why_it_simulates_no_episodes(tmp_path):
    (tmp_path / "metrics.json").write_text('{"source": "real", "pad": null}')
    with pytest.raises(ValueError, match="keeps no touches; train it again"):
        trained_run.read_simulated_run(tmp_path)
    (tmp_path / recognition_data.RECOGNITION_ABOUT).write_text('{"unusable": "the force was not measured"}')
    with pytest.raises(ValueError, match="trained on recorded touches, and simulated episodes need a pad"):
        trained_run.read_simulated_run(tmp_path)
    with pytest.raises(DataError, match="is of no use to recognition: the force was not measured"):
        read(tmp_path)
