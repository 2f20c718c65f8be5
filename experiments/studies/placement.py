"""Confidence where the placement's error is stated wrong.

Objects stand as far off as in two worlds (1 and 2 mm and degrees), and half of it, the truth or twice as much is stated
to the belief. It infers the scale of what is stated; next to it is the belief that takes it as exact. Temperatures are
fitted on the validation objects over all of these worlds together, as nobody knows which of them is the real one.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from experiments.common.runs import Part
from experiments.recognize.trained_run import meshes_by_name
from experiments.studies.lab import Column, EpisodePlan, StudyLab, clusters_of, format_estimate, make_table, pool_parts
from i2t.recognition import belief, calibrated, metrics, outcomes
from i2t.recognition.belief import Likelihood, Particles
from i2t.recognition.episodes import Episodes
from i2t.recognition.metrics import to_json
from i2t.recognition.outcomes import PredictedTouch
from i2t.recognition.planning import update_beliefs
from i2t.recognition.site_pool import prepare_surfaces
from i2t.simulation.touches import SimulationErrors

TRUE_MM = (1.0, 2.0)  # and degrees, one standard deviation of the placement
STATED_FACTORS = {"half": 0.5, "right": 1.0, "double": 2.0}  # of it
SCALE_PRIORS = {"inferred": belief.ScalePrior(), "as stated": None}
ASKED_ERRORS = (0.01, 0.05, 0.1)
ALLOWED_EXCESS = 0.015  # by which stops may be wrong more often than asked
SCALE = "scale"  # prefix of the inferred scales in a part
VALIDATION, TEST = "validation", "test"


class Condition(NamedTuple):
    """True displacement of objects, and the error that is stated to the belief."""

    true_mm: float
    stated: str  # a key of `STATED_FACTORS`

    @property
    def stated_mm(self) -> float:
        """The placement's error that is stated (mm and degrees, one standard deviation)."""
        return self.true_mm * STATED_FACTORS[self.stated]

    def __str__(self) -> str:
        return f"{self.true_mm:g} mm, stated {self.stated_mm:g}"


CONDITIONS = tuple(Condition(true, stated) for true in TRUE_MM for stated in STATED_FACTORS)


class PlacementBeliefs(NamedTuple):
    """Beliefs along episodes."""

    probability: np.ndarray  # (e, t, objects)
    scale: np.ndarray  # (e,) of the placement's error after the last touch, a multiple of what was stated


def evaluate(lab: StudyLab) -> Part:
    """Beliefs on validation and test objects in every condition, with common random numbers."""
    sets = {VALIDATION: lab.cfg.validation, TEST: lab.cfg.objects}
    meshes = meshes_by_name([name for names in sets.values() for name in names])
    surfaces = dict(zip(meshes, prepare_surfaces(list(meshes.values())), strict=True))  # alike: compiled for once
    found: Part = {}
    for i, (label, names) in enumerate(sets.items()):
        key = jax.random.fold_in(lab.key, i)
        some = replace(lab, names=names, surfaces=[surfaces[name] for name in names], key=key)
        part = evaluate_objects(some, label)
        found |= {f"{label}: {column}": values for column, values in part.items()}
    return found


def evaluate_objects(lab: StudyLab, label: str) -> dict[str, np.ndarray]:
    """Truth, beliefs and inferred scales of one set of objects, by method and condition."""
    conditions = CONDITIONS[:3] if lab.args.debug else CONDITIONS
    key_sites, key_episodes = jax.random.split(lab.key)
    plan = lab.plan(key_sites)
    episodes = {
        true: lab.simulate(jax.random.clone(key_episodes), plan, f"{label}, {true:g} mm", errors=placed(lab, true))
        for true in sorted({condition.true_mm for condition in conditions})
    }
    found: dict[str, np.ndarray] = {"truth": plan.truth, "pool": plan.pool}
    for stated_mm in sorted({condition.stated_mm for condition in conditions}):
        for method in SCALE_PRIORS:
            particles, table = predict(lab, plan, stated_mm, method)
            for condition in conditions:
                if condition.stated_mm == stated_mm:
                    believed = believe(table, episodes[condition.true_mm], lab.pad_model.likelihood, particles)
                    found[f"{method}, {condition}"] = believed.probability
                    found[f"{SCALE}, {method}, {condition}"] = believed.scale
    return found


def placed(lab: StudyLab, mm: float) -> SimulationErrors:
    """The lab's errors with another one of placement, in mm and degrees."""
    return replace(lab.cfg.errors, placement=mm * 1e-3, placement_angle=np.radians(mm))


def predict(lab: StudyLab, plan: EpisodePlan, stated_mm: float, method: str) -> tuple[Particles, PredictedTouch]:
    """Pose particles for what is stated, and the touches predicted for them."""
    prior = outcomes.placement_std(stated_mm * 1e-3, np.radians(stated_mm))
    particles = belief.sample_particles(prior, lab.cfg.num_particles, lab.seed, scales=SCALE_PRIORS[method])
    label = f"stated {stated_mm:g} mm, {method}"
    (table,) = lab.predict(plan.sites, particles, [lab.pad_model.reading_model], label)
    return particles, jax.device_put(table)


def believe(
    table: PredictedTouch, episodes: Episodes, likelihood: Likelihood, particles: Particles
) -> PlacementBeliefs:
    """Beliefs along episodes, and the scales of the placement inferred by their ends."""
    count, touches = episodes.site.shape
    start = belief.init(particles, table.hit.shape[1], channels=table.reading.shape[-1])
    beliefs = jax.tree.map(lambda x: jnp.broadcast_to(x, (count, *x.shape)), start)
    after = []
    for i in range(touches):
        observations = jax.tree.map(lambda x, i=i: x[:, i], episodes.observations)
        beliefs, p = update_beliefs(beliefs, jnp.asarray(episodes.site[:, i]), observations, table, likelihood)
        after.append(np.asarray(p))
    return PlacementBeliefs(np.stack(after, axis=1), np.asarray(_scales(beliefs, particles)))


@jax.jit
def _scales(beliefs: belief.Belief, particles: Particles) -> Array:
    return jax.vmap(lambda state: belief.scale_posterior(state, particles)[0])(beliefs)


def report(parts: Sequence[Part], out: Path, pads: Sequence[str]) -> dict[str, Any]:
    """Accuracy, calibration and stopping errors of both methods in every condition."""
    columns = pool_parts(parts)
    truth = {name: columns.pop(f"{name}: truth") for name in (VALIDATION, TEST)}
    played = [{name: part[f"{TEST}: {name}"] for name in ("truth", "pool")} for part in parts]
    clusters = clusters_of(played, pads)
    result: dict[str, Any] = {"episodes": len(truth[TEST]), "methods": {}}
    for method in SCALE_PRIORS:
        names = [name for name in columns if name.startswith(f"{TEST}: {method}, ")]
        conditions = [name.removeprefix(f"{TEST}: {method}, ") for name in names]
        known = np.concatenate([columns[f"{VALIDATION}: {method}, {each}"] for each in conditions])
        temperature = calibrated.fit_temperature(known, np.tile(truth[VALIDATION], len(conditions)))
        print(f"\n{method}: temperature {temperature.initial:.2f} (1 + {temperature.growth:.3f} (t - 1)) after t")
        entry: dict[str, Any] = {"temperature": temperature._asdict(), "conditions": {}}
        for condition in conditions:
            p = calibrated.calibrated_beliefs(columns[f"{TEST}: {method}, {condition}"], temperature)
            scale = columns[f"{TEST}: {SCALE}, {method}, {condition}"]
            entry["conditions"][condition] = report_condition(condition, p, truth[TEST], scale, clusters)
        result["methods"][method] = entry
    result["tables"] = {"conditions": table_of_conditions(result["methods"])}
    return result


def table_of_conditions(methods: dict[str, Any]) -> dict[str, Any]:
    """Accuracy, calibration and errors of those that stopped, by what is stated of the placement's error."""
    rows = [
        [
            method, condition, {key: values[-1] for key, values in scores["accuracy"].items()}, scores["mean"],
            scores["ece"]["error"], *(stop["stopped_error"] for stop in scores["stopping"]),
        ]
        for method, entry in methods.items()
        for condition, scores in entry["conditions"].items()
    ]  # fmt: skip
    asked = [Column(f"wrong of those that stopped, {error:.0%} asked", 1, percent=True) for error in ASKED_ERRORS]
    head = ["scale", "placement", "after the last [95 %]", "mean over touches [95 %]", "ECE", *asked]
    return make_table(head, rows)


def report_condition(
    condition: str, p: np.ndarray, truth: np.ndarray, scale: np.ndarray, clusters: Sequence[np.ndarray]
) -> dict[str, Any]:
    """Print and return one condition's scores."""
    accuracy, mean = metrics.accuracy(p, truth, clusters=clusters), metrics.mean_accuracy(p, truth, clusters=clusters)
    last = metrics.calibration_error(metrics.confidence(p)[:, -1], metrics.hits(p, truth)[:, -1])
    stops = [metrics.stopping(p, truth, error, clusters=clusters) for error in ASKED_ERRORS]
    print(
        f"{condition}: {float(accuracy.mean[-1]):.3f} after {p.shape[1]}, mean {format_estimate(mean)}; "
        f"ECE {last.error:.3f} (chance {last.chance:.3f}); scale inferred {np.median(scale):.2f}"
    )
    for stop in stops:
        kept = float(stop.stopped_error.mean) <= stop.requested_error + ALLOWED_EXCESS
        print(
            f"    asked {stop.requested_error:4.0%}: {float(stop.stopped.mean):4.0%} stop, of which wrong "
            f"{format_estimate(stop.stopped_error)}{'' if kept else ' TOO OFTEN'}, all {format_estimate(stop.error)}"
        )
    return {
        "accuracy": to_json(accuracy), "mean": to_json(mean), "ece": to_json(last),
        "stopping": [to_json(stop) for stop in stops],
        "scale_percentiles_25_50_75": np.percentile(scale, [25, 50, 75]).tolist(),
    }  # fmt: skip
