"""Each program of examples/ runs and does what its documentation states."""

import importlib.util
import json
import re
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import i2t
from experiments.train import __main__ as train
from i2t.convert import presses
from i2t.convert.commands import main as convert
from i2t.errors import CheckpointError, DataError
from i2t.files.writing import slug
from i2t.prediction.touch_model import TouchModel
from tests.helpers.baselines import bare_dataset

EXAMPLES = sorted((Path(__file__).parents[1] / "examples").glob("[0-9][0-9]_*.py"))
DATA = Path(__file__).parents[1] / "examples" / "data"


def _load(number: int) -> ModuleType:
    path = EXAMPLES[number]
    assert path.name.startswith(f"{number:02d}_")
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_examples_write_only_into_the_folder_of_runs():
    for path in EXAMPLES:
        for argument in re.findall(r"def main\((.*?)\) ->", path.read_text(), re.S):
            for name in re.findall(r'(?:out|path): str = "([^"]+)"', argument):
                assert name.startswith("runs/"), f"{path.name} writes {name}"


def test_the_data_are_those_that_their_program_makes(tmp_path):
    spec = importlib.util.spec_from_file_location("make_data", DATA / "make_data.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.main(tmp_path)
    made, kept = ((folder / "presses.csv").read_text().splitlines() for folder in (tmp_path, DATA))
    assert made[0] == kept[0]
    numbers = [np.array([row.split(",")[:19] for row in rows[1:]], float) for rows in (made, kept)]
    np.testing.assert_allclose(*numbers, atol=0.11)  # a tenth of a microtesla is the last digit
    meshes = [i2t.load_mesh(folder / "mug.stl", "mm") for folder in (tmp_path, DATA)]
    assert len(meshes[0].faces) == len(meshes[1].faces)
    np.testing.assert_allclose(*(mesh.vertices.max(0) - mesh.vertices.min(0) for mesh in meshes), atol=1e-5)
    assert all(path.stat().st_size < 100_000 for path in DATA.iterdir() if path.is_file())


def test_a_table_of_simulated_presses_is_not_real_data(tmp_path):
    table = DATA / "presses.csv"
    assert convert(["presses", str(table), str(tmp_path / "set"), "--indenter", "sphere:4.0"]) == 0
    dataset = i2t.load_dataset(tmp_path / "set")
    assert (len(dataset), dataset.source) == (100, "simulated")
    text = table.read_text()
    for replaced, source in ((-1, "real"), (1, "mixed")):
        (tmp_path / "other.csv").write_text(text.replace("simulated", "", replaced))
        words = ["presses", str(tmp_path / "other.csv"), str(tmp_path / source), "--indenter", "sphere:4.0"]
        assert convert([*words, "--as-stated"]) == 0
        assert i2t.load_dataset(tmp_path / source).source == source
    (tmp_path / "other.csv").write_text(text.replace("simulated", "a dream"))
    with pytest.raises(DataError, match="line 2 has the source 'a dream'; write real or simulated"):
        presses.convert(tmp_path / "other.csv", indenter="sphere:4.0", board=i2t.reskin_board())


def test_a_patch_is_rendered_and_drawn(tmp_path):
    patch = _load(1).main(str(tmp_path / "patch.png"))
    assert abs(float(patch.nearest)) < 0.1e-3
    assert (tmp_path / "patch.png").stat().st_size > 1000


@pytest.mark.full
def test_a_depth_image_gives_the_patch_of_the_mesh():
    assert _load(2).main() < 0.05e-3


@pytest.mark.full
def test_a_press_is_strongest_below_the_ball(tmp_path):
    reading = _load(3).main(str(tmp_path / "press.png")).reshape(-1, 3)
    assert np.linalg.norm(reading, axis=1).argmax() in (0, 1)  # the ball is 3 mm along x: between chips 0 and 1
    assert (tmp_path / "press.png").exists()


@pytest.mark.full
def test_simulated_touches_come_back_from_disk(tmp_path):
    dataset = _load(4).main(str(tmp_path / "touches.h5"), 4)
    assert len(dataset) == 8
    assert dataset.source == "simulated"


@pytest.mark.full
def test_a_trained_run_predicts_touches(trained_run):
    reading = _load(5).main(str(trained_run))
    assert np.isfinite(reading.mean).all()
    assert (reading.std > 0).all()


@pytest.mark.full
def test_sixty_presses_calibrate_a_skin():
    assert _load(6).main() > 0.5


@pytest.mark.full
def test_touches_find_the_object():
    before, after = _load(7).main(8)
    assert after < before / 2


@pytest.mark.full
def test_an_object_is_recognised():
    from i2t.recognition.recognizer import RecognizerConfig

    config = RecognizerConfig(num_sites=3, num_particles=16, max_touches=3)  # as the notebook's
    assert _load(8).main(72, config) in ("star", "cylinder", "hammer")


@pytest.mark.full
def test_a_surface_grows_under_touches():
    mesh = _load(10).main(touches=3, library_size=4, across=20)
    assert np.ptp(mesh.vertices, axis=0) == pytest.approx([64e-3, 64e-3, 25e-3], abs=12e-3)


@pytest.mark.full
def test_a_press_improves_the_estimated_depth():
    after, before = _load(9).main()  # with fewer patches none of them may be like what was met
    assert after < 0.9 * before


@pytest.mark.full
def test_an_episode_of_an_environment_is_played():
    np.testing.assert_allclose(_load(11).main(), -np.log(2) * np.ones(4), rtol=1e-5)


@pytest.mark.full
def test_the_paper_in_one_page(capsys):
    right = _load(0).main(touches=36, epochs=2, episodes=3, count=2)
    assert set(right) == {"Imagine2touch", "proprioception"}
    assert all(0 <= share <= 1 for share in right.values())
    assert "of 3 after 2 touches (chance 33%; simulated)" in capsys.readouterr().out


def test_a_user_defined_predictor_is_trained_compared_saved_and_loaded(tmp_path, capsys):
    """It needs one file and one line; each option of a network is one more line."""
    rng = np.random.default_rng(0)
    slope, n = rng.uniform(-1, 1, (80, 2)), 80
    at = np.linspace(0, 1, 48)
    patch = 1e-3 * (slope[:, :1, None] * at + slope[:, 1:, None] * at[:, None])
    patch -= patch.min((1, 2), keepdims=True)
    reading = slope @ rng.normal(size=(2, 6)) * 20 + rng.normal(size=(n, 6))
    recorded = bare_dataset(patch, reading)
    touches = recorded.touches._replace(session=np.arange(n) // 8, force=np.ones(n, np.float32))
    sessions = tuple(f"run {i}" for i in range(10))
    i2t.save_dataset(tmp_path / "set.h5", replace(recorded, touches=touches, sessions=sessions))
    words = ["--dataset", str(tmp_path / "set.h5"), "--split", "session", "--preset", "debug", "--epochs", "1"]
    words += ["--methods", "ridge", "paper-depth", "--method", "examples.12_your_own_predictor:Slopes"]
    words += ["--paper.bottleneck", "3", "--paper.auxiliary-weight", "0.5"]
    assert train.main([*words, "--out", str(tmp_path / "run")]) == 0
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    own, network = "least squares on slopes", "paper's network, depth"
    assert set(metrics["methods"]) == {"mean reading", "ridge on PCA", network, own}
    assert metrics["methods"][own]["r2"] > 0.9
    model = i2t.load_predictor(tmp_path / "run" / "checkpoint" / slug(network)).model.cfg
    assert (model.bottleneck, model.auxiliary_weight, model.readings) == (3, 0.5, 6)

    assert train.main([*words[:-6], "no_such_module:Slopes", "--out", str(tmp_path / "none")]) == 2
    assert "no_such_module:Slopes cannot be imported" in capsys.readouterr().err


@pytest.mark.full
def test_a_user_defined_predictor_loads_once_its_module_is_imported(tmp_path, monkeypatch):
    example = _load(12)
    predictor = example.main(str(tmp_path / "p"), 36)
    again = i2t.load_predictor(tmp_path / "p")
    patch = np.zeros((48, 48))
    np.testing.assert_array_equal(again.predict(patch).mean, predictor.predict(patch).mean)
    name = f"{example.SlopeModel.__module__}:SlopeModel"
    monkeypatch.delitem(TouchModel.registered, name)
    with pytest.raises(CheckpointError, match=f"a {name}, which is not registered here; call importlib"):
        i2t.load_predictor(tmp_path / "p")
