"""Output of `experiments.recognize`: saved episodes, scores over pads with intervals, tables and figures."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from experiments.common.cells import AVERAGE_SUFFIX
from experiments.common.intervals import clusters_needed
from experiments.common.runs import Part, write_json
from experiments.common.tables import cell, text_table
from experiments.recognize import figures
from i2t import viz
from i2t.dataset import holds_simulated
from i2t.errors import printable
from i2t.intervals import MIN_CLUSTERS, Estimate, cluster_interval, estimate_at, rate_interval, rows_of
from i2t.objects.solids import Mesh
from i2t.recognition import calibrated, metrics
from i2t.recognition.belief import TouchObservation
from i2t.recognition.calibrated import POSTERIOR_TEMPERATURE, TemperatureScaling
from i2t.recognition.episodes import EVIDENCE_WEIGHTS, Episodes
from i2t.recognition.metrics import to_json
from i2t.recognition.paper_rules import PROPRIOCEPTION
from i2t.types import Board

IMAGINE2TOUCH = {
    "Imagine2touch (paper's network, mask)": "paper's network, mask",
    "Imagine2touch (paper's network, depth)": "paper's network, depth",
}  # networks of experiments.train, by their rows in tables
FORCE_NETWORKS = {row: name.replace("network", "network and measured force") for row, name in IMAGINE2TOUCH.items()}
RULES_GP, CONSTANT_READING = "same rules, Gaussian process", "same rules, constant reading"
MEDIAN_FORCE = " at the median force"  # suffix of a row with the median force of the training touches
PAPER_SETS = ("primitives", "tools")
PUBLISHED_I2T = {"primitives": 0.50, "tools": 0.70, "mean": 0.58}  # accuracies in the paper, by votes
PUBLISHED_PROPRIOCEPTION = {"primitives": 0.23, "tools": 0.80, "mean": 0.46}
REQUESTED_ERRORS = (0.01, 0.05, 0.10)  # error probabilities of the stopping rule
# Pairs of rows that differ only by the measured force, or only by the model.
SAME_INPUT_PAIRS = (
    *((FORCE_NETWORKS[row], row) for row in IMAGINE2TOUCH),
    (RULES_GP, RULES_GP + MEDIAN_FORCE),
    *((RULES_GP + MEDIAN_FORCE, row) for row in IMAGINE2TOUCH),
    *((RULES_GP, row) for row in FORCE_NETWORKS.values()),
)
COMPARED_PAIRS = (
    *((f"{row}, votes", f"{PROPRIOCEPTION}, votes") for row in (*IMAGINE2TOUCH, RULES_GP, CONSTANT_READING)),
    *((f"{row}, product", f"{PROPRIOCEPTION}, product") for row in (*IMAGINE2TOUCH, RULES_GP)),
    *((f"{row}, votes", f"{CONSTANT_READING}, votes") for row in (*IMAGINE2TOUCH, RULES_GP)),
    *((f"{a}, {rule}", f"{b}, {rule}") for rule in ("votes", "product") for a, b in SAME_INPUT_PAIRS),
    ("fused", "readings"),
    ("fused", "readings and position"),
    ("fused", "readings and presence"),
    ("fused", "position and presence"),
    ("readings and presence", "presence"),
    ("fused", f"{RULES_GP}, product"),
    ("fused, oracle", "fused"),
    ("readings and presence, oracle", "readings and presence"),
)


class EpisodeResults(NamedTuple):
    """Episodes with one set of objects, and the beliefs of each method after each touch."""

    names: tuple[str, ...]
    truth: np.ndarray  # (e,)
    beliefs: dict[str, np.ndarray]  # (e, t, objects) by method
    episodes: Episodes | None  # None if every method had its own
    pad: str = ""  # name of the pad
    pool: np.ndarray = np.zeros(0, str)  # (e,) name of each episode's pool of sites, whose episodes are not independent


Results = dict[str, EpisodeResults]  # of one pad and seed, by set of objects

# --- on disk ---


def to_part(results: Results) -> Part:
    """Convert all sets of a seed to nested dicts of arrays."""
    part: Part = {"about": json.dumps({name: episodes.names for name, episodes in results.items()})}
    for name, (_, truth, beliefs, episodes, pad, pool) in results.items():
        kept = {method: p.astype(np.float32) for method, p in beliefs.items()}
        part[name] = {"truth": truth, "beliefs": kept, "pad": pad, "pool": pool}
        if episodes is not None:
            part[name] |= episodes._asdict() | {"observations": episodes.observations._asdict()}
    return part


def from_part(part: Part) -> Results:
    """Invert `to_part`."""
    results = {}
    for name, names in json.loads(str(part["about"])).items():
        saved, episodes = part[name], None
        if "observations" in saved:
            observations = TouchObservation(**saved["observations"])
            episodes = Episodes(saved["truth"], saved["site"], observations, saved["T_w_t"])
        results[name] = EpisodeResults(
            tuple(names), saved["truth"], saved["beliefs"], episodes, str(saved["pad"]), saved["pool"]
        )
    return results


# --- episodes over all pads and seeds ---


class PooledEpisodes(NamedTuple):
    """Episodes with one set of objects over all pads and seeds."""

    names: tuple[str, ...]
    truth: np.ndarray  # (e,)
    beliefs: dict[str, np.ndarray]  # (e, t, objects) by method, float64
    pad: np.ndarray  # (e,) names
    pool: np.ndarray  # (e,) names

    def clusters(self, *more: np.ndarray) -> list[np.ndarray]:
        """Cluster the episodes by pad, by pool of sites, and by more labels (e,), such as the true object. Without the
        latter, intervals are for these objects only.
        """
        return [np.unique(label, return_inverse=True)[1] for label in (self.pad, self.pool, *more)]


def pool_set(parts: Sequence[Results], name: str) -> PooledEpisodes:
    """Join the episodes of a set over all pads and seeds."""
    sets = [part[name] for part in parts]
    truth, pool = (np.concatenate([getattr(part, field) for part in sets]) for field in ("truth", "pool"))
    beliefs = {
        method: np.concatenate([part.beliefs[method] for part in sets]).astype(np.float64) for method in sets[0].beliefs
    }
    pad = np.repeat([part.pad for part in sets], [len(part.truth) for part in sets])
    return PooledEpisodes(sets[0].names, truth, beliefs, pad, pool)


def pads_of(parts: Sequence[Results], pools: str = "pools of sites") -> dict[str, Any]:
    """Describe the pads, the number of runs, and the clusters of intervals."""
    pads = sorted({results.pad for part in parts for results in part.values()})
    several = f"over pads and {pools}, for these objects"
    few = f"over {pools}, for {'this pad' if len(pads) == 1 else 'these pads'} and these objects"
    intervals = f"95 %, {several if len(pads) >= MIN_CLUSTERS else few}"
    return {"pads": pads, "runs": len(parts), "pools": pools, "intervals": intervals}


# --- calibration ---


def calibrate(parts: Sequence[Results]) -> tuple[list[Results], dict[str, TemperatureScaling]]:
    """Scale beliefs by temperatures. Returns the beliefs and the temperature of each method.

    Temperatures are fitted to the validation objects of all pads. Without validation objects, all methods have that of
    the fused belief (`POSTERIOR_TEMPERATURE`). The paper's rules are not scaled.
    """
    methods = [method for method in next(iter(parts[0].values())).beliefs if method.split(", ")[0] in EVIDENCE_WEIGHTS]
    temperatures = dict.fromkeys(methods, POSTERIOR_TEMPERATURE)
    if "validation" in parts[0]:
        validation = pool_set(parts, "validation")
        temperatures = {m: calibrated.fit_temperature(validation.beliefs[m], validation.truth) for m in methods}
    scaled = [{name: _scaled(results, temperatures) for name, results in part.items()} for part in parts]
    return scaled, temperatures


def _scaled(results: EpisodeResults, temperatures: Mapping[str, TemperatureScaling]) -> EpisodeResults:
    scaled = {
        method: calibrated.calibrated_beliefs(results.beliefs[method], temperature)
        for method, temperature in temperatures.items()
    }
    return results._replace(beliefs=results.beliefs | scaled)


# --- scores ---


def summarise(
    parts: Sequence[Results], out: Path, source: str, pools: str = "pools of sites", **about: Any
) -> dict[str, Any]:
    """Score every set over all pads, and write metrics.json, including `about`, and figures."""
    sets = {name: pool_set(parts, name) for name in parts[0]}
    scores = {name: score_set(episodes) for name, episodes in sets.items()}
    for name, entry in scores.items():
        played = [part[name].episodes for part in parts]
        contacts = [np.mean(episodes.observations.contact) for episodes in played if episodes is not None]
        if contacts:
            entry["air"] = float(1 - np.mean(contacts))
    summary = {"source": source, **pads_of(parts, pools), **about, "sets": scores}
    write_json(out / "metrics.json", summary)
    for name, episodes in sets.items():
        write_figures(name, episodes, out, holds_simulated(source))
    return summary


def score_set(episodes: PooledEpisodes) -> dict[str, Any]:
    """Score every method on one set of objects."""
    return {
        "objects": list(episodes.names),
        "episodes": len(episodes.truth),
        "pools": len(np.unique(episodes.pool)),
        "methods": {method: score_method(episodes, method) for method in episodes.beliefs},
        "paired": compare_methods(episodes),
    }


def score_method(episodes: PooledEpisodes, method: str) -> dict[str, Any]:
    """Score a method on a set. Early stopping is scored only for methods whose beliefs are probabilities."""
    p, truth, clusters = episodes.beliefs[method], episodes.truth, episodes.clusters()
    confidence, hit = metrics.confidence(p), metrics.hits(p, truth)
    errors = [metrics.calibration_error(confidence[:, t], hit[:, t], 10) for t in range(p.shape[1])]
    scores = {
        "accuracy": to_json(metrics.accuracy(p, truth, clusters=clusters)),
        "mean": to_json(metrics.mean_accuracy(p, truth, clusters=clusters)),
        # For other objects, of which these are a sample. The interval is wide, because there are few objects.
        "last_other_objects": to_json(rate_interval(hit[:, -1], episodes.clusters(truth))),
        "by_object": score_objects(episodes.names, hit, truth, clusters),
        "calibration_error": [error.error for error in errors],
        "calibration_error_by_chance": [error.chance for error in errors],
        "log_loss": metrics.log_loss(p, truth).mean(0).tolist(),
        "confusion": metrics.confusion(p[:, -1], truth).tolist(),
    }
    if method.split(", ")[0] in EVIDENCE_WEIGHTS:
        stops = [metrics.stopping(p, truth, error, clusters=clusters) for error in REQUESTED_ERRORS]
        scores["stopping"] = [to_json(stop) for stop in stops]
    return scores


def score_objects(
    names: Sequence[str], hit: np.ndarray, truth: np.ndarray, clusters: Sequence[np.ndarray]
) -> dict[str, Any]:
    """Compute the recognition rate of each object after the last touch and averaged over touches."""
    rates = {}
    for i, name in enumerate(names):
        rows = truth == i
        both = rate_interval(np.stack([hit[rows, -1], hit[rows].mean(1)], 1), rows_of(clusters, rows))
        rates[name] = {"last": to_json(estimate_at(both, 0)), "mean": to_json(estimate_at(both, 1))}
    return rates


def compare_methods(episodes: PooledEpisodes, wanted_half_width: float = 0.03) -> dict[str, Any]:
    """Compute differences between methods on the same episodes, and the number of pads that would narrow the interval
    after the last touch to the wanted half width.
    """
    differences: dict[str, Any] = {}
    for pair in COMPARED_PAIRS:
        if set(pair) <= set(episodes.beliefs) and len(episodes.truth) > 1:
            hits = [metrics.hits(episodes.beliefs[method], episodes.truth) for method in pair]
            difference = metrics.compare_paired(*hits, clusters=episodes.clusters())
            half = float(difference.last.high - difference.last.mean)
            needed = clusters_needed(half, len(np.unique(episodes.pad)), wanted_half_width)
            differences[" - ".join(pair)] = to_json(difference) | {"pads_needed": needed}
    return differences


def mean_over_objects(parts: Sequence[Results]) -> dict[str, Any]:
    """Compute the accuracy after the last touch over all objects of the paper's sets, each distinguished from the
    others of its set, which is the paper's last column, and paired differences. Sets of one pad share the pad only. The
    result is empty for other objects.
    """
    if not set(PAPER_SETS) <= set(parts[0]):
        return {}
    sets = [pool_set(parts, name) for name in PAPER_SETS]
    weight = np.concatenate([np.full(len(part.truth), len(part.names) / len(part.truth)) for part in sets])
    clusters = [np.concatenate([part.pad for part in sets]), np.concatenate([part.pool for part in sets])]
    hits = {
        method: np.concatenate([metrics.hits(part.beliefs[method], part.truth)[:, -1] for part in sets])
        for method in sets[0].beliefs
    }
    pairs = {f"{a} - {b}": hits[a] - hits[b] for a, b in COMPARED_PAIRS if {a, b} <= set(hits)}

    def mean(values: np.ndarray) -> dict[str, Any]:
        # Linearised about the mean, so that its variance is at least that of independent episodes.
        centre = np.average(values, weights=weight)
        deviation = cluster_interval((values - centre) * weight / weight.mean(), clusters)
        return to_json(Estimate(*(part + centre for part in deviation)))

    means, differences = ({name: mean(values) for name, values in table.items()} for table in (hits, pairs))
    return {"mean of the sets": means, "differences of these means": differences}


# --- tables ---


def print_tables(summary: dict[str, Any]) -> None:
    """Print the accuracy of every method on every set and object, and differences between methods."""
    for name, entry in summary["sets"].items():
        touches = len(next(iter(entry["methods"].values()))["log_loss"])
        columns = sorted({1, min(3, touches), min(5, touches), touches})
        air = f", {100 * entry['air']:.0f} % of touches in air" if "air" in entry else ""
        print(
            f"\n{printable(name)} ({summary['source']}): {', '.join(map(printable, entry['objects']))}; "
            f"{entry['episodes']} episodes, {entry['pools']} {summary['pools']}, {len(summary['pads'])} pads{air}; "
            f"intervals {summary['intervals']}"
        )
        rows = []
        for method, values in entry["methods"].items():
            if method.endswith(AVERAGE_SUFFIX):  # a rule between votes and product
                continue
            published, accuracy = published_accuracy(name, method), values["accuracy"]
            cells = [cell({part: limits[t - 1] for part, limits in accuracy.items()}) for t in columns]
            means = [f"{np.mean(values[score]):.3f}" for score in ("calibration_error", "log_loss")]
            rows.append([method, *cells, cell(values["mean"]), *means, _paper(published)])
        head = ["method", *(f"after {t}" for t in columns), "mean of all", "ECE", "NLL", ""]
        print(text_table(head, rows))
        print_objects(entry, touches)
        for pair, values in entry["paired"].items():
            pads = f"; {values['pads_needed']} pads would resolve 3 points" if values["pads_needed"] else ""
            last, mean = (cell(values[score], signed=True) for score in ("last", "mean"))
            print(f"  {pair}: after {touches} {last}, mean {mean}{pads}")


def published_accuracy(name: str, method: str) -> float | None:
    """Look up the paper's accuracy after ten touches, if the row is one of its methods."""
    source, _, rule = method.rpartition(", ")
    if rule != "votes":
        return None
    if source in IMAGINE2TOUCH:
        return PUBLISHED_I2T.get(name)
    return PUBLISHED_PROPRIOCEPTION.get(name) if source == PROPRIOCEPTION else None


def print_objects(entry: dict[str, Any], touches: int) -> None:
    """Print the rate at which each object is recognised."""
    rows = (
        [method, *(cell(values["by_object"][name]["last"]) for name in entry["objects"])]
        for method, values in entry["methods"].items()
        if method.endswith(("fused", "readings", "presence", "votes", "product"))
    )
    print(text_table([f"after {touches}, by true object", *entry["objects"]], rows, "  "))


def print_mean_over_objects(summary: dict[str, Any]) -> None:
    """Print the paper's last column, if the paper's sets were used."""
    if "mean of the sets" not in summary:
        return
    rows = (
        [method, cell(estimate), _paper(published_accuracy("mean", method))]
        for method, estimate in summary["mean of the sets"].items()
        if not method.endswith(AVERAGE_SUFFIX)
    )
    print(f"\nall objects of {' and '.join(PAPER_SETS)}, each distinguished from the others of its set:")
    print(text_table(["method", "after the last touch", ""], rows))
    for pair, estimate in summary["differences of these means"].items():
        print(f"  {pair}: {cell(estimate, signed=True)}")


def print_stopping(summary: dict[str, Any]) -> None:
    """Print the scores of early stopping with the fused belief."""
    entry = summary["sets"].get("all", next(iter(summary["sets"].values())))
    for stop in entry["methods"]["fused"]["stopping"]:
        print(
            f"stopping at an error of {stop['requested_error']:.0%}: error {cell(stop['error'])}, predicted "
            f"{stop['predicted_error']:.3f}, after {stop['touches']['mean']:.1f} touches; among the "
            f"{stop['stopped']['mean']:.0%} that stopped early, error {cell(stop['stopped_error'])}, predicted "
            f"{stop['stopped_predicted_error']:.3f}"
        )


def _paper(published: float | None) -> str:
    return f"paper: {published:.2f}" if published else ""


# --- figures ---


def report_hardest_episode(
    results: EpisodeResults, meshes: Sequence[Mesh], out: Path, source: str, board: Board
) -> None:
    """Report the correct episode whose true object had the lowest posterior after one touch."""
    assert results.episodes is not None
    p = results.beliefs["fused"].astype(np.float64)
    first = p[np.arange(len(p)), 0, results.truth]
    right = p[:, -1].argmax(-1) == results.truth
    episode = int(np.argmin(np.where(right, first, 1 + first)))
    record = viz.EpisodeRecord(
        meshes, results.names, results.episodes.T_w_t[episode],
        np.asarray(results.episodes.observations.reading)[episode], board, p[episode], int(results.truth[episode]),
        holds_simulated(source),
    )  # fmt: skip
    viz.write_episode_report(record, out)


def write_figures(name: str, episodes: PooledEpisodes, out: Path, simulated: bool) -> None:
    """Draw accuracy and confusion of a set."""
    shown = {
        method: metrics.accuracy(p, episodes.truth, clusters=episodes.clusters())
        for method, p in episodes.beliefs.items()
        if method in EVIDENCE_WEIGHTS or method.endswith(", votes")
    }
    viz.save_figure(figures.accuracy(shown, f"Accuracy, {name}", simulated), out / f"accuracy_{name}.png")
    if "fused" in episodes.beliefs:
        counts = {"fused": metrics.confusion(episodes.beliefs["fused"][:, -1], episodes.truth)}
        figure = viz.plot_confusions(counts, episodes.names, f"Confusion, {name}", simulated)
        viz.save_figure(figure, out / f"confusion_{name}.png")
