"""Where a tip pressed: on skins of which all is known as Bayes says, on recorded presses by the command."""

import json
from unittest.mock import create_autospec

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from experiments.reconstruct.__main__ import main
from i2t.calibration import Calibration
from i2t.reconstruction.local_shape import PatchLikelihood
from i2t.reconstruction.tip import TipModel, credible_level, imagine_tip, infer_tip

EDGE = np.linspace(-8e-3, 8e-3, 33)
PLACES = np.stack(np.meshgrid(EDGE, EDGE, indexing="ij"), axis=-1).reshape(-1, 2)
DEPTHS = np.linspace(0.5e-3, 2e-3, 4)
CHIPS = np.array([[0, 0], [6, 6], [6, -6], [-6, 6], [-6, -6]]) * 1e-3
EXACT = PatchLikelihood(dof=1e6, temperature=1.0, prior_share=0.0)


def felt(places: np.ndarray, depths: np.ndarray) -> np.ndarray:
    """A skin of five chips: each feels the tip along x, y and z, the more the nearer and the deeper it is."""
    away = places[:, None] - CHIPS
    near = np.exp(-np.sum(away**2, -1) / (2 * 4e-3**2))[..., None]
    return (100 * depths[:, None, None] / 2e-3 * near * np.concatenate([away / 4e-3, np.ones_like(near)], -1)).reshape(
        len(places), -1
    )


@pytest.fixture(scope="module")
def model():
    every = np.repeat(PLACES, len(DEPTHS), 0), np.tile(DEPTHS, len(PLACES))
    mean = jnp.float32(felt(*every)).reshape(len(PLACES), len(DEPTHS), -1)
    return TipModel(jnp.float32(PLACES), jnp.float32(DEPTHS), mean, jnp.full_like(mean, 5.0), EXACT)


def test_weights_are_those_of_the_normal_density(model):
    reading = felt(PLACES[[200]], DEPTHS[[1]])[0] + np.random.default_rng(0).normal(0, 5, 15)
    found = jax.jit(infer_tip)(reading, model)
    density = stats.norm.logpdf(reading, np.asarray(model.mean), 5.0).sum(-1)
    expected = np.exp(density - density.max())
    expected /= expected.sum()
    np.testing.assert_allclose(found.weight, expected, atol=2e-4)
    np.testing.assert_allclose(found.position, np.einsum("pl,pi->i", expected, PLACES), atol=2e-6)
    np.testing.assert_allclose(found.load, expected.sum(0) @ DEPTHS, atol=2e-6)
    np.testing.assert_allclose(found.bits, np.log2(expected.size) - stats.entropy(expected.ravel(), base=2), atol=0.02)


def test_regions_hold_what_they_say_and_the_mean_is_near(model):
    rng = np.random.default_rng(1)
    rows, depth = rng.integers(len(PLACES), size=400), rng.choice(DEPTHS, 400)
    readings = felt(PLACES[rows], depth) + rng.normal(0, 5, (400, 15))

    def one(reading, place):
        found = infer_tip(reading, model)
        return found.position, credible_level(found, model, place)

    position, credible = jax.lax.map(lambda each: one(*each), (jnp.float32(readings), jnp.float32(PLACES[rows])))
    assert abs(np.mean(credible <= 0.9) - 0.9) < 0.04  # one standard deviation is 0.015
    assert abs(np.mean(credible <= 0.5) - 0.5) < 0.07
    assert np.median(np.linalg.norm(position - PLACES[rows], axis=1)) < 0.6e-3


def test_a_head_sharpens_what_is_known(model):
    reading = felt(PLACES[[200]], DEPTHS[[1]])[0] + np.random.default_rng(0).normal(0, 5, 15)
    alone = infer_tip(reading, model)
    head = jnp.float32(PLACES[200]), jnp.full(2, 0.2e-3)
    pooled = infer_tip(reading, model, head=head, head_weight=1.0)
    assert np.linalg.norm(pooled.position - PLACES[200]) < np.linalg.norm(alone.position - PLACES[200])
    np.testing.assert_array_equal(infer_tip(reading, model, head=head, head_weight=0.0).weight, alone.weight)
    told = infer_tip(reading, model._replace(likelihood=EXACT._replace(prior_share=0.1)))
    assert told.weight.min() >= 0.099 / told.weight.size  # a share of the prior stays


def test_a_skin_that_knows_no_load_tells_of_no_tip():
    without = create_autospec(Calibration, instance=True, load_kind="none")
    with pytest.raises(ValueError, match="takes positions with depth or force"):
        imagine_tip(without, PLACES, np.ones(len(PLACES)))


@pytest.mark.full
def test_recorded_presses_are_told_by_blocks_that_are_held_out(tmp_path):
    """Eight blocks with as many presses each, so that both parts have one size."""
    rng = np.random.default_rng(3)
    corners = np.stack(np.meshgrid([-12e-3, -6e-3, 0, 6e-3], [-6e-3, 0]), -1).reshape(-1, 1, 2)
    places, depths = (corners + rng.uniform(0.1e-3, 5.9e-3, (8, 15, 2))).reshape(-1, 2), rng.uniform(0.5e-3, 2e-3, 120)
    places[0] = -12e-3, -6e-3  # where blocks begin
    readings = felt(places, depths) + rng.normal(0, 2, (120, 15))
    columns = ["x_mm", "y_mm", "depth_mm", *(f"b{i}{axis}_uT" for i in range(5) for axis in "xyz")]
    table = tmp_path / "presses.csv"
    rows = np.column_stack([1e3 * places, 1e3 * depths, readings])
    np.savetxt(table, rows, delimiter=",", header=",".join(columns), comments="", fmt="%.4f")
    args = ["tip", "--dataset", str(table), "--preset", "debug"]
    assert main([*args, "--out", str(tmp_path / "out")]) == 0
    written = json.loads((tmp_path / "out" / "metrics.json").read_text())
    methods = written["methods"]
    assert written["presses"] == {"learnt": 60, "test": 24}
    pooled = methods["by imagination, with the head"]
    assert pooled["position_mm_median"][0] < methods["nearest neighbours"]["position_mm_median"][0]
    assert 0 <= pooled["coverage_90"][0] <= 1
    assert (tmp_path / "out" / "tips.png").exists()
