"""What a user holds: saving, loading, one touch and many, meshes and poses, and refusals."""

import json
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from i2t import geometry
from i2t.contact.pressure import PressureModelConfig, predict_pressures
from i2t.errors import CheckpointError
from i2t.objects import catalogue
from i2t.patches.dimensions import PATCH_PIXELS, PATCH_WINDOW, REACH
from i2t.prediction import model, predictor
from i2t.prediction.gp_method import GPModel
from i2t.prediction.networks import PatchNetwork, PressureNetwork
from i2t.prediction.predictor import Predictor
from i2t.rendering.render import prepare_surface, render_view
from i2t.skin.boards import board_as_lists, make_board, name_of_board, same_board
from i2t.skin_models import pressure_gp as gp
from i2t.training import Standard
from tests.helpers.baselines import fit_baselines

PRESSURE = PressureModelConfig(PATCH_WINDOW / PATCH_PIXELS, smooth=False, tilt=0.0)


@pytest.fixture(scope="module")
def patches():
    x = (np.arange(PATCH_PIXELS) + 0.5) / PATCH_PIXELS - 0.5
    centres = np.random.default_rng(0).uniform(-0.3, 0.3, (6, 2))
    square = (x[None, :, None] - centres[:, :1, None]) ** 2 + (x[None, None, :] - centres[:, 1:, None]) ** 2
    return np.clip(square * 5e-3, 0, REACH).astype(np.float32)


def fitted_gp(patches: np.ndarray, channels: int) -> tuple[Predictor, jax.Array]:
    """A Gaussian process conditioned on six round tips with arbitrary readings, and these readings."""
    pressure = predict_pressures(PRESSURE, patches, np.full(6, 0.8), np.full(6, np.nan))
    lengths = len(gp.MAP_LENGTHS_MM)
    hyper = gp.GPHyperparameters(jnp.full(lengths, 1 / lengths), jnp.float32(0.2), jnp.float32(1.0), jnp.float32(0.01))
    readings = 20 * jax.random.normal(jax.random.key(1), (6, channels))
    fitted = GPModel(gp.fit(hyper, pressure, readings), PRESSURE)
    return Predictor(fitted, PATCH_WINDOW, REACH, 0.8, 0.3e-3, 1.3, {"method": "test", "source": "simulated"}), readings


def network_fields(channels: int, **changes: Any) -> tuple[Any, ...]:
    """Parameters, configuration and normalisation of a small network with random weights."""
    cfg = model.ModelConfig(
        readings=channels, encoder_width=8, decoder_width=8, auxiliary=False, heteroscedastic=True, members=2, **changes
    )
    params = jax.vmap(lambda key: model.init(key, cfg))(jax.random.split(jax.random.key(2), 2))
    k = len(cfg.conditions)
    norm = model.Normalisation(
        Standard(jnp.arange(1.0 * channels), jnp.full(channels, 2.0)),
        Standard(jnp.zeros(k), jnp.ones(k)),
        jnp.zeros(channels),
    )
    return params, cfg, norm


@pytest.fixture(scope="module")
def process(patches):
    return fitted_gp(patches, 15)


@pytest.fixture(scope="module")
def network():
    fields = network_fields(15, conditions=("force", "nearest"))
    return Predictor(PatchNetwork(*fields), PATCH_WINDOW, REACH, 1.0, 0.3e-3)


@pytest.fixture(scope="module")
def on_pressure():
    fields = network_fields(15, conditions=("force", "travel"), input="pressure", pixels=20)
    return Predictor(PressureNetwork(*fields, PRESSURE), PATCH_WINDOW, REACH, 1.0, 0.3e-3, 0.5)


def test_one_touch_is_a_row_of_many(process, patches):
    assert process[0].with_pressure(smooth=True).pressure == replace(PRESSURE, smooth=True)
    many = process[0].predict(patches, force=np.linspace(0.5, 1.5, 6))
    single = process[0].predict(patches[2], force=np.linspace(0.5, 1.5, 6)[2])
    assert single.mean.shape == single.std.shape == (15,)
    # uT: single precision through a contact
    np.testing.assert_allclose(single.mean, many.mean[2], rtol=1e-4, atol=1e-3)
    np.testing.assert_allclose(single.std, many.std[2], rtol=1e-3)
    # The force left out is the default force.
    np.testing.assert_array_equal(process[0].predict(patches).mean, process[0].predict(patches, force=0.8).mean)


def assert_same_predictions(first: Predictor, other: Predictor, patches: np.ndarray, **given: float) -> None:
    before, after = first.predict(patches, **given), other.predict(patches, **given)
    np.testing.assert_array_equal(before.mean, after.mean)
    np.testing.assert_array_equal(before.std, after.std)


@pytest.fixture(scope="module")
def baseline_predictors():
    """Every baseline, fitted to small patches with a force and a nearest point."""
    rng = np.random.default_rng(3)
    patches, measured = rng.uniform(0, REACH, (30, 8, 8)), rng.uniform(0.5, 1.5, (30, 2))
    readings, pressure = rng.normal(size=(30, 6)), rng.uniform(0, 0.1, (30, 20, 20))
    fitted = fit_baselines(patches, measured, readings, np.arange(30) // 3, pressure)
    return {name: Predictor(model, PATCH_WINDOW, REACH, 1.1, 0.3e-3, 1.4) for name, model in fitted.items()}


def test_baselines_are_predictors_like_the_others(baseline_predictors, tmp_path):
    """Saved, where the one before them was, and loaded, one touch or many, with what was not measured taken as in
    training.
    """
    assert len(baseline_predictors) == 9
    patches = np.random.default_rng(4).uniform(0, REACH, (7, 8, 8))
    for saved in baseline_predictors.values():
        saved.save(tmp_path / "p")
        loaded = predictor.load_predictor(tmp_path / "p")
        assert type(loaded.model) is type(saved.model)
        assert_same_predictions(loaded, saved, patches, force=0.9, nearest=0.9e-3)
        many = loaded.predict(patches, nearest=0.9e-3)
        np.testing.assert_array_equal(many.mean, loaded.predict(patches, force=1.1, nearest=0.9e-3).mean)
        single = loaded.predict(patches[2], nearest=0.9e-3)
        np.testing.assert_allclose(single.mean, many.mean[2], rtol=1e-5, atol=1e-5)
        assert (many.std > 0).all()


@pytest.mark.parametrize("name", ["anyskin", "grid-5x1"])
def test_the_board_of_the_training_is_kept(network, tmp_path, name):
    board = make_board(name)
    replace(network, metadata={"board": board_as_lists(board)}).save(tmp_path / "p")
    loaded = predictor.load_predictor(tmp_path / "p")
    assert same_board(loaded.board, board)
    assert name_of_board(loaded.board) == name
    for damaged in (
        None,
        {},
        {"chips": [[0, 0, 0]]},
        board_as_lists(make_board("grid-2x2")),
        {"chips": 1, "rotations": 2},
    ):
        assert replace(network, metadata={"board": damaged}).board is None
    assert network.board is None


def test_an_unknown_name_of_a_predictor_hints_at_the_ready_model(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    for name in ("nominall", "Nominal", "NOMINAL/", "nominal/"):
        with pytest.raises(CheckpointError, match=r"there is no such folder; did you mean nominal\?"):
            predictor.load_predictor(name)
    writers = "name the folder that i2t fit or python -m experiments.train wrote, or a ready model, nominal$"
    with pytest.raises(CheckpointError, match=f"^runs/fitt: there is no such folder; {writers}"):
        predictor.load_predictor("runs/fitt")
    (tmp_path / "runs" / "fit").mkdir(parents=True)
    with pytest.raises(CheckpointError, match=r"^runs/fitt: there is no such folder; did you mean runs/fit\?$"):
        predictor.load_predictor("runs/fitt")
    with pytest.raises(CheckpointError, match=f"^runs/fit: holds no predictor of this i2t; {writers}"):
        predictor.load_predictor("runs/fit")


@pytest.mark.full
@pytest.mark.parametrize("which", ["process", "network", "on_pressure"])
def test_a_loaded_predictor_equals_the_saved_one(which, patches, request, tmp_path):
    original = request.getfixturevalue(which)
    original = original[0] if which == "process" else original
    original.save(tmp_path / "p")
    loaded = predictor.load_predictor(tmp_path / "p")
    assert type(loaded.model) is type(original.model)
    fields = ("pressure", "window", "reach", "default_force", "default_travel", "std_scale", "metadata")
    assert all(getattr(loaded, field) == getattr(original, field) for field in fields)
    assert_same_predictions(loaded, original, patches, force=1.0, nearest=-1e-4)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"version": 3}, "of version 3, but this i2t reads version 5; use the i2t that wrote it, or train again"),
        ({"window": None}, "lacks window"),
        (None, "holds no predictor|there is no such folder"),
    ],
)
def test_predictors_that_cannot_be_read_are_refused_in_one_sentence(network, tmp_path, change, words):
    """They are predictors of later versions, incomplete ones, and foreign files."""
    network.save(tmp_path / "p")
    path = tmp_path / "p" / "_CHECKPOINT_METADATA"
    about = json.loads(path.read_text())
    about["custom_metadata"].update(change or {})
    if change == {"window": None}:
        del about["custom_metadata"]["window"]
    path.write_text(json.dumps(about if change else {}))
    for folder in ("p",) if change else ("p", "missing"):
        with pytest.raises(CheckpointError, match=words) as error:
            predictor.load_predictor(tmp_path / folder)
        assert "\n" not in str(error.value)


def edit_metadata(folder, edit):
    path = folder / "_CHECKPOINT_METADATA"
    about = json.loads(path.read_text())
    edit(about["custom_metadata"])
    path.write_text(json.dumps(about))


def test_a_predictor_that_calls_travel_depth_is_read(on_pressure, patches, tmp_path):
    """As version 4 does in its conditions, its default and the control of its pressure."""
    original = replace(on_pressure, model=replace(on_pressure.model, pressure=replace(PRESSURE, control="travel")))
    original.save(tmp_path / "p")

    def as_version_4(about):
        about["version"], about["default_depth"] = 4, about.pop("default_travel")
        text = json.dumps(about["model"]["settings"])
        assert text.count('"travel"') == 2
        about["model"]["settings"] = json.loads(text.replace('"travel"', '"depth"'))

    edit_metadata(tmp_path / "p", as_version_4)
    loaded = predictor.load_predictor(tmp_path / "p")
    assert loaded.default_travel == original.default_travel
    assert_same_predictions(loaded, original, patches, force=1.0, travel=0.2e-3)


@pytest.mark.parametrize(
    ("sign", "offset", "force"), [(1.0, 0.0, 0.8), (-1.0, 0.0, 0.8), (1.0, 1e-3, 0.8), (1.0, 0, -2)]
)
def test_an_old_predictor_with_unusual_sign_conventions_is_refused(patches, tmp_path, sign, offset, force):
    fitted, _ = fitted_gp(patches, 12)
    replace(fitted, default_force=0.8).save(tmp_path / "p")

    def add_conventions(about):
        about["default_force"] = force
        about["model"]["settings"]["pressure"]["values"] |= {"force_sign": sign, "depth_offset": offset}

    edit_metadata(tmp_path / "p", add_conventions)
    if (sign, offset, force) == (1.0, 0.0, 0.8):
        assert_same_predictions(predictor.load_predictor(tmp_path / "p"), fitted, patches, force=1.0, nearest=-1e-4)
        return
    with pytest.raises(CheckpointError, match=r"as its recording counted them .*; train again: python -m"):
        predictor.load_predictor(tmp_path / "p")


@pytest.mark.full
def test_any_board_is_predicted(patches):
    fitted, readings = fitted_gp(patches, 12)
    fields = network_fields(12, conditions=("force",), input="pressure", pixels=20)
    for candidate in (fitted, replace(fitted, model=PressureNetwork(*fields, PRESSURE))):
        assert "4 chips" in repr(candidate)
        assert candidate.predict(patches[0]).mean.shape == (12,)
    # With little noise a process comes back to the readings that it was conditioned on.
    assert np.corrcoef(fitted.predict(patches, force=0.8).mean.ravel(), np.ravel(readings))[0, 1] > 0.9


def test_a_network_predicts_the_same_as_its_model(network, patches):
    """The public predictor and i2t.prediction.model give the same numbers."""
    params, cfg, norm = network.model.params, network.model.cfg, network.model.normalisation
    inputs = model.Inputs(jnp.asarray(patches[0]), jnp.array([1.2, -2e-4]))
    mean, std = model.predict(params, cfg, norm, inputs)
    seen = network.predict(patches[0], force=1.2, nearest=-2e-4)
    np.testing.assert_allclose(seen.mean, mean, rtol=1e-5)
    np.testing.assert_allclose(seen.std, std, rtol=1e-5)


@pytest.mark.full
def test_a_mesh_and_a_pose_give_a_patch(process, tmp_path):
    """`predict_touch` renders exactly what `render_view` does, for a mesh from any library."""
    ball = catalogue.make_object("dome")
    top = float(ball.mesh.vertices[:, 2].max())
    T_w_t = geometry.contact_frame(jnp.array([1e-3, 0, top]), jnp.array([0.0, 0, 1]))
    surface = prepare_surface(ball.mesh)
    view = jax.device_get(render_view(surface, T_w_t))
    by_hand = process[0].predict(view.patch.depth, force=0.7, view=view.depth).mean
    for mesh in (ball, ball.mesh, surface):
        np.testing.assert_allclose(process[0].predict_touch(mesh, T_w_t, force=0.7).mean, by_hand, atol=1e-3)

    path = tmp_path / "dome.stl"
    trimesh.Trimesh(ball.mesh.vertices * 1000, ball.mesh.faces).export(path)
    with pytest.raises(ValueError, match="unit"):
        process[0].predict_touch(path, T_w_t)
    # A file keeps six digits of 20 mm: 20 nm, a ten-thousandth of an indentation.
    from_file = process[0].predict_touch(path, T_w_t, force=0.7, unit="mm").mean
    np.testing.assert_allclose(from_file, by_hand, rtol=1e-3, atol=1e-2)


DOME = catalogue.make_object("dome")
FLAT = np.zeros((48, 48))
AWAY = np.eye(4) + np.diag([0.0, 0, 1], 1)  # a metre above, looking up


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda *fixtures: fixtures[1].predict(np.zeros((4, 5))), "shape"),
        (lambda *fixtures: fixtures[1].predict(np.full((48, 48), np.nan)), "NaN"),
        (lambda *fixtures: fixtures[1].predict(FLAT, force=[1.0, 2.0]), "force"),
        (lambda *fixtures: fixtures[1].predict(FLAT, force=np.nan), "force"),
        (lambda *fixtures: fixtures[1].predict(FLAT, force=1.0), "nearest"),
        (lambda *fixtures: fixtures[1].predict(np.zeros((20, 20)), force=1.0, nearest=0.0), "pixels"),
        (lambda *fixtures: fixtures[2].predict(np.zeros((8, 8))), "needs nearest"),
        (lambda *fixtures: fixtures[2].predict(np.zeros((9, 9)), nearest=0.0), "takes 8"),
        (lambda *fixtures: fixtures[0].predict_touch(DOME, AWAY), "nothing lies in"),
        (lambda *fixtures: fixtures[0].predict_touch(DOME, np.full((4, 4), np.nan)), "finite"),
    ],
)
def test_input_that_does_not_fit_is_refused_in_one_sentence(process, network, baseline_predictors, call, words):
    with pytest.raises(ValueError, match=words) as error:
        call(process[0], network, baseline_predictors["ridge-measured"])
    assert "\n" not in str(error.value)


@pytest.fixture(scope="module")
def by_travel():
    """Predictor on patches that was fitted to presses by travel of a round tip."""
    fields = network_fields(15, conditions=("travel",))
    about = {"travel_range": [0.1e-3, 0.6e-3], "mean_depth_range": [1e-3, 2e-3], "largest_reading": 1e3}
    return Predictor(PatchNetwork(*fields), PATCH_WINDOW, REACH, 1.0, 0.3e-3, metadata=about)


def test_each_load_is_refused_by_a_predictor_that_does_not_use_it(by_travel, process, patches):
    assert (by_travel.load, process[0].load) == ("travel", "force")
    assert "default travel 0.3 mm" in repr(by_travel)
    for given in ({"force": 1.0}, {"force": 1.0, "travel": 0.2e-3}):
        with pytest.raises(
            ValueError, match=r"^force: this predictor was fitted to presses by travel; give travel=, i"
        ):
            by_travel.predict(SLOPE, **given)
    with pytest.raises(ValueError, match="travel: this predictor was fitted to presses by force; give force="):
        process[0].predict(patches[0], travel=0.2e-3)
    seen, less = by_travel.predict(SLOPE, travel=0.5e-3), by_travel.predict(SLOPE)
    assert abs(seen.mean - less.mean).max() > 1e-4
    np.testing.assert_array_equal(by_travel.predict(SLOPE, travel=0.3e-3).mean, less.mean)


SLOPE = np.tile(np.linspace(0, 3e-3, 48), (48, 1))  # m, a mean depth of 1.5 mm


@pytest.mark.parametrize(
    ("given", "about", "words"),
    [
        ({"travel": 0.9e-3}, {}, "travel is 0.9 mm, and the model was trained on 0.1 to 0.6 mm"),
        ({"travel": 0.01e-3}, {}, "travel is 0.01 mm"),
        ({"patch": 0 * SLOPE}, {}, "patch has a mean depth of 0 mm, and the model was trained on 1 to 2 mm"),
        ({}, {"largest_reading": 0.1}, "uT, and the largest one of the training touches 0.1"),
        ({"travel": 0.9e-3, "patch": 0 * SLOPE}, {}, "travel is .*; patch has"),
    ],
)
def test_predictions_outside_the_training_give_one_warning(by_travel, given, about, words):
    known = replace(by_travel, metadata=by_travel.metadata | about)
    with pytest.warns(UserWarning, match=rf"{words}.*: its prediction is only a guess$") as warned:
        known.predict(**{"patch": SLOPE, **given})
    assert len(warned) == 1


def test_a_touch_a_little_outside_the_training_is_not_warned_of(by_travel):
    """Of a few dozen touches, those held out lie a little outside the range of the others."""
    by_travel.predict(0.5 * SLOPE, travel=0.06e-3)
    by_travel.predict(1.3 * SLOPE, travel=0.8e-3)


@pytest.mark.parametrize("trained", [[-2e-5, 6e-4], [5e-4, 5e-4]])
def test_the_training_touches_themselves_are_not_warned_of(by_travel, trained):
    """Recorded travel may be slightly negative, or the same for all touches."""
    known = replace(by_travel, metadata=by_travel.metadata | {"travel_range": trained})
    for travel in trained:
        known.predict(SLOPE, travel=travel)


def test_a_much_lighter_press_than_in_training_is_warned_of(process, patches):
    known = replace(process[0], metadata={"force_range": [0.5, 2.0]})
    with pytest.warns(UserWarning, match="force is 0.1 N, and the model was trained on presses of at least 0.5 N: its"):
        known.predict(patches[0], force=0.1)
