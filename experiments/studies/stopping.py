"""Error rate of beliefs that stop at a requested error, with placement errors as stated, half or twice as large.

There are enough episodes to measure an error rate of one in a hundred. One temperature serves all placements, because
the actual one is unknown in use. It is fitted to validation objects in all placements or, more conservatively, in the
largest alone.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from experiments.common.runs import Part
from experiments.recognize.report import REQUESTED_ERRORS
from experiments.studies.lab import SETS, StudyLab, StudyWorld
from experiments.studies.mismatch import placed
from experiments.studies.report import Column, clusters_of, make_table, pool_parts
from i2t.intervals import estimate_at
from i2t.recognition import calibrated, metrics
from i2t.recognition.episodes import run_belief
from i2t.recognition.metrics import to_json

LARGEST = "twice as large"
PLACEMENTS = {"as stated": 1.0, "half as large": 0.5, LARGEST: 2.0}  # factors of the stated errors of placement
KINDS = ("fused", "position")
# Constants of the likelihood, with values around the default that are compared on validation objects.
CONSTANTS = {
    "dof": (2.0, 4.0, 8.0, 16.0, 32.0),
    "inflation": (0.5, 0.7, 1.0, 1.4, 2.0),
    "indentation_error": (0.05, 0.1, 0.2, 0.4, 0.8),
    "outlier_rate": (0.001, 0.003, 0.01, 0.03, 0.1),
}


def evaluate(lab: StudyLab) -> Part:
    """Compute beliefs `(e, t, objects)` by "evidence, placement" with validation objects and with test objects."""
    part: Part = {}
    for name, key, objects in zip(
        SETS, jax.random.split(lab.key, len(SETS)), (lab.cfg.validation, lab.cfg.objects), strict=True
    ):
        part[name] = _evaluate_set(lab.with_objects(objects), key, name)
    return part


def _evaluate_set(lab: StudyLab, key: Array, label: str) -> Part:
    key_sites, key_episodes = jax.random.split(key)
    truth, particles, model = lab.truth(), lab.particles(), lab.pad_model
    plan = lab.plan(key_sites, len(truth))
    (table,) = lab.predict(plan.sites, particles, [model.reading_model], label)
    part: Part = {"truth": truth, "pool": plan.pool}
    for name, factor in PLACEMENTS.items():
        world = StudyWorld(errors=placed(lab.cfg.errors, factor))
        episodes = lab.simulate(jax.random.clone(key_episodes), plan, truth, f"{label}, {name}", world=world)
        beliefs = run_belief(table, episodes, model.likelihood, particles, KINDS)
        part |= {f"{kind}, {name}": p for kind, p in beliefs.items()}
        if label == SETS[0] and factor == 1:
            for constant, value in tried():
                other = model.likelihood._replace(**{constant: jnp.float32(value)})
                part[f"{constant}={value:g}"] = run_belief(table, episodes, other, particles, KINDS[:1])[KINDS[0]]
    return part


def tried() -> list[tuple[str, float]]:
    """Pairs of a likelihood constant and a value to compare."""
    return [(constant, value) for constant, values in CONSTANTS.items() for value in values]


def _constants(validation: dict[str, np.ndarray]) -> dict[str, Any]:
    """Table of the validation log loss, at its best temperature, by value of each constant."""
    rows = []
    for constant, values in CONSTANTS.items():
        losses = []
        for value in values:
            p = validation[f"{constant}={value:g}"].astype(np.float64)
            temperature = calibrated.fit_temperature(p, validation["truth"])
            scaled = calibrated.calibrated_beliefs(p, temperature)
            losses.append(float(metrics.log_loss(scaled, validation["truth"]).mean()))
        rows.append([constant, *(f"{value:g}: {loss:.3f}" for value, loss in zip(values, losses, strict=True))])
    return make_table(["constant", *(f"value {i + 1}: log loss" for i in range(len(rows[0]) - 1))], rows)


def report(parts: Sequence[Part], pads: Sequence[str]) -> dict[str, Any]:
    """Report error rates of stopping against the requested ones by placement, and how hard both object sets are."""
    validation, test = (pool_parts([part[name] for part in parts]) for name in SETS)
    clusters = clusters_of([part["test"] for part in parts], pads)
    temperatures = {}
    for label, names in (("all placement errors", list(PLACEMENTS)), ("the largest", [LARGEST])):
        beliefs = np.concatenate([validation[f"fused, {name}"] for name in names]).astype(np.float64)
        temperatures[label] = calibrated.fit_temperature(beliefs, np.tile(validation["truth"], len(names)))
    rows = []
    for name in PLACEMENTS:
        raw = test[f"fused, {name}"].astype(np.float64)
        scaled = [calibrated.calibrated_beliefs(raw, temperature) for temperature in temperatures.values()]
        for requested in REQUESTED_ERRORS:
            stops = [metrics.stopping(p, test["truth"], requested, clusters=clusters) for p in scaled]
            cells = [cell for stop in stops for cell in (stop.stopped, stop.stopped_error, stop.touches)]
            rows.append([name, f"{requested:.0%}", *cells])
    head: list[Any] = ["placement errors", "requested error"]
    for label in temperatures:
        head += [
            Column(f"fitted to {label}: stopped early", 0, percent=True), Column("wrong when stopped", 1, percent=True),
            Column("touches", 1),
        ]  # fmt: skip
    groups = clusters_of([part["validation"] for part in parts], pads), clusters
    hardness = []
    for objects, data, cluster in zip(("validation objects", "test objects"), (validation, test), groups, strict=True):
        for name in PLACEMENTS if data is test else ["as stated"]:
            position, fused = (data[f"{kind}, {name}"].astype(np.float64) for kind in ("position", "fused"))
            means = [metrics.mean_accuracy(p, data["truth"], clusters=cluster) for p in (position, fused)]
            last = estimate_at(metrics.accuracy(fused, data["truth"], clusters=cluster), -1)
            hardness.append([objects, name, *means, last])
    columns = [Column(name, 2) for name in ("position, mean over touches", "fused, mean over touches", "fused, last")]
    tables = {
        "errors": make_table(head, rows),
        "constants": _constants(validation),
        "hardness": make_table(["objects", "placement errors", *columns], hardness),
    }
    return {"episodes": len(test["truth"]), "temperatures": to_json(temperatures), "tables": tables}
