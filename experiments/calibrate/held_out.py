"""Which presses are held out: a share of many presses, or each of a few in turn.

A share of many presses is held out at random, and another in whole blocks. With fewer than MIN_SHARED_PRESSES, each
press is predicted from all others (leave one out), and, where presses share blocks or places, each block or place from
all others. Errors within a block or place are not independent, so intervals are over blocks or places.
"""

from typing import NamedTuple

import numpy as np

from experiments.calibrate.arguments import Preset
from i2t.dataset import same_places, square_blocks
from i2t.dataset.splits import SAME_PLACE_M
from i2t.intervals import MIN_CLUSTERS
from i2t.recordings.presses import LoadedPresses

RANDOM = "random presses"
EACH_PRESS = "each press left out"
PLACE = "place"
MIN_PRESSES = 8  # fewest presses of which each is predicted from the others
ADVISED_PRESSES = 20  # as docs/tutorial_own_skin.md advises
MIN_SHARED_PRESSES = 60  # fewest presses of which a share is held out
LARGEST_CLUSTER_SHARE = 0.5  # largest share of the presses that may be left out together


class PressSplit(NamedTuple):
    """Rows of a recording: what methods may learn from, and what they are tested on."""

    tests: dict[str, np.ndarray]  # predicted from the pool
    pool: np.ndarray


class PressClusters(NamedTuple):
    """Presses that lie together; a single cluster where no part of the presses can be left out."""

    name: str  # of one cluster
    of_press: np.ndarray  # (n,) cluster of each press, from 0; -1 for a press that is not used

    @property
    def number(self) -> int:
        """Number of clusters."""
        return int(self.of_press.max()) + 1

    def plural(self, count: int = 2) -> str:
        """Name of `count` clusters."""
        head, *rest = self.name.split(" ", 1)
        return " ".join([head if count == 1 else f"{head}s", *rest])


class HeldOut(NamedTuple):
    """Presses to learn from and to test on, and sentences for the reader of the figures."""

    splits: tuple[PressSplit, ...]
    in_turn: bool  # each press is predicted once, from all others
    clusters: PressClusters  # over which intervals are taken
    sentences: tuple[str, ...]

    @property
    def tests(self) -> dict[str, np.ndarray]:
        """Rows of each test, over all splits."""
        names = dict.fromkeys(name for split in self.splits for name in split.tests)
        return {name: np.concatenate([s.tests[name] for s in self.splits if name in s.tests]) for name in names}


def hold_out(recording: LoadedPresses, cfg: Preset, seed: int, usable: np.ndarray, source: str) -> HeldOut:
    """Choose the presses to hold out by their number and places.

    Args:
        recording: The n presses.
        cfg: The preset, which has the size of a block and the shares to hold out.
        seed: Seed of the random choices.
        usable: (n,) mask; other presses are neither learned from nor tested on.
        source: Name of the recording, for messages.

    Returns:
        The splits, and sentences that say how presses are held out and what that cannot show.

    Raises:
        ValueError: There are too few presses, or neither their places nor their loads vary.
    """
    rows = np.flatnonzero(usable)
    if len(rows) < MIN_PRESSES:
        raise ValueError(
            f"{source} has {len(rows)} usable presses, too few to predict each from the others; {MIN_PRESSES} are "
            f"enough for that, and some {ADVISED_PRESSES} all over the skin to learn it"
        )
    position_mm = 1e3 * recording.position[rows]
    clusters = _clusters_of(position_mm, cfg.block_mm)
    if clusters.number == 1 and not np.ptp(recording.load[rows]) and not np.ptp(position_mm, axis=0).any():
        raise ValueError(
            f"all {len(rows)} presses of {source} have one place and one {recording.load_kind}, which says nothing of "
            "any other press; press at other places, some twenty in all"
        )
    of_press = np.full(len(usable), -1)
    of_press[rows] = clusters.of_press
    all_clusters, in_turn = clusters._replace(of_press=of_press), len(rows) < MIN_SHARED_PRESSES
    splits, sentences = _in_turn(rows, clusters) if in_turn else ([_shares(all_clusters, cfg, seed, usable)], [])
    if clusters.number == 1:
        sentences.append(_about_one_place(position_mm, recording.load_kind))
    return HeldOut(tuple(splits), in_turn, all_clusters, (*sentences, *_about_clusters(clusters)))


def _clusters_of(position_mm: np.ndarray, block_mm: float) -> PressClusters:
    """Square blocks of presses at positions (n, 2), or else their places; a single place where one of these holds more
    than half of the presses.
    """
    most = LARGEST_CLUSTER_SHARE * len(position_mm)
    blocks = square_blocks(position_mm, block_mm)
    if np.bincount(blocks).max() <= most:
        return PressClusters(f"block of {block_mm:g} mm", blocks)
    places = same_places(position_mm / 1e3)
    return PressClusters(PLACE, places if np.bincount(places).max() <= most else np.zeros_like(places))


def _about_one_place(position_mm: np.ndarray, load_kind: str) -> str:
    """What presses at positions (n, 2) cannot show where more than half of them lie at one place."""
    n = len(position_mm)
    close = np.linalg.norm(position_mm - np.median(position_mm, axis=0), axis=1) <= 1e3 * SAME_PLACE_M
    share = f"all {n} presses" if close.all() else f"more than half of the {n} presses"
    return (
        f"{share} lie at one place, so leaving places out is impossible: the figures say how well other {load_kind}s "
        "are predicted there, and nothing about other places"
    )


def _in_turn(rows: np.ndarray, clusters: PressClusters) -> tuple[list[PressSplit], list[str]]:
    """Splits that predict each press from all others, and each cluster of several presses from all other clusters."""
    n, sizes = len(rows), np.bincount(clusters.of_press)
    splits = [PressSplit({EACH_PRESS: rows[[i]]}, np.delete(rows, i)) for i in range(n)]
    sentences = [
        f"{n} presses are fewer than {MIN_SHARED_PRESSES}, too few to hold a share of them out: each press is left out "
        f"in turn and predicted from the {n - 1} others"
    ]
    if sizes.max() == 1:
        sentences.append(f"each press has a {clusters.name} to itself, so that its place is left out with it")
    elif len(sizes) > 1:
        name, left = f"each {clusters.name} left out", n - sizes
        for i in range(len(sizes)):
            own = clusters.of_press == i
            splits.append(PressSplit({name: rows[own]}, rows[~own]))
        few = f"{left.min()}" if left.min() == left.max() else f"{left.min()} to {left.max()}"
        sentences.append(
            f"each of {len(sizes)} {clusters.plural()} is left out in turn, too, and predicted from the {few} "
            "presses of the others"
        )
    return splits, sentences


def _shares(clusters: PressClusters, cfg: Preset, seed: int, usable: np.ndarray) -> PressSplit:
    """A split that tests on a share of the presses at random, and on another in whole clusters."""
    held, together = share_masks(clusters.of_press, cfg, seed)
    tests = {RANDOM: np.flatnonzero(held & usable)}
    if clusters.number > 1:
        tests[clusters.plural()] = np.flatnonzero(together & usable)
    return PressSplit(tests, np.flatnonzero(~held & ~together & usable))


def share_masks(cluster: np.ndarray, cfg: Preset, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Masks of random presses and of whole clusters that no method sees.

    Args:
        cluster: (n,) cluster of each press, below 0 where it has none. A single cluster is never held out.
        cfg: The preset, which has the number of random presses, of which at most a quarter of n is taken, and the
            share of clusters.
        seed: Seed of the random choices.

    Returns:
        Two masks (n,). Whole clusters hold at most half of the presses.
    """
    rng, presses, count = np.random.default_rng(seed), len(cluster), int(cluster.max()) + 1
    held, together = np.zeros(presses, bool), np.zeros(presses, bool)
    held[rng.permutation(presses)[: min(cfg.held_out_presses, presses // 4)]] = True
    if count == 1:
        return held, together
    for number in rng.permutation(count)[: max(round(cfg.block_share * count), 1)]:
        own = cluster == number
        if (together | own).sum() <= LARGEST_CLUSTER_SHARE * presses:
            together |= own
    return held, together


def _about_clusters(clusters: PressClusters) -> list[str]:
    """What few clusters, or clusters near each other, cannot show."""
    count, sentences = clusters.number, []
    if count > 1 and clusters.name == PLACE:
        sentences.append("most presses lie in one block, so nothing is said about places farther from them")
    if count < MIN_CLUSTERS:
        lie = f"presses lie in {count} {clusters.plural(count)}"
        sentences.append(f"there is no interval: {lie}, and {MIN_CLUSTERS} are needed")
    return sentences
