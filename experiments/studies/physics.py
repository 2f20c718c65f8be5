"""Recognition with a skin whose physics differs from the pad model's, with a pad model fitted to its own touches.

Each physics is left out once. The inflation of reading errors and the temperature of the belief are fitted to episodes
with validation objects in all other physics, as is the prior of the pad models (`experiments.studies.priors`). Test
objects in the left-out physics give the scores. Pad models are fitted to a few touches of the training objects in that
physics, or to as many as the run had. An oracle, fitted to as many touches without errors of pose and reading, shows
the cost of these errors. "None" is the pad model of the matched physics, with a prior from that physics.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from experiments.common.runs import Part
from experiments.studies import free_sides, layered_skin
from experiments.studies.lab import SETS, StudyLab, StudyWorld
from experiments.studies.mismatch import faulty
from experiments.studies.priors import WorldCall, call_of, prior_from, prior_without
from experiments.studies.report import Column, clusters_of, make_table, pool_parts
from experiments.studies.winkler import winkler_press
from i2t.intervals import mean_interval
from i2t.recognition import calibrated, metrics
from i2t.recognition.calibrated import TemperatureScaling
from i2t.recognition.episodes import run_belief
from i2t.skin_models.pad_fit import fit_oracle_pad_model
from i2t.skin_models.pad_model import PadModel, inflate_errors
from i2t.skin_models.reading_model import LAYERS
from i2t.types import Board

INFLATIONS = (0.35, 0.5, 0.7, 1.0, 1.4, 2.0)  # candidate factors of the errors of readings
WITHOUT = "position and presence"  # evidence of a belief without readings
KINDS = ("fused", "readings")
MATCHED = "bonded layer"
TWO_LAYERS = "soft layer on a stiff one"
ALL = "all"  # as many as the run has
ELSEWHERE = "none"  # no touches of its own: the pad model is that of the matched physics
ORACLE = "oracle"


def worlds(lab: StudyLab) -> dict[str, StudyWorld]:
    """Worlds by physics; the first matches the pad model's layer."""
    pad, errors = lab.run.pad, lab.cfg.errors
    chips = jnp.asarray(pad.board.chips) + jnp.array([[0.3e-3, 0.4e-3, 0.0]], jnp.float32)
    worn = pad._replace(young=0.7 * pad.young, magnetization=0.9 * pad.magnetization)
    physics = {
        MATCHED: StudyWorld(),
        "Winkler foundation": StudyWorld(law=lambda _: winkler_press),
        "free side faces": StudyWorld(law=free_sides.press_law),
        "soft compressible layer": StudyWorld(pad=pad._replace(young=0.6 * pad.young, poisson=jnp.float32(0.3))),
        "softer layer": StudyWorld(pad=pad._replace(young=0.8 * pad.young, poisson=jnp.float32(0.4))),
        TWO_LAYERS: StudyWorld(law=partial(layered_skin.press_law, layers=((0.5, 0.5), (0.5, 2.0)))),
        "worn pad": StudyWorld(pad=worn, errors=faulty(errors, relaxation=0.15)),
        "skin remounted 0.5 mm off": StudyWorld(pad=pad._replace(board=Board(chips, pad.board.rotations))),
    }
    return {name: world for name, world in physics.items() if name in (MATCHED, TWO_LAYERS) or not lab.size.debug}


def evaluate(lab: StudyLab) -> Part:
    """Compute beliefs `(e, t, objects)` by set and "physics; touches; inflation; evidence", and each set's truth."""
    key_touch, key_fit, *keys = jax.random.split(lab.key, 2 + len(SETS))
    physics, surfaces = worlds(lab), lab.trained_surfaces()
    touched = {
        name: lab.touch_known_objects(jax.random.fold_in(key_touch, i), surfaces, world)
        for i, (name, world) in enumerate(physics.items())
    }
    calls = {name: call_of(dataset) for name, dataset in touched.items()}
    key_elsewhere = jax.random.fold_in(key_fit, len(physics))
    matched = lab.refit(key_elsewhere, touched[MATCHED], surfaces, None, prior_from([calls[MATCHED]]))
    models = {(MATCHED, ELSEWHERE): matched}
    for i, (name, dataset) in enumerate(touched.items()):
        prior = prior_without(calls, name)
        for count in (20, None) if lab.size.debug else (20, 200, None):  # None: as many as the run had
            model = lab.refit(jax.random.fold_in(key_fit, i), dataset, surfaces, count, prior)
            models[name, ALL if count is None else str(count)] = model
        rows = np.ones(len(dataset), bool)
        models[name, ORACLE] = fit_oracle_pad_model(dataset, rows, model, lab.cfg.limits, discrepancy=prior.discrepancy)
    part: Part = {
        "layers": np.array([[float(x) for x in model.reading_model.layer] for model in models.values()]),
        "calls": np.stack([_as_row(call) for call in calls.values()]),
    }
    for name, key, objects in zip(SETS, keys, (lab.cfg.validation, lab.cfg.objects), strict=True):
        part[name] = _evaluate_set(lab.with_objects(objects), key, physics, models, name)
    return part


def _as_row(call: WorldCall) -> np.ndarray:
    """Flatten the best prior of a world: the layer's Poisson's ratio and modulus, then weights, bend and width."""
    weights, bend, width, _ = call.discrepancy
    return np.array([*(float(part) for part in LAYERS[call.layer]), *np.asarray(weights), float(bend), float(width)])


def _evaluate_set(
    lab: StudyLab,
    key: Array,
    physics: dict[str, StudyWorld],
    models: dict[tuple[str, str], PadModel],  # by physics and number of its own touches
    label: str,
) -> Part:
    key_sites, key_episodes = jax.random.split(key)
    truth, particles = lab.truth(), lab.particles()
    plan = lab.plan(key_sites, len(truth))
    tables = lab.predict(plan.sites, particles, [model.reading_model for model in models.values()], label)
    by_model = dict(zip(models, tables, strict=True))
    part: Part = {"truth": truth, "pool": plan.pool}
    for name, world in physics.items():
        episodes = lab.simulate(jax.random.clone(key_episodes), plan, truth, f"{label}, {name}", world=world)
        for (where, touches), model in models.items():
            if touches != ELSEWHERE and where != name:
                continue
            table, case = by_model[where, touches], f"{name}; {touches}"
            without = run_belief(table, episodes, model.likelihood, particles, [WITHOUT])
            part[f"{case}; 1; {WITHOUT}"] = without[WITHOUT]
            for factor in INFLATIONS:
                beliefs = run_belief(table, episodes, inflate_errors(model, factor).likelihood, particles, KINDS)
                part |= {f"{case}; {factor:g}; {kind}": p for kind, p in beliefs.items()}
    return part


class LeftOutBeliefs(NamedTuple):
    """Beliefs of test episodes in one physics, with inflation and temperature from the others."""

    p: np.ndarray  # (e, t, objects)
    inflation: float


def leave_out(parts: Sequence[Part], physics: str, touches: str, kind: str) -> LeftOutBeliefs:
    """Fit inflation and temperature to validation episodes in all other physics, and apply them to test episodes.

    For the pad model of the matched physics (`ELSEWHERE`), both are fitted to episodes in the matched physics alone.

    Args:
        parts: Results of the pads and seeds.
        physics: The physics that is left out.
        touches: Number of its own touches that the pad model is fitted to.
        kind: Evidence of the belief.

    Returns:
        Calibrated beliefs of the test episodes, and the chosen inflation.
    """
    validation, test = (pool_parts([part[name] for part in parts]) for name in SETS)
    others = [name for name in names_of(parts) if name != physics] if touches != ELSEWHERE else [MATCHED]
    truth = np.tile(validation["truth"], len(others))
    candidates: list[tuple[float, float, TemperatureScaling]] = []
    for factor in (1.0,) if kind == WITHOUT else INFLATIONS:
        p = np.concatenate([validation[f"{name}; {touches}; {factor:g}; {kind}"] for name in others]).astype(np.float64)
        temperature = calibrated.fit_temperature(p, truth)
        loss = metrics.log_loss(calibrated.calibrated_beliefs(p, temperature), truth).mean()
        candidates.append((float(loss), factor, temperature))
    _, factor, temperature = min(candidates, key=lambda candidate: candidate[0])
    p = test[f"{physics}; {touches}; {factor:g}; {kind}"].astype(np.float64)
    return LeftOutBeliefs(calibrated.calibrated_beliefs(p, temperature), factor)


def names_of(parts: Sequence[Part]) -> list[str]:
    """Names of the simulated physics."""
    return list(dict.fromkeys(key.split("; ")[0] for key in parts[0]["test"] if "; " in key))


def report(parts: Sequence[Part], pads: Sequence[str]) -> dict[str, Any]:
    """Report accuracy in each left-out physics, its difference from the matched one with all touches, and the log loss
    minus that of a belief without readings.
    """
    tests = [part["test"] for part in parts]
    clusters, truth = clusters_of(tests, pads), np.concatenate([part["truth"] for part in tests])
    cases = list(dict.fromkeys(tuple(key.split("; ")[:2]) for key in tests[0] if "; " in key))
    cases.remove((MATCHED, ELSEWHERE))  # its calibration leaves no physics out
    rows, inflations = [], {}
    for kind in KINDS:
        matched = metrics.hits(leave_out(parts, MATCHED, ALL, kind).p, truth)
        for name, touches in cases:
            judged = leave_out(parts, name, touches, kind)
            hits, loss = metrics.hits(judged.p, truth), metrics.log_loss(judged.p, truth)
            objects = judged.p.shape[-1]
            without = (
                leave_out(parts, name, touches, WITHOUT).p if kind == "fused" else np.full_like(judged.p, 1 / objects)
            )
            gained = mean_interval((loss - metrics.log_loss(without, truth)).mean(1), clusters)
            mean = metrics.mean_accuracy(judged.p, truth, clusters=clusters)
            lost = metrics.compare_paired(hits, matched, clusters=clusters).mean
            rows.append([name, kind, touches, mean, lost, float(loss.mean()), gained])
            inflations[f"{name}, {kind}, {touches}"] = judged.inflation
    head = [
        "physics", "evidence", "touches of this skin", Column("mean over touches [95 %]", 2),
        Column(f"difference from {MATCHED}", 2, signed=True), Column("log loss", 2),
        Column("log loss, difference from that without readings", 2, signed=True),
    ]  # fmt: skip
    layers, tables = np.concatenate([part["layers"] for part in parts]), {"methods": make_table(head, rows)}
    calls = np.stack([part["calls"] for part in parts], axis=1)  # (physics, parts, values)
    return {
        "episodes": len(truth),
        "inflations": inflations,
        "layers": layers.tolist(),
        "calls": dict(zip(names_of(parts), calls.tolist(), strict=True)),
        "tables": tables,
    }
