"""What `experiments.recognize` leaves behind: sittings on disk, scores over seeds with intervals, tables, figures."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from experiments.common import nested
from experiments.common.runs import write_json
from experiments.recognize import figures as drawing
from i2t.objects.catalogue import Mesh
from i2t.recognition import calibrated
from i2t.recognition import metrics as scores
from i2t.recognition.belief import TEMPERATURE_SCALING, TouchObservation, TemperatureScaling
from i2t.recognition.episodes import EVIDENCE, Episodes
from i2t.recognition.metrics import to_json
from i2t.skin.boards import reskin_board
from i2t.viz import touches as plots
from i2t.viz.story import story

PAPER = {"primitives": {"I2T, votes": 0.50, "proprioception, votes": 0.23},
         "tools": {"I2T, votes": 0.70, "proprioception, votes": 0.80}}  # fmt: skip
ASKED = (0.01, 0.05, 0.10)  # errors of the stopping rule
EVENLY = 10  # bins of a reliability diagram


class Played(NamedTuple):
    """Sittings with one set of objects and what each method believed after each touch."""

    names: tuple[str, ...]
    truth: np.ndarray  # (e,)
    believed: dict[str, np.ndarray]  # (e, t, objects)
    episodes: Episodes


def save(path: Path, played: dict[str, Played]) -> None:
    """Write all sets of a seed, at once or not at all."""
    about = json.dumps({name: each.names for name, each in played.items()})
    sets = {
        name: {
            "site": each.episodes.site, "T_w_t": each.episodes.T_w_t, "measured": each.episodes.observations._asdict(),
            "believed": {method: p.astype(np.float32) for method, p in each.believed.items()}, "truth": each.truth,
        }
        for name, each in played.items()
    }  # fmt: skip
    nested.save(path, {**sets, "about": about})


def load(path: Path) -> dict[str, Played]:
    """What `save` wrote."""
    sets = nested.load(path)
    played = {}
    for name, names in json.loads(str(sets["about"])).items():
        found = sets[name]
        episodes = Episodes(found["truth"], found["site"], TouchObservation(**found["measured"]), found["T_w_t"])
        played[name] = Played(tuple(names), found["truth"], found["believed"], episodes)
    return played


def pooled(parts: Sequence[dict[str, Played]], name: str, method: str) -> tuple[np.ndarray, np.ndarray]:
    """Beliefs and truths of a set over all seeds."""
    p = np.concatenate([part[name].believed[method] for part in parts])
    return p.astype(np.float64), np.concatenate([part[name].truth for part in parts])


def sobered(parts: Sequence[dict[str, Played]]) -> tuple[list[dict[str, Played]], dict[str, TemperatureScaling]]:
    """Beliefs no surer than they should be, and the temper of each: fitted to the validation objects of all seeds, or
    that of earlier ones where there are none. The paper's rules stay as they are.
    """
    methods = [method for method in next(iter(parts[0].values())).believed if method.split(", ")[0] in EVIDENCE]
    tempers = dict.fromkeys(methods, TEMPERATURE_SCALING)
    if "validation" in parts[0]:
        tempers = {method: calibrated.fit_temperature(*pooled(parts, "validation", method)) for method in methods}
    return [{name: _sober(played, tempers) for name, played in part.items()} for part in parts], tempers


def _sober(played: Played, tempers: dict[str, TemperatureScaling]) -> Played:
    found = {method: calibrated.calibrated_beliefs(played.believed[method], temper) for method, temper in tempers.items()}
    return played._replace(believed=played.believed | found)


def summarise(parts: Sequence[dict[str, Played]], tempers: dict[str, TemperatureScaling], out: Path, source: str) -> dict[str, Any]:
    """Scores of every set over all seeds, written to metrics.json with figures beside it."""
    result: dict[str, Any] = {"source": source, "seeds": len(parts), "tempers": to_json(tempers), "sets": {}}
    for name, first in parts[0].items():
        entry: dict[str, Any] = {"objects": list(first.names), "methods": {}}
        for method in first.believed:
            p, truth = pooled(parts, name, method)
            entry["methods"][method] = scored(p, truth, parts, name, method)
        entry["sittings"] = len(truth)
        entry["air"] = float(1 - np.mean([np.mean(part[name].episodes.observations.contact) for part in parts]))
        entry["paired"] = comparisons(parts, name, first.believed)
        result["sets"][name] = entry
    if {"primitives", "all"} <= set(parts[0]):
        result["prisms of all"] = prisms_alone(parts)
    if {"validation", "all"} <= set(parts[0]) and "fused" in parts[0]["all"].believed:
        p_validation, truth_validation = pooled(parts, "validation", "fused")
        found = calibrated.conformal_sets(p_validation, truth_validation, *pooled(parts, "all", "fused"))
        result["conformal 90 %"] = {"coverage": to_json(found.coverage), "size": to_json(found.size)}
    write_json(out / "metrics.json", result)
    figures(parts, out, source != "real")
    return result


def scored(
    p: np.ndarray, truth: np.ndarray, parts: Sequence[dict[str, Played]], name: str, method: str
) -> dict[str, Any]:
    """All scores of a method on a set."""
    sure, hit = scores.confidence(p), scores.hits(p, truth)
    seeds = np.array([scores.hits(part[name].believed[method], part[name].truth).mean() for part in parts])
    each = [scores.calibration_error(sure[:, t], hit[:, t], EVENLY) for t in range(p.shape[1])]
    return {
        "accuracy": to_json(scores.accuracy(p, truth)),
        "mean": to_json(scores.mean_accuracy(p, truth)),
        "mean_over_seeds": to_json(scores.student_interval(seeds)),
        "calibration_error": [e.error for e in each],
        "calibration_error_by_chance": [e.chance for e in each],
        "log_loss": scores.log_loss(p, truth).mean(0).tolist(),
        "brier": scores.brier(p, truth).mean(0).tolist(),
        "stopping": [to_json(scores.stopping(p, truth, asked)) for asked in ASKED],
        "until_95": to_json(scores.touches_to_confidence(scores.confident_at(p), p.shape[1])),
        "confusion": scores.confusion(p[:, -1], truth).tolist(),
    }


def prisms_alone(parts: Sequence[dict[str, Played]]) -> dict[str, Any]:
    """Sittings of the set of all in which a primitive was there, told apart from the other primitives only."""
    names = parts[0]["all"].names
    prisms = [names.index(name) for name in parts[0]["primitives"].names]
    found = {}
    for method in parts[0]["all"].believed:
        p, truth, _ = scores.restrict_to(*pooled(parts, "all", method), prisms)
        found[method] = to_json(scores.accuracy(p, truth))
    return found


PAIRS = (
    ("I2T, votes", "proprioception, votes"),
    ("I2T, product", "proprioception, product"),
    ("fused", "tactile only"),
    ("fused", "position only"),
    ("fused", "I2T, product"),
    ("fused, oracle", "fused"),
    ("tactile only, oracle", "tactile only"),
)


def comparisons(parts: Sequence[dict[str, Played]], name: str, believed: dict[str, np.ndarray]) -> dict[str, Any]:
    """Differences between methods on the same sittings."""
    found = {}
    for one, other in PAIRS:
        if one in believed and other in believed:
            hits = [scores.hits(*pooled(parts, name, method)) for method in (one, other)]
            found[f"{one} - {other}"] = to_json(scores.compare_paired(*hits))
    return found


def report(result: dict[str, Any]) -> None:
    """Print the tables."""
    for name, entry in result["sets"].items():
        touches = len(next(iter(entry["methods"].values()))["log_loss"])
        columns = sorted({1, min(3, touches), min(5, touches), touches})
        print(
            f"\n{name} ({result['source']}): {', '.join(entry['objects'])}; {entry['sittings']} sittings over "
            f"{result['seeds']} pads and seeds, {100 * entry['air']:.0f} % of touches in air"
        )
        head = "".join(f"{f'after {t}':>18}" for t in columns)
        print(f"{'':26}{head}{'mean of all':>22}{'ECE':>7}{'NLL':>7}")
        for method, values in entry["methods"].items():
            shown = _rates(values["accuracy"], columns)
            mean = values["mean"]
            note = PAPER.get(name, {}).get(method)
            print(
                f"{method:26}{shown}  {mean['mean']:6.3f} [{mean['low']:.3f}, {mean['high']:.3f}]"
                f"{np.mean(values['calibration_error']):7.3f}{np.mean(values['log_loss']):7.3f}"
                + (f"   paper: {note:.2f}" if note else "")
            )
        if name == "all" and "prisms of all" in result:
            print("  the primitives of these sittings, told apart from each other only:")
            for method, accuracy in result["prisms of all"].items():
                print(f"  {method:24}{_rates(accuracy, columns)}")
        for pair, values in entry["paired"].items():
            print(
                f"  {pair}: after {touches} {_signed(values['last'])} (p = {values['last_p']:.2g}), "
                f"mean {_signed(values['mean'])} (p = {values['mean_p']:.2g})"
            )


def extras(result: dict[str, Any]) -> None:
    """Print how sure the belief may be: stopping and conformal sets."""
    entry = result["sets"].get("all", next(iter(result["sets"].values())))
    fused = entry["methods"]["fused"]
    for stop in fused["stopping"]:
        print(
            f"stop at an error of {stop['asked']:.0%}: {_range(stop['error'])} wrong where the belief says "
            f"{stop['promised']:.3f}, after {stop['touches']['mean']:.1f} touches; of the "
            f"{stop['stopped']['mean']:.0%} that stopped {_range(stop['stopped_error'])} where it says "
            f"{stop['stopped_promised']:.3f}"
        )
    for name in ("calibration_error", "log_loss", "brier"):
        print(f"{name.replace('_', ' ')} after each touch: " + " ".join(f"{x:.3f}" for x in fused[name]))
    if "conformal 90 %" in result:
        coverage, size = result["conformal 90 %"]["coverage"]["mean"], result["conformal 90 %"]["size"]["mean"]
        rates = [f"{c:.3f} ({n:.1f})" for c, n in zip(coverage, size, strict=True)]
        print("conformal 90 % sets hold the object in (objects in them): " + " ".join(rates))


def tell(played: Played, meshes: Sequence[Mesh], out: Path, source: str) -> None:
    """The story of the sitting whose right object was least believed in after the first touch, among those that ended
    right.
    """
    p = played.believed["fused"].astype(np.float64)
    rows = np.arange(len(p))
    right = p[:, -1].argmax(-1) == played.truth
    doubt = np.where(right, p[rows, 0, played.truth], 1 + p[rows, 0, played.truth])
    one = int(np.argmin(doubt))
    readings = np.asarray(played.episodes.observations.reading)[one]
    T = played.episodes.T_w_t[one]
    story(meshes, played.names, T, readings, reskin_board(), p[one], int(played.truth[one]), out, source != "real")


def _rates(accuracy: dict[str, Any], columns: Sequence[int]) -> str:
    return "".join(
        f"{accuracy['mean'][t - 1]:6.3f} [{accuracy['low'][t - 1]:.2f}, {accuracy['high'][t - 1]:.2f}]" for t in columns
    )


def _range(estimate: dict[str, float]) -> str:
    return f"{estimate['mean']:.3f} [{estimate['low']:.3f}, {estimate['high']:.3f}]"


def _signed(estimate: dict[str, float]) -> str:
    return f"{estimate['mean']:+.3f} [{estimate['low']:+.3f}, {estimate['high']:+.3f}]"


def figures(parts: Sequence[dict[str, Played]], out: Path, simulated: bool) -> None:
    """Pictures of every set."""
    for name, first in parts[0].items():
        curves, reliable = {}, {}
        for method in first.believed:
            p, truth = pooled(parts, name, method)
            curves[method] = scores.accuracy(p, truth)
            if method in ("fused", "tactile only", "position only"):
                t = p.shape[1] // 2
                reliable[method] = scores.reliability(scores.confidence(p)[:, t], scores.hits(p, truth)[:, t])
        chosen = {k: v for k, v in curves.items() if "average" not in k and "oracle" not in k}
        plots.save(drawing.accuracy(chosen, f"Accuracy, {name}", simulated), out / f"accuracy_{name}.png")
        if "fused" in first.believed:
            plots.save(
                drawing.reliability(reliable, f"Reliability, {name}", simulated), out / f"reliability_{name}.png"
            )
            p, truth = pooled(parts, name, "fused")
            plots.save(
                drawing.confusion(scores.confusion(p[:, -1], truth), first.names, f"Taken for, {name}", simulated),
                out / f"confusion_{name}.png",
            )
