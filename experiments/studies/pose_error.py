"""How well must a pose be known for the paper's rules, and for its baseline that only knows where contacts were?

The same sittings with more and more error of placement, and with views of objects that are noisy themselves.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from experiments.common.runs import Part
from experiments.recognize import figures as drawing
from experiments.studies.lab import Lab, shown, sit
from i2t import viz
from i2t.recognition import metrics as scores
from i2t.recognition.metrics import Estimate, to_json
from i2t.recognition.paper_rules import paper_rules
from i2t.recognition.site_pool import draw_informative_sites, sample_sites

RULES = ("votes", "product")


class World(NamedTuple):
    """A set of objects, how far they are from where they are believed (mm and degrees), and how noisily known (mm)."""

    objects: str
    placement: float
    rough: float

    def __str__(self) -> str:
        return f"{self.objects}, {self.placement} mm" + (f", views {self.rough} mm" if self.rough else "")


def play(lab: Lab) -> Part:
    """Both of the paper's sets in every world."""
    debug = lab.args.preset == "debug"
    placements, roughs = ((0.0, 1.0), (0.3,)) if debug else (lab.args.placements, lab.args.rough)
    found: Part = {}
    for which, (name, names) in enumerate({"primitives": lab.cfg.primitives, "tools": lab.cfg.tools}.items()):
        key_pool, key_play, key_site = jax.random.split(jax.random.fold_in(lab.key, which), 3)
        surfaces = [lab.surfaces[lab.names.index(one)] for one in names]
        sites = sample_sites(key_pool, surfaces, names, lab.cfg.num_sites, lab.cfg.site_limits)
        truth = np.repeat(np.arange(len(names)), lab.sittings)
        chosen = draw_informative_sites(key_site, sites, len(truth), lab.cfg.touches)
        for size in placements:
            errors = replace(lab.cfg.errors, placement=size * 1e-3, placement_angle=np.radians(size))
            key = jax.random.clone(key_play)  # the same luck in all worlds
            episodes = sit(lab, key, sites, truth, chosen, f"{name}, {size} mm", surfaces=surfaces, errors=errors)
            for rough in (0.0, *roughs) if size == 1.0 else (0.0,):
                told = paper_rules(lab.predictor, lab.learnt.reading_std, surfaces, episodes, rough * 1e-3)
                kept = {rule: p for rule, p in told.items() if rule.endswith(RULES)}
                found[str(len(found))] = {"truth": truth, **World(name, size, rough)._asdict(), **kept}
    return found


def report(parts: Sequence[Part], out: Path) -> dict[str, Any]:
    """Accuracy after the last touch in every world, and where the baseline overtakes."""
    result: dict[str, Any] = {"worlds": {}}
    leads: dict[str, list[Estimate]] = {}
    sizes: set[float] = set()
    for number, first in parts[0].items():
        world = World(str(first["objects"]), float(first["placement"]), float(first["rough"]))
        sizes.add(world.placement)
        kept = [key for key in first if key not in World._fields]
        columns = {key: np.concatenate([part[number][key] for part in parts]) for key in kept}
        truth = columns["truth"]
        entry: dict[str, Any] = {"sittings": len(truth)}
        said = []
        for rule in RULES:
            ours, theirs = (scores.hits(columns[f"{source}, {rule}"], truth) for source in ("I2T", "proprioception"))
            lead = scores.compare_paired(ours, theirs).last
            entry[rule] = {
                "I2T": to_json(scores.wilson_interval(ours[:, -1])), "proprioception": to_json(scores.wilson_interval(theirs[:, -1])),
                "lead": to_json(lead),
            }  # fmt: skip
            said.append(f"{rule}: {ours[:, -1].mean():.3f} against {theirs[:, -1].mean():.3f}, by {shown(lead)}")
            if not world.rough:
                leads.setdefault(f"{world.objects}, {rule}", []).append(lead)
        result["worlds"][str(world)] = entry
        print(f"{world!s:32} " + "   ".join(said))
    lines = {name: Estimate(*(np.array(x, float) for x in zip(*each, strict=True))) for name, each in leads.items()}
    result["crossing_mm"] = {name: crossings(sorted(sizes), line.mean) for name, line in lines.items()}
    for name, at in result["crossing_mm"].items():
        where = " and ".join(f"{x:.2f} mm" for x in at) or "nowhere"
        print(f"{name}: the two are even at {where}")
    if len(sizes) > 1:
        viz.save_figure(drawing.accuracy_differences(sorted(sizes), lines, True), out / "crossing.png")
    return result


def crossings(sizes: Sequence[float], lead: Sequence[float] | np.ndarray) -> list[float]:
    """Sizes at which a lead changes sign, on the straight lines between those measured."""
    steps = zip(pairwise(sizes), pairwise(lead), strict=True)
    return [float(a + (b - a) * x / (x - y)) for (a, b), (x, y) in steps if x * y < 0]
