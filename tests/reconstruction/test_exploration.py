"""The next touch: only safe sites, and the preference of each policy."""

from functools import partial

import numpy as np
import pytest
from helpers.balls import ball_model, from_above

from i2t.reconstruction import exploration
from i2t.reconstruction.evidence import contact_evidence
from i2t.reconstruction.exploration import AROUND_LIMITS, POLICY_NAMES, ExplorationConfig, choose_touch
from i2t.reconstruction.signed_distances import grid_around
from i2t.reconstruction.surface import (
    SurfaceEstimate,
    condition_on,
    estimate_surface,
    init,
    posterior_covariance,
    predict,
    update,
    weighted_prior,
)
from i2t.simulation.site_limits import SiteLimits

LOW, HIGH = np.array([-32e-3, -32e-3, 0.0]), np.array([32e-3, 32e-3, 60e-3])
GRID = grid_around(LOW, HIGH, across=16, margin=4e-3)
RADII = np.linspace(20e-3, 30e-3, 6)
CENTRE = np.array([0, 0, 30e-3])
_balls = partial(ball_model, GRID, RADII, CENTRE)


def _config(**changes):
    return ExplorationConfig(stride=1, candidates=16, probes=60, **changes)


@pytest.fixture(scope="module")
def touched():
    """The model, its state after a touch from above, and the surface estimate."""
    model = _balls()
    state, _ = update(model, init(model)[0], contact_evidence(from_above(55e-3)))
    return model, state, estimate_surface(model, state)


@pytest.mark.parametrize("policy", POLICY_NAMES)
def test_only_safe_sites_are_chosen_and_none_if_none_is_safe(policy, touched):
    model, state, estimate = touched
    for seed, min_cos in ((0, 1.0), *((seed, 0.5) for seed in range(4))):
        config = _config(policy=policy, limits=SiteLimits(min_cos=min_cos))
        chosen = choose_touch(model, state, config=config, seed=seed, estimate=estimate)
        safe = chosen.proposals.T_o_t[chosen.proposals.safe]
        assert (chosen.T_o_t is None) == (len(safe) == 0) == (min_cos == 1)
        if min_cos < 1:
            assert (np.abs(safe - chosen.T_o_t).max((1, 2)) == 0).any()
            assert -chosen.T_o_t[2, 2] > 0.5
    empty = SurfaceEstimate(GRID, np.ones(len(model.points), np.float32), np.ones(len(model.points), np.float32))
    assert choose_touch(model, state, config=_config(policy=policy), estimate=empty).T_o_t is None


def test_sites_are_on_the_surface_and_face_into_it():
    model = _balls()
    estimate = estimate_surface(model, init(model)[0])
    proposals = exploration.propose_sites(estimate, np.random.default_rng(0), config=_config(limits=AROUND_LIMITS))
    offset = proposals.T_o_t[:, :3, 3] - CENTRE
    away = offset / np.linalg.norm(offset, axis=-1, keepdims=True)
    np.testing.assert_allclose(np.linalg.norm(offset, axis=-1), RADII.mean(), atol=1e-3)
    assert ((proposals.T_o_t[:, :3, 2] * away).sum(-1) < -0.97).all()
    assert proposals.safe.all()


def test_a_site_below_an_overhang_or_whose_overtravel_meets_the_table_is_not_safe():
    x, _, z = GRID.points().T
    block = np.maximum(np.abs(x) - 25e-3, np.abs(z - 20e-3) - 15e-3)
    slot = np.maximum(-x, np.abs(z - 20e-3) - 5e-3)  # open to the side: its floor looks at its ceiling
    estimate = SurfaceEstimate(GRID, np.maximum(block, -slot).astype(np.float32), np.ones(len(block), np.float32))
    on_floor, on_top = from_above(15e-3), from_above(35e-3)
    on_floor[0, 3] = on_top[0, 3] = 15e-3
    safe = exploration.safe_sites(estimate, np.stack([on_floor, on_top]), config=_config(limits=AROUND_LIMITS))
    assert safe.tolist() == [False, True]
    lost = np.stack([on_top, on_top * np.nan])
    assert exploration.safe_sites(estimate, lost, config=_config(limits=AROUND_LIMITS)).tolist() == [True, False]
    unknown = estimate._replace(distance=np.full_like(estimate.distance, np.nan))
    assert not exploration.safe_sites(unknown, on_top[None], config=_config(limits=AROUND_LIMITS)).any()
    empty = estimate._replace(distance=np.ones_like(estimate.distance))
    for overtravel, allowed in ((2e-3, True), (10e-3, False)):
        config = _config(limits=SiteLimits(), overtravel=overtravel)
        assert exploration.safe_sites(empty, from_above(5e-3)[None], config=config).tolist() == [allowed]


@pytest.mark.parametrize(
    ("make", "problem"),
    [
        (lambda: ExplorationConfig(overtravel=-1.0), "overtravel"),
        (lambda: ExplorationConfig(overtravel=np.nan), "overtravel"),
        (lambda: SiteLimits(clearance=-1.0), "sites.clearance"),
        (lambda: SiteLimits(flange=np.nan), "sites.flange"),
    ],
)
def test_options_that_would_loosen_safety_are_refused(make, problem):
    with pytest.raises(ValueError, match=problem):
        make()


def test_the_uncertainty_policy_chooses_the_least_certain_site(touched):
    model, state, estimate = touched
    config = _config(policy="uncertainty", limits=AROUND_LIMITS)
    unsure = choose_touch(model, state, config=config, estimate=estimate)
    assert unsure.score == pytest.approx(unsure.proposals.std.max())


def test_the_expected_reduction_equals_that_of_the_variance_by_a_measurement():
    """The expected reduction is compared with a regression that has one more point."""
    model = _balls(free_tolerance=1.0)
    seen = CENTRE + 25e-3 * np.array([[0, 0, 1.0], [1.0, 0, 0]])
    weigh = partial(condition_on, model, weighted_prior(model, init(model)[0]))
    places = CENTRE + 25e-3 * np.array([[0, 1.0, 0], [0.1, 0, 0.995], [-1.0, 0, 0]])
    probes = CENTRE + 25e-3 * np.array([[0, 0.8, 0.6], [-0.6, 0.8, 0], [0.6, 0, 0.8]])
    posterior = weigh(points=seen, values=np.zeros(2), std=np.full(2, 1e-3))
    before = predict(model, posterior, probes)[1] ** 2
    cov = posterior_covariance(model, posterior, probes, places)
    own = predict(model, posterior, places)[1] ** 2 - model.config.band_floor**2
    for i, place in enumerate(places):
        more = weigh(points=np.concatenate([seen, place[None]]), values=np.zeros(3), std=np.array([1e-3, 1e-3, 2e-3]))
        after = predict(model, more, probes)[1] ** 2
        expected = cov[:, i] ** 2 / (own[i] + 2e-3**2)
        np.testing.assert_allclose(before - after, expected, rtol=0.02, atol=1e-9)
