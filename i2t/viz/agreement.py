"""Agreement between two modalities of the same touches, such as views and readings, and a test against chance.

`agreement` quantifies the paper's remark that a mapping from patches to readings "should be possible". If two
modalities were unrelated, pairing their touches at random would not change how far their neighbourhoods and their
geometry agree; the permutation test checks this. Random pairing within groups, such as objects, tests whether the
modalities agree beyond what the group explains.

Sources: linear CKA, Kornblith et al. (ICML 2019); overlap of nearest neighbours, Huh et al. (ICML 2024); p-values,
Phipson and Smyth (Stat. Appl. Genet. Mol. Biol. 9, 2010): (1 + permutations at least as extreme) / (1 + permutations).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

NUM_NEIGHBOURS = 10  # number of nearest neighbours of a touch that are compared between two modalities


class Agreement(NamedTuple):
    """Agreement of two modalities of the same touches: shared neighbours, mutual neighbours and linear CKA, each 1 for
    full agreement and near 0 for none.
    """

    overlap: float  # mean share of a touch's k nearest neighbours that both modalities have in common
    mutual: float  # pairs of mutual neighbours in both modalities, as a share of those in either
    cka: float  # linear CKA, 1 for the same geometry up to rotation and scale


class PermutationTest(NamedTuple):
    """Agreement of two modalities, its mean when touches are paired at random, and p-values of a one-sided test."""

    observed: Agreement
    chance: Agreement  # mean of each measure over the permutations
    p: Agreement  # p-value of each measure
    permutations: int


def neighbours(x: Float[np.ndarray, "n d"], k: int = NUM_NEIGHBOURS) -> Int[np.ndarray, "n k"]:
    """Find the k nearest other touches of every touch by Euclidean distance. Ties are broken by a fixed random order.

    Args:
        x: Features of the touches.
        k: Number of neighbours.

    Returns:
        `(n, k)` row numbers of the neighbours, nearest first.

    Raises:
        ValueError: There are too few other touches.
    """
    x = np.asarray(x, np.float64)
    n = len(x)
    if not 0 < k < n:
        raise ValueError(f"{k} nearest neighbours cannot be chosen among {n} touches; choose between 1 and {n - 1}")
    # Binary views are often equidistant. Ties must not follow the order of the touches, which both modalities share.
    order = np.random.default_rng(0).permutation(n)
    shuffled = x[order]
    square = np.sum(shuffled**2, axis=1)
    distance = square[None, :] - 2 * x @ shuffled.T
    distance[order, np.arange(n)] = np.inf
    return order[np.argsort(distance, axis=1, kind="stable")[:, :k]]


def agreement(x: Float[np.ndarray, "n a"], y: Float[np.ndarray, "n b"], k: int = NUM_NEIGHBOURS) -> Agreement:
    """Measure the agreement of two modalities of the same touches.

    Args:
        x: Features of the touches in the first modality.
        y: Features of the same touches in the second modality.
        k: Number of neighbours of each touch.

    Returns:
        Three measures, each 1 if the two modalities have the same neighbours or the same geometry.
    """
    return _Pair(x, y, k).agree(np.arange(len(x)))


def permutation_test(
    x: Float[np.ndarray, "n a"],
    y: Float[np.ndarray, "n b"],
    *,
    permutations: int = 999,
    seed: int = 0,
    groups: Int[np.ndarray, " n"] | None = None,
) -> PermutationTest:
    """Test whether two modalities agree more than by chance.

    Args:
        x: Features of the touches in the first modality.
        y: Features of the same touches in the second modality.
        permutations: Number of random pairings.
        seed: Seed of the pairings.
        groups: Group of each touch. Touches are paired only within their group, which tests for agreement beyond the
            group. By default, all touches form one group.

    Returns:
        The agreement, its mean over the permutations, and the p-values.
    """
    pair, rng = _Pair(x, y, NUM_NEIGHBOURS), np.random.default_rng(seed)
    observed = pair.agree(np.arange(len(x)))
    permuted = np.array([pair.agree(_random_pairing(rng, len(x), groups)) for _ in range(permutations)])
    p = (1 + np.sum(permuted >= np.array(observed)[None], axis=0)) / (1 + permutations)
    return PermutationTest(observed, Agreement(*permuted.mean(0).tolist()), Agreement(*p.tolist()), permutations)


class _Pair:
    """Two modalities, prepared for many pairings."""

    def __init__(self, x: np.ndarray, y: np.ndarray, k: int) -> None:
        if len(x) != len(y):
            raise ValueError(f"both modalities need the same touches, but one has {len(x)} and the other {len(y)}")
        self.k = k
        self.neighbours_x = neighbours(x, k)
        self.adjacent_y = _adjacency(neighbours(y, k))
        self.mutual_x = _mutual_edges(_adjacency(self.neighbours_x))
        self.mutual_y = self.adjacent_y & self.adjacent_y.T
        a, b = (values - np.mean(values, axis=0, keepdims=True) for values in (x, y))
        self.a, self.b = np.asarray(a, np.float64), np.asarray(b, np.float64)
        self.scale = max(float(np.linalg.norm(self.a.T @ self.a) * np.linalg.norm(self.b.T @ self.b)), 1e-300)

    def agree(self, order: np.ndarray) -> Agreement:
        """Measure the agreement when touch i of the first modality is paired with touch order[i] of the second."""
        both = self.adjacent_y[order[:, None], order[self.neighbours_x]].mean()
        shared = int(self.mutual_y[order[self.mutual_x[0]], order[self.mutual_x[1]]].sum())
        either = len(self.mutual_x[0]) + int(self.mutual_y.sum()) // 2 - shared
        cross = float(np.linalg.norm(self.a.T @ self.b[order])) ** 2
        return Agreement(float(both), shared / max(either, 1), cross / self.scale)


def _adjacency(nearest: np.ndarray) -> Bool[np.ndarray, "n n"]:
    """Convert neighbour lists to a mask (n, n), true where touch j is among the neighbours of touch i."""
    adjacent = np.zeros((len(nearest), len(nearest)), bool)
    adjacent[np.arange(len(nearest))[:, None], nearest] = True
    return adjacent


def _mutual_edges(adjacent: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """List the pairs (i < j) that are each other's neighbours."""
    i, j = np.nonzero(np.triu(adjacent & adjacent.T))
    return i, j


def _random_pairing(rng: np.random.Generator, n: int, groups: np.ndarray | None) -> np.ndarray:
    if groups is None:
        return rng.permutation(n)
    order = np.arange(n)
    for group in np.unique(groups):
        rows = np.flatnonzero(groups == group)
        order[rows] = rng.permutation(rows)
    return order
