"""What a set of touches looks like: a map of its views, clusters, how stable both are, and how far what was seen agrees
with what was felt.

A view is what the model sees of a patch, by default the paper's binary contact mask ("processed depth"). Distances are
those of principal components, which keep nearly all of the variance and make them quick. `agreement` puts a number on
the paper's remark that a mapping from patches to readings "should be possible": were two modalities unrelated, pairing
them anew would not change how far their neighbourhoods and their geometry agree, and the permutation test asks just
that. Pairing anew within groups (objects, say) asks whether they agree in more than in telling the groups apart.

Sources: t-SNE, van der Maaten and Hinton (JMLR 9, 2008); adjusted Rand index, Hubert and Arabie (J. Classif. 2, 1985);
linear CKA, Kornblith et al. (ICML 2019); overlap of nearest neighbours, Huh et al. (ICML 2024); p-values,
Phipson and Smyth (Stat. Appl. Genet. Mol. Biol. 9, 2010): (1 + as extreme) / (1 + permutations). NumPy, and
scikit-learn (`pip install "i2t[notebooks]"`), which gets one thread: some thousand touches are not worth waiting for
others.
"""

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from i2t.types import REACH

CLUSTERS = 5  # the paper's
COMPONENTS = 50  # of the views
NEIGHBOURS = 10
PERPLEXITY = 30.0
TOLERANCE = 1.5e-3  # m behind the nearest point that counts as contact, as in `i2t.prediction.model.ModelConfig`


class Clusters(NamedTuple):
    """Touches sorted by their views."""

    label: Int[np.ndarray, " n"]  # the largest cluster is 0
    centre: Float[np.ndarray, "k d"]  # mean of each cluster's features


class Agreement(NamedTuple):
    """How far two modalities of the same touches agree; each lies between 0 and 1, or a little below for nothing."""

    overlap: float  # mean share of k nearest neighbours that a touch has in both
    mutual: float  # share of all pairs that are mutual neighbours in either that are so in both
    cka: float  # linear; 1 for the same geometry up to turning and scaling


class Tested(NamedTuple):
    """An agreement, what it is when touches are paired anew, and how rarely that comes as high."""

    observed: Agreement
    chance: Agreement  # mean over permutations
    p: Agreement
    permutations: int


def views(patch: Float[np.ndarray, "n h w"], kind: Literal["mask", "depth"] = "mask") -> Float[np.ndarray, "n d"]:
    """Patches (m) as the model sees them, flattened: the contact mask, or depth in parts of the reach."""
    patch = np.asarray(patch, np.float64)
    near = patch <= patch.min((1, 2), keepdims=True) + TOLERANCE
    seen = near if kind == "mask" else np.clip(patch / REACH, 0, 1)
    return seen.reshape(len(patch), -1).astype(np.float64)


def components(x: Float[np.ndarray, "n d"], most: int = COMPONENTS) -> Float[np.ndarray, "n c"]:
    """The first principal components, as lengths; a touch's distances are kept but for what the rest leaves out."""
    centred = np.asarray(x, np.float64) - np.mean(x, axis=0, keepdims=True)
    u, s, _ = np.linalg.svd(centred, full_matrices=False)
    return (u * s[None])[:, : min(most, len(s))]


def standardised(x: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n d"]:
    """Each column in units of its spread about its mean; a column that never changes stays zero."""
    std = np.std(x, axis=0, keepdims=True)
    return (x - np.mean(x, axis=0, keepdims=True)) / np.where(std > 0, std, 1)


def cluster(x: Float[np.ndarray, "n d"], clusters: int = CLUSTERS, seed: int = 0, starts: int = 10) -> Clusters:
    """k-means, the best of some random starts; clusters are numbered by size."""
    from sklearn.cluster import KMeans
    from threadpoolctl import threadpool_limits

    if len(x) < clusters:
        raise ValueError(f"{len(x)} touches cannot be sorted into {clusters} clusters; give more touches")
    with threadpool_limits(1):
        fitted = KMeans(clusters, n_init=starts, random_state=seed).fit(x)
    order = np.argsort(-np.bincount(fitted.labels_, minlength=clusters), kind="stable")
    return Clusters(np.argsort(order)[fitted.labels_], fitted.cluster_centers_[order])


def embed(
    x: Float[np.ndarray, "n d"], others: Float[np.ndarray, "m d"] | None = None, seed: int = 0,
    perplexity: float = PERPLEXITY,
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "m 2"]]:  # fmt: skip
    """t-SNE of touches and, among them, of other points (cluster means): t-SNE has no projection of its own, so they
    are embedded together.
    """
    from sklearn.manifold import TSNE
    from threadpoolctl import threadpool_limits

    x = np.asarray(x, np.float64)
    both = x if others is None else np.concatenate([x, others])
    if len(both) < 4:
        raise ValueError(f"{len(both)} touches make no map; give four at least")
    most = min(perplexity, (len(both) - 1) / 3)
    with threadpool_limits(1):
        at = TSNE(2, perplexity=most, init="pca", random_state=seed).fit_transform(both.astype(np.float32))
    return at[: len(x)].astype(np.float64), at[len(x) :].astype(np.float64)


def rand_index(a: Int[np.ndarray, " n"], b: Int[np.ndarray, " n"]) -> float:
    """Adjusted Rand index of two clusterings: 1 for the same, 0 on average for unrelated ones."""
    from sklearn.metrics import adjusted_rand_score

    return float(adjusted_rand_score(a, b))


def stability(x: Float[np.ndarray, "n d"], clusters: int = CLUSTERS, seeds: int = 10, share: float = 0.8):
    """Adjusted Rand index of the clusterings of all pairs of seeds: ((pairs,) of all touches, (pairs,) of clusterings
    of random parts of the touches, compared on those that both have).
    """
    whole = [cluster(x, clusters, seed).label for seed in range(seeds)]
    parts = []
    for seed in range(seeds):
        rows = np.random.default_rng(seed).permutation(len(x))[: max(round(share * len(x)), clusters)]
        label = np.full(len(x), -1)
        label[rows] = cluster(x[rows], clusters, seed).label
        parts.append(label)

    def pairs(labels: list[np.ndarray]) -> np.ndarray:
        return np.array(
            [
                rand_index(a[both], b[both])
                for i, a in enumerate(labels)
                for b in labels[:i]
                if (both := (a >= 0) & (b >= 0)).sum() > 1
            ]
        )

    return pairs(whole), pairs(parts)


def neighbours(x: Float[np.ndarray, "n d"], k: int = NEIGHBOURS) -> Int[np.ndarray, "n k"]:
    """The k nearest other touches of each; of equally near ones those that a fixed random order puts first."""
    x = np.asarray(x, np.float64)
    n = len(x)
    if not 0 < k < n:
        raise ValueError(f"{n} touches have no {k} nearest others; choose between 1 and {n - 1}")
    # Binary views are often equally far: ties must not follow the order of the touches, which both modalities share.
    order = np.random.default_rng(0).permutation(n)
    shuffled = x[order]
    square = np.sum(shuffled**2, axis=1)
    distance = square[None, :] - 2 * x @ shuffled.T
    distance[order, np.arange(n)] = np.inf
    return order[np.argsort(distance, axis=1, kind="stable")[:, :k]]


def agreement(x: Float[np.ndarray, "n a"], y: Float[np.ndarray, "n b"], k: int = NEIGHBOURS) -> Agreement:
    """How far two modalities of the same n touches agree."""
    return _Pair(x, y, k).agree(np.arange(len(x)))


def permutation_test(
    x: Float[np.ndarray, "n a"], y: Float[np.ndarray, "n b"], k: int = NEIGHBOURS, permutations: int = 999,
    seed: int = 0, groups: Int[np.ndarray, " n"] | None = None,
) -> Tested:  # fmt: skip
    """Whether they agree more than by chance; with `groups`, more than touches of the same group do anyway."""
    pair, rng = _Pair(x, y, k), np.random.default_rng(seed)
    observed = pair.agree(np.arange(len(x)))
    made = np.array([pair.agree(_paired_anew(rng, len(x), groups)) for _ in range(permutations)])
    p = (1 + np.sum(made >= np.array(observed)[None], axis=0)) / (1 + permutations)
    return Tested(observed, Agreement(*made.mean(0).tolist()), Agreement(*p.tolist()), permutations)


class _Pair:
    """Two modalities, prepared for many pairings."""

    def __init__(self, x: np.ndarray, y: np.ndarray, k: int) -> None:
        if len(x) != len(y):
            raise ValueError(f"{len(x)} touches of one modality do not pair with {len(y)} of the other")
        self.k = k
        self.near, other = neighbours(x, k), neighbours(y, k)
        self.near_y = _adjacent(other)
        self.mutual_x = _edges(_adjacent(self.near))
        self.mutual_y = self.near_y & self.near_y.T
        a, b = (values - np.mean(values, axis=0, keepdims=True) for values in (x, y))
        self.a, self.b = np.asarray(a, np.float64), np.asarray(b, np.float64)
        self.scale = max(float(np.linalg.norm(self.a.T @ self.a) * np.linalg.norm(self.b.T @ self.b)), 1e-300)

    def agree(self, order: np.ndarray) -> Agreement:
        """With touch i of the first paired with touch order[i] of the second."""
        both = self.near_y[order[:, None], order[self.near]].mean()
        shared = int(self.mutual_y[order[self.mutual_x[0]], order[self.mutual_x[1]]].sum())
        either = len(self.mutual_x[0]) + int(self.mutual_y.sum()) // 2 - shared
        cross = float(np.linalg.norm(self.a.T @ self.b[order])) ** 2
        return Agreement(float(both), shared / max(either, 1), cross / self.scale)


def _adjacent(near: np.ndarray) -> Bool[np.ndarray, "n n"]:
    made = np.zeros((len(near), len(near)), bool)
    made[np.arange(len(near))[:, None], near] = True
    return made


def _edges(adjacent: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs (i < j) that are each other's neighbours."""
    i, j = np.nonzero(np.triu(adjacent & adjacent.T))
    return i, j


def _paired_anew(rng: np.random.Generator, n: int, groups: np.ndarray | None) -> np.ndarray:
    if groups is None:
        return rng.permutation(n)
    order = np.arange(n)
    for group in np.unique(groups):
        rows = np.flatnonzero(groups == group)
        order[rows] = rng.permutation(rows)
    return order
