"""Numbers that sentences of the documents repeat are those of the tables, whose measurements are in docs/results."""

import json
import re
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import i2t
from experiments.check_docs.pages import Finding

ROOT = Path(__file__).parents[2]
MASK, DEPTH = "Imagine2touch (paper's network, mask), votes", "Imagine2touch (paper's network, depth), votes"
PROCESS, CONSTANT = "same rules, Gaussian process, votes", "same rules, constant reading, votes"
ARM = "proprioception, votes"
CEILING = "ceiling: GP without camera and arm errors"
NUMBER_WORDS = {11: "Eleven", 12: "Twelve", 13: "Thirteen"}


@cache
def _measured(step: str) -> dict[str, Any]:
    return json.loads((ROOT / "docs" / "results" / f"{step}.json").read_text())


def _scores(step: str, objects: str, method: str) -> dict[str, Any]:
    return _measured(step)["sets"][objects]["methods"][method]


def _last(step: str, objects: str, method: str) -> dict[str, float]:
    return {name: values[-1] for name, values in _scores(step, objects, method)["accuracy"].items()}


def _short(value: float, decimals: int = 2) -> str:
    """Write a rate as the prose does, such as .53."""
    return f"{value:.{decimals}f}".replace("0.", ".", 1)


def _shown(step: str, objects: str, method: str, decimals: int = 2) -> str:
    """Accuracy after the last touch."""
    return _short(_last(step, objects, method)["mean"], decimals)


def _spanned(found: Mapping[str, float]) -> str:
    """A rate and its interval."""
    return f"{_short(found['mean'])} [{_short(found['low'])}, {_short(found['high'])}]"


def _half_width(objects: str, method: str) -> float:
    """Half the interval of a difference to proprioception after the last touch, in points."""
    found = _measured("paper")["sets"][objects]["paired"][f"{method} - {ARM}"]["last"]
    return 50 * (found["high"] - found["low"])


def _pads_for(points: float, objects: str, method: str) -> str:
    """Number of pads that would narrow that interval to so many points either way."""
    return f"{_measured('paper')['runs'] * (_half_width(objects, method) / points) ** 2:.0f}"


def _ratio(condition: str, touches: int, score: str = "ratio") -> str:
    """A score of reconstruction after some touches."""
    return _short(_measured("reconstruct")["conditions"][condition]["after"][str(touches)][score][0])


def _lost(world: str) -> float:
    """Points of mean accuracy that the fused belief loses in a world of which it knows nothing."""
    found = _measured("mismatch")["tables"]["methods"]
    means = {row[0]: row[5]["mean"] for row in found["rows"] if row[1] == "fused"}
    return -100 * means[world]


def _span(scores: Mapping[str, Any]) -> str:
    """R² of a predictor with its interval."""
    low, high = scores["r2_interval"]
    return f"{scores['r2']:.2f} [{low:.2f}, {high:.2f}]"


def _rows_of_eflesh() -> list[str]:
    """Rows of the table of the ready model of a real skin, from its own measurements."""
    methods = json.loads((ROOT / "i2t" / "models" / "eflesh" / "metrics.json").read_text())["methods"]
    rows = []
    for name, found in methods.items():
        covered = f"{found['coverage_90']:.2f} |" if "coverage_90" in found else "|"
        rows.append(f"| {name} | {found['r2']:.3f} | {found['rmse']:.1f} | {covered}")
    return rows


def _sentences() -> list[tuple[str, str]]:
    """Pages and sentences on them."""
    paper = {(objects, method): _shown("paper", objects, method) for objects in ("primitives", "tools")
             for method in (MASK, DEPTH, PROCESS, CONSTANT, ARM)}  # fmt: skip
    primitives, tools = ({method: paper[name, method] for method in (MASK, DEPTH, PROCESS, CONSTANT, ARM)}
                         for name in ("primitives", "tools"))  # fmt: skip
    readings, fused = _scores("recognize", "all", "readings"), _scores("recognize", "all", "fused")
    present = _scores("recognize", "all", "readings and presence")
    gain = 100 * (present["mean"]["mean"] - readings["mean"]["mean"])
    at_ten = [_ratio(name, 10) for name in ("reduction", "contact pose only")]
    card = json.loads((ROOT / "i2t" / "models" / "nominal" / "metrics.json").read_text())["pad model"]
    trained = _measured("train")["methods"]
    gp, ceiling = (trained[name] for name in (_measured("train")["best"], CEILING))
    examples = len(list((ROOT / "examples").glob("*.py")))
    return [
        ("README.md", f"`import i2t` gives {len(i2t.__all__)} names"),
        ("README.md", f"{NUMBER_WORDS[examples]} short programs are in `examples/`"),
        ("README.md", f"these reach {primitives[MASK]} on primitives and {tools[MASK]} on tools from masks"),
        ("README.md", f"with the Gaussian process reach {primitives[PROCESS]} and {tools[PROCESS]}"),
        ("README.md", f"five objects right in {_spanned(_last('recognize', 'all', 'fused'))} after ten touches"),
        ("README.md", f"from readings alone in {_spanned(_last('recognize', 'all', 'readings'))}"),
        ("README.md", f"it loses {_lost('free side faces'):.0f} to {_lost('Winkler foundation'):.0f} points"),
        ("docs/recognition.md", f"loses {_lost('Winkler foundation'):.0f} points of mean accuracy; free side faces "
         f"cost it {_lost('free side faces'):.0f} points, a soft compressible layer "
         f"{_lost('soft compressible layer'):.0f}"),
        ("docs/recognition.md", "Placements twice as far off as stated cost "
         f"{_lost('placement off twice as far as stated'):.0f} points, a skin mounted anew by half a millimetre "
         f"{_lost('skin remounted by 0.5 mm'):.0f}"),
        ("docs/recognition.md", f"it reaches {primitives[MASK]} from masks and {primitives[DEPTH]} from depths"),
        ("docs/recognition.md", f"on tools it reaches {tools[MASK]} and {tools[DEPTH]} (the paper's .70) and stays "
         f"below proprioception ({tools[ARM]}, the paper's .80)"),
        ("docs/recognition.md", f"A constant reading gets {tools[CONSTANT]} on tools"),
        ("docs/recognition.md", f"known to {_half_width('primitives', DEPTH):.0f} points (depth) and "
         f"{_half_width('primitives', MASK):.0f} points (mask) on primitives, to {_half_width('tools', DEPTH):.0f} "
         f"and {_half_width('tools', MASK):.0f} on tools"),
        ("docs/recognition.md", f"3 points would take some {_pads_for(3, 'primitives', MASK)} pads on primitives from "
         f"masks, and on tools about {_pads_for(3, 'tools', MASK)} (mask) and {_pads_for(3, 'tools', DEPTH)} (depth)"),
        ("docs/recognition.md", f"reach {_shown('recognize', 'all', 'readings', 3)} after ten touches and "
         f"{_short(readings['mean']['mean'], 3)} on the mean: meeting something or nothing is worth {gain:.0f} points"),
        ("docs/recognition.md", f"known worst ({_short(fused['by_object']['cylinder']['last']['mean'])} fused)"),
        ("docs/recognition.md", f"| fused | | .95, missed by {_short(0.95 - fused['accuracy']['mean'][9])}, within the "
         f"interval | .88, missed by {_short(0.88 - fused['mean']['mean'])}, within the interval |"),
        ("docs/recognition.md", f"| .85, missed by {_short(0.85 - present['accuracy']['mean'][2])} | .92, met |"),
        ("docs/recognition.md", f"pad model](model_card.md) has {card['r2']:.2f}"),
        ("docs/model_card.md", f"R² {_span(gp)} of the readings, where errors of camera and arm leave "
         f"{ceiling['r2']:.2f} to be explained. Its 90 % intervals hold {gp['coverage_90']:.2f} of the values"),
        *(("docs/model_card.md", row) for row in _rows_of_eflesh()),
        ("docs/recognition.md", f"one of three primitives in {primitives[MASK]} and one of two tools in {tools[MASK]}"),
        ("docs/recognition.md", f"the belief one of five objects in {_shown('recognize', 'all', 'fused')} ([table]"),
        ("docs/model_card.md", f"R² {card['r2']:.2f} of its {card['touches']} training touches"),
        ("docs/reconstruction.md", f"{_ratio('uncertainty', 5)} and {_ratio('uncertainty', 20)} are reached by"),
        ("docs/reconstruction.md", f"IoU after 20 touches is {_ratio('uncertainty', 20, 'iou')} (goal .75)"),
        ("docs/reconstruction.md", f"ratios at 10 touches are {at_ten[0]} and {at_ten[1]}"),
    ]  # fmt: skip


def findings(root: Path) -> Iterator[Finding]:
    """Sentences that no longer repeat what was measured, and claims that it no longer bears."""
    for page, words in _sentences():
        text = re.sub(r"\[([^\]]+)\]\((?:docs/)?glossary\.md\)", r"\1", (root / page).read_text())
        if words not in " ".join(text.split()):
            yield Finding(root / page, 1, f"what was measured says: {words}")
    for page, claim, holds in _claims():
        if not holds:
            yield Finding(root / page, 1, f"what was measured no longer says that {claim}")


def _claims() -> Iterator[tuple[str, str, bool]]:
    """Pages, claims made on them, and whether they were measured."""
    fused, present = (_scores("recognize", "all", name) for name in ("fused", "readings and presence"))
    last = _last("recognize", "all", "fused")
    missed = last["mean"] < 0.95 < last["high"] and fused["mean"]["mean"] < 0.88 < fused["mean"]["high"]
    yield "docs/recognition.md", "the fused belief misses its goals within the interval", missed
    met = _last("recognize", "all", "readings and presence")["mean"] >= 0.92 and present["mean"]["mean"] >= 0.84
    yield "docs/recognition.md", "readings and presence meet their goals", met
    for name, above in (("primitives", True), ("tools", False)):
        arm = _last("paper", name, ARM)["mean"]
        stands = all((_last("paper", name, method)["mean"] > arm) == above for method in (MASK, DEPTH))
        yield "docs/recognition.md", f"on {name} the paper's method stands to proprioception as said", stands
        others = [_last("paper", name, method)["mean"] for method in (MASK, DEPTH, CONSTANT, ARM)]
        best = _last("paper", name, PROCESS)["mean"] > max(others)
        yield "docs/recognition.md", f"on {name} the Gaussian process is best", best
    right = all(
        found["stopped_error"]["mean"] <= found["requested_error"] + 0.015
        and abs(found["stopped_predicted_error"] - found["stopped_error"]["mean"]) < 0.01
        for found in fused["stopping"]
    )
    yield "docs/recognition.md", "stops are as right as was asked", right
    worlds = ("worn pad", "arm twice as stiff", "arm half as stiff", "meshes 3 % smaller", "meshes 3 % larger")
    yield "docs/recognition.md", "those worlds cost a point at most", all(_lost(world) < 1.5 for world in worlds)
    conditions = _measured("reconstruct")["conditions"]
    left = [conditions[policy]["after"]["20"]["ratio"][0] for policy in ("random", "uncertainty", "reduction")]
    yield "README.md", "half to two thirds of the distance are left", 0.5 < min(left) <= max(left) < 0.67
