"""Code that all studies share: a finished run with its pad model, objects to tell apart, simulated episodes, tables."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array

from experiments.common.intervals import with_interval
from experiments.common.presets import choose_preset
from experiments.common.runs import Part
from experiments.recognize import figures, trained_run
from experiments.recognize.config import PRESETS, Recognition
from experiments.recognize.trained_run import TrainedRun, meshes_by_name
from experiments.studies.arguments import StudyArgs
from i2t import viz
from i2t.dataset import Dataset
from i2t.recognition import metrics
from i2t.recognition.belief import Particles
from i2t.recognition.episodes import EpisodeConfig, Episodes, run_episodes
from i2t.recognition.intervals import MIN_CLUSTERS, Estimate, estimate_at
from i2t.recognition.metrics import to_json
from i2t.recognition.outcomes import LinearReadingModel, PredictedTouch
from i2t.recognition.pad_model import PadModel, fit_pad_model
from i2t.recognition.site_pool import (
    SitePool,
    plan_random_touches,
    pose_particles,
    precompute_outcomes,
    prepare_surfaces,
    sample_sites,
)
from i2t.simulation import touches as simulation
from i2t.simulation.press import PressLimits
from i2t.simulation.touches import SimulationErrors
from i2t.types import Pad, Surface

MAX_PARTICLES = 128  # of each object: with 64 to 512 accuracies are the same within 0.01
DEBUG_EPISODES = 2  # of each object
SHARED_BY = 5  # episodes that touch the same sites: one with each of five objects
FIRST_SEED = 100  # of the studies' keys, apart from those of other experiments


class EpisodePlan(NamedTuple):
    """Episodes before they are simulated: which object is there, and where it is touched."""

    sites: SitePool
    truth: np.ndarray  # (e,)
    chosen: np.ndarray  # (e, t) sites of the pool
    pool: np.ndarray  # (e,) number of the sites' draw: episodes of one number touch the same sites


@dataclass(frozen=True)
class StudyLab:
    """One pad and seed: the finished run with its pad model, and the objects to tell apart."""

    args: StudyArgs
    cfg: Recognition
    folder: Path  # of the run
    run: TrainedRun
    names: tuple[str, ...]
    surfaces: list[Surface]
    episodes: int  # of each object
    seed: int
    key: Array

    @property
    def pad_model(self) -> PadModel:
        """The pad model of the run."""
        return self.run.pad_model

    def particles(self, errors: SimulationErrors | None = None) -> Particles:
        """Pose particles of an object under some errors of placement, the lab's unless given."""
        return pose_particles(errors or self.cfg.errors, self.cfg.num_particles, self.seed)

    def sample_sites(self, key: Array) -> SitePool:
        """Safe sites of the lab's objects."""
        return sample_sites(key, self.surfaces, self.names, self.cfg.num_sites, self.cfg.site_limits)

    def truth(self, repeats: int = 1) -> np.ndarray:
        """Object of each episode: all in turn; `repeats` times as often where episodes are short."""
        return np.arange(len(self.surfaces) * self.episodes * repeats) % len(self.surfaces)

    def plan(self, key: Array, *, truth: np.ndarray | None = None, touches: int | None = None) -> EpisodePlan:
        """Episodes at random sites, `SHARED_BY` one after the other at the same ones; each object in turn is there
        unless a `truth` is given, which may number objects beyond the lab's.
        """
        truth = self.truth() if truth is None else truth
        plan = plan_random_touches(
            key, self.surfaces, self.names, len(truth), touches or self.cfg.touches, limits=self.cfg.site_limits,
            share=SHARED_BY,
        )  # fmt: skip
        return EpisodePlan(plan.sites, truth, plan.chosen, plan.pool)

    def predict(
        self, sites: SitePool, particles: Particles, models: Sequence[LinearReadingModel], label: str
    ) -> list[PredictedTouch]:
        """Predicted touches of the lab's objects, for each reading model."""
        overtravel = self.cfg.limits.overtravel
        return precompute_outcomes(
            self.surfaces, particles.twist, sites.T_w_t, models, overtravel=overtravel, label=label
        )

    def simulate(
        self,
        key: Array,
        plan: EpisodePlan,
        label: str,
        *,
        surfaces: Sequence[Surface] | None = None,
        pad: Pad | None = None,
        errors: SimulationErrors | None = None,
        limits: PressLimits | None = None,
    ) -> Episodes:
        """Simulated episodes; surfaces, pad, errors and limits are the lab's unless given."""
        config = EpisodeConfig(errors or self.cfg.errors, limits or self.cfg.limits, plan.chosen.shape[1])
        return run_episodes(
            key, surfaces or self.surfaces, plan.truth, plan.chosen,
            sites=plan.sites, pad=pad or self.run.pad, config=config, label=label,
        )  # fmt: skip

    def refit(self, key: Array, *, pad: Pad | None = None, limits: PressLimits | None = None) -> PadModel:
        """The pad model as the run fitted it, but from touches of another pad, or of presses with other limits."""
        pad, limits, errors = pad or self.run.pad, limits or self.cfg.limits, self.cfg.errors
        key_press, key_fit = jax.random.split(key)
        names, counts = self._trained_on()
        surfaces = [self.run.surfaces[name] for name in names]
        made = simulation.simulate_touches(key_press, surfaces, pad, errors, counts, limits=limits)
        dataset = Dataset.simulated(made, names, pad)
        rows = np.ones(len(dataset), bool)
        return fit_pad_model(key_fit, dataset, rows, self.run.surfaces, errors=errors, limits=limits)

    def _trained_on(self) -> tuple[tuple[str, ...], list[int]]:
        """Objects that the run trained on, and the number of touches of each."""
        which, counts = np.unique(self.run.dataset.touches.object[self.run.rows], return_counts=True)
        return tuple(self.run.dataset.objects[i] for i in which), counts.tolist()


def prepare_lab(args: StudyArgs, folder: Path, seed: int) -> StudyLab:
    """Read a finished run, fit its pad model, and prepare the objects."""
    cfg = choose_preset(PRESETS, args.preset)
    cfg = replace(cfg, num_particles=min(cfg.num_particles, MAX_PARTICLES))
    key_fit, key = jax.random.split(jax.random.key(FIRST_SEED + seed))
    run = trained_run.load_trained_run(key_fit, folder, cfg.errors, cfg.limits)
    surfaces = prepare_surfaces(list(meshes_by_name(cfg.objects).values()))
    episodes = DEBUG_EPISODES if args.debug else args.episodes
    return StudyLab(args, cfg, folder, run, cfg.objects, surfaces, episodes, seed, key)


# --- reports ---


def clusters_of(parts: Sequence[Part], pads: Sequence[str], *, objects: str | None = None) -> list[np.ndarray]:
    """Clusters of the pooled episodes, for their intervals: by pad, by the draw of their sites where parts tell it, and
    with `objects`, a column's name, by the object that was there. Without them intervals are for these very objects.
    """
    counts = [len(part["truth"]) for part in parts]
    labels = [np.repeat(np.asarray(pads), counts)]
    if all("pool" in part for part in parts):
        run = np.repeat(np.arange(len(parts)), counts)
        labels.append(np.stack([run, np.concatenate([part["pool"] for part in parts])]))
    if objects is not None:
        labels.append(np.concatenate([part[objects] for part in parts]))
    numbers = [np.unique(label, axis=-1, return_inverse=True)[1].reshape(-1) for label in labels]
    # Nothing tells episodes of one or two clusters apart: their interval is for these very ones.
    return numbers if any(number.max() >= MIN_CLUSTERS - 1 for number in numbers) else []


def pool_parts(parts: Sequence[Part]) -> dict[str, np.ndarray]:
    """Arrays of several pads and seeds as one, by name. Raises ValueError where the pads were not asked the same."""
    for part in parts:
        if differing := sorted(set(part) ^ set(parts[0])):
            raise ValueError(
                f"the parts of this study are not of one version ({differing[0]!r} is in some of them only); "
                "delete its folder and run it again"
            )
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def format_estimate(estimate: Estimate) -> str:
    """A mean with its interval."""
    return with_interval(*estimate)


class Column(NamedTuple):
    """A column of a study's table in the documents: how its numbers are written."""

    name: str
    decimals: int = 3
    signed: bool = False
    percent: bool = False


def make_table(columns: Sequence[Any], rows: Sequence[Sequence[Any]]) -> dict[str, Any]:
    """A table as `metrics.json` holds it and `experiments.reproduce` writes it: the same form for all studies.

    Args:
        columns: `Column`, or a name alone.
        rows: Words, numbers, and means with their intervals (`Estimate`, or the dict of its JSON).
    """
    described = [column if isinstance(column, Column) else Column(column) for column in columns]
    return {
        "columns": [column._asdict() for column in described],
        "rows": [[cell if isinstance(cell, str) else to_json(cell) for cell in row] for row in rows],
    }


def touches_shown(touches: int, shown: Sequence[int]) -> list[int]:
    """Numbers of touches that a table shows, of those that there are."""
    return sorted({min(t, touches) for t in shown})


def report_error(name: str, unit: str, values: np.ndarray, where: str) -> dict[str, Any]:
    """Print and return quantiles of an error."""
    percentiles = np.percentile(values, [25, 50, 75, 90])
    print(f"{name}: median {percentiles[1]:.2f} {unit}, 90 % below {percentiles[3]:.2f} {unit} {where}")
    return {"unit": unit, "of": len(values), "percentiles_25_50_75_90": percentiles.tolist()}


def report_methods(parts: Sequence[Part], out: Path, pads: Sequence[str]) -> dict[str, Any]:
    """Accuracy of every method on the same episodes, and its paired difference to the first setting; methods are
    called "evidence, setting".
    """
    columns, clusters = pool_parts(parts), clusters_of(parts, pads)
    truth = columns.pop("truth")
    columns.pop("pool", None)
    result: dict[str, Any] = {"episodes": len(truth), "methods": {}}
    settings: dict[str, dict[str, Estimate]] = {}
    first: dict[str, np.ndarray] = {}  # whether right, by evidence, in the first setting
    rows: list[list[Any]] = []
    for name, beliefs in columns.items():
        p = beliefs.astype(np.float64)
        evidence, _, setting = name.partition(", ")
        accuracy = metrics.accuracy(p, truth, clusters=clusters)
        mean = metrics.mean_accuracy(p, truth, clusters=clusters)
        hits = metrics.hits(p, truth)
        lost = metrics.compare_paired(hits, first.setdefault(evidence, hits), clusters=clusters)
        log_loss = metrics.log_loss(p, truth).mean(0)
        result["methods"][name] = {
            "accuracy": to_json(accuracy), "mean": to_json(mean), "difference_last": to_json(lost.last),
            "difference_mean": to_json(lost.mean), "log_loss": log_loss.tolist(),
        }  # fmt: skip
        last = estimate_at(accuracy, -1)
        settings.setdefault(setting or "all settings", {})[evidence] = last
        rows.append([setting or "-", evidence, last, lost.last, mean, lost.mean, float(log_loss.mean())])
        print(
            f"{name:50} after {p.shape[1]}: {format_estimate(last)} ({format_estimate(lost.last)})   "
            f"mean: {format_estimate(mean)} ({format_estimate(lost.mean)})"
        )
    reference = next(iter(settings))
    head = [
        "setting", "evidence", Column(f"after {p.shape[1]} [95 %]"), Column(f"minus {reference}", signed=True),
        Column(f"mean of 1 to {p.shape[1]} [95 %]"), Column(f"minus {reference}", signed=True),
        Column("log loss", decimals=2),
    ]  # fmt: skip
    result["tables"] = {"methods": make_table(head, rows)}
    figure = figures.sensitivity(settings, f"After {p.shape[1]} touches", "accuracy", True)
    viz.save_figure(figure, out / "accuracy.png")
    return result
