"""The pad model of a run: the touches that it is fitted to, and the reason if there is none."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from helpers.random_touches import recorded_presses

from experiments.train.arguments import TrainArgs
from experiments.train.configs import Simulation
from experiments.train.run import fit_or_explain
from experiments.train.sources import RecordedSource, SimulatedSource
from i2t.hardware.rig import Rig
from i2t.objects.named import read_meshes, require_objects
from i2t.skin.files import save_pad
from i2t.skin.pad import nominal_pad
from i2t.skin_models.pad_fit import ContactModel
from i2t.skin_models.pad_model import PadModel, add_press_errors, load_pad_model

CORNERS = ((0, 0, 0), (0, 20, 0), (20, 0, 0), (0, 0, 20))
FACES = ((0, 1, 2), (0, 2, 3), (0, 3, 1), (2, 1, 3))


@pytest.fixture
def mug(tmp_path):
    path = tmp_path / "mug.stl"
    trimesh.Trimesh(CORNERS, FACES).export(path)
    return path


def test_all_touches_or_those_that_train_make_the_pad_model_of_a_recording(monkeypatch):
    fitted_to, known = [], load_pad_model("nominal")

    def fit(self, key, touches):
        fitted_to.append(len(touches.dataset))
        return known

    monkeypatch.setattr(ContactModel, "fit", fit)
    dataset = recorded_presses(60, objects=("star", "hammer"))
    train = np.arange(60) < 40
    for every in (False, True):
        source = RecordedSource(Path("DATA"), None, (), None, None, every)
        source.pad_model(0, dataset, train, source.known_objects())
    assert fitted_to == [40, 60]


def test_a_rig_and_meshes_give_the_poses_and_shapes_of_the_objects(tmp_path, mug):
    replace(Rig(), object_covariance=np.diag([4e-6] * 6)).write(tmp_path / "lab.toml")
    known = RecordedSource(Path("DATA"), None, (mug,), "mm", tmp_path / "lab.toml", False).known_objects()
    assert known.errors.placement == pytest.approx(2e-3)
    np.testing.assert_allclose(np.ptp(known.meshes["mug"].vertices, axis=0), 0.02, atol=1e-6)


def test_touches_that_make_no_pad_model_end_no_training(capsys):
    dataset = recorded_presses(objects=("star", "hammer"), force=np.full(40, np.nan))
    source = RecordedSource(Path("DATA"), None, (), None, None, False)
    fit = partial(source.pad_model, 0, dataset, np.ones(40, bool), source.known_objects())
    assert "no press among the training touches has a measured force" in fit_or_explain(fit)
    assert "recognition cannot use this run" in capsys.readouterr().out


def test_errors_of_a_fitted_pad_widen_its_predictions():
    likelihood = SimpleNamespace(inflation=np.float32(1.0))
    likelihood._replace = lambda **new: SimpleNamespace(**new)
    model = PadModel(None, likelihood, np.ones(3), 0.5, np.full((10, 3), 4.0))
    assert add_press_errors(model, 3.0).likelihood.inflation == pytest.approx(1.25)
    assert add_press_errors(model, 0.0).likelihood.inflation == 1.0


def test_the_skin_of_a_pad_on_disk_is_that_of_its_touches(tmp_path):
    path = tmp_path / "left.npz"
    save_pad(path, nominal_pad())
    assert SimulatedSource(str(path), Simulation()).read_pad()[1].name == "simulated, left"
    save_pad(path, nominal_pad(), about={"pad": "skin A", "presses": 90, "source": "real"})
    about = SimulatedSource(str(path), Simulation()).read_pad()[1]
    assert (about.name, about.made_from) == ("skin A", ", fitted to 90 real presses")


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
    meshes = read_meshes([*map(Path, ["star", "hammer"]), mug], "mm")
    assert list(meshes) == ["star", "hammer", "mug"]
    assert list(read_meshes([Path("star"), Path("hammer")], None)) == ["star", "hammer"]
    star = tmp_path / "star.stl"
    star.write_bytes(mug.read_bytes())
    for names, unit, said in (
        (["star", str(mug)], None, "--unit mm"),
        (["star", str(star)], "mm", "are both called star"),
        (["star"], None, "at least two"),
        (["star", "cup"], "mm", "cup: is neither a mesh file nor an object of the catalogue"),
    ):
        with pytest.raises(ValueError, match=said):
            require_objects([Path(name) for name in names], unit)
