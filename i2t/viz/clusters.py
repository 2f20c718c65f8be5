"""Clusters of touches by their views: principal components, k-means, the stability of the clusters, and a map.

A view is a patch as the model sees it, by default the paper's binary contact mask ("processed depth"). Distances are
computed on principal components, which keep nearly all of the variance and are fast.

Sources: t-SNE, van der Maaten and Hinton (JMLR 9, 2008); adjusted Rand index, Hubert and Arabie (J. Classif. 2, 1985).
The module needs NumPy and scikit-learn (extra `notebooks`), which runs on one thread, because a
few thousand touches gain nothing from more.
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from i2t.patches.dimensions import CONTACT_TOLERANCE_M, REACH

NUM_CLUSTERS = 5  # number of clusters of views in the paper


class Clusters(NamedTuple):
    """k clusters of n touches, largest first: the cluster number of each touch, and each cluster's mean features."""

    label: Int[np.ndarray, " n"]  # cluster of each touch; cluster 0 is the largest
    centre: Float[np.ndarray, "k d"]  # mean features of each cluster


class TouchMap(NamedTuple):
    """Positions of n touches on a plane map (t-SNE), their cluster numbers, the map positions of the k clusters' means,
    and row numbers of e example touches of each cluster.
    """

    at: Float[np.ndarray, "n 2"]  # positions of the touches on the map
    label: Int[np.ndarray, " n"]
    means: Float[np.ndarray, "k 2"]  # positions of the clusters' means on the map
    examples: Int[np.ndarray, "k e"]  # row numbers of example touches


def views(patch: Float[np.ndarray, "n h w"], kind: Literal["mask", "depth"] = "mask") -> Float[np.ndarray, "n d"]:
    """Convert patches to flat feature vectors: contact masks (1 close to the nearest point, else 0), or depths as
    fractions of the reach.

    Args:
        patch: Depth (m) behind the nearest surface point.
        kind: The contact mask, or the depth relative to the reach.

    Returns:
        `(n, h w)` features between 0 and 1, a row for each patch.
    """
    patch = np.asarray(patch, np.float64)
    near = patch <= patch.min((1, 2), keepdims=True) + CONTACT_TOLERANCE_M
    view = near if kind == "mask" else np.clip(patch / REACH, 0, 1)
    return view.reshape(len(patch), -1).astype(np.float64)


def components(x: Float[np.ndarray, "n d"], count: int = 50) -> Float[np.ndarray, "n c"]:
    """Compute the first principal components of touches, whose distances approximate those of the features.

    Args:
        x: Features of the touches.
        count: Maximum number of components.

    Returns:
        `(n, c)` components of the touches, those with the largest variance first.
    """
    centred = np.asarray(x, np.float64) - np.mean(x, axis=0, keepdims=True)
    u, s, _ = np.linalg.svd(centred, full_matrices=False)
    return (u * s[None])[:, :count]


def standardised(x: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n d"]:
    """Centre every column and divide it by its standard deviation; a constant column becomes zero.

    Args:
        x: Features of the touches.

    Returns:
        `(n, d)` standardised features.
    """
    std = np.std(x, axis=0, keepdims=True)
    return (x - np.mean(x, axis=0, keepdims=True)) / np.where(std > 0, std, 1)


def cluster(x: Float[np.ndarray, "n d"], clusters: int = NUM_CLUSTERS, seed: int = 0) -> Clusters:
    """Cluster touches by k-means. Clusters are numbered by size, largest first.

    Args:
        x: Features of the touches.
        clusters: Number of clusters.
        seed: Seed of the random starts.

    Returns:
        The cluster of each touch and the clusters' means.

    Raises:
        ValueError: There are fewer touches than clusters.
    """
    from sklearn.cluster import KMeans
    from threadpoolctl import threadpool_limits

    if len(x) < clusters:
        raise ValueError(f"{len(x)} touches cannot be sorted into {clusters} clusters; give more touches")
    with threadpool_limits(1):
        fitted = KMeans(clusters, n_init=10, random_state=seed).fit(x)
    order = np.argsort(-np.bincount(fitted.labels_, minlength=clusters), kind="stable")
    return Clusters(np.argsort(order)[fitted.labels_], fitted.cluster_centers_[order])


def embed(
    x: Float[np.ndarray, "n d"],
    others: Float[np.ndarray, "m d"] | None = None,
    seed: int = 0,
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "m 2"]]:
    """Embed touches in a plane by t-SNE, jointly with other points, because t-SNE cannot project points afterwards.

    Args:
        x: Features of the touches.
        others: Features of m other points, such as cluster means.
        seed: Seed of t-SNE.

    Returns:
        `(n, 2)` map positions of the touches, and `(m, 2)` map positions of the other points.

    Raises:
        ValueError: There are fewer than four points.
    """
    from sklearn.manifold import TSNE
    from threadpoolctl import threadpool_limits

    x = np.asarray(x, np.float64)
    both = x if others is None else np.concatenate([x, others])
    if len(both) < 4:
        raise ValueError(f"a map needs at least four touches, not {len(both)}")
    perplexity = min(30.0, (len(both) - 1) / 3)  # effective number of neighbours
    with threadpool_limits(1):
        at = TSNE(2, perplexity=perplexity, init="pca", random_state=seed).fit_transform(both.astype(np.float32))
    return at[: len(x)].astype(np.float64), at[len(x) :].astype(np.float64)


def map_touches(
    x: Float[np.ndarray, "n d"], clusters: Clusters, seed: int = 0, ranks: Sequence[float] = (0.0,)
) -> TouchMap:
    """Map touches and the means of their clusters, and choose examples of each cluster.

    Args:
        x: Features of the touches.
        clusters: Clusters of the same touches, from `cluster`.
        seed: Seed of t-SNE.
        ranks: Relative rank of each example by its distance on the map from its cluster's mean: 0 is the nearest touch
            and 0.5 the median one.

    Returns:
        Map positions and clusters of the touches, map positions of the means, and row numbers of the examples.
    """
    at, means = embed(x, clusters.centre, seed)
    examples = []
    for i, mean in enumerate(means):
        own = np.flatnonzero(clusters.label == i)
        order = own[np.argsort(np.linalg.norm(at[own] - mean[None], axis=1))]
        examples.append([order[int(rank * len(order))] for rank in ranks])
    return TouchMap(at, clusters.label, means, np.array(examples))


def rand_index(a: Int[np.ndarray, " n"], b: Int[np.ndarray, " n"]) -> float:
    """Compute the adjusted Rand index of two clusterings: 1 for equal ones, 0 on average for unrelated ones.

    Args:
        a: Cluster of each touch in the first clustering.
        b: Cluster of each touch in the second clustering.

    Returns:
        The adjusted Rand index, at most 1.
    """
    from sklearn.metrics import adjusted_rand_score

    return float(adjusted_rand_score(a, b))


def stability(
    x: Float[np.ndarray, "n d"], seeds: int = 10, share: float = 0.8
) -> tuple[Float[np.ndarray, " pairs"], Float[np.ndarray, " pairs"]]:
    """Measure how well k-means clusterings of touches agree between seeds, and between random subsets of the touches.

    Args:
        x: Features of the touches.
        seeds: Number of clusterings of each kind.
        share: Share of the touches in a random subset.

    Returns:
        Adjusted Rand indices (1 for equal clusterings, 0 by chance) of all pairs of seeds, and of all pairs of subsets
        on the touches that they share.
    """
    whole = [cluster(x, seed=seed).label for seed in range(seeds)]
    parts = []
    for seed in range(seeds):
        rows = np.random.default_rng(seed).permutation(len(x))[: max(round(share * len(x)), NUM_CLUSTERS)]
        label = np.full(len(x), -1)
        label[rows] = cluster(x[rows], seed=seed).label
        parts.append(label)
    return _pairwise_rand_indices(whole), _pairwise_rand_indices(parts)


def _pairwise_rand_indices(labels: list[np.ndarray]) -> np.ndarray:
    """Compute the Rand indices of all pairs of clusterings on the touches that both label; a label of -1 means none."""
    indices = []
    for i, a in enumerate(labels):
        for b in labels[:i]:
            both = (a >= 0) & (b >= 0)
            if both.sum() > 1:
                indices.append(rand_index(a[both], b[both]))
    return np.array(indices)
