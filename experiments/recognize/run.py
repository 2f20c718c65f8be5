"""Question: which object is it, by touch, and how sure can one be?

    python -m experiments.recognize                       on runs/train of python -m experiments.train
    python -m experiments.recognize --preset debug        a handful of episodes, too few to mean anything
    python -m experiments.recognize --trained-run runs/study    every pad and seed of a study, intervals over all
    python -m experiments.recognize --objects a.stl b.stl --unit mm      meshes of your own, simulated episodes
    python -m experiments.recognize --dataset DIR         recorded touches, each session an episode; the pad model is of
                                                          --trained-run, or of --pad, and of the skin that recorded

The objects were not trained on. Each episode puts one of them down with the errors of the world, touches it ten times
at random safe sites of random candidates, and asks after each touch which one it is:

  the paper       exp(-|tau - tau~|) of the run's predictor at the believed pose; votes, their average, product;
                  and the same with the distance from the contact to the nearest point of each model (proprioception);
  the belief      `i2t.recognition.belief` with a pad model fitted to the training touches, whose objects were
                  registered by their contacts: from readings alone, from positions alone, and from both; next to it an
                  oracle fitted to the same touches without any error of pose or noise.

The paper's two sets (three primitives, two tools) are played apart, with the paper's heuristic for the next touch, and
all five as one set. What was fixed before testing is in docs/recognition.md. Everything is simulated unless --dataset
says otherwise. Results go to --out: metrics.json, config.json, episodes of each seed (npz) and figures.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from experiments.common.presets import choose_preset
from experiments.common.runs import begin
from experiments.recognize import recorded, trained_run
from experiments.recognize import report as reporting
from experiments.recognize.config import PRESETS, PresetName, Recognition
from experiments.recognize.trained_run import TrainedRun, finished_runs, load_meshes, meshes_by_name
from i2t import dataset as data
from i2t.objects import Mesh
from i2t.recognition.belief import Particles
from i2t.recognition.episodes import EpisodeConfig, run_belief, run_episodes
from i2t.recognition.outcomes import PredictedTouch
from i2t.recognition.pad_model import PadModel, fit_oracle_pad_model
from i2t.recognition.paper_rules import paper_rules
from i2t.recognition.site_pool import (
    SitePool,
    draw_informative_sites,
    draw_random_sites,
    pose_particles,
    precompute_outcomes,
    prepare_surfaces,
    sample_sites,
)
from i2t.types import Board, Surface


@dataclass(frozen=True)
class SimulateArgs:
    """Recognise objects by touch and report how often and how sure."""

    out: Path = Path("runs/recognize")  # folder for everything that is made
    trained_run: Path = Path("runs/train")  # a finished run of experiments.train, or a study's folder of several
    preset: PresetName = "paper"
    objects: tuple[Path, ...] = ()  # to tell apart: names of the catalogue and mesh files
    unit: str | None = None  # of those files, for instance mm
    dataset: Path | None = None  # recorded touches to recognise; its objects are the catalogue's or those of --objects
    pad: Path | None = None  # with --dataset, in place of a run's: an earlier session, a pad or a pad model of the skin
    other_skin: bool = False  # with --dataset: judge touches of another skin all the same, and say so
    max_touches: int | None = None  # with --dataset: of each session; by default as many as all long enough ones have
    rig: Path | None = None  # of the lab that recorded them: its object_covariance says how far poses may be off
    episodes: int | None = None  # of each object, for each pad and seed
    paper_episodes: int | None = None  # the same in the paper's sets, twice as many unless given
    seed: int = 0
    resume: bool = False  # go on with an unfinished run in --out
    overwrite: bool = False  # replace a finished or unfinished run in --out


class ObjectSet(NamedTuple):
    """A set of objects to tell apart."""

    names: Sequence[str]
    episodes: int  # of each
    heuristic: bool  # whether the paper's chooses the sites


class Predictions(NamedTuple):
    """Objects, sites, and what each object would feel like at each site with the pad model and with the oracle."""

    names: list[str]
    surfaces: list[Surface]
    sites: SitePool
    particles: Particles
    tables: list[PredictedTouch]


def run(args: SimulateArgs) -> dict[str, Any]:
    """Every pad and seed of the run, then the tables over them."""
    cfg = configure(args)
    if args.dataset is not None:
        return recorded.run(args, cfg)
    if args.pad is not None:
        raise ValueError(
            "--pad is for recorded touches (--dataset); simulate with it: python -m experiments.train --pad"
        )
    folders = finished_runs(args.trained_run)
    begin(args.out, args, cfg, args.resume, args.overwrite)
    parts = []
    for i, folder in enumerate(folders):
        path = args.out / f"episodes-{i}.npz"
        if not path.exists():
            reporting.save(path, play(args, cfg, folder, args.seed + i))
        parts.append(reporting.load(path))
    touched = data.load_dataset(folders[0] / "data.h5")
    return report(args, parts, touched.source, touched.board)


def configure(args: SimulateArgs) -> Recognition:
    """The preset with the numbers of episodes that the command line asks for."""
    cfg = choose_preset(PRESETS, args.preset)
    if args.episodes is not None:
        n = args.episodes
        cfg = replace(cfg, episodes=n, paper_episodes=2 * n, validation_episodes=n)
    if args.paper_episodes is not None:
        cfg = replace(cfg, paper_episodes=args.paper_episodes)
    return cfg


def report(args: SimulateArgs, parts: list[reporting.Results], source: str, board: Board) -> dict[str, Any]:
    """Scores, figures, tables, and the report of one episode."""
    parts, temperatures = reporting.calibrate(parts)
    result = reporting.summarise(parts, temperatures, args.out, source)
    name = next(name for name in ("all", "your objects") if name in parts[0])
    meshes = load_meshes(args.objects, args.unit) if args.objects else meshes_by_name(parts[0][name].names)
    reporting.report_hardest_episode(parts[0][name], list(meshes.values()), args.out / "story", source, board)
    reporting.print_tables(result)
    reporting.print_calibration(result)
    print(f"\nresults and figures are in {args.out}")
    return result


def play(args: SimulateArgs, cfg: Recognition, folder: Path, seed: int) -> reporting.Results:
    """All sets of one pad and seed."""
    key_fit, key_groups = jax.random.split(jax.random.key(seed))
    trained = trained_run.load_trained_run(key_fit, folder, cfg.errors, cfg.limits)
    oracle = fit_oracle_pad_model(trained.dataset, trained.rows, trained.pad_model, cfg.limits)
    print(
        f"pad model fitted to {folder}: R2 {trained.pad_model.r2:.3f} on held-out touches, {oracle.r2:.3f} without "
        "errors of pose"
    )
    done: reporting.Results = {}
    groups = object_groups(args, cfg)
    prepared = iter(prepare_surfaces([mesh for meshes, _ in groups for mesh in meshes.values()]))  # compiled for once
    for i, (meshes, sets) in enumerate(groups):
        key_pool, key_sets = jax.random.split(jax.random.fold_in(key_groups, i))
        surfaces = [next(prepared) for _ in meshes]
        sites = sample_sites(key_pool, surfaces, list(meshes), cfg.num_sites, cfg.site_limits)
        particles = pose_particles(cfg.errors, cfg.num_particles, seed)
        tables = precompute_outcomes(
            surfaces, particles.twist, sites.T_w_t, [trained.pad_model.reading_model, oracle.reading_model],
            overtravel=cfg.limits.overtravel, label=", ".join(sets),
        )  # fmt: skip
        predictions = Predictions(list(meshes), surfaces, sites, particles, tables)
        for j, (name, objects) in enumerate(sets.items()):
            key = jax.random.fold_in(key_sets, j)
            done[name] = play_set(key, name, objects, predictions=predictions, cfg=cfg, trained=trained, oracle=oracle)
    return done


def object_groups(args: SimulateArgs, cfg: Recognition) -> list[tuple[dict[str, Mesh], dict[str, ObjectSet]]]:
    """Groups of meshes by name that share their sites, each with the sets that are played among them."""
    if args.objects:
        own = load_meshes(args.objects, args.unit)
        return [(own, {"your objects": ObjectSet(list(own), cfg.episodes, False)})]
    return [
        (
            meshes_by_name(cfg.validation),
            {"validation": ObjectSet(cfg.validation, cfg.validation_episodes, False)},
        ),
        (
            meshes_by_name(cfg.objects),
            {
                "all": ObjectSet(cfg.objects, cfg.episodes, False),
                "primitives": ObjectSet(cfg.primitives, cfg.paper_episodes, True),
                "tools": ObjectSet(cfg.tools, cfg.paper_episodes, True),
            },
        ),
    ]


def play_set(
    key: jax.Array,
    name: str,
    objects: ObjectSet,
    *,
    predictions: Predictions,
    cfg: Recognition,
    trained: TrainedRun,
    oracle: PadModel,
) -> reporting.EpisodeResults:
    """Simulated episodes with one set of objects, and what every method believes after each touch."""
    key_play, key_site = jax.random.split(key)
    which = [predictions.names.index(one) for one in objects.names]
    surfaces = [predictions.surfaces[i] for i in which]
    rows = np.flatnonzero(np.isin(predictions.sites.owner, which))
    sites = SitePool(predictions.sites.T_w_t[rows], np.searchsorted(which, predictions.sites.owner[rows]))
    truth = np.repeat(np.arange(len(which)), objects.episodes)
    draw = draw_informative_sites if objects.heuristic else draw_random_sites
    chosen = draw(key_site, sites, len(truth), cfg.touches)
    config = EpisodeConfig(cfg.errors, cfg.limits, cfg.touches)
    episodes = run_episodes(
        key_play, surfaces, truth, chosen, sites=sites, pad=trained.pad, config=config, label=name
    )  # fmt: skip
    believed: dict[str, np.ndarray] = {}
    models = (("", trained.pad_model), (", oracle", oracle))
    for (label, model), table in zip(models, predictions.tables, strict=True):
        some = jax.tree.map(lambda x: x[rows][:, which], table)
        found = run_belief(some, episodes, model.likelihood, predictions.particles)
        believed |= {f"{kind}{label}": p for kind, p in found.items()}
    believed |= paper_rules(trained.predictor, trained.pad_model.reading_std, surfaces, episodes)
    return reporting.EpisodeResults(tuple(objects.names), truth, believed, episodes)
