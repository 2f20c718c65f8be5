"""The ready models: they load by name from the package alone, say that they are simulated, and their card is true."""

import json
from pathlib import Path

import numpy as np
import pytest

import i2t
from i2t import models
from i2t.models import READY_MODELS, model_card, ready_path
from i2t.recognition.pad_model_files import load_pad_model

ROOT = Path(__file__).parents[1]
MAX_BYTES = 5_000_000


@pytest.mark.parametrize("name", READY_MODELS)
def test_a_ready_model_is_small_and_part_of_the_package(name):
    folder = Path(models.__file__).parent / name
    files = [path for path in folder.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) < MAX_BYTES
    text = (ROOT / "pyproject.toml").read_text()
    assert f'"models/{name}/**"' in text


def test_a_folder_of_the_users_own_is_meant_before_a_ready_model(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert ready_path("nominal", "predictor").is_dir()
    assert ready_path("runs/train", "predictor") == Path("runs/train")
    Path("nominal").mkdir()
    assert ready_path("nominal", "predictor") == Path("nominal")


def test_a_card_of_no_model_is_refused():
    with pytest.raises(ValueError, match="there is nominal"):
        model_card("eflesh")


def test_the_ready_pad_model_is_of_simulated_pad_0():
    known = load_pad_model("nominal")
    card = model_card("nominal")
    assert (known.origin.pad, known.origin.source) == ("simulated pad 0", "simulated")
    assert list(known.origin.objects) == card["trained on"]
    assert known.model.r2 == pytest.approx(card["pad model"]["r2"])
    nominal = np.asarray(i2t.reskin_board().chips)  # but for the thickness of the pad over them
    assert np.asarray(known.board.chips)[:, :2] == pytest.approx(nominal[:, :2])


def test_the_card_in_the_docs_gives_the_figures_of_the_run():
    card, page = model_card("nominal"), (ROOT / "docs" / "model_card.md").read_text()
    assert card["source"] == "simulated"
    for name, scores in card["methods"].items():
        low, high = scores["r2_interval"]
        row = f"| {name} | {scores['r2']:.2f} [{low:.2f}, {high:.2f}] | {scores['rmse']:.2f} |"
        assert row in page, f"the card has no row {row}"
    for said in (f"{card['pad model']['r2']:.2f}", f"{card['megabytes']} MB", *card["trained on"], *card["tested on"]):
        assert said in page, f"the card does not say {said}"
    assert not set(card["trained on"]) & set(card["tested on"])


def test_the_card_is_what_the_run_of_the_ready_models_writes():
    from experiments.ready_models.run import card_figures

    metrics = {"best": "b", "methods": {"b": {"r2": 0.5, "r2_interval": [0.4, 0.6], "rmse": 2.0, "r2_axis": [1]}}}
    figures = card_figures(json.loads(json.dumps(metrics)))
    assert figures.kept == "b"
    assert figures.methods == {"b": {"r2": 0.5, "r2_interval": [0.4, 0.6], "rmse": 2.0}}


@pytest.mark.full
def test_the_ready_predictor_imagines_touches(tmp_path, capsys):
    from i2t.imagine import main

    assert main(["star", "--sites", "2", "--out", str(tmp_path / "star.png")]) == 0
    assert "+-" in capsys.readouterr().out
    assert (tmp_path / "star.png").stat().st_size > 10_000
    assert main(["star", "--sites", "1", "--board", "grid-2x2", "--out", str(tmp_path / "star.png")]) == 2


@pytest.mark.full
def test_the_ready_predictor_is_as_good_as_its_card_says():
    """On new simulated touches of an object that it has not seen, with the pad and the errors of its training."""
    import jax

    from i2t.simulation.touches import SimulationErrors
    from i2t.skin.pad import numbered_pad

    surface = i2t.prepare_surface(i2t.make_object("hammer").mesh)
    made = i2t.simulate_touches(jax.random.key(7), [surface], numbered_pad(0), SimulationErrors(), 36)
    predictor = i2t.load_predictor("nominal")
    reading = predictor.predict(
        made.patch, force=made.force, nearest=made.nearest, depth=made.depth, wide=made.wide
    )  # fmt: skip
    truth = np.asarray(made.reading)
    off = truth - reading.mean
    assert np.mean(off**2) < 0.85 * np.mean((truth - truth.mean(0)) ** 2)
    assert 0.8 < np.mean(np.abs(off) < 1.645 * reading.std) <= 1


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["mug.stl"], "neither a mesh file nor an object"),
        (["star", "--unit", "mm"], "--unit is of a mesh file"),
        (["star", "--force", "-1"], "--force is -1"),
    ],
)
def test_wrong_use_of_imagine_is_one_sentence(words, said, capsys, tmp_path, monkeypatch):
    from i2t.imagine import main

    monkeypatch.chdir(tmp_path)
    assert main(words) == 2
    printed = capsys.readouterr()
    assert said in printed.err
    assert len(printed.err.strip().splitlines()) == 1
    assert not list(tmp_path.iterdir())
