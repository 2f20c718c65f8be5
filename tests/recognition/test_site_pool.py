"""Sites of episodes: drawn anew for each touch, or from pools of their own; where the paper's heuristic draws."""

import jax
import numpy as np
import pytest
from helpers.site_poses import TWO_POOLS

from i2t.objects import catalogue
from i2t.recognition import site_pool
from i2t.simulation import sites as touch_sites
from i2t.simulation.sites import RECOGNITION_LIMITS

NAMES = ("square", "hexagon")


@pytest.fixture(scope="module")
def surfaces():
    return site_pool.prepare_surfaces([catalogue.make_object(name).mesh for name in NAMES])


@pytest.mark.full
def test_no_two_touches_share_a_site(surfaces):
    plan = site_pool.plan_random_touches(jax.random.key(1), surfaces, NAMES, 30, 4, limits=RECOGNITION_LIMITS)
    assert plan.chosen.shape == (30, 4)
    assert sorted(plan.chosen.reshape(-1)) == list(range(120))
    points = np.asarray(plan.sites.T_w_t)[:, :3, 3]
    apart = np.linalg.norm(points[:, None] - points[None], axis=-1) + np.eye(120)
    assert apart.min() > 0
    assert len(set(plan.pool)) == 30  # each episode by itself
    assert 0.3 < plan.sites.owner.mean() < 0.7  # both objects are hypotheses
    check = jax.jit(jax.vmap(lambda surface, T: touch_sites.is_safe(surface, T, RECOGNITION_LIMITS), (None, 0)))
    for i, surface in enumerate(surfaces):
        assert np.asarray(check(surface, plan.sites.T_w_t))[plan.sites.owner == i].all()


def test_only_episodes_of_one_pool_share_sites(surfaces, monkeypatch):
    drawn = iter(range(100))

    def draw(key, surface, count, limits, name):
        return np.array([np.eye(4) * next(drawn) for _ in range(count)], np.float32).reshape(-1, 4, 4)

    monkeypatch.setattr(site_pool, "_draw_sites", draw)
    plan = site_pool.plan_random_touches(jax.random.key(1), surfaces, NAMES, 7, 4, limits=RECOGNITION_LIMITS, share=3)
    assert plan.pool.tolist() == [0, 0, 0, 1, 1, 1, 2]
    assert len(plan.sites.owner) == 12
    np.testing.assert_array_equal(plan.chosen[0], plan.chosen[2])
    assert set(plan.chosen[2]).isdisjoint(plan.chosen[3])
    assert sorted(np.asarray(plan.sites.T_w_t)[:, 0, 0]) == list(range(12))


@pytest.mark.full
def test_joined_pools_number_their_own_sites_pool_by_pool(surfaces):
    pools = site_pool.sample_pools(jax.random.key(0), surfaces, NAMES, pools=4, per_object=6, limits=RECOGNITION_LIMITS)
    assert pools.T_w_t.shape == (4, 2, 6, 4, 4)
    assert len(np.unique(pools.T_w_t[:, :, :, :3, 3].reshape(-1, 3), axis=0)) == 4 * 2 * 6
    joined = pools.joined()
    number = (2 * 2 + 1) * 6 + 3  # of the fourth site of the second object in the third pool
    np.testing.assert_array_equal(np.asarray(joined.T_w_t)[number], pools.T_w_t[2, 1, 3])
    assert joined.owner[number] == 1


def test_the_heuristic_plans_touches_in_each_pool_separately():
    weights = site_pool.pool_informativeness(TWO_POOLS)
    np.testing.assert_allclose(weights, [[[0, 1], [0, 1]], [[1, 0], [1, 0]]], atol=1e-6)
    plan = site_pool.plan_informative_touches(jax.random.key(0), TWO_POOLS, np.array([0, 1, 1]), 20)
    at = np.asarray(plan.sites.T_w_t)[plan.chosen][:, :, 0, 3]
    np.testing.assert_allclose(at, [[1e-2] * 20, [0] * 20, [0] * 20], atol=1e-8)
    share = plan.sites.owner[plan.chosen].mean(1)
    assert ((share > 0) & (share < 1)).all()


def test_an_object_without_safe_sites_is_named(surfaces, monkeypatch):
    none = touch_sites.Sites(jax.numpy.zeros((256, 4, 4)), jax.numpy.zeros(256, bool))
    monkeypatch.setattr(site_pool, "_draw_batch", lambda *_: none)
    with pytest.raises(ValueError, match="square has too few safe sites: 0 among"):
        site_pool.sample_pools(
            jax.random.key(0), surfaces[:1], NAMES[:1], pools=1, per_object=1, limits=RECOGNITION_LIMITS
        )
