"""Output of `experiments.recognize`: episodes on disk, scores over pads with intervals, tables, figures."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

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
from i2t.recognition.calibrated import TEMPERATURE_SCALING, TemperatureScaling
from i2t.recognition.episodes import EVIDENCE, Episodes
from i2t.recognition.metrics import to_json
from i2t.recognition.paper_rules import PROPRIOCEPTION
from i2t.types import Board

IMAGINE2TOUCH = {
    "Imagine2touch (paper's network, mask)": "paper's network, mask",
    "Imagine2touch (paper's network, depth)": "paper's network, depth",
}  # networks of experiments.train, by the rows that they make
WITH_FORCE = {row: name.replace("network", "network and measured force") for row, name in IMAGINE2TOUCH.items()}
RULES_GP, CONSTANT = "same rules, Gaussian process", "same rules, constant reading"
MEDIAN_FORCE = " at the median force"  # of the training touches, in place of each touch's: ends the row's name
PAPER_SETS = ("primitives", "tools")
PUBLISHED_I2T = {"primitives": 0.50, "tools": 0.70, "mean": 0.58}  # the paper's accuracies, by votes
PUBLISHED_PROPRIOCEPTION = {"primitives": 0.23, "tools": 0.80, "mean": 0.46}
REQUESTED_ERRORS = (0.01, 0.05, 0.10)  # of the stopping rule
NUM_BINS = 10  # of a calibration error
WANTED_HALF_WIDTH = 0.03  # of the interval of a difference after the last touch, for which pads are counted
# What the measured force is worth to the network and to the GP, and what the GP is worth with it and without.
FAIR = (
    *((WITH_FORCE[row], row) for row in IMAGINE2TOUCH),
    (RULES_GP, RULES_GP + MEDIAN_FORCE),
    *((RULES_GP + MEDIAN_FORCE, row) for row in IMAGINE2TOUCH),
    *((RULES_GP, row) for row in WITH_FORCE.values()),
)
COMPARED = (
    *((f"{row}, votes", f"{PROPRIOCEPTION}, votes") for row in (*IMAGINE2TOUCH, RULES_GP, CONSTANT)),
    *((f"{row}, product", f"{PROPRIOCEPTION}, product") for row in (*IMAGINE2TOUCH, RULES_GP)),
    *((f"{row}, votes", f"{CONSTANT}, votes") for row in (*IMAGINE2TOUCH, RULES_GP)),
    *((f"{one}, {rule}", f"{other}, {rule}") for rule in ("votes", "product") for one, other in FAIR),
    ("fused", "readings"),
    ("fused", "readings and position"),
    ("fused", "readings and presence"),
    ("fused", "position and presence"),
    ("readings and presence", "presence"),
    ("fused", f"{RULES_GP}, product"),
    ("fused, oracle", "fused"),
    ("readings and presence, oracle", "readings and presence"),
)
UNPRINTED = ", average"  # a rule between the other two; its scores are in metrics.json
SHOWN_BY_OBJECT = ("fused", "readings", "presence", "votes", "product")  # ends of methods' names


class EpisodeResults(NamedTuple):
    """Episodes with one set of objects and what each method believed after each touch."""

    names: tuple[str, ...]
    truth: np.ndarray  # (e,)
    beliefs: dict[str, np.ndarray]  # (e, t, objects) by method
    episodes: Episodes | None  # None where every method had its own
    pad: str = ""  # that touched
    pool: np.ndarray = np.zeros(0, str)  # (e,) names of the pools of sites: episodes of one are alike


Results = dict[str, EpisodeResults]  # of one pad and seed, by set of objects

# --- on disk ---


def to_part(results: Results) -> Part:
    """All sets of a seed as nested dicts of arrays."""
    part: Part = {"about": json.dumps({name: each.names for name, each in results.items()})}
    for name, (_, truth, beliefs, episodes, pad, pool) in results.items():
        kept = {method: p.astype(np.float32) for method, p in beliefs.items()}
        part[name] = {"truth": truth, "beliefs": kept, "pad": pad, "pool": pool}
        if episodes is not None:
            part[name] |= episodes._asdict() | {"observations": episodes.observations._asdict()}
    return part


def from_part(part: Part) -> Results:
    """What `to_part` was given."""
    results = {}
    for name, names in json.loads(str(part["about"])).items():
        found, episodes = part[name], None
        if "observations" in found:
            observations = TouchObservation(**found["observations"])
            episodes = Episodes(found["truth"], found["site"], observations, found["T_w_t"])
        results[name] = EpisodeResults(
            tuple(names), found["truth"], found["beliefs"], episodes, str(found["pad"]), found["pool"]
        )
    return results


# --- what episodes have in common ---


class PooledEpisodes(NamedTuple):
    """Episodes with one set of objects over all pads and seeds."""

    names: tuple[str, ...]
    truth: np.ndarray  # (e,)
    beliefs: dict[str, np.ndarray]  # (e, t, objects) by method, float64
    pad: np.ndarray  # (e,) names
    pool: np.ndarray  # (e,) names

    def clusters(self, *more: np.ndarray) -> list[np.ndarray]:
        """Clusters of the episodes: by pad, by pool of sites, and by more labels (e,), such as the object that was
        there. Without that one intervals are for these very objects.
        """
        return [np.unique(label, return_inverse=True)[1] for label in (self.pad, self.pool, *more)]


def pool_set(parts: Sequence[Results], name: str) -> PooledEpisodes:
    """The episodes of a set, over all pads and seeds."""
    sets = [part[name] for part in parts]
    truth, pool = (np.concatenate([getattr(each, field) for each in sets]) for field in ("truth", "pool"))
    beliefs = {
        method: np.concatenate([each.beliefs[method] for each in sets]).astype(np.float64) for method in sets[0].beliefs
    }
    pad = np.repeat([each.pad for each in sets], [len(each.truth) for each in sets])
    return PooledEpisodes(sets[0].names, truth, beliefs, pad, pool)


def pads_of(parts: Sequence[Results], pools: str = "pools of sites") -> dict[str, Any]:
    """The pads over which intervals are, the number of runs, and what the pools are called."""
    pads = sorted({each.pad for part in parts for each in part.values()})
    several = f"over pads and {pools}, for these objects"
    few = f"over {pools}, for {'this pad' if len(pads) == 1 else 'these pads'} and these objects"
    intervals = f"95 %, {several if len(pads) >= MIN_CLUSTERS else few}"
    return {"pads": pads, "runs": len(parts), "pools": pools, "intervals": intervals}


# --- calibration ---


def calibrate(parts: Sequence[Results]) -> tuple[list[Results], dict[str, TemperatureScaling]]:
    """Beliefs after temperature scaling, and the temperature of each method.

    Temperatures are fitted to the validation objects of all pads; without validation objects all have that of the
    fused belief (`TEMPERATURE_SCALING`). The paper's rules stay as they are.
    """
    methods = [method for method in next(iter(parts[0].values())).beliefs if method.split(", ")[0] in EVIDENCE]
    temperatures = dict.fromkeys(methods, TEMPERATURE_SCALING)
    if "validation" in parts[0]:
        known = pool_set(parts, "validation")
        temperatures = {m: calibrated.fit_temperature(known.beliefs[m], known.truth) for m in methods}
    return [{name: _scaled(each, temperatures) for name, each in part.items()} for part in parts], temperatures


def _scaled(results: EpisodeResults, temperatures: Mapping[str, TemperatureScaling]) -> EpisodeResults:
    found = {
        method: calibrated.calibrated_beliefs(results.beliefs[method], temperature)
        for method, temperature in temperatures.items()
    }
    return results._replace(beliefs=results.beliefs | found)


# --- scores ---


def summarise(
    parts: Sequence[Results], out: Path, source: str, pools: str = "pools of sites", **about: Any
) -> dict[str, Any]:
    """Scores of every set over all pads, and what else there is to say about them, written to metrics.json with figures
    next to it.
    """
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
    """Scores of every method on one set of objects."""
    return {
        "objects": list(episodes.names),
        "episodes": len(episodes.truth),
        "pools": len(np.unique(episodes.pool)),
        "methods": {method: score_method(episodes, method) for method in episodes.beliefs},
        "paired": compare_methods(episodes),
    }


def score_method(episodes: PooledEpisodes, method: str) -> dict[str, Any]:
    """All scores of a method on a set; those of deciding when sure only where beliefs are probabilities."""
    p, truth, clusters = episodes.beliefs[method], episodes.truth, episodes.clusters()
    confidence, hit = metrics.confidence(p), metrics.hits(p, truth)
    errors = [metrics.calibration_error(confidence[:, t], hit[:, t], NUM_BINS) for t in range(p.shape[1])]
    scores = {
        "accuracy": to_json(metrics.accuracy(p, truth, clusters=clusters)),
        "mean": to_json(metrics.mean_accuracy(p, truth, clusters=clusters)),
        # The same for other objects, of which these are a sample: wide, as there are few.
        "last_other_objects": to_json(rate_interval(hit[:, -1], episodes.clusters(truth))),
        "by_object": score_objects(episodes.names, hit, truth, clusters),
        "calibration_error": [error.error for error in errors],
        "calibration_error_by_chance": [error.chance for error in errors],
        "log_loss": metrics.log_loss(p, truth).mean(0).tolist(),
        "confusion": metrics.confusion(p[:, -1], truth).tolist(),
    }
    if method.split(", ")[0] in EVIDENCE:
        stops = [metrics.stopping(p, truth, error, clusters=clusters) for error in REQUESTED_ERRORS]
        scores["stopping"] = [to_json(stop) for stop in stops]
    return scores


def score_objects(
    names: Sequence[str], hit: np.ndarray, truth: np.ndarray, clusters: Sequence[np.ndarray]
) -> dict[str, Any]:
    """Rates at which each object is recognised when it is there, after the last touch and in the mean over touches."""
    found = {}
    for i, name in enumerate(names):
        rows = truth == i
        both = rate_interval(np.stack([hit[rows, -1], hit[rows].mean(1)], 1), rows_of(clusters, rows))
        found[name] = {"last": to_json(estimate_at(both, 0)), "mean": to_json(estimate_at(both, 1))}
    return found


def compare_methods(episodes: PooledEpisodes) -> dict[str, Any]:
    """Differences between methods on the same episodes; none of a single one."""
    found: dict[str, Any] = {}
    for one, other in COMPARED:
        if {one, other} <= set(episodes.beliefs) and len(episodes.truth) > 1:
            hits = [metrics.hits(episodes.beliefs[method], episodes.truth) for method in (one, other)]
            difference = metrics.compare_paired(*hits, clusters=episodes.clusters())
            half = float(difference.last.high - difference.last.mean)
            needed = clusters_needed(half, len(np.unique(episodes.pad)), WANTED_HALF_WIDTH)
            found[f"{one} - {other}"] = to_json(difference) | {"pads_needed": needed}
    return found


def mean_over_objects(parts: Sequence[Results]) -> dict[str, Any]:
    """Accuracy after the last touch over all objects of the paper's sets, each decided among those of its set: the
    paper's last column; and paired differences of it. Sets of one pad are independent but for the pad. Nothing where
    other objects were played.
    """
    if not set(PAPER_SETS) <= set(parts[0]):
        return {}
    sets = [pool_set(parts, name) for name in PAPER_SETS]
    weight = np.concatenate([np.full(len(each.truth), len(each.names) / len(each.truth)) for each in sets])
    clusters = [np.concatenate([each.pad for each in sets]), np.concatenate([each.pool for each in sets])]
    hits = {
        method: np.concatenate([metrics.hits(each.beliefs[method], each.truth)[:, -1] for each in sets])
        for method in sets[0].beliefs
    }
    pairs = {f"{one} - {other}": hits[one] - hits[other] for one, other in COMPARED if {one, other} <= set(hits)}

    def mean(values: np.ndarray) -> dict[str, Any]:
        # Linearised about the mean, so that its variance is at least that of independent episodes.
        about = np.average(values, weights=weight)
        found = cluster_interval((values - about) * weight / weight.mean(), clusters)
        return to_json(Estimate(*(part + about for part in found)))

    means, differences = ({name: mean(values) for name, values in some.items()} for some in (hits, pairs))
    return {"mean of the sets": means, "differences of these means": differences}


# --- tables ---


def print_tables(summary: dict[str, Any]) -> None:
    """Accuracy of every method on every set, by object, and differences between methods."""
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
            if method.endswith(UNPRINTED):
                continue
            published, accuracy = published_accuracy(name, method), values["accuracy"]
            cells = [cell({part: limits[t - 1] for part, limits in accuracy.items()}) for t in columns]
            means = [f"{np.mean(values[score]):.3f}" for score in ("calibration_error", "log_loss")]
            rows.append([method, *cells, cell(values["mean"]), *means, _paper(published)])
        head = ["method", *(f"after {t}" for t in columns), "mean of all", "ECE", "NLL", ""]
        print(text_table(head, rows))
        print_objects(entry, touches)
        for pair, values in entry["paired"].items():
            pads = f"; {values['pads_needed']} pads for +- 3 points" if values["pads_needed"] else ""
            last, mean = (cell(values[score], signed=True) for score in ("last", "mean"))
            print(f"  {pair}: after {touches} {last}, mean {mean}{pads}")


def published_accuracy(name: str, method: str) -> float | None:
    """The paper's accuracy after ten touches, of the rows that are its methods."""
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
        if method.endswith(SHOWN_BY_OBJECT)
    )
    print(text_table([f"after {touches}, by the object that was there", *entry["objects"]], rows, "  "))


def print_mean_over_objects(summary: dict[str, Any]) -> None:
    """The paper's last column, if its sets were played."""
    if "mean of the sets" not in summary:
        return
    rows = (
        [method, cell(estimate), _paper(published_accuracy("mean", method))]
        for method, estimate in summary["mean of the sets"].items()
        if not method.endswith(UNPRINTED)
    )
    print(f"\nall objects of {' and '.join(PAPER_SETS)}, each decided among those of its set:")
    print(text_table(["method", "after the last touch", ""], rows))
    for pair, estimate in summary["differences of these means"].items():
        print(f"  {pair}: {cell(estimate, signed=True)}")


def print_stopping(summary: dict[str, Any]) -> None:
    """Print how the fused belief stops when it is sure."""
    entry = summary["sets"].get("all", next(iter(summary["sets"].values())))
    for stop in entry["methods"]["fused"]["stopping"]:
        print(
            f"stop at an error of {stop['requested_error']:.0%}: error {cell(stop['error'])}, predicted "
            f"{stop['predicted_error']:.3f}, after {stop['touches']['mean']:.1f} touches; of the "
            f"{stop['stopped']['mean']:.0%} that stopped early error {cell(stop['stopped_error'])}, predicted "
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
    one = int(np.argmin(np.where(right, first, 1 + first)))
    record = viz.EpisodeRecord(
        meshes, results.names, results.episodes.T_w_t[one], np.asarray(results.episodes.observations.reading)[one],
        board, p[one], int(results.truth[one]), holds_simulated(source),
    )  # fmt: skip
    viz.write_episode_report(record, out)


def write_figures(name: str, episodes: PooledEpisodes, out: Path, simulated: bool) -> None:
    """Accuracy and confusion of a set."""
    shown = {
        method: metrics.accuracy(p, episodes.truth, clusters=episodes.clusters())
        for method, p in episodes.beliefs.items()
        if method in EVIDENCE or method.endswith(", votes")
    }
    viz.save_figure(figures.accuracy(shown, f"Accuracy, {name}", simulated), out / f"accuracy_{name}.png")
    if "fused" in episodes.beliefs:
        counts = {"fused": metrics.confusion(episodes.beliefs["fused"][:, -1], episodes.truth)}
        figure = viz.plot_confusions(counts, episodes.names, f"Confusion, {name}", simulated)
        viz.save_figure(figure, out / f"confusion_{name}.png")
