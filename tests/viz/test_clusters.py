"""Clusters, maps and agreement of modalities: against closed forms, brute force and scikit-learn."""

import numpy as np
import pytest

from i2t.viz import clusters


def blobs(seed: int = 0, n: int = 40, d: int = 6) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    label = np.repeat(np.arange(5), n)
    centres = 20 * np.eye(5, d)
    return centres[label] + rng.normal(size=(5 * n, d)), label


def test_a_mask_is_what_lies_near_the_nearest_point():
    patch = np.full((1, 4, 4), 4e-3)
    patch[0, 0] = [0.0, 1e-3, 2e-3, 1.5e-3]
    assert clusters.views(patch)[0, :4].tolist() == [1, 1, 0, 1]
    assert clusters.views(patch).sum() == 3
    np.testing.assert_allclose(clusters.views(patch, "depth")[0, :4], [0, 0.25, 0.5, 0.375])


def test_components_keep_distances_and_order_variances():
    x = np.random.default_rng(0).normal(size=(30, 8)) * np.arange(1, 9)[None]
    c = clusters.components(x)
    np.testing.assert_allclose(np.linalg.norm(c[3] - c[7]), np.linalg.norm(x[3] - x[7]), rtol=1e-12)
    assert (np.diff(c.var(0)) <= 1e-9).all()


def test_clusters_far_apart_are_found_again_at_every_seed():
    x, label = blobs()
    found = clusters.cluster(x, seed=3)
    assert clusters.rand_index(found.label, label) == 1
    np.testing.assert_allclose(found.centre[0], x[found.label == 0].mean(0))
    whole, parts = clusters.stability(x, seeds=3)
    assert whole.min() == 1
    assert parts.min() == 1
    assert len(whole) == len(parts) == 3


def test_clusters_are_numbered_by_size():
    x = np.r_[np.zeros((3, 2)), np.full((9, 2), 10.0), np.full((5, 2), [-20.0, 5.0])]
    x = x + 0.01 * np.random.default_rng(0).normal(size=x.shape)
    assert np.bincount(clusters.cluster(x, 3).label).tolist() == [9, 5, 3]


def test_a_map_keeps_groups_apart_and_puts_means_among_their_own():
    x, label = blobs(n=20)
    means = np.stack([x[label == i].mean(0) for i in range(5)])
    at, of_means = clusters.embed(x, means, seed=1)
    nearest = np.linalg.norm(of_means[:, None] - at[None], axis=-1).argmin(1)
    assert (label[nearest] == np.arange(5)).all()
    again, _ = clusters.embed(x, means, seed=1)
    np.testing.assert_array_equal(at, again)


def test_neighbours_are_those_of_brute_force():
    x = np.random.default_rng(1).normal(size=(25, 3))
    distance = np.linalg.norm(x[:, None] - x[None], axis=-1)
    np.fill_diagonal(distance, np.inf)
    np.testing.assert_array_equal(np.sort(clusters.neighbours(x, 4)), np.sort(np.argsort(distance, axis=1)[:, :4]))
    with pytest.raises(ValueError, match="nearest others"):
        clusters.neighbours(x, 25)


def test_agreement_is_one_for_the_same_geometry_however_turned_and_scaled():
    rng = np.random.default_rng(2)
    x = rng.normal(size=(60, 4))
    turn = np.linalg.qr(rng.normal(size=(4, 4)))[0]
    same = clusters.agreement(x, 3 * x @ turn + 7)
    np.testing.assert_allclose(same, (1, 1, 1), atol=1e-12)


def test_cka_is_the_formula_of_its_paper():
    rng = np.random.default_rng(3)
    x, y = rng.normal(size=(20, 3)), rng.normal(size=(20, 5))
    centre = np.eye(20) - 1 / 20
    k, m = centre @ x @ x.T @ centre, centre @ y @ y.T @ centre
    expected = np.sum(k * m) / (np.linalg.norm(k) * np.linalg.norm(m))
    np.testing.assert_allclose(clusters.agreement(x, y, 3).cka, expected, rtol=1e-10)


def test_mutual_neighbours_against_sets():
    rng = np.random.default_rng(4)
    x, y = rng.normal(size=(30, 2)), rng.normal(size=(30, 2))

    def mutual(values):
        near = [set(row) for row in clusters.neighbours(values, 5)]
        return {(i, j) for i in range(30) for j in near[i] if i in near[j] and i < j}, near

    (a, near_x), (b, near_y) = mutual(x), mutual(y)
    found = clusters.agreement(x, y, 5)
    assert found.mutual == pytest.approx(len(a & b) / len(a | b))
    assert found.overlap == pytest.approx(np.mean([len(p & q) / 5 for p, q in zip(near_x, near_y, strict=True)]))


def test_unrelated_modalities_are_not_found_to_agree_and_related_ones_are():
    rng = np.random.default_rng(5)
    x = rng.normal(size=(80, 3))
    unrelated = clusters.permutation_test(x, rng.normal(size=(80, 3)), permutations=99)
    assert min(unrelated.p) > 0.01  # the least that 99 permutations can give
    # Chance: each of n - 1 others is as likely a neighbour, k / (n - 1); over 99 permutations within 5 %.
    assert unrelated.chance.overlap == pytest.approx(10 / 79, rel=0.05)
    related = clusters.permutation_test(x, x + 0.3 * rng.normal(size=x.shape), permutations=99)
    assert max(related.p) == 0.01


def test_groups_that_both_tell_apart_are_no_agreement_within_them():
    x, label = blobs(6, n=20)
    y, _ = blobs(7, n=20)
    anyhow = clusters.permutation_test(x, y, permutations=49)
    within = clusters.permutation_test(x, y, permutations=49, groups=label)
    assert anyhow.p.overlap == 0.02
    assert within.p.overlap > 0.02


def test_ties_do_not_follow_the_order_of_touches():
    same = np.zeros((60, 2))
    assert clusters.agreement(same, np.random.default_rng(8).normal(size=(60, 2)), 5).overlap < 0.25
