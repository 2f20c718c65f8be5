"""Which presses are held out: of many presses a share, of a few each in turn.

A share of many presses is held out at random, and another in whole blocks. Fewer than MIN_SHARED_PRESSES are too few
for that: each is predicted from all others (leave one out), and, where presses share blocks or places, each block or
place from all others. Errors of one block or place are not independent, so that intervals are over these.
"""

from typing import NamedTuple

import numpy as np
from scipy.cluster.hierarchy import fcluster, linkage

from experiments.calibrate.arguments import Preset
from experiments.calibrate.data import MM_PER_M, PressRecording
from i2t.dataset import square_blocks
from i2t.prediction.metrics import MIN_CLUSTERS

RANDOM = "random presses"
EACH_PRESS = "each press left out"
PLACE = "place"
MIN_PRESSES = 8  # to predict each from the others
ADVISED_PRESSES = 20  # of docs/tutorial_own_skin.md
MIN_SHARED_PRESSES = 60  # of which a share is held out
SAME_PLACE_MM = 0.2  # distance up to which presses are at one place
LARGEST_CLUSTER_SHARE = 0.5  # of the presses, of what may be left out together


class PressSplit(NamedTuple):
    """Rows of a recording: what methods may learn from, and what they are tested on."""

    tests: dict[str, np.ndarray]  # predicted from the pool
    pool: np.ndarray


class Clusters(NamedTuple):
    """Presses that lie together."""

    name: str  # of one of them
    of_press: np.ndarray  # (n,) number, from 0

    def plural(self, count: int = 2) -> str:
        """Name of as many."""
        head, *rest = self.name.split(" ", 1)
        return " ".join([head if count == 1 else f"{head}s", *rest])


class HeldOut(NamedTuple):
    """Presses to learn from and to test on, and what a reader has to know of them."""

    splits: tuple[PressSplit, ...]
    in_turn: bool  # each press is predicted once, from all others
    clusters: Clusters  # that intervals are over
    sentences: tuple[str, ...]

    @property
    def tests(self) -> dict[str, np.ndarray]:
        """Rows of each test, over all splits."""
        names = dict.fromkeys(name for split in self.splits for name in split.tests)
        return {name: np.concatenate([s.tests[name] for s in self.splits if name in s.tests]) for name in names}


def hold_out(recording: PressRecording, cfg: Preset, seed: int, usable: np.ndarray, source: str) -> HeldOut:
    """Hold presses out by their number and places.

    Args:
        recording: n presses.
        cfg: What share of how many presses is held out.
        seed: Of what is chosen at random.
        usable: (n,) mask; other presses are neither learned from nor tested on.
        source: Name of the recording, for messages.

    Returns:
        The splits, and sentences that say which way of holding out was taken and what it cannot show.

    Raises:
        ValueError: Presses are too few, or nothing about them varies.
    """
    rows = np.flatnonzero(usable)
    if len(rows) < MIN_PRESSES:
        raise ValueError(
            f"{source} has {len(rows)} usable presses, too few to predict each from the others; {MIN_PRESSES} are "
            f"enough for that, and some {ADVISED_PRESSES} all over the skin to learn it"
        )
    clusters = clusters_of(MM_PER_M * recording.position[rows], cfg.block_mm)
    if clusters is None and not np.ptp(recording.load[rows]) and not np.ptp(recording.position[rows], axis=0).any():
        raise ValueError(
            f"all {len(rows)} presses of {source} have one place and one {recording.load_kind}, which says nothing of "
            "any other press; press at other places, some twenty in all"
        )
    one_place = about_one_place(MM_PER_M * recording.position[rows], recording.load_kind)
    if len(rows) < MIN_SHARED_PRESSES:
        return _in_turn(rows, clusters, one_place, len(usable))
    return _shares(rows, clusters, one_place, cfg, seed, usable)


def clusters_of(position_mm: np.ndarray, block_mm: float) -> Clusters | None:
    """Square blocks in which presses lie, or else places; None where one of these holds more than half of the presses.

    Args:
        position_mm: (n, 2) positions of the presses.
        block_mm: Edge of a block.

    Returns:
        The number of the cluster of each press.
    """
    most = LARGEST_CLUSTER_SHARE * len(position_mm)
    blocks = square_blocks(position_mm, block_mm)
    if np.bincount(blocks).max() <= most:
        return Clusters(f"block of {block_mm:g} mm", blocks)
    places = fcluster(linkage(position_mm, "complete"), SAME_PLACE_MM, "distance") - 1
    return Clusters(PLACE, places) if np.bincount(places).max() <= most else None


def about_one_place(position_mm: np.ndarray, load_kind: str) -> str:
    """What cannot be told where more than half of the presses, at these positions (n, 2), lie at one place."""
    n = len(position_mm)
    close = np.linalg.norm(position_mm - np.median(position_mm, axis=0), axis=1) <= SAME_PLACE_MM
    share = f"all {n} presses" if close.all() else f"more than half of the {n} presses"
    return (
        f"{share} lie at one place, so leaving places out is impossible: the figures say how well other {load_kind}s "
        "are predicted there, and nothing about other places"
    )


def _in_turn(rows: np.ndarray, clusters: Clusters | None, one_place: str, total: int) -> HeldOut:
    """Each press predicted from all others, and each cluster from all others where that is something else."""
    n = len(rows)
    splits = [PressSplit({EACH_PRESS: rows[[i]]}, np.delete(rows, i)) for i in range(n)]
    sentences = [
        f"{n} presses are fewer than {MIN_SHARED_PRESSES}, too few to hold a share of them out: each press is left out "
        f"in turn and predicted from the {n - 1} others"
    ]
    if clusters is None:
        sentences.append(one_place)
        clusters = Clusters(PLACE, np.zeros(n, int))
    elif (sizes := np.bincount(clusters.of_press)).max() == 1:
        sentences.append(f"each press has a {clusters.name} to itself, so that its place is left out with it")
    else:
        name, left = f"each {clusters.name} left out", n - sizes
        for i in range(len(sizes)):
            own = clusters.of_press == i
            splits.append(PressSplit({name: rows[own]}, rows[~own]))
        few = f"{left.min()}" if left.min() == left.max() else f"{left.min()} to {left.max()}"
        sentences.append(
            f"each of {len(sizes)} {clusters.plural()} is left out in turn, too, and predicted from the {few} "
            "presses of the others"
        )
    sentences += _about_clusters(clusters)
    return HeldOut(tuple(splits), True, _of_all(clusters, rows, total), tuple(sentences))


def _shares(
    rows: np.ndarray, clusters: Clusters | None, one_place: str, cfg: Preset, seed: int, usable: np.ndarray
) -> HeldOut:
    """A share of the presses at random, and another in whole clusters."""
    whole = None if clusters is None else _of_all(clusters, rows, len(usable)).of_press
    held, together = share_masks(len(usable), whole, cfg, seed)
    tests, sentences = {RANDOM: np.flatnonzero(held & usable)}, []
    if clusters is None:
        sentences.append(one_place)
        clusters = Clusters(PLACE, np.zeros(len(rows), int))
    else:
        tests[clusters.plural()] = np.flatnonzero(together & usable)
    sentences += _about_clusters(clusters)
    split = PressSplit(tests, np.flatnonzero(~held & ~together & usable))
    return HeldOut((split,), False, _of_all(clusters, rows, len(usable)), tuple(sentences))


def share_masks(presses: int, cluster: np.ndarray | None, cfg: Preset, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Masks of random presses and of whole clusters that no method sees.

    Args:
        presses: How many there are; at most a quarter is taken at random.
        cluster: (n,) number of the cluster of each press, below 0 where it has none; None to take none.
        cfg: What share of how many presses is held out.
        seed: Of what is chosen.

    Returns:
        Two masks (n,). Whole clusters hold at most half of the presses.
    """
    rng = np.random.default_rng(seed)
    held, together = np.zeros(presses, bool), np.zeros(presses, bool)
    held[rng.permutation(presses)[: min(cfg.held_out_presses, presses // 4)]] = True
    if cluster is None:
        return held, together
    count = cluster.max() + 1
    for number in rng.permutation(count)[: max(round(cfg.block_share * count), 1)]:
        own = cluster == number
        if (together | own).sum() <= LARGEST_CLUSTER_SHARE * presses:
            together |= own
    return held, together


def _about_clusters(clusters: Clusters) -> list[str]:
    """What few or near places cannot tell."""
    count, sentences = int(clusters.of_press.max()) + 1, []
    if count > 1 and clusters.name == PLACE:
        sentences.append("most presses lie in one block, so that nothing is said about places farther from them")
    if count < MIN_CLUSTERS:
        lie = f"presses lie in {count} {clusters.plural(count)}"
        sentences.append(f"there is no interval: {lie}, and {MIN_CLUSTERS} are needed")
    return sentences


def _of_all(clusters: Clusters, rows: np.ndarray, total: int) -> Clusters:
    """Clusters of all presses from those of some rows; -1 for others."""
    of_press = np.full(total, -1)
    of_press[rows] = clusters.of_press
    return clusters._replace(of_press=of_press)
