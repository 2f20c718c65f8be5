"""Comparison of the belief's constants with other values.

Each constant takes a few values, one constant at a time, on the same episodes with the validation objects; test objects
take no part. Values are compared by the log loss over all touches after a temperature of their own, as that is fitted
in any case, and by their differences to the value in use on the same episodes.

  likelihood  the numbers of `i2t.recognition.belief.Likelihood` that errors of the pad model do not tell;
  particles   their number and the width of the normal distributions about them;
  scale       the placement's error as stated, or its scale inferred with several priors, where half, all and twice
              of it is stated;
  planar      the inflation of errors on the planar table, where readings are those of the nearest node.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.common.runs import Part
from experiments.recognize.trained_run import meshes_by_name
from experiments.studies import planar
from experiments.studies.lab import Column, EpisodePlan, StudyLab, clusters_of, format_estimate, make_table, pool_parts
from experiments.studies.placement import STATED_FACTORS, Condition, believe, placed
from i2t.recognition import belief, calibrated, metrics, outcomes
from i2t.recognition.belief import Likelihood, Particles, ScalePrior
from i2t.recognition.episodes import Episodes
from i2t.recognition.intervals import Clusters, mean_interval
from i2t.recognition.metrics import to_json
from i2t.recognition.site_pool import prepare_surfaces

PLACEMENT_MM = 1.0  # and degrees, one standard deviation of the placement in every world
IN_USE = "in use"
LIKELIHOOD = {
    "dof": (4.0, 16.0),
    "inflation": (1.5, 2.2),
    "indentation_error": (0.1, 0.3, 0.5),
    "outlier_rate": (0.003, 0.03),
    "tactile_weight": (0.5, 0.75),
}
POSITION_FACTORS = (0.5, 2.0)  # of the standard deviations of positions
PARTICLE_COUNTS = (32, 64, 256, 512)
STD_RATIOS = (0.35, 0.7)
SCALE_PRIORS = {
    "log_std = 0.7, drawn = 2": ScalePrior(),
    "log_std = 0.35, drawn = 2": ScalePrior(log_std=0.35),
    "log_std = 0.7, drawn = 1": ScalePrior(drawn=1.0),
    "log_std = 0.35, drawn = 1": ScalePrior(log_std=0.35, drawn=1.0),
    "log_std = 1.4, drawn = 2": ScalePrior(log_std=1.4),
}
PLANAR_INFLATIONS, DEBUG_INFLATIONS = (1.0, 1.3, 1.7, 2.5), (1.0, 1.7)
CONSTANT_KINDS = ("likelihood", "particles", "scale", "planar")


class ConstantChoice(NamedTuple):
    """One constant with another value than the one in use."""

    constant: str
    value: float

    def __str__(self) -> str:
        return f"{self.constant} = {self.value:g}"


def evaluate(lab: StudyLab) -> Part:
    """Beliefs on the validation objects with every value of every constant."""
    surfaces = prepare_surfaces(list(meshes_by_name(lab.cfg.validation).values()))
    lab = replace(lab, names=lab.cfg.validation, surfaces=surfaces)
    key_sites, key_episodes, key_planar = jax.random.split(lab.key, 3)
    plan = lab.plan(key_sites)
    episodes = lab.simulate(key_episodes, plan, "validation", errors=placed(lab, PLACEMENT_MM))
    beliefs = partial(beliefs_with, lab, plan, episodes)
    return {
        "truth": plan.truth,
        "pool": plan.pool,
        "likelihood": likelihood_choices(lab.pad_model.likelihood, beliefs),
        "particles": particle_choices(beliefs, debug=lab.args.debug),
        "scale": scale_choices(beliefs, debug=lab.args.debug),
        **planar_inflations(replace(lab, key=key_planar)),
    }


def beliefs_with(
    lab: StudyLab,
    plan: EpisodePlan,
    episodes: Episodes,
    likelihoods: dict[str, Likelihood] | None = None,
    *,
    stated_mm: float = PLACEMENT_MM,
    num_particles: int | None = None,
    std_ratio: float = belief.PARTICLE_STD_RATIO,
    scales: ScalePrior | None = None,
) -> dict[str, np.ndarray]:
    """Beliefs (e, t, objects) with each likelihood, the one in use unless given, from one table of predictions."""
    prior = outcomes.placement_std(stated_mm * 1e-3, np.radians(stated_mm))
    count = num_particles or lab.cfg.num_particles
    particles: Particles = belief.sample_particles(prior, count, lab.seed, std_ratio=std_ratio, scales=scales)
    (table,) = lab.predict(plan.sites, particles, [lab.pad_model.reading_model], f"{count} poses")
    table = jax.device_put(table)
    likelihoods = likelihoods or {IN_USE: lab.pad_model.likelihood}
    return {name: believe(table, episodes, each, particles).probability for name, each in likelihoods.items()}


def likelihood_choices(in_use: Likelihood, beliefs: Callable[..., dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Beliefs with other constants of the likelihood."""
    tried = {IN_USE: in_use}
    for constant, values in LIKELIHOOD.items():
        for value in values:
            tried[str(ConstantChoice(constant, value))] = in_use._replace(**{constant: jnp.float32(value)})
    for factor in POSITION_FACTORS:
        tried[str(ConstantChoice("position_std, times", factor))] = in_use._replace(
            position_std=factor * in_use.position_std
        )
    return beliefs(tried)


def particle_choices(beliefs: Callable[..., dict[str, np.ndarray]], *, debug: bool) -> dict[str, np.ndarray]:
    """Beliefs with more, fewer, wider and narrower particles."""
    found = {IN_USE: beliefs()[IN_USE]}
    for count in PARTICLE_COUNTS[:1] if debug else PARTICLE_COUNTS:
        found[str(ConstantChoice("num_particles", count))] = beliefs(num_particles=count)[IN_USE]
    for ratio in STD_RATIOS[:1] if debug else STD_RATIOS:
        found[str(ConstantChoice("std_ratio", ratio))] = beliefs(std_ratio=ratio)[IN_USE]
    return found


def scale_choices(beliefs: Callable[..., dict[str, np.ndarray]], *, debug: bool) -> dict[str, np.ndarray]:
    """Beliefs (e, conditions, t, objects) with the placement's error as stated, and with its scale inferred."""
    priors: dict[str, ScalePrior | None] = {IN_USE: None, **dict(list(SCALE_PRIORS.items())[: 1 if debug else None])}
    stated = [Condition(PLACEMENT_MM, name).stated_mm for name in STATED_FACTORS]
    return {
        name: np.stack([beliefs(stated_mm=mm, scales=prior)[IN_USE] for mm in stated], axis=1)
        for name, prior in priors.items()
    }


def planar_inflations(lab: StudyLab) -> Part:
    """Beliefs about validation objects anywhere on the table, with several inflations."""
    grid = planar.DEBUG_GRID if lab.args.debug else planar.PlanarGrid()
    presses = planar.draw_presses(lab, grid)
    episodes, predicted = planar.simulate_presses(lab, presses, grid), planar.predict_touches(lab, grid)
    found = {}
    for value in DEBUG_INFLATIONS if lab.args.debug else PLANAR_INFLATIONS:
        name = IN_USE if value == grid.inflation else str(ConstantChoice("inflation", value))
        judge = planar.Judge(lab, predicted, replace(grid, inflation=value))
        found[name] = np.stack([judge.unknown(presses, episodes, i)[0] for i in range(len(presses.truth))])
    return {"planar truth": presses.truth, "planar": found}


def report(parts: Sequence[Part], out: Path, pads: Sequence[str]) -> dict[str, Any]:
    """Log loss of every value, and whether one beats the value in use by more than chance."""
    result: dict[str, Any] = {"episodes": sum(len(part["truth"]) for part in parts), "constants": {}}
    for kind in CONSTANT_KINDS:
        beliefs = pool_parts([part[kind] for part in parts])
        played = [{"truth": part["planar truth"]} for part in parts] if kind == "planar" else parts
        truth = np.concatenate([part["truth"] for part in played])
        result["constants"][kind] = report_kind(kind, beliefs, truth, clusters_of(played, pads))
    result["tables"] = {kind: table_of_values(entries) for kind, entries in result["constants"].items()}
    return result


def table_of_values(entries: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Log loss of each value, and how much lower it is than that of the value in use."""
    rows = [
        [value, scores["log_loss"], scores.get("lower_by", "-"), {k: v[-1] for k, v in scores["accuracy"].items()}]
        for value, scores in entries.items()
    ]
    return make_table(["value", "log loss", Column("lower by [95 %]", signed=True), "accuracy after the last"], rows)


def report_kind(
    kind: str, beliefs: dict[str, np.ndarray], truth: np.ndarray, clusters: Clusters
) -> dict[str, dict[str, Any]]:
    """Print and return the scores of one kind's values, each against the value in use."""
    losses = {name: calibrated_losses(p, truth) for name, p in beliefs.items()}
    entries: dict[str, dict[str, Any]] = {}
    print(f"\n{kind}: log loss over all touches, {len(truth)} episodes with validation objects")
    for name, loss in losses.items():
        p = beliefs[name].reshape(len(truth), -1, *beliefs[name].shape[-2:])[:, 0]
        accuracy = metrics.accuracy(p, truth, clusters=clusters)
        entries[name] = {"log_loss": float(loss.mean()), "accuracy": to_json(accuracy)}
        words = f"{name:28} {loss.mean():.3f}"
        if name != IN_USE:
            better = mean_interval(losses[IN_USE] - loss, clusters)
            entries[name]["lower_by"] = to_json(better)
            words += f"   lower by {format_estimate(better)}{'   BETTER' if better.low > 0 else ''}"
        print(words)
    return entries


def calibrated_losses(p: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Log loss (e,) of each episode's beliefs (e, ..., t, objects) over all touches and conditions, after the
    temperature that suits them best.
    """
    conditions = int(np.prod(p.shape[1:-2]))
    flat, repeated = p.reshape(-1, *p.shape[-2:]), np.repeat(truth, conditions)
    scaled = calibrated.calibrated_beliefs(flat, calibrated.fit_temperature(flat, repeated))
    return metrics.log_loss(scaled, repeated).reshape(len(truth), -1).mean(1)
