"""One camera over several sessions: pooled as one least-squares problem, and views corrected as Embree sees them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from registration.test_session import MESHES, NOISE, SURFACES, embree_touches
from rendering.test_render import embree_heights

import i2t
from i2t.dataset import Dataset
from i2t.geometry import from_twist, to_twist
from i2t.patches.dimensions import REACH, VIEW_PIXELS, VIEW_WINDOW
from i2t.patches.views import view_of_noisy_heights
from i2t.registration import (
    SessionEstimate,
    SessionRegistrationConfig,
    pool_hand_eye,
    with_hand_eye,
)
from i2t.simulation.touches import SimulationErrors, sample_session_errors

CONFIG = SessionRegistrationConfig()
STD = np.asarray(CONFIG.std, float)[6:]
OFFSET = np.array([1.4, -0.9, 0.6, -0.06, 0.08, 0.05]) * 1e-3


def measured(rng, true: np.ndarray, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Measure a twist linearly, in standard deviations; some of its directions hardly have an effect."""
    design = rng.normal(size=(rows, 6)) * [3, 3, 1, 1, 0.1, 5]
    return design, design @ true + rng.normal(size=rows)


def estimate_of(design: np.ndarray, value: np.ndarray) -> SessionEstimate:
    """Estimate a twist from a session and the prior by ridge regression."""
    covariance = np.linalg.inv(np.eye(6) + design.T @ design)
    twist = covariance @ design.T @ value
    both = np.zeros((12, 12))
    both[6:, 6:] = covariance * np.outer(STD, STD)
    return SessionEstimate(np.eye(4), np.asarray(from_twist(STD * twist)), both, np.zeros(1), np.ones(1))


def test_pooled_sessions_are_one_ridge_regression_on_all_of_them():
    rng = np.random.default_rng(0)
    parts = [measured(rng, OFFSET / STD, rows) for rows in (4, 9, 30, 12)]
    pooled = pool_hand_eye([estimate_of(*part) for part in parts])
    design, value = (np.concatenate(part) for part in zip(*parts, strict=True))
    information = np.eye(6) + design.T @ design
    expected = np.linalg.solve(information, design.T @ value)
    np.testing.assert_allclose(to_twist(pooled.T_t_camera) / STD, expected, atol=1e-4)
    assert pooled.num_sessions == 4
    widened = max(1.0, pooled.disagreement) ** 2
    np.testing.assert_allclose(pooled.covariance / np.outer(STD, STD), np.linalg.inv(information) * widened, rtol=1e-3)


def test_intervals_cover_the_truth_and_a_moved_camera_makes_sessions_disagree():
    rng, standard, disagreements = np.random.default_rng(1), [], []
    for _ in range(200):
        true = rng.normal(size=6)
        pooled = pool_hand_eye([estimate_of(*measured(rng, true, 12)) for _ in range(5)])
        error = to_twist(pooled.T_t_camera) - STD * true
        standard.append(error / np.sqrt(np.diag(pooled.covariance)))
        disagreements.append(pooled.disagreement)
    assert 0.94 < np.mean(np.abs(standard) < 1.96) < 0.985  # never narrowed, at times widened by chance
    assert 0.9 < np.median(disagreements) < 1.1
    moved = pool_hand_eye([estimate_of(*measured(rng, rng.normal(size=6), 12)) for _ in range(5)])
    assert moved.disagreement > 4
    with pytest.raises(ValueError, match="the list is empty"):
        pool_hand_eye([])


@pytest.mark.parametrize("tool_offset_at_capture", [(0.0, 0.0, 0.0), (0.01, -0.02, -0.06)])
def test_corrected_views_are_those_that_embree_sees_from_the_tool(tool_offset_at_capture):
    """The camera is displaced by 1.8 mm and turned by half a degree. Outside of silhouettes only noise remains."""
    back = np.eye(4)
    back[:3, 3] = tool_offset_at_capture
    offset = np.asarray(from_twist(jnp.float32(OFFSET)), float)
    touches = embree_touches(MESHES[1], SURFACES["hammer"], np.eye(4), back @ offset @ np.linalg.inv(back))
    dataset = Dataset.simulated(touches, ("hammer",), i2t.nominal_pad())
    corrected = with_hand_eye(dataset, offset, tool_offset_at_capture=tool_offset_at_capture).touches
    triangles = np.float32(MESHES[1].vertices)[np.asarray(MESHES[1].faces)]
    z = embree_heights(triangles, np.float32(touches.T_w_t), VIEW_WINDOW, VIEW_PIXELS)
    true = jax.vmap(view_of_noisy_heights)(jnp.float32(z))

    def missed(view, of_true):
        return np.median(np.abs(np.asarray(of_true) - view).mean((1, 2)))

    assert missed(corrected.patch, true.patch.depth) < 0.25 * missed(touches.patch, true.patch.depth)
    assert missed(corrected.patch, true.patch.depth) < 1.2 * NOISE
    inner = np.s_[:, 8:-8, 8:-8]  # what is beyond a view's edge was not seen
    assert missed(corrected.view[inner], np.minimum(true.depth, REACH)[inner]) < 0.25 * missed(
        touches.view[inner], np.minimum(true.depth, REACH)[inner]
    )
    assert np.abs(corrected.nearest - true.patch.nearest).max() < 3 * NOISE
    assert corrected.patch.min() >= 0
    assert corrected.patch.max() <= np.float32(REACH)


def test_cropped_views_stay_cropped_and_empty_views_stay_unchanged():
    offset = np.asarray(from_twist(jnp.float32(OFFSET)), float)
    touches = embree_touches(MESHES[0], SURFACES["hexagon"], np.eye(4), offset)
    view, nearest = np.array(touches.view), np.array(touches.nearest)
    cropped = np.full(view.shape[1:], True)
    cropped[12:-12, 12:-12] = False
    view[:, cropped] = np.nan
    nearest[3] = np.inf
    dataset = Dataset.simulated(touches._replace(view=view, nearest=nearest), ("hexagon",), i2t.nominal_pad())
    corrected = with_hand_eye(dataset, offset).touches
    assert np.isfinite(corrected.patch).all()
    assert (np.isnan(corrected.view) == np.isnan(view)).all()
    np.testing.assert_array_equal(corrected.patch[3], touches.patch[3])
    assert np.isposinf(corrected.nearest[3])
    assert (np.abs(corrected.patch - touches.patch).mean((1, 2)) > 0).sum() == len(nearest) - 1


@pytest.mark.full
def test_a_simulated_lab_may_have_one_camera_for_all_sessions():
    key, errors, pad = jax.random.key(0), SimulationErrors(), i2t.nominal_pad()
    own = sample_session_errors(jax.random.split(jax.random.fold_in(key, 0), 4)[0], errors).T_t_camera
    drawn = i2t.simulate_touches(key, [SURFACES["hexagon"]], pad, errors, 4, touches_per_session=2)
    same = i2t.simulate_touches(
        jax.random.clone(key), [SURFACES["hexagon"]], pad, errors, 4, touches_per_session=2, T_t_camera=own
    )
    np.testing.assert_allclose(same.view[:2], drawn.view[:2], atol=2e-4)  # the first session's is its own
    assert np.abs(same.view[2:] - drawn.view[2:]).mean() > 0.05e-3
    np.testing.assert_array_equal(same.reading, drawn.reading)  # the skin does not see it
