"""Agreement of two modalities: against closed forms and brute force."""

import numpy as np
import pytest
from helpers.blobs import blobs

from i2t.viz import agreement


def test_neighbours_are_those_of_brute_force():
    x = np.random.default_rng(1).normal(size=(25, 3))
    distance = np.linalg.norm(x[:, None] - x[None], axis=-1)
    np.fill_diagonal(distance, np.inf)
    np.testing.assert_array_equal(np.sort(agreement.neighbours(x, 4)), np.sort(np.argsort(distance, axis=1)[:, :4]))
    with pytest.raises(ValueError, match="nearest neighbours cannot"):
        agreement.neighbours(x, 25)


def test_agreement_is_one_for_the_same_geometry_however_turned_and_scaled():
    rng = np.random.default_rng(2)
    x = rng.normal(size=(60, 4))
    turn = np.linalg.qr(rng.normal(size=(4, 4)))[0]
    same = agreement.agreement(x, 3 * x @ turn + 7)
    np.testing.assert_allclose(same, (1, 1, 1), atol=1e-12)


def test_cka_is_the_formula_of_its_paper():
    rng = np.random.default_rng(3)
    x, y = rng.normal(size=(20, 3)), rng.normal(size=(20, 5))
    centre = np.eye(20) - 1 / 20
    k, m = centre @ x @ x.T @ centre, centre @ y @ y.T @ centre
    expected = np.sum(k * m) / (np.linalg.norm(k) * np.linalg.norm(m))
    np.testing.assert_allclose(agreement.agreement(x, y, 3).cka, expected, rtol=1e-10)


def test_mutual_neighbours_against_sets():
    rng = np.random.default_rng(4)
    x, y = rng.normal(size=(30, 2)), rng.normal(size=(30, 2))

    def mutual(values):
        near = [set(row) for row in agreement.neighbours(values, 5)]
        return {(i, j) for i in range(30) for j in near[i] if i in near[j] and i < j}, near

    (a, near_x), (b, near_y) = mutual(x), mutual(y)
    measured = agreement.agreement(x, y, 5)
    assert measured.mutual == pytest.approx(len(a & b) / len(a | b))
    assert measured.overlap == pytest.approx(np.mean([len(p & q) / 5 for p, q in zip(near_x, near_y, strict=True)]))


def test_unrelated_modalities_are_not_found_to_agree_and_related_ones_are():
    rng = np.random.default_rng(5)
    x = rng.normal(size=(80, 3))
    unrelated = agreement.permutation_test(x, rng.normal(size=(80, 3)), permutations=99)
    assert min(unrelated.p) > 0.01  # the least that 99 permutations can give
    # Chance: each of n - 1 others is as likely a neighbour, k / (n - 1); over 99 permutations within 5 %.
    assert unrelated.chance.overlap == pytest.approx(10 / 79, rel=0.05)
    related = agreement.permutation_test(x, x + 0.3 * rng.normal(size=x.shape), permutations=99)
    assert max(related.p) == 0.01


def test_groups_in_both_modalities_are_not_agreement_within_them():
    x, label = blobs(6, n=20)
    y, _ = blobs(7, n=20)
    anyhow = agreement.permutation_test(x, y, permutations=49)
    within = agreement.permutation_test(x, y, permutations=49, groups=label)
    assert anyhow.p.overlap == 0.02
    assert within.p.overlap > 0.02


def test_ties_do_not_follow_the_order_of_touches():
    same = np.zeros((60, 2))
    assert agreement.agreement(same, np.random.default_rng(8).normal(size=(60, 2)), 5).overlap < 0.25
