"""Views, clusters and maps of touches: groups that are there are found again."""

import numpy as np
from helpers.blobs import blobs

from i2t.viz import clusters


def test_a_mask_holds_the_pixels_near_the_nearest_point():
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


def test_distant_clusters_are_recovered_with_every_seed():
    x, label = blobs()
    clustering = clusters.cluster(x, seed=3)
    assert clusters.rand_index(clustering.label, label) == 1
    np.testing.assert_allclose(clustering.centre[0], x[clustering.label == 0].mean(0))
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


def test_the_examples_of_a_cluster_are_its_own_from_the_nearest_to_its_mean_on():
    x, _ = blobs(n=12)
    clustering = clusters.cluster(x)
    touch_map = clusters.map_touches(x, clustering, ranks=(0.0, 0.5))
    assert touch_map.examples.shape == (5, 2)
    for i, (nearest, middle) in enumerate(touch_map.examples):
        assert clustering.label[nearest] == clustering.label[middle] == i
        distance = np.linalg.norm(touch_map.at[clustering.label == i] - touch_map.means[i], axis=1)
        assert np.linalg.norm(touch_map.at[nearest] - touch_map.means[i]) == distance.min()
        assert np.linalg.norm(touch_map.at[middle] - touch_map.means[i]) == np.sort(distance)[6]
