"""Sets of touches sorted by what was seen: views, principal components, clusters, their stability, and a map.

A view is what the model sees of a patch, by default the paper's binary contact mask ("processed depth"). Distances are
those of principal components, which keep nearly all of the variance and make them quick.

Sources: t-SNE, van der Maaten and Hinton (JMLR 9, 2008); adjusted Rand index, Hubert and Arabie (J. Classif. 2, 1985).
NumPy, and scikit-learn (`pip install "imagine2touch[notebooks]"`) on one thread: a few thousand touches gain nothing
from more.
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from i2t.patches.dimensions import CONTACT_TOLERANCE_M, REACH

NUM_CLUSTERS = 5  # the paper's
NUM_COMPONENTS = 50  # of the views
STARTS = 10  # random starts of k-means, of which the best is taken
PART_SHARE = 0.8  # of the touches, in a random part
PERPLEXITY = 30.0  # effective number of neighbours; less where there are few touches


class Clusters(NamedTuple):
    """Touches sorted by their views."""

    label: Int[np.ndarray, " n"]  # the largest cluster is 0
    centre: Float[np.ndarray, "k d"]  # mean of each cluster's features


class TouchMap(NamedTuple):
    """Touches on a map, their clusters, and examples of each cluster."""

    at: Float[np.ndarray, "n 2"]
    label: Int[np.ndarray, " n"]
    means: Float[np.ndarray, "k 2"]  # of the clusters, on the map
    examples: Int[np.ndarray, "k e"]  # row numbers of touches


def views(patch: Float[np.ndarray, "n h w"], kind: Literal["mask", "depth"] = "mask") -> Float[np.ndarray, "n d"]:
    """Patches as the model sees them, flattened.

    Args:
        patch: m behind the nearest surface point.
        kind: The contact mask, or depth relative to the reach.

    Returns:
        A row for each patch.
    """
    patch = np.asarray(patch, np.float64)
    near = patch <= patch.min((1, 2), keepdims=True) + CONTACT_TOLERANCE_M
    view = near if kind == "mask" else np.clip(patch / REACH, 0, 1)
    return view.reshape(len(patch), -1).astype(np.float64)


def components(x: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n c"]:
    """The first principal components, as lengths: distances are kept but for what the other components add.

    Args:
        x: Features of the touches.

    Returns:
        A row of at most `NUM_COMPONENTS` for each touch, the greatest first.
    """
    centred = np.asarray(x, np.float64) - np.mean(x, axis=0, keepdims=True)
    u, s, _ = np.linalg.svd(centred, full_matrices=False)
    return (u * s[None])[:, : min(NUM_COMPONENTS, len(s))]


def standardised(x: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n d"]:
    """Each column in units of its standard deviation about its mean; a constant column becomes zero.

    Args:
        x: Features of the touches.

    Returns:
        Features of the same shape.
    """
    std = np.std(x, axis=0, keepdims=True)
    return (x - np.mean(x, axis=0, keepdims=True)) / np.where(std > 0, std, 1)


def cluster(x: Float[np.ndarray, "n d"], clusters: int = NUM_CLUSTERS, seed: int = 0) -> Clusters:
    """k-means; clusters are numbered by size.

    Args:
        x: Features of the touches.
        clusters: How many.
        seed: Of the random starts.

    Returns:
        Cluster of each touch, and the clusters' means.

    Raises:
        ValueError: There are fewer touches than clusters.
    """
    from sklearn.cluster import KMeans
    from threadpoolctl import threadpool_limits

    if len(x) < clusters:
        raise ValueError(f"{len(x)} touches cannot be sorted into {clusters} clusters; give more touches")
    with threadpool_limits(1):
        fitted = KMeans(clusters, n_init=STARTS, random_state=seed).fit(x)
    order = np.argsort(-np.bincount(fitted.labels_, minlength=clusters), kind="stable")
    return Clusters(np.argsort(order)[fitted.labels_], fitted.cluster_centers_[order])


def embed(
    x: Float[np.ndarray, "n d"],
    others: Float[np.ndarray, "m d"] | None = None,
    seed: int = 0,
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "m 2"]]:
    """t-SNE of touches and, among them, of other points: t-SNE has no projection of its own.

    Args:
        x: Features of the touches.
        others: Features of other points, such as cluster means.
        seed: Of t-SNE.

    Returns:
        Positions on the map of the touches and of the other points.

    Raises:
        ValueError: There are fewer than four points.
    """
    from sklearn.manifold import TSNE
    from threadpoolctl import threadpool_limits

    x = np.asarray(x, np.float64)
    both = x if others is None else np.concatenate([x, others])
    if len(both) < 4:
        raise ValueError(f"{len(both)} touches make no map; give four at least")
    most = min(PERPLEXITY, (len(both) - 1) / 3)
    with threadpool_limits(1):
        at = TSNE(2, perplexity=most, init="pca", random_state=seed).fit_transform(both.astype(np.float32))
    return at[: len(x)].astype(np.float64), at[len(x) :].astype(np.float64)


def map_touches(
    x: Float[np.ndarray, "n d"], clusters: Clusters, seed: int = 0, ranks: Sequence[float] = (0.0,)
) -> TouchMap:
    """A map of touches and the means of their clusters, with examples of each cluster.

    Args:
        x: Features of the touches.
        clusters: Of the same touches, as `cluster` gives them.
        seed: Of t-SNE.
        ranks: Which examples: 0 is the touch nearest to its cluster's mean on the map, 0.5 the median one.

    Returns:
        Places on the map, clusters, the means' places, and the examples' row numbers.
    """
    at, means = embed(x, clusters.centre, seed)
    examples = []
    for i, mean in enumerate(means):
        own = np.flatnonzero(clusters.label == i)
        order = own[np.argsort(np.linalg.norm(at[own] - mean[None], axis=1))]
        examples.append([order[int(rank * len(order))] for rank in ranks])
    return TouchMap(at, clusters.label, means, np.array(examples))


def rand_index(a: Int[np.ndarray, " n"], b: Int[np.ndarray, " n"]) -> float:
    """Adjusted Rand index of two clusterings: 1 for the same, 0 on average for unrelated ones.

    Args:
        a: Cluster of each touch.
        b: The same in the other clustering.

    Returns:
        The index, at most 1.
    """
    from sklearn.metrics import adjusted_rand_score

    return float(adjusted_rand_score(a, b))


def stability(
    x: Float[np.ndarray, "n d"], seeds: int = 10
) -> tuple[Float[np.ndarray, " pairs"], Float[np.ndarray, " pairs"]]:
    """Agreement of clusterings between seeds and between random parts of the touches.

    Args:
        x: Features of the touches.
        seeds: How many clusterings of each kind.

    Returns:
        Adjusted Rand indices of all pairs of seeds, and of all pairs of parts on the touches they share.
    """
    whole = [cluster(x, seed=seed).label for seed in range(seeds)]
    parts = []
    for seed in range(seeds):
        rows = np.random.default_rng(seed).permutation(len(x))[: max(round(PART_SHARE * len(x)), NUM_CLUSTERS)]
        label = np.full(len(x), -1)
        label[rows] = cluster(x[rows], seed=seed).label
        parts.append(label)
    return _pairwise_rand_indices(whole), _pairwise_rand_indices(parts)


def _pairwise_rand_indices(labels: list[np.ndarray]) -> np.ndarray:
    """Rand indices of all pairs of clusterings, on the touches that both have (label 0 or more)."""
    found = []
    for i, a in enumerate(labels):
        for b in labels[:i]:
            both = (a >= 0) & (b >= 0)
            if both.sum() > 1:
                found.append(rand_index(a[both], b[both]))
    return np.array(found)
