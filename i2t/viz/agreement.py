"""Agreement of what was seen of a set of touches with what was measured, and whether that is more than chance.

`agreement` puts a number on the paper's remark that a mapping from patches to readings "should be possible": were two
modalities unrelated, pairing them anew would not change how far their neighbourhoods and their geometry agree, which
the permutation test asks. Pairing anew within groups (objects, say) asks whether they agree beyond the group.

Sources: linear CKA, Kornblith et al. (ICML 2019); overlap of nearest neighbours, Huh et al. (ICML 2024); p-values,
Phipson and Smyth (Stat. Appl. Genet. Mol. Biol. 9, 2010): (1 + as extreme) / (1 + permutations).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

NUM_NEIGHBOURS = 10


class Agreement(NamedTuple):
    """Agreement of two modalities of the same touches; each lies between 0 and 1, or a little below for nothing."""

    overlap: float  # mean share of k nearest neighbours that a touch has in both
    mutual: float  # share of all pairs that are mutual neighbours in either that are so in both
    cka: float  # linear; 1 for the same geometry up to rotation and scale


class PermutationTest(NamedTuple):
    """An agreement, what it is when touches are paired anew, and how rarely that comes as high."""

    observed: Agreement
    chance: Agreement  # mean over permutations
    p: Agreement
    permutations: int


def neighbours(x: Float[np.ndarray, "n d"], k: int = NUM_NEIGHBOURS) -> Int[np.ndarray, "n k"]:
    """The k nearest other touches of each; of equally near ones those that a fixed random order puts first.

    Args:
        x: Features of the touches.
        k: How many.

    Returns:
        Their row numbers, the nearest first.

    Raises:
        ValueError: There are not so many other touches.
    """
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


def agreement(x: Float[np.ndarray, "n a"], y: Float[np.ndarray, "n b"], k: int = NUM_NEIGHBOURS) -> Agreement:
    """Agreement of two modalities of the same touches.

    Args:
        x: Features of the one.
        y: Features of the other.
        k: Neighbours of each touch.

    Returns:
        Three measures of it, each 1 where the two have the same neighbours or the same geometry.
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
        x: Features of the one.
        y: Features of the other.
        permutations: How many random pairings.
        seed: Of the pairings.
        groups: Of each touch, within which touches are paired anew: whether they agree beyond the group. All touches
            are one group unless given.

    Returns:
        The agreement, its mean over permutations, and p-values.
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
            raise ValueError(f"{len(x)} touches of one modality do not pair with {len(y)} of the other")
        self.k = k
        self.neighbours_x = neighbours(x, k)
        self.adjacent_y = _adjacency(neighbours(y, k))
        self.mutual_x = _mutual_edges(_adjacency(self.neighbours_x))
        self.mutual_y = self.adjacent_y & self.adjacent_y.T
        a, b = (values - np.mean(values, axis=0, keepdims=True) for values in (x, y))
        self.a, self.b = np.asarray(a, np.float64), np.asarray(b, np.float64)
        self.scale = max(float(np.linalg.norm(self.a.T @ self.a) * np.linalg.norm(self.b.T @ self.b)), 1e-300)

    def agree(self, order: np.ndarray) -> Agreement:
        """Agreement with touch i of the first paired with touch order[i] of the second."""
        both = self.adjacent_y[order[:, None], order[self.neighbours_x]].mean()
        shared = int(self.mutual_y[order[self.mutual_x[0]], order[self.mutual_x[1]]].sum())
        either = len(self.mutual_x[0]) + int(self.mutual_y.sum()) // 2 - shared
        cross = float(np.linalg.norm(self.a.T @ self.b[order])) ** 2
        return Agreement(float(both), shared / max(either, 1), cross / self.scale)


def _adjacency(nearest: np.ndarray) -> Bool[np.ndarray, "n n"]:
    """Mask (n, n): touch j is among the nearest of touch i."""
    found = np.zeros((len(nearest), len(nearest)), bool)
    found[np.arange(len(nearest))[:, None], nearest] = True
    return found


def _mutual_edges(adjacent: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs (i < j) that are each other's neighbours."""
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
