"""Question: how often are objects recognised by touch, and are the probabilities calibrated?

    python -m experiments.recognize                       a few episodes with the pad of runs/train, few poses of each
                                                          object, and wide intervals
    python -m experiments.recognize --preset paper        the numbers of episodes in the docs, in hours
    python -m experiments.recognize --method paper        the paper's own method and loop (experiments.recognize.paper)
    python -m experiments.recognize --preset debug        a handful of episodes, too few for meaningful results
    python -m experiments.recognize --pad-model runs/study      every pad and seed of a study, with intervals over pads
    python -m experiments.recognize --objects a.stl b.stl --unit mm      simulated episodes with your own meshes
    python -m experiments.recognize --dataset DIR         recorded touches (experiments.recognize.recorded)

No model was trained on the objects. Each episode places one of them with the errors of the simulation, and touches it
ten times at random safe sites, drawn anew for each touch. After each touch, the methods estimate the object:

  the belief      `i2t.recognition.belief` with the run's pad model, which was fitted to the training touches after
                  registration of their objects by contacts: from readings, from contact or its absence, from positions,
                  and from their combinations; an oracle is fitted to the same touches without errors of pose or noise;
  the paper       exp(-|tau - tau~|) of the paper's networks at the expected pose, combined by votes, average or
                  product; the same rules are applied to the run's Gaussian process, to a constant reading, and to the
                  distance from the contact to the nearest point of each model (proprioception).

The paper's two sets (three primitives, two tools) are separate, at sites that the paper's heuristic draws from random
candidates, so that all methods have the same episodes. All five objects also form one set. docs/recognition.md lists
the settings that were fixed before testing. Everything is simulated. Results go to --out: metrics.json (95 % intervals
over pads and pools of sites), config.json, episodes of each pad and seed (npz) and figures.
"""

from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from experiments.common.presets import choose_preset
from experiments.common.runs import Part, begin
from experiments.common.tasks import make_parts
from experiments.recognize import paper
from experiments.recognize import report as reporting
from experiments.recognize.arguments import SimulateArgs
from experiments.recognize.config import PRESETS, Recognition
from experiments.recognize.plans import ObjectSet, object_groups, plan_touches
from experiments.recognize.trained_run import TrainedRun, load_trained_run
from i2t.models.finished import FinishedRun, finished_runs
from i2t.objects import Mesh
from i2t.objects.named import read_meshes
from i2t.prediction.predictor import Predictor
from i2t.recognition.belief import Particles
from i2t.recognition.environment import EnvironmentConfig
from i2t.recognition.episodes import BeliefModel, believe
from i2t.recognition.metrics import to_json
from i2t.recognition.paper_rules import paper_rules
from i2t.recognition.rollout import run_episodes
from i2t.recognition.site_pool import pose_particles, prepare_surfaces
from i2t.skin_models.pad_fit import fit_oracle_pad_model
from i2t.skin_models.pad_model import PadModel, load_pad_model
from i2t.types import Surface


class EpisodeWorld(NamedTuple):
    """Data that the sets of one pad and seed share."""

    cfg: Recognition
    run: FinishedRun
    trained: TrainedRun
    oracle: PadModel
    predictors: dict[str, Predictor]  # for the paper's rules, by row
    particles: Particles


def run(args: SimulateArgs) -> dict[str, Any]:
    """Simulate the episodes of every pad and seed, and report the scores."""
    cfg, own = configure(args), read_meshes(args.objects, args.unit)
    runs = finished_runs(args.pad_model, args.pads)
    begin(args, cfg)
    by_paper = args.method == "paper"
    play_run = partial(paper.play, cfg) if by_paper else partial(play, cfg, own)
    stem = "loop" if by_paper else "episodes"
    makers = {args.out / f"{stem}-{i}.npz": partial(play_run, run, args.seed + i) for i, run in runs.items()}
    parts = [reporting.from_part(part) for part in make_parts(makers, args.workers)]
    return paper.report(args.out, runs.values(), parts) if by_paper else report(args.out, runs.values(), parts, own)


def configure(args: SimulateArgs) -> Recognition:
    """Apply the command line to the preset."""
    n = args.episodes
    of_paper = args.paper_episodes if args.paper_episodes is not None or n is None else 2 * n
    return choose_preset(
        PRESETS, args.preset, num_particles=args.num_particles,
        episodes=n, own_episodes=n, validation_episodes=n, paper_episodes=of_paper,
    )  # fmt: skip


def report(
    out: Path, runs: Iterable[FinishedRun], parts: list[reporting.Results], own: Mapping[str, Mesh]
) -> dict[str, Any]:
    """Write and print the scores, figures, and the report of one episode."""
    fitted = load_pad_model(next(iter(runs)).pad_model)
    source = fitted.origin.source
    parts, temperatures = reporting.calibrate(parts)
    about = {"temperatures": to_json(temperatures), **reporting.mean_over_objects(parts)}
    result = reporting.summarise(parts, out, source, **about)
    name = next(name for name in ("all", "your objects") if name in parts[0])
    meshes = own or read_meshes(parts[0][name].names)
    reporting.report_hardest_episode(parts[0][name], list(meshes.values()), out / "story", source, fitted.board)
    reporting.print_tables(result)
    reporting.print_mean_over_objects(result)
    reporting.print_stopping(result)
    return result


def play(cfg: Recognition, own: Mapping[str, Mesh], run: FinishedRun, seed: int) -> Part:
    """Simulate the episodes of all sets with one pad and seed."""
    _, key_groups = jax.random.split(jax.random.key(seed))
    trained = load_trained_run(run)
    oracle = fit_oracle_pad_model(trained.dataset, trained.rows, trained.pad_model, cfg.limits)
    print(
        f"pad model of {run.folder}: R2 {trained.pad_model.r2:.3f} on held-out touches, {oracle.r2:.3f} without "
        "errors of pose"
    )
    results: reporting.Results = {}
    particles = pose_particles(cfg.errors, cfg.num_particles, seed)
    mean = trained.dataset.touches.reading[trained.rows].mean(0)
    predictors = paper.rule_predictors(run.folder, paper.load_paper_networks(run), trained.predictor, mean)
    world = EpisodeWorld(cfg, run, trained, oracle, predictors, particles)
    groups = object_groups(own, cfg)
    # All at once, to compile once.
    prepared = iter(prepare_surfaces([mesh for meshes, _ in groups for mesh in meshes.values()]))
    for i, (meshes, sets) in enumerate(groups):
        surfaces = {name: next(prepared) for name in meshes}
        for j, (name, objects) in enumerate(sets.items()):
            key = jax.random.fold_in(jax.random.fold_in(key_groups, i), j)
            of_set = [surfaces[member] for member in objects.names]
            results[name] = play_set(key, name, objects, surfaces=of_set, world=world)
    return reporting.to_part(results)


def play_set(
    key: jax.Array, name: str, objects: ObjectSet, *, surfaces: Sequence[Surface], world: EpisodeWorld
) -> reporting.EpisodeResults:
    """Simulate episodes with one set of objects, and compute the beliefs of every method."""
    cfg, trained = world.cfg, world.trained
    key_play, key_site = jax.random.split(key)
    truth = np.arange(len(surfaces) * objects.episodes) % len(surfaces)
    plan = plan_touches(key_site, objects, surfaces, len(truth), cfg)
    oracle_evidence = ("readings and presence", "fused")
    models = {
        "": BeliefModel(trained.pad_model.reading_model, trained.pad_model.likelihood),
        ", oracle": BeliefModel(world.oracle.reading_model, world.oracle.likelihood, oracle_evidence),
    }
    config = EnvironmentConfig(cfg.errors, cfg.limits, cfg.touches)
    episodes = run_episodes(
        key_play, surfaces, truth, plan.chosen, sites=plan.sites, pad=trained.pad, config=config, label=name
    )
    beliefs = believe(
        surfaces, plan.sites, episodes, world.particles, models, overtravel=cfg.limits.overtravel, label=name
    )
    beliefs |= paper_rules(world.predictors, trained.pad_model.reading_std, surfaces, episodes)
    pools = np.array([f"{world.run.folder.name}, {name}, pool {number}" for number in plan.pool])
    return reporting.EpisodeResults(
        tuple(objects.names), truth, beliefs, episodes, f"pad {world.run.pad_name}", pools
    )  # fmt: skip
