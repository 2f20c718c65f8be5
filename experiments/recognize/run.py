"""Question: which object is it, told by touch, and how sure can one be?

    python -m experiments.recognize                       on runs/train of python -m experiments.train
    python -m experiments.recognize --preset debug        a handful of episodes, too few to mean anything
    python -m experiments.recognize --run runs/study      every pad and seed of a study, with intervals over all
    python -m experiments.recognize --objects a.stl b.stl --unit mm      meshes of your own, their sittings simulated
    python -m experiments.recognize --dataset DIR         recorded touches, each run a sitting, in place of simulated
    python -m experiments.recognize --live --help         an arm, real or not, that touches where the belief wants it to

The objects were never touched in training. Each sitting puts one of them down with the errors of the world, touches it
ten times at random safe sites of random candidates, and asks after each touch which one it is:

  the paper       exp(-|tau - tau~|) of the checkpoint's predictor at the believed pose; votes, their average, product;
                  and the same with the distance from the contact to the nearest point of each model (proprioception);
  the belief      `i2t.recognition.belief` on a pad learnt from the training touches, whose objects were registered by
  their
                  contacts: from readings alone, from positions alone, and from both; beside it an oracle that learnt
                  the same touches without any error of pose or noise.

The paper's two sets (three primitives, two tools) are played apart, with the paper's heuristic for the next touch, and
all five as one set. What was fixed before testing is in docs/recognition.md. Everything is simulated unless --dataset
says otherwise. Results go to --out: metrics.json, config.json, episodes of each seed (npz) and figures.
"""

import json
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

# Factors of a few hundred rows are too small to share, as in experiments.train.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax
import numpy as np
import tyro
from tqdm import tqdm

from experiments.common.runs import begin, reported
from experiments.recognize import report as reporting
from experiments.train.run import numbered_pad
from i2t import dataset as data
from i2t.collect import devices
from i2t.dataset import Dataset
from i2t.objects import catalogue
from i2t.objects.catalogue import Mesh
from i2t.prediction.predictor import Predictor, load_predictor
from i2t.recognition import belief
from i2t.recognition.belief import Particles
from i2t.recognition.episodes import (
    PadModel,
    SitePool,
    EpisodeConfig,
    Sitting,
    run_belief,
    learn,
    fit_oracle_pad_model,
    paper_rules,
    pose_particles,
    pool,
    draw_random_sites,
    episodes_from_dataset,
    prepare_surfaces,
    precompute_outcomes,
    draw_informative_sites,
)
from i2t.recognition.outcomes import PredictedTouch
from i2t.simulation import sites as touch_sites
from i2t.simulation.press import PressLimits
from i2t.simulation.touches import Errors
from i2t.skin.contact import FINE
from i2t.skin.files import load_pad
from i2t.types import Pad, Surface


@dataclass(frozen=True)
class Recognition:
    """How much of everything; what is fixed before testing."""

    primitives: tuple[str, ...] = ("square", "star", "cylinder")
    tools: tuple[str, ...] = ("screwdriver", "hammer")
    validation: tuple[str, ...] = ("flower", "cross", "pyramid", "cutter", "spanner")
    touches: int = 10
    sittings: int = 80  # of each object, in the set of all
    paper_sittings: int = 200  # of each object, in each of the paper's sets
    validation_sittings: int = 40  # of each validation object, for the conformal sets
    sites: int = 24  # of each object
    places: int = 512  # of each object
    errors: Errors = field(default_factory=Errors)
    limits: PressLimits = field(default_factory=lambda: PressLimits(final=FINE))
    reach: touch_sites.Limits = touch_sites.RECOGNITION


PRESETS = {
    "paper": Recognition(),
    "debug": Recognition(  # as many sittings in each set, so that they compile once
        primitives=("square", "cylinder"), tools=("screwdriver", "hammer"), validation=("flower", "spanner"),
        touches=3, sittings=3, paper_sittings=6, validation_sittings=6, sites=3, places=16, limits=PressLimits(),
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Args:
    """Recognise objects by touch and report how often and how sure."""

    out: Path = Path("runs/recognize")  # folder for everything that is made
    run: Path = Path("runs/train")  # a finished run of experiments.train, or a study's folder of several
    preset: Literal["paper", "debug"] = "paper"
    objects: tuple[Path, ...] = ()  # mesh files to tell apart, in place of the catalogue's
    unit: str | None = None  # of those files, for instance mm
    dataset: Path | None = None  # recorded touches to replay; its objects are the catalogue's or those of --objects
    rig: Path | None = None  # of the lab that recorded them: its object_covariance says how far poses may be off
    sittings: int | None = None  # of each object, for each pad and seed
    paper_sittings: int | None = None  # the same in the paper's sets, twice as many unless given
    seed: int = 0
    resume: bool = False  # go on with an unfinished run in --out
    overwrite: bool = False  # replace a finished or unfinished run in --out


def main(argv: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    argv = sys.argv[1:] if argv is None else argv
    if "--live" in argv:
        from experiments.recognize import live

        return live.main([word for word in argv if word != "--live"])
    args = tyro.cli(Args, args=argv, description=__doc__, prog="python -m experiments.recognize")
    return reported(partial(run, args), args.out)


def run(args: Args) -> dict[str, Any]:
    """Every pad and seed of the run, then the tables over them."""
    cfg = PRESETS[args.preset]
    if args.sittings is not None:
        n = args.sittings
        cfg = replace(cfg, sittings=n, paper_sittings=2 * n, validation_sittings=n)
    if args.paper_sittings is not None:
        cfg = replace(cfg, paper_sittings=args.paper_sittings)
    folders = finished_runs(args.run)
    begin(args.out, args, cfg, args.resume, args.overwrite)
    parts = []
    for i, folder in enumerate(folders):
        path = args.out / f"episodes-{i}.npz"
        if not path.exists():
            played = replay(args, cfg, folder) if args.dataset else play(args, cfg, folder, args.seed + i)
            reporting.save(path, played)
        parts.append(reporting.load(path))
    source = data.load(args.dataset).source if args.dataset else "simulated"
    parts, tempers = reporting.sobered(parts)
    result = reporting.summarise(parts, tempers, args.out, source)
    name = next(name for name in ("all", "recorded", "your objects") if name in parts[0])
    meshes = load_meshes(args.objects, args.unit) if args.objects else meshes_by_name(parts[0][name].names)
    reporting.tell(parts[0][name], list(meshes.values()), args.out / "story", source)
    reporting.report(result)
    reporting.extras(result)
    print(f"\nresults and figures are in {args.out}")
    return result


def finished_runs(folder: Path) -> list[Path]:
    """The folder of a run, or those of a study's pads and seeds. Raises ValueError where there is none."""
    folders = sorted(path.parent for path in folder.glob("pad-*-seed-*/metrics.json")) or [folder]
    if not (folders[0] / "metrics.json").exists():
        raise ValueError(f"{folder} holds no finished run; make one: python -m experiments.train --out {folder}")
    return folders


def play(args: Args, cfg: Recognition, folder: Path, seed: int) -> dict[str, reporting.Played]:
    """All sets of one pad and seed."""
    key_learn, key_groups = jax.random.split(jax.random.key(seed))
    told = taught_by(key_learn, folder, cfg)
    learnt, oracle = told.learnt, fit_oracle_pad_model(told.dataset, told.rows, told.learnt, cfg.limits)
    print(f"pad learnt from {folder}: R2 {learnt.r2:.3f} on touches left out, {oracle.r2:.3f} without errors of pose")
    done: dict[str, reporting.Played] = {}
    groups = candidates(args, cfg)
    prepared = iter(prepare_surfaces([mesh for meshes, _ in groups for mesh in meshes.values()]))  # compiled for once
    for i, (meshes, sets) in enumerate(groups):
        key_pool, key_sets = jax.random.split(jax.random.fold_in(key_groups, i))
        surfaces = [next(prepared) for _ in meshes]
        sites = sample_sites(key_pool, surfaces, list(meshes), cfg.sites, cfg.reach)
        placements = pose_particles(cfg.errors, cfg.places, seed)
        skins, what = [learnt.reading_model, oracle.reading_model], ", ".join(sets)
        tables = precompute_outcomes(surfaces, placements.twist, sites.T_w_t, skins, cfg.limits.past_goal, what)
        table = Imagined(list(meshes), surfaces, sites, placements, tables)
        for j, (name, part) in enumerate(sets.items()):
            key = jax.random.fold_in(key_sets, j)
            done[name] = play_set(key, name, part, table, cfg, told.pad, told.predictor, (learnt, oracle))
    return done


class Part(NamedTuple):
    """A set of objects to tell apart."""

    names: Sequence[str]
    sittings: int  # of each
    heuristic: bool  # whether the paper's chooses the sites


class Imagined(NamedTuple):
    """Objects, sites, and what each object would feel like at each site to the pad learnt and to the oracle."""

    names: list[str]
    surfaces: list[Surface]
    sites: SitePool
    placements: Particles
    tables: list[PredictedTouch]


def candidates(args: Args, cfg: Recognition) -> list[tuple[dict[str, Mesh], dict[str, Part]]]:
    """Groups of meshes by name that share their sites, each with the sets that are played among them."""
    if args.objects:
        own = load_meshes(args.objects, args.unit)
        return [(own, {"your objects": Part(list(own), cfg.sittings, False)})]

    everything = cfg.primitives + cfg.tools
    return [
        (meshes_by_name(cfg.validation), {"validation": Part(cfg.validation, cfg.validation_sittings, False)}),
        (
            meshes_by_name(everything),
            {
                "all": Part(everything, cfg.sittings, False),
                "primitives": Part(cfg.primitives, cfg.paper_sittings, True),
                "tools": Part(cfg.tools, cfg.paper_sittings, True),
            },
        ),
    ]


def play_set(
    key: jax.Array, name: str, part: Part, imagined: Imagined, cfg: Recognition, pad: Pad, predictor: Predictor,
    pads: tuple[PadModel, PadModel],
) -> reporting.Played:  # fmt: skip
    """Simulated sittings with one set of objects, and what every method believes after each touch."""
    key_play, key_site = jax.random.split(key)
    which = [imagined.names.index(one) for one in part.names]
    surfaces = [imagined.surfaces[i] for i in which]
    rows = np.flatnonzero(np.isin(imagined.sites.owner, which))
    sites = SitePool(imagined.sites.T_w_t[rows], np.searchsorted(which, imagined.sites.owner[rows]))
    truth = np.repeat(np.arange(len(which)), part.sittings)
    chosen = (draw_informative_sites if part.heuristic else draw_random_sites)(key_site, sites, len(truth), cfg.touches)
    sitting = Sitting(key_play, surfaces, truth, sites, pad, EpisodeConfig(cfg.errors, cfg.limits, cfg.touches))
    with tqdm(total=chosen.size, desc=f"{name}: touching", unit="touch") as bar:
        sitting.touch(chosen, bar)
    episodes = sitting.episodes()
    believed: dict[str, np.ndarray] = {}
    for label, learnt, table in zip(("", ", oracle"), pads, imagined.tables, strict=True):
        some = jax.tree.map(lambda x: x[rows][:, which], table)
        found = run_belief(some, episodes, learnt.likelihood, imagined.placements)
        believed |= {f"{kind}{label}": p for kind, p in found.items()}
    believed |= paper_rules(predictor, pads[0].std, surfaces, episodes)
    return reporting.Played(tuple(part.names), truth, believed, episodes)


def replay(args: Args, cfg: Recognition, folder: Path) -> dict[str, reporting.Played]:
    """Recorded sittings in place of simulated ones."""
    assert args.dataset is not None
    told = taught_by(jax.random.key(args.seed), folder, cfg)
    learnt = told.learnt
    recorded = data.load(args.dataset)
    meshes = load_meshes(args.objects, args.unit) if args.objects else meshes_by_name(recorded.objects)
    surfaces = prepare_surfaces(list(meshes.values()))
    sites, episodes = episodes_from_dataset(recorded, list(meshes), cfg.touches)
    placements = belief.sample_particles(devices.read_rig(args.rig).object_covariance, cfg.places, args.seed)
    (table,) = precompute_outcomes(surfaces, placements.twist, sites.T_w_t, [learnt.reading_model], cfg.limits.past_goal, "recorded")
    believed = run_belief(table, episodes, learnt.likelihood, placements)
    believed |= paper_rules(told.predictor, learnt.reading_std, surfaces, episodes)
    return {"recorded": reporting.Played(tuple(meshes), episodes.truth, believed, episodes)}


class Taught(NamedTuple):
    """A finished run of experiments.train, and the pad as its touches taught it."""

    dataset: Dataset
    rows: np.ndarray  # of the touches that it trained on
    known: dict[str, Surface]  # the objects that were touched, by name
    predictor: Predictor
    pad: Pad
    learnt: PadModel


def taught_by(key: jax.Array, folder: Path, cfg: Recognition) -> Taught:
    """Read a run and learn its pad."""
    dataset, predictor, pad = trained(folder)
    rows, known = training_rows(dataset, folder), taught(dataset)
    learnt = learn(key, dataset, rows, known, cfg.errors, cfg.limits)
    return Taught(dataset, rows, known, predictor, pad, learnt)


def trained(folder: Path) -> tuple[Dataset, Predictor, Pad]:
    """Touches, predictor and pad of a finished run of experiments.train."""
    about = json.loads((folder / "metrics.json").read_text())
    if about.get("source") != "simulated" or not (folder / "data.h5").exists():
        raise ValueError(f"{folder} was not trained on simulated touches; pass one that was, as --run")
    number = about["pad"]
    pad = numbered_pad(number) if isinstance(number, int) else load_pad(Path(number))
    return data.load(folder / "data.h5"), load_predictor(folder), pad


def training_rows(dataset: Dataset, folder: Path) -> np.ndarray:
    """The touches that the run trained on."""
    about = next(path for path in (folder / "config.json", folder.parent / "config.json") if path.exists())
    names = json.loads(about.read_text())["experiment"]["simulation"]["train"]
    return np.isin(dataset.touches.object, [dataset.objects.index(name) for name in names])


def taught(dataset: Dataset) -> dict[str, Surface]:
    """Surfaces of the catalogue's objects in a data set, by name."""
    names = [name for name in dataset.objects if name in catalogue.NAMES]
    return dict(zip(names, prepare_surfaces([catalogue.make_object(name).mesh for name in names]), strict=True))


def load_meshes(paths: Sequence[Path], unit: str | None) -> dict[str, Mesh]:
    """Meshes of files, by the files' names."""
    if unit is None:
        raise ValueError("say in which unit the files of --objects are, for instance --unit mm")
    if len(paths) < 2:
        raise ValueError("--objects needs at least two meshes to tell apart")
    return {path.stem: catalogue.load_mesh(path, unit)[0].mesh for path in paths}


def meshes_by_name(names: Sequence[str]) -> dict[str, Mesh]:
    """Meshes of the catalogue, by name."""
    return {name: catalogue.make_object(name).mesh for name in names}
