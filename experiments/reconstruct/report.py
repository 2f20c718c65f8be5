"""Numbers of a run, with intervals over objects and pads, and the table that the documents show."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from experiments.common.intervals import with_interval
from experiments.reconstruct.arguments import ReconstructSizes
from experiments.reconstruct.episodes import Episode, Explorer, reported
from experiments.reconstruct.scores import SCORES
from i2t.recognition.intervals import bootstrap_clusters, mean_interval

Episodes = dict[str, dict[tuple[int, int], Episode]]
GAP_TOUCHES = 5  # after which a policy's share of the gap between random and oracle is reported


def summarize(episodes: Episodes, explorer: Explorer, sizes: ReconstructSizes) -> dict[str, Any]:
    """Scores of every condition after 0, 1, 5, 10 and 20 touches."""
    numbers = sorted({number for number, _ in next(iter(episodes.values()))})
    floors = [explorer.shapes[number].floor_mm for number in numbers]
    return {
        "source": "simulated",
        "episodes_of_each_condition": len(next(iter(episodes.values()))),
        "test_objects": len(numbers),
        "pads": sizes.pads,
        "grid_floor_mm": float(np.mean(floors)),
        "conditions": {name: _condition(found, sizes) for name, found in episodes.items()},
        "share_of_gap": _shares(episodes, sizes),
    }


def _condition(found: dict[tuple[int, int], Episode], sizes: ReconstructSizes) -> dict[str, Any]:
    counts = sorted({count for each in found.values() for count in each.scores})
    return {
        "stopped": sum(each.stopped for each in found.values()),
        "hits": float(np.mean([np.mean([touch.hit for touch in each.state.touches]) for each in found.values()])),
        "after": {str(count): _after(found, count, sizes) for count in counts},
    }


def _after(found: dict[tuple[int, int], Episode], count: int, sizes: ReconstructSizes) -> dict[str, list[float]]:
    """Means with 95 % intervals over objects and pads; ratios are of means."""
    kept = {key: each for key, each in found.items() if count in each.scores}
    clusters = _clusters(list(kept), sizes)
    values = {name: np.array([each.scores[count][name] for each in kept.values()]) for name in SCORES}
    start = np.array([each.scores[0]["chamfer_mm"] for each in kept.values()])
    rows = {
        name: _triple(mean_interval(value, clusters)) for name, value in values.items() if not np.isnan(value).any()
    }
    rows["ratio"] = _ratio(values["chamfer_mm"], start, clusters)
    if "hidden_mm" in rows:
        before = np.array([each.scores[0]["hidden_mm"] for each in kept.values()])
        rows["hidden_ratio"] = _ratio(values["hidden_mm"], before, clusters)
    return rows


def _clusters(keys: Sequence[tuple[int, int]], sizes: ReconstructSizes) -> list[np.ndarray]:
    """Object and pad of each episode."""
    return [np.array([number for number, _ in keys]), np.array([sum(key) % sizes.pads for key in keys])]


def _ratio(above: np.ndarray, below: np.ndarray, clusters: Sequence[np.ndarray]) -> list[float]:
    """A ratio of means with its interval."""

    def of(weights: np.ndarray) -> np.ndarray:
        return (weights @ above) / (weights @ below)

    return _triple(bootstrap_clusters(of, clusters, len(above)))


def _shares(episodes: Episodes, sizes: ReconstructSizes) -> dict[str, list[float]]:
    """Share of the way from random to the greedy oracle that each policy goes, after the same touches."""
    touches = min(GAP_TOUCHES, sizes.oracle_touches, sizes.touches)
    if not {"random", "oracle"} <= episodes.keys() or touches not in reported(sizes.touches):
        return {}
    keys = list(episodes["random"])

    def distances(name: str) -> np.ndarray:
        return np.array([_last(episodes[name][key], touches) for key in keys])

    random, oracle = distances("random"), distances("oracle")
    clusters = _clusters(keys, sizes)
    shares: dict[str, list[float]] = {}
    for name in ("even", "uncertainty", "reduction"):
        if name in episodes:
            shares[name] = _ratio(random - distances(name), random - oracle, clusters)
    return shares


def _last(episode: Episode, touches: int) -> float:
    """Distance after so many touches, or after the last before an episode stopped."""
    return episode.scores[max(count for count in episode.scores if count <= touches)]["chamfer_mm"]


def _triple(estimate: Any) -> list[float]:
    return [float(estimate.mean), float(estimate.low), float(estimate.high)]


def table(report: dict[str, Any]) -> str:
    """The scores in Markdown."""
    counts = sorted({int(c) for found in report["conditions"].values() for c in found["after"]} - {0})
    heads = " | ".join(f"{count} touch{'es' if count > 1 else ''}" for count in counts)
    lines = [
        f"| condition | start, mm | {heads} | IoU | F-score | in the 90 % band | band, mm |",
        "| --- " * (len(counts) + 6) + "|",
    ]
    for name, found in report["conditions"].items():
        after = found["after"]
        ratios = [_cell(after[str(c)]["ratio"]) if str(c) in after else "" for c in counts]
        last = after[max(after, key=int)]
        ends = [f"{last[score][0]:.2f}" for score in ("iou", "f_score", "coverage")] + [f"{last['band_mm'][0]:.1f}"]
        lines.append(f"| {name} | {after['0']['chamfer_mm'][0]:.2f} | {' | '.join(ratios)} | {' | '.join(ends)} |")
    for name, share in report["share_of_gap"].items():
        lines.append(f"\n{name}: share of the gap between random and the greedy oracle {_cell(share)}")
    view = report["conditions"].get("one view first")
    if view:
        hidden = [
            f"{_cell(view['after'][str(c)]['hidden_ratio'])} after {c}"
            for c in counts
            if "hidden_ratio" in view["after"].get(str(c), {})
        ]
        lines.append(f"\nhidden surface after one view, error over that of the view alone: {', '.join(hidden)}")
    lines.append(f"\ngrid floor: {report['grid_floor_mm']:.2f} mm")
    return "\n".join(lines)


def _cell(triple: list[float]) -> str:
    return with_interval(*triple, digits=2)
