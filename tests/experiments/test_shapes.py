"""The stamp experiment: its presses, held-out parts and classifiers, and the command at its debug size."""

import json
from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.shapes import __main__ as command
from experiments.shapes import methods, pad, world
from experiments.shapes.methods import FOLDS, StampClassificationBenchmark, presses_on, split_folds
from experiments.shapes.run import PRESETS, _with_new_split_names
from experiments.tsne import __main__ as tsne
from i2t import dataset as data
from i2t.errors import DataError
from i2t.geometry import random_motion
from i2t.objects import catalogue
from i2t.patches.dimensions import PAD_WINDOW
from i2t.rendering.render import prepare_surface, render_heights
from i2t.skin.pad import pad_from_seed

CFG = PRESETS["debug"]


def one(name: str) -> world.Stamp:
    return jax.tree.map(lambda leaf: leaf[world.SHAPES.index(name)], world.stamps())


@cache
def pressed():
    """Fifty presses on one skin."""
    return world.press_stamps(jax.random.key(0), [pad_from_seed(0)], 50, CFG.pressing)


@pytest.mark.full
def test_a_stamp_is_met_as_the_renderer_sees_it():
    stamp = one("angle")
    T = world.pose(jnp.array([1e-3, -2e-3]), jnp.float32(0.7), stamp)
    T = T @ random_motion(jax.random.key(3), 0.0, 0.02)
    face, base = world.heights(stamp, T, PAD_WINDOW, 40)
    seen = np.asarray(render_heights(prepare_surface(catalogue.make_object("stamp-angle").mesh), T, PAD_WINDOW, 40))
    ours = np.minimum(face, base)
    both = np.isfinite(ours) & np.isfinite(seen)
    # Walls, which only the renderer sees: less than half a cell at 0.02 rad, along 40 mm of outline and 80 of base.
    assert (np.isfinite(ours) != np.isfinite(seen)).sum() < 40
    assert (np.abs(ours[both] - seen[both]) > 2e-6).sum() < 20
    area = np.isfinite(np.asarray(face)).sum() * 0.25  # mm2 of cells of half a millimetre
    assert area == pytest.approx(51, abs=40 * 0.25)  # two bars of 10 x 3 less their corner; the outline is 40 mm


@pytest.mark.full
def test_the_centre_of_pressure_and_the_force_are_as_stated():
    touches = pressed().touches
    where = presses_on(pressed(), 0)
    assert np.abs(where.position).max() <= world.MAX_POSITION_M + 1e-6
    assert touches.truth.force.min() >= 1
    assert touches.truth.force.max() <= 3
    # The patch is deepest where the face is not, and the face touches: its nearest point lies in the skin.
    np.testing.assert_allclose(touches.nearest, -touches.truth.indentation, atol=1e-6)
    assert np.bincount(touches.object).tolist() == [10] * 5
    assert pressed().source == "simulated"


@pytest.mark.full
def test_folds_hold_out_the_stated_rows():
    where = presses_on(pressed(), 0)
    for split in methods.SPLITS:
        part = split_folds(where, split, 0)
        assert part is not None
        assert set(part) <= set(range(FOLDS))
    angle = split_folds(where, "angle", 0)
    for fold in range(FOLDS):
        turn = np.degrees(where.rotation[angle == fold]) % 360
        assert ((turn >= 72 * fold - 1e-6) & (turn <= 72 * (fold + 1) + 1e-6)).all()
    block = np.floor(where.position / 2e-3).astype(int)
    location = split_folds(where, "location", 0)
    for cell in np.unique(block, axis=0):
        assert len(np.unique(location[(block == cell).all(1)])) == 1
    travel = split_folds(where, "travel", 0)
    for shape in range(5):
        own = where.shape == shape
        assert where.travel[own & (travel == 0)].max() <= where.travel[own & (travel == 1)].min()
    lost = where._replace(rotation=np.full(50, np.nan), position=np.full((50, 2), np.nan))
    assert split_folds(lost, "angle", 0) is None
    assert split_folds(lost, "location", 0) is None


def test_the_hysteresis_of_a_chip_is_found():
    rng = np.random.default_rng(1)
    before, runs = 50 * rng.normal(size=(200, 15)), np.arange(200) // 100
    kept = np.where(np.arange(15) // 3 == 2, 0.3, 0.0)
    residuals = np.where((runs == 0)[:, None], kept[None] * before, 0) + rng.normal(size=(200, 15))
    found = pad.fit_hysteresis(residuals, before, runs, np.array([0, 1, 7]))
    # Shrunk by n / (n + MEMORY); noise of 1 uT on 50 uT over 300 values leaves 0.001.
    np.testing.assert_allclose(found[0], kept * 100 / (100 + 8), atol=0.03)
    np.testing.assert_allclose(found[1:], 0, atol=0.01)


@pytest.mark.full
def test_designs_are_linear_readings_of_the_pad_itself():
    """A skin that is known exactly reads what its designs predict."""
    dataset, where = pressed(), presses_on(pressed(), 0)
    benchmark = StampClassificationBenchmark(where, dataset.board, world.SHAPES, CFG.methods, 0)
    train = np.arange(40)
    skin, readings = benchmark.fitted(train)
    phi = benchmark.features.hypotheses(skin.layer)
    mean = pad.predict_reading(skin, phi)[np.arange(50), where.shape]
    left = np.sum((readings - mean)[40:] ** 2) / np.sum(readings[40:] ** 2)
    assert left < 0.25  # noise and tilt; a reading that is not explained leaves 1
    log_p = benchmark.log_probability(methods.PREDICTED, train, np.arange(40, 50), 0)
    assert (log_p.argmax(1) == where.shape[40:]).mean() >= 0.7  # of ten; chance gives this with p < 0.001


@pytest.mark.full
def test_the_command_writes_what_it_found_and_refuses_to_lose_it(tmp_path, capsys):
    out = tmp_path / "run"
    assert command.main(["--preset", "debug", "--out", str(out)]) == 0
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["source"] == "simulated"
    assert set(metrics["splits"]) == set(methods.SPLITS)
    for scored in metrics["splits"].values():
        assert set(scored) == set(methods.METHODS)
        for method in scored.values():
            assert np.sum(method["confusion"]) == 2 * CFG.presses
            mean, low, high = method["total"]
            assert low <= mean <= high
    assert set(metrics["new"]) == {"0", "2"}
    assert {"confusion.png", "rates.png"} <= {path.name for path in out.iterdir()}
    assert "(simulated)" in capsys.readouterr().out
    assert command.main(["--preset", "debug", "--out", str(out)]) == 2
    assert "finished run" in capsys.readouterr().err

    (out / "metrics.json").unlink()  # and a pad that is missing is made again
    (out / "pad-1.json").unlink()
    assert command.main(["--preset", "debug", "--out", str(out), "--resume"]) == 0
    again = json.loads((out / "metrics.json").read_text())
    assert json.dumps(again["splits"]) == json.dumps(metrics["splits"])


@pytest.mark.full
def test_recorded_presses_with_few_arm_states_are_classified_by_readings_alone(tmp_path, capsys):
    touches = pressed().touches
    nowhere = np.full_like(touches.T_w_o, np.nan)
    touches = touches._replace(T_w_o=nowhere, force=np.full_like(touches.force, np.nan), truth=None)
    path, out = tmp_path / "presses.h5", tmp_path / "run"
    data.save_dataset(path, replace(pressed(), touches=touches, source="real"))
    assert command.main(["--preset", "debug", "--dataset", str(path), "--out", str(out)]) == 0
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["source"] == "real"
    assert set(metrics["splits"]) == {"random", "travel"}
    assert set(metrics["splits"]["random"]) == {methods.PAPER}
    assert "simulated" not in capsys.readouterr().out


@pytest.mark.full
def test_the_map_of_touches_is_made_by_one_command(tmp_path, capsys):
    path, out = tmp_path / "presses.h5", tmp_path / "map"
    data.save_dataset(path, pressed())
    arguments = ["--preset", "debug", "--dataset", str(path), "--out", str(out)]
    assert tsne.main(arguments) == 0
    metrics = json.loads((out / "metrics.json").read_text())
    assert sum(metrics["cluster_sizes"]) == metrics["touches"] == 50
    assert metrics["rand_index"]["seeds"][0] <= 1
    assert metrics["agreement"]["all"]["permutations"] == 99
    assert (out / "tsne.png").stat().st_size > 10_000
    assert "(simulated)" in capsys.readouterr().out
    assert tsne.main(arguments) == 2
    data.save_dataset(path, pressed().select(np.arange(12)))
    assert tsne.main([*arguments, "--overwrite"]) == 2
    assert "at least 40 are needed" in capsys.readouterr().err


@pytest.mark.full
def test_one_shape_and_unknown_stamps_are_refused():
    with pytest.raises(DataError, match="needs at least two"):
        methods.shapes_of(replace(pressed(), objects=("T",)))
    with pytest.raises(ValueError, match="no stamp is called"):
        world.stamps(["banana"])


def test_a_classifier_without_finite_probabilities_is_refused(monkeypatch):
    monkeypatch.setattr(methods, "_train", lambda *_: None)
    monkeypatch.setattr(methods, "_log_probability", lambda _, x: jnp.full((len(x), 2), jnp.nan))
    x, y = np.random.default_rng(0).normal(size=(6, 3)), np.arange(6) % 2
    with pytest.raises(ValueError, match="no finite probabilities"):
        methods.classify(methods.Classifier(), x, y, x, classes=2, seed=0)


def test_splits_of_an_earlier_version_have_the_names_of_today():
    part = {"splits": {"random": {"a": 1}, "depth": {"a": 2}}, "new": {}}
    assert _with_new_split_names(part) == {"splits": {"random": {"a": 1}, "travel": {"a": 2}}, "new": {}}
