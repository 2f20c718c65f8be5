"""What a user holds: saving, loading, one touch and many, meshes and poses, and refusals."""

import shutil
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2t import geometry
from i2t.errors import CheckpointError
from i2t.objects import catalogue
from i2t.prediction import gp, model, predictor
from i2t.prediction.predictor import TrainedNetwork, Predictor
from i2t.prediction.pressure import PressureModelConfig
from i2t.rendering.render import prepare_surface, render_patch
from i2t.types import PATCH_PIXELS, PATCH_WINDOW, REACH, WIDE_PIXELS, WIDE_WINDOW

IMAGINATION = PressureModelConfig(PATCH_WINDOW / PATCH_PIXELS, smooth=False, tilt=0.0)


@pytest.fixture(scope="module")
def patches():
    x = (np.arange(PATCH_PIXELS) + 0.5) / PATCH_PIXELS - 0.5
    centres = np.random.default_rng(0).uniform(-0.3, 0.3, (6, 2))
    square = (x[None, :, None] - centres[:, :1, None]) ** 2 + (x[None, None, :] - centres[:, 1:, None]) ** 2
    return np.clip(square * 5e-3, 0, REACH).astype(np.float32)


@pytest.fixture(scope="module")
def process(patches):
    """A Gaussian process that has seen six round tips, with any readings at all."""
    imagined = predictor.predict_pressures(IMAGINATION, patches, np.full(6, 0.8), np.full(6, np.nan))
    lengths = len(gp.LENGTHS_MM)
    hyper = gp.GPHyperparameters(jnp.full(lengths, 1 / lengths), jnp.float32(0.2), jnp.float32(1.0), jnp.float32(0.01))
    readings = 20 * jax.random.normal(jax.random.key(1), (6, 15))
    fitted = gp.fit(hyper, imagined, readings)
    return Predictor(fitted, None, IMAGINATION, PATCH_WINDOW, REACH, 0.8, 0.3e-3, 1.3, {"method": "test"}), readings


@pytest.fixture(scope="module")
def network():
    cfg = model.ModelConfig(
        encoder_width=8,
        decoder_width=8,
        auxiliary=False,
        heteroscedastic=True,
        members=2,
        conditions=("force", "nearest"),
    )
    params = jax.vmap(lambda key: model.init(key, cfg))(jax.random.split(jax.random.key(2), 2))
    norm = model.Normalisation(
        model.Standard(jnp.arange(15.0), jnp.full(15, 2.0)), model.Standard(jnp.zeros(2), jnp.ones(2)), jnp.zeros(15)
    )
    return Predictor(None, TrainedNetwork(params, cfg, norm), None, PATCH_WINDOW, REACH, 1.0, 0.3e-3)


def test_a_process_reproduces_what_it_was_taught(process, patches):
    """With little noise its mean comes back to the readings, and far less uncertain than before seeing any."""
    taught, readings = process
    seen = taught.predict(patches, force=0.8)
    assert np.corrcoef(seen.mean.ravel(), np.ravel(readings))[0, 1] > 0.9
    assert (seen.std > 0).all()


def test_one_touch_is_a_row_of_many(process, patches):
    many = process[0].predict(patches, force=np.linspace(0.5, 1.5, 6))
    one = process[0].predict(patches[2], force=np.linspace(0.5, 1.5, 6)[2])
    assert one.mean.shape == one.std.shape == (15,)
    np.testing.assert_allclose(one.mean, many.mean[2], rtol=1e-4, atol=1e-3)  # uT: single precision through a contact
    np.testing.assert_allclose(one.std, many.std[2], rtol=1e-3)


def test_force_left_out_is_the_middle_of_training(process, patches):
    np.testing.assert_array_equal(process[0].predict(patches).mean, process[0].predict(patches, force=0.8).mean)


def test_what_is_saved_is_what_is_loaded(process, network, patches, tmp_path):
    for name, made, given in (("process", process[0], {}), ("network", network, {"force": 1.0, "nearest": -1e-4})):
        predictor.save(tmp_path / name, made)
        loaded = predictor.load_predictor(tmp_path / name)
        assert (loaded.window, loaded.std_scale, loaded.metadata) == (made.window, made.spread, made.about)
        before, after = made.predict(patches, **given), loaded.predict(patches, **given)
        np.testing.assert_array_equal(before.mean, after.mean)
        np.testing.assert_array_equal(before.std, after.std)


def test_a_network_without_conditions_is_saved_too(network, patches, tmp_path):
    params, cfg, norm = network.network
    alone = replace(cfg, conditions=())
    params = jax.vmap(lambda key: model.init(key, alone))(jax.random.split(jax.random.key(3), 2))
    nothing = model.Standard(jnp.zeros(0), jnp.zeros(0))
    made = replace(network, network=TrainedNetwork(params, alone, norm._replace(conditions=nothing)))
    predictor.save(tmp_path / "alone", made)
    loaded = predictor.load_predictor(tmp_path / "alone")
    np.testing.assert_array_equal(loaded.predict(patches).mean, made.predict(patches).mean)


def test_a_network_predicts_what_the_model_says(network, patches):
    """Through the user's door or straight from i2t.prediction.model: the same numbers."""
    params, cfg, norm = network.network
    inputs = model.Inputs(jnp.asarray(patches[0]), jnp.array([1.2, -2e-4]))
    mean, std = model.predict(params, cfg, norm, inputs)
    seen = network.predict(patches[0], force=1.2, nearest=-2e-4)
    np.testing.assert_allclose(seen.mean, mean, rtol=1e-5)
    np.testing.assert_allclose(seen.std, std, rtol=1e-5)


def test_a_mesh_and_a_pose_are_a_patch(process):
    """`predict_touch` renders just what `render_patch` does, whoever brings the mesh."""
    ball = catalogue.make_object("dome")
    top = float(ball.mesh.vertices[:, 2].max())
    T_w_t = geometry.contact_frame(jnp.array([1e-3, 0, top]), jnp.array([0.0, 0, 1]))
    surface = prepare_surface(ball.mesh)
    patch = render_patch(surface, T_w_t)
    wide = render_patch(surface, T_w_t, window=WIDE_WINDOW, pixels=WIDE_PIXELS)
    around = np.clip(wide.depth + (wide.nearest - patch.nearest), 0, REACH)
    by_hand = process[0].predict(np.asarray(patch.depth), force=0.7, wide=around)
    for mesh in (ball, ball.mesh, surface):
        np.testing.assert_allclose(process[0].predict_touch(mesh, T_w_t, force=0.7).mean, by_hand.mean, atol=1e-3)


def test_a_mesh_file_needs_its_unit(process, tmp_path):
    path = tmp_path / "dome.stl"
    dome = catalogue.make_object("dome").mesh
    import trimesh

    trimesh.Trimesh(dome.vertices * 1000, dome.faces).export(path)
    T_w_t = geometry.contact_frame(jnp.array([0, 0, dome.vertices[:, 2].max()]), jnp.array([0.0, 0, 1]))
    with pytest.raises(ValueError, match="unit"):
        process[0].predict_touch(path, T_w_t)
    from_file = process[0].predict_touch(path, T_w_t, unit="mm")
    # A file keeps six digits of 20 mm: 20 nm, a ten-thousandth of an indentation.
    np.testing.assert_allclose(from_file.mean, process[0].predict_touch(dome, T_w_t).mean, rtol=1e-3, atol=1e-2)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"patch": np.zeros((4, 5))}, "shape"),
        ({"patch": np.full((48, 48), np.nan)}, "NaN"),
        ({"patch": np.zeros((48, 48)), "force": [1.0, 2.0]}, "force"),
        ({"patch": np.zeros((48, 48)), "force": np.nan}, "force"),
        ({"patch": np.zeros((48, 48)), "force": 1.0}, "nearest"),
        ({"patch": np.zeros((20, 20)), "force": 1.0, "nearest": 0.0}, "pixels"),
    ],
)
def test_what_does_not_fit_is_refused(network, values, words):
    with pytest.raises(ValueError, match=words) as error:
        network.predict(**values)
    assert "\n" not in str(error.value)


def test_air_is_refused(process):
    away = geometry.contact_frame(jnp.array([0.0, 0, 1]), jnp.array([0.0, 0, -1]))
    with pytest.raises(ValueError, match="nothing lies in front"):
        process[0].predict_touch(catalogue.make_object("dome"), away)
    with pytest.raises(ValueError, match="finite"):
        process[0].predict_touch(catalogue.make_object("dome"), np.full((4, 4), np.nan))


def test_damage_is_one_sentence(process, tmp_path):
    predictor.save(tmp_path / "good", process[0])
    shutil.copytree(tmp_path / "good", tmp_path / "foreign")
    (tmp_path / "foreign" / "_CHECKPOINT_METADATA").write_text("{}")
    for folder, words in (("foreign", "holds no predictor"), ("missing", "holds no predictor")):
        with pytest.raises(CheckpointError, match=words) as error:
            predictor.load_predictor(tmp_path / folder)
        assert "\n" not in str(error.value)
