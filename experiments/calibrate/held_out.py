"""Selection of held-out presses.

Of many presses, one share is held out at random and another in whole blocks. Of few presses, each is predicted from all
others (leave-one-out), and each block or place with several presses from all other blocks or places. Errors within a
block or place are not independent, so intervals are over blocks or places.
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


class PressSplit(NamedTuple):
    """Rows of a recording for training and for tests."""

    tests: dict[str, np.ndarray]  # rows of each test by name
    pool: np.ndarray  # rows from which training presses are drawn


class PressClusters(NamedTuple):
    """Clusters of neighbouring presses. A single cluster means that none can be held out."""

    name: str  # what one cluster is called
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
    """Training and test presses, with sentences that explain how they were chosen."""

    splits: tuple[PressSplit, ...]
    in_turn: bool  # each press is predicted once, from all others
    clusters: PressClusters  # intervals are over these
    sentences: tuple[str, ...]  # for the user

    @property
    def tests(self) -> dict[str, np.ndarray]:
        """Rows of each test, over all splits."""
        names = dict.fromkeys(name for split in self.splits for name in split.tests)
        return {name: np.concatenate([s.tests[name] for s in self.splits if name in s.tests]) for name in names}


def hold_out(recording: LoadedPresses, cfg: Preset, seed: int, usable: np.ndarray, source: str) -> HeldOut:
    """Choose the presses to hold out by their number and places.

    Args:
        recording: The n presses.
        cfg: Size of a block and the shares to hold out.
        seed: Seed of the random choices.
        usable: Mask `(n,)` of the presses to use for training and tests.
        source: Name of the recording, for messages.

    Returns:
        The splits, and sentences that explain them and their limits.

    Raises:
        ValueError: There are too few presses, or neither their places nor their loads vary.
    """
    rows = np.flatnonzero(usable)
    if len(rows) < cfg.min_presses:
        raise ValueError(
            f"{source} has {len(rows)} usable presses, too few to predict each from the others; {cfg.min_presses} are "
            "enough for that, and some 20 all over the skin for a calibration"
        )
    position_mm = 1e3 * recording.position[rows]
    clusters = _clusters_of(position_mm, cfg)
    if clusters.number == 1 and not np.ptp(recording.load[rows]) and not np.ptp(position_mm, axis=0).any():
        raise ValueError(
            f"all {len(rows)} presses of {source} have one place and one {recording.load_kind}, so they cannot predict "
            "other presses; press at other places, about twenty in all"
        )
    of_press = np.full(len(usable), -1)
    of_press[rows] = clusters.of_press
    all_clusters, in_turn = clusters._replace(of_press=of_press), len(rows) < cfg.min_shared_presses
    if in_turn:
        splits, sentences = _in_turn(rows, clusters, cfg.min_shared_presses)
    else:
        splits, sentences = [_shares(all_clusters, cfg, seed, usable)], []
    if clusters.number == 1:
        sentences.append(_about_one_place(position_mm, recording.load_kind))
    return HeldOut(tuple(splits), in_turn, all_clusters, (*sentences, *_about_clusters(clusters)))


def _clusters_of(position_mm: np.ndarray, cfg: Preset) -> PressClusters:
    """Cluster presses at positions (n, 2) by square blocks, or by places if a block holds too many presses, or as a
    single cluster if a place does.
    """
    most = cfg.max_cluster_share * len(position_mm)
    blocks = square_blocks(position_mm, cfg.block_mm)
    if np.bincount(blocks).max() <= most:
        return PressClusters(f"block of {cfg.block_mm:g} mm", blocks)
    places = same_places(position_mm / 1e3)
    return PressClusters(PLACE, places if np.bincount(places).max() <= most else np.zeros_like(places))


def _about_one_place(position_mm: np.ndarray, load_kind: str) -> str:
    """State that the figures do not apply to other places, because most presses at positions (n, 2) share one place."""
    n = len(position_mm)
    close = np.linalg.norm(position_mm - np.median(position_mm, axis=0), axis=1) <= 1e3 * SAME_PLACE_M
    share = f"all {n} presses" if close.all() else f"more than half of the {n} presses"
    return (
        f"{share} are at one place, so places cannot be left out: the figures apply to other {load_kind}s at this "
        "place, not to other places"
    )


def _in_turn(rows: np.ndarray, clusters: PressClusters, min_shared: int) -> tuple[list[PressSplit], list[str]]:
    """Predict each press from all others, and each cluster of several presses from all other clusters."""
    n, sizes = len(rows), np.bincount(clusters.of_press)
    splits = [PressSplit({EACH_PRESS: rows[[i]]}, np.delete(rows, i)) for i in range(n)]
    sentences = [
        f"{n} presses are fewer than {min_shared}, too few to hold a share of them out: each press is left out "
        f"in turn and predicted from the {n - 1} others"
    ]
    if sizes.max() == 1:
        sentences.append(f"each press has a {clusters.name} to itself, so its place is left out with it")
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
    """Hold out a share of the presses at random, and another in whole clusters."""
    held, together = share_masks(clusters.of_press, cfg, seed)
    tests = {RANDOM: np.flatnonzero(held & usable)}
    if clusters.number > 1:
        tests[clusters.plural()] = np.flatnonzero(together & usable)
    return PressSplit(tests, np.flatnonzero(~held & ~together & usable))


def share_masks(cluster: np.ndarray, cfg: Preset, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Choose random presses and whole clusters to hold out.

    Args:
        cluster: Cluster of each press, `(n,)`; below 0 for a press without one. A single cluster is never held out.
        cfg: Number of random presses, which is limited to a quarter of n, and share of clusters.
        seed: Seed of the random choices.

    Returns:
        Masks `(n,)` of the random presses and of the whole clusters.
    """
    rng, presses, count = np.random.default_rng(seed), len(cluster), int(cluster.max()) + 1
    held, together = np.zeros(presses, bool), np.zeros(presses, bool)
    held[rng.permutation(presses)[: min(cfg.held_out_presses, presses // 4)]] = True
    if count == 1:
        return held, together
    for number in rng.permutation(count)[: max(round(cfg.block_share * count), 1)]:
        own = cluster == number
        if (together | own).sum() <= cfg.max_cluster_share * presses:
            together |= own
    return held, together


def _about_clusters(clusters: PressClusters) -> list[str]:
    """State the limits of the figures if clusters are few or near each other."""
    count, sentences = clusters.number, []
    if count > 1 and clusters.name == PLACE:
        sentences.append("most presses are in one block, so the figures do not apply to places farther away")
    if count < MIN_CLUSTERS:
        presses = f"presses are in {count} {clusters.plural(count)}"
        sentences.append(f"there is no interval: {presses}, and {MIN_CLUSTERS} are needed")
    return sentences
