"""What `experiments.recognize` leaves behind: episodes on disk, scores over seeds with intervals, tables, figures."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from experiments.common.runs import load_part, save_part, write_json
from experiments.recognize import figures
from i2t import viz
from i2t.objects.solids import Mesh
from i2t.recognition import calibrated, metrics
from i2t.recognition.belief import TEMPERATURE_SCALING, TemperatureScaling, TouchObservation
from i2t.recognition.episodes import EVIDENCE, Episodes
from i2t.recognition.intervals import student_interval
from i2t.recognition.metrics import to_json
from i2t.types import Board

PUBLISHED = {
    "primitives": {"I2T, votes": 0.50, "proprioception, votes": 0.23},
    "tools": {"I2T, votes": 0.70, "proprioception, votes": 0.80},
}  # the paper's accuracies
REQUESTED_ERRORS = (0.01, 0.05, 0.10)  # of the stopping rule
NUM_BINS = 10  # of a calibration error
COMPARED = (
    ("I2T, votes", "proprioception, votes"),
    ("I2T, product", "proprioception, product"),
    ("fused", "tactile only"),
    ("fused", "position only"),
    ("fused", "I2T, product"),
    ("fused, oracle", "fused"),
    ("tactile only, oracle", "tactile only"),
)


class EpisodeResults(NamedTuple):
    """Episodes with one set of objects and what each method believed after each touch."""

    names: tuple[str, ...]
    truth: np.ndarray  # (e,)
    beliefs: dict[str, np.ndarray]  # (e, t, objects) by method
    episodes: Episodes


Results = dict[str, EpisodeResults]  # of one pad and seed, by set of objects

# --- on disk ---


def save(path: Path, results: Results) -> None:
    """Write all sets of a seed, at once or not at all."""
    about = json.dumps({name: each.names for name, each in results.items()})
    sets = {
        name: {
            "site": each.episodes.site, "T_w_t": each.episodes.T_w_t, "truth": each.truth,
            "observations": each.episodes.observations._asdict(),
            "beliefs": {method: p.astype(np.float32) for method, p in each.beliefs.items()},
        }
        for name, each in results.items()
    }  # fmt: skip
    save_part(path, {**sets, "about": about})


def load(path: Path) -> Results:
    """What `save` wrote."""
    sets = load_part(path)
    results = {}
    for name, names in json.loads(str(sets["about"])).items():
        found = sets[name]
        observations = TouchObservation(**found["observations"])
        episodes = Episodes(found["truth"], found["site"], observations, found["T_w_t"])
        results[name] = EpisodeResults(tuple(names), found["truth"], found["beliefs"], episodes)
    return results


# --- calibration ---


def pooled(parts: Sequence[Results], name: str, method: str) -> tuple[np.ndarray, np.ndarray]:
    """Beliefs (e, t, objects) and truths (e,) of a set over all seeds."""
    p = np.concatenate([part[name].beliefs[method] for part in parts])
    return p.astype(np.float64), np.concatenate([part[name].truth for part in parts])


def calibrate(parts: Sequence[Results]) -> tuple[list[Results], dict[str, TemperatureScaling]]:
    """Beliefs after temperature scaling, and the temperature of each method.

    Temperatures are fitted to the validation objects of all seeds; without validation objects they are those of earlier
    ones. The paper's rules stay as they are.
    """
    methods = [method for method in next(iter(parts[0].values())).beliefs if method.split(", ")[0] in EVIDENCE]
    temperatures = dict.fromkeys(methods, TEMPERATURE_SCALING)
    if "validation" in parts[0]:
        temperatures = {method: calibrated.fit_temperature(*pooled(parts, "validation", method)) for method in methods}
    return [{name: _scaled(each, temperatures) for name, each in part.items()} for part in parts], temperatures


def _scaled(results: EpisodeResults, temperatures: Mapping[str, TemperatureScaling]) -> EpisodeResults:
    found = {
        method: calibrated.calibrated_beliefs(results.beliefs[method], temperature)
        for method, temperature in temperatures.items()
    }
    return results._replace(beliefs=results.beliefs | found)


# --- scores ---


def summarise(
    parts: Sequence[Results], temperatures: Mapping[str, TemperatureScaling], out: Path, source: str
) -> dict[str, Any]:
    """Scores of every set over all seeds, written to metrics.json with figures next to it."""
    written = {method: to_json(temperature) for method, temperature in temperatures.items()}
    summary: dict[str, Any] = {"source": source, "seeds": len(parts), "temperatures": written, "sets": {}}
    for name in parts[0]:
        summary["sets"][name] = _score_set(parts, name)
    if {"primitives", "all"} <= set(parts[0]):
        summary["primitives of all"] = primitives_only(parts)
    if {"validation", "all"} <= set(parts[0]) and "fused" in parts[0]["all"].beliefs:
        validation, test = pooled(parts, "validation", "fused"), pooled(parts, "all", "fused")
        sets = calibrated.conformal_sets(*validation, *test)
        summary["conformal 90 %"] = {"coverage": to_json(sets.coverage), "size": to_json(sets.size)}
    write_json(out / "metrics.json", summary)
    write_figures(parts, out, source != "real")
    return summary


def _score_set(parts: Sequence[Results], name: str) -> dict[str, Any]:
    """Scores of every method on one set of objects."""
    first = parts[0][name]
    contact = np.mean([np.mean(part[name].episodes.observations.contact) for part in parts])
    return {
        "objects": list(first.names),
        "episodes": sum(len(part[name].truth) for part in parts),
        "air": float(1 - contact),
        "methods": {method: score_method(parts, name, method) for method in first.beliefs},
        "paired": compare_methods(parts, name),
    }


def score_method(parts: Sequence[Results], name: str, method: str) -> dict[str, Any]:
    """All scores of a method on a set."""
    p, truth = pooled(parts, name, method)
    confidence, hit = metrics.confidence(p), metrics.hits(p, truth)
    of_seeds = [metrics.hits(part[name].beliefs[method], part[name].truth).mean() for part in parts]
    errors = [metrics.calibration_error(confidence[:, t], hit[:, t], NUM_BINS) for t in range(p.shape[1])]
    return {
        "accuracy": to_json(metrics.accuracy(p, truth)),
        "mean": to_json(metrics.mean_accuracy(p, truth)),
        "mean_over_seeds": to_json(student_interval(np.array(of_seeds))),
        "calibration_error": [error.error for error in errors],
        "calibration_error_by_chance": [error.chance for error in errors],
        "log_loss": metrics.log_loss(p, truth).mean(0).tolist(),
        "brier": metrics.brier(p, truth).mean(0).tolist(),
        "stopping": [to_json(metrics.stopping(p, truth, error)) for error in REQUESTED_ERRORS],
        "touches_to_95": to_json(metrics.touches_to_confidence(metrics.confident_at(p), p.shape[1])),
        "confusion": metrics.confusion(p[:, -1], truth).tolist(),
    }


def primitives_only(parts: Sequence[Results]) -> dict[str, Any]:
    """Accuracy in those episodes of the set of all in which a primitive was there, among the primitives only."""
    names = parts[0]["all"].names
    primitives = [names.index(name) for name in parts[0]["primitives"].names]
    found = {}
    for method in parts[0]["all"].beliefs:
        p, truth, _ = metrics.restrict_to(*pooled(parts, "all", method), primitives)
        found[method] = to_json(metrics.accuracy(p, truth))
    return found


def compare_methods(parts: Sequence[Results], name: str) -> dict[str, Any]:
    """Differences between methods on the same episodes."""
    found = {}
    for one, other in COMPARED:
        if {one, other} <= set(parts[0][name].beliefs):
            hits = [metrics.hits(*pooled(parts, name, method)) for method in (one, other)]
            found[f"{one} - {other}"] = to_json(metrics.compare_paired(*hits))
    return found


# --- tables ---


def print_tables(summary: dict[str, Any]) -> None:
    """Accuracy of every method on every set, and differences between methods."""
    for name, entry in summary["sets"].items():
        touches = len(next(iter(entry["methods"].values()))["log_loss"])
        columns = sorted({1, min(3, touches), min(5, touches), touches})
        print(
            f"\n{name} ({summary['source']}): {', '.join(entry['objects'])}; {entry['episodes']} episodes over "
            f"{summary['seeds']} pads and seeds, {100 * entry['air']:.0f} % of touches in air"
        )
        head = "".join(f"{f'after {t}':>18}" for t in columns)
        print(f"{'':26}{head}{'mean of all':>22}{'ECE':>7}{'NLL':>7}")
        for method, values in entry["methods"].items():
            mean = values["mean"]
            published = PUBLISHED.get(name, {}).get(method)
            print(
                f"{method:26}{_rates(values['accuracy'], columns)}  {mean['mean']:6.3f} "
                f"[{mean['low']:.3f}, {mean['high']:.3f}]"
                f"{np.mean(values['calibration_error']):7.3f}{np.mean(values['log_loss']):7.3f}"
                + (f"   paper: {published:.2f}" if published else "")
            )
        if name == "all" and "primitives of all" in summary:
            print("  episodes of these with a primitive, decided among the primitives only:")
            for method, accuracy in summary["primitives of all"].items():
                print(f"  {method:24}{_rates(accuracy, columns)}")
        for pair, values in entry["paired"].items():
            print(
                f"  {pair}: after {touches} {_signed(values['last'])} (p = {values['last_p']:.2g}), "
                f"mean {_signed(values['mean'])} (p = {values['mean_p']:.2g})"
            )


def print_calibration(summary: dict[str, Any]) -> None:
    """How far the fused belief is calibrated: stopping, scores and conformal sets."""
    entry = summary["sets"].get("all", next(iter(summary["sets"].values())))
    fused = entry["methods"]["fused"]
    for stop in fused["stopping"]:
        print(
            f"stop at an error of {stop['requested_error']:.0%}: error {_range(stop['error'])}, predicted "
            f"{stop['predicted_error']:.3f}, after {stop['touches']['mean']:.1f} touches; of the "
            f"{stop['stopped']['mean']:.0%} that stopped early error {_range(stop['stopped_error'])}, predicted "
            f"{stop['stopped_predicted_error']:.3f}"
        )
    for name in ("calibration_error", "log_loss", "brier"):
        print(f"{name.replace('_', ' ')} after each touch: " + " ".join(f"{x:.3f}" for x in fused[name]))
    if "conformal 90 %" in summary:
        coverage, size = summary["conformal 90 %"]["coverage"]["mean"], summary["conformal 90 %"]["size"]["mean"]
        rates = [f"{c:.3f} ({n:.1f})" for c, n in zip(coverage, size, strict=True)]
        print("coverage of conformal 90 % sets (mean size) after each touch: " + " ".join(rates))


def _rates(accuracy: dict[str, Any], columns: Sequence[int]) -> str:
    return "".join(
        f"{accuracy['mean'][t - 1]:6.3f} [{accuracy['low'][t - 1]:.2f}, {accuracy['high'][t - 1]:.2f}]" for t in columns
    )


def _range(estimate: dict[str, float]) -> str:
    return f"{estimate['mean']:.3f} [{estimate['low']:.3f}, {estimate['high']:.3f}]"


def _signed(estimate: dict[str, float]) -> str:
    return f"{estimate['mean']:+.3f} [{estimate['low']:+.3f}, {estimate['high']:+.3f}]"


# --- figures ---


def report_hardest_episode(
    results: EpisodeResults, meshes: Sequence[Mesh], out: Path, source: str, board: Board
) -> None:
    """Report the correct episode whose true object had the lowest posterior after one touch."""
    p = results.beliefs["fused"].astype(np.float64)
    first = p[np.arange(len(p)), 0, results.truth]
    right = p[:, -1].argmax(-1) == results.truth
    one = int(np.argmin(np.where(right, first, 1 + first)))
    record = viz.EpisodeRecord(
        meshes, results.names, results.episodes.T_w_t[one], np.asarray(results.episodes.observations.reading)[one],
        board, p[one], int(results.truth[one]), source != "real",
    )  # fmt: skip
    viz.write_episode_report(record, out)


def write_figures(parts: Sequence[Results], out: Path, simulated: bool) -> None:
    """Accuracy, reliability and confusion of every set."""
    for name, first in parts[0].items():
        curves, reliable = {}, {}
        for method in first.beliefs:
            p, truth = pooled(parts, name, method)
            curves[method] = metrics.accuracy(p, truth)
            if method in EVIDENCE:
                t = p.shape[1] // 2
                reliable[method] = metrics.reliability(metrics.confidence(p)[:, t], metrics.hits(p, truth)[:, t])
        shown = {k: v for k, v in curves.items() if "average" not in k and "oracle" not in k}
        viz.save_figure(figures.accuracy(shown, f"Accuracy, {name}", simulated), out / f"accuracy_{name}.png")
        if "fused" in first.beliefs:
            figure = figures.reliability(reliable, f"Reliability, {name}", simulated)
            viz.save_figure(figure, out / f"reliability_{name}.png")
            p, truth = pooled(parts, name, "fused")
            counts = metrics.confusion(p[:, -1], truth)
            figure = figures.confusion(counts, first.names, f"Confusion, {name}", simulated)
            viz.save_figure(figure, out / f"confusion_{name}.png")
