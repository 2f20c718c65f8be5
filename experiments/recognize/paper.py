"""Question: which object is it, by the paper's own method?

    python -m experiments.recognize --method paper                              on runs/train of experiments.train
    python -m experiments.recognize --method paper --trained-run runs/study     every pad of a study

The paper's network predicts what each possible object would feel like where a touch ended, at the believed pose; each
touch votes for the object whose prediction is nearest (exp(-|tau - tau~|), tau in standard deviations); a hypothesis is
sampled from the votes so far, and the paper's heuristic draws the next touch on it (`i2t.recognition.paper_rules`).
Every method drives its own episodes by its own scores:

  Imagine2touch            the paper's network, on contact masks (its published code) and on depths (its text)
  same rules, GP           the same with the predictor that the run kept
  constant reading         the same with the mean of the training readings wherever an object is seen
  proprioception           the paper's baseline: distance of the contact from each object's model

Methods meet the same objects in the same places with the same errors, so their differences are paired. Each five
episodes have a pool of sites of their own. Intervals are over pads and pools, for these objects. Everything is
simulated; a touch costs about 1/30 s on two cores, and five pads with 200 episodes of each object a few hours.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from experiments.common.checks import pad_name
from experiments.common.tasks import Task, TaskOptions, run_tasks
from experiments.recognize import report as reporting
from experiments.recognize.config import Recognition
from experiments.recognize.report import CONSTANT, IMAGINE2TOUCH, RULES_GP, EpisodeResults, Results
from experiments.recognize.trained_run import meshes_by_name, read_simulated_run
from i2t.files import slug
from i2t.prediction.gp_method import GPModel
from i2t.prediction.model import ModelConfig
from i2t.prediction.predictor import Predictor, load_predictor
from i2t.progress import progress
from i2t.recognition.episodes import EpisodeConfig, EpisodeSimulator, TouchNumber
from i2t.recognition.paper_rules import (
    PROPRIOCEPTION,
    Scorer,
    beliefs_by_rule,
    constant_predictor,
    contact_distances,
    reading_scorers,
    run_loop,
)
from i2t.recognition.site_pool import prepare_surfaces, sample_pools
from i2t.types import Pad, Surface, Touches
from i2t.windows import PATCH_PIXELS

PAPER_EPOCHS = 120  # for which experiments.train trains the paper's network


class PaperNetworks(NamedTuple):
    """The paper's networks of a finished run, and what their training readings were like."""

    networks: dict[str, Predictor]  # by the rows' names
    mean: np.ndarray  # (c,) uT, of the training readings
    std: np.ndarray  # (c,) uT
    epochs: int  # for which they were trained; the least of them


def load_paper_networks(folder: Path) -> PaperNetworks | None:
    """The paper's networks of a finished run of `experiments.train`.

    Args:
        folder: Of the run.

    Returns:
        The networks; None where the run trained none.
    """
    found: dict[str, Predictor] = {}
    epochs = []
    for row, name in IMAGINE2TOUCH.items():
        place = folder / "checkpoint" / slug(name)
        if not place.is_dir():
            continue
        predictor = load_predictor(place)
        model: Any = predictor.model
        if model.cfg.pixels != PATCH_PIXELS or isinstance(model.cfg, ModelConfig):
            continue  # a network of another camera, or more than the paper's
        found[row], norm = predictor, model.normalisation
        epochs.append((predictor.metadata or {})["epochs"])
    if not found:
        return None
    return PaperNetworks(found, np.asarray(norm.reading.mean), np.asarray(norm.reading.std), min(epochs))


def missing_networks(folder: Path, found: PaperNetworks | None) -> str:
    """One sentence about the rows that are left out, or are not what the paper's were; empty where none is."""
    missing = [name for row, name in IMAGINE2TOUCH.items() if found is None or row not in found.networks]
    if missing:
        return f"{folder} holds no {' and no '.join(missing)}, so these rows of Imagine2touch are left out"
    if found is not None and found.epochs < PAPER_EPOCHS:
        return (
            f"the networks of {folder} were trained for {found.epochs} epochs; the defaults of experiments.train are "
            f"{PAPER_EPOCHS}"
        )
    return ""


def run(out: Path, cfg: Recognition, folders: Sequence[Path], seed: int, options: TaskOptions) -> dict[str, Any]:
    """The paper's sets on every pad, then the tables over them.

    Args:
        out: Folder for everything that is made.
        cfg: Objects, numbers and errors.
        folders: Of finished runs.
        seed: Of the first; the next ones count on.
        options: Who plays them.

    Returns:
        What is written to metrics.json.
    """
    tasks = []
    for i, folder in enumerate(folders):
        path = out / f"loop-{i}.npz"
        tasks.append(Task(path.stem, path, partial(play_part, cfg, folder, seed + i, path)))
    run_tasks(tasks, options)
    parts = [reporting.load(task.finished) for task in tasks]
    about: dict[str, Any] = {
        "method": "the paper's loop",
        "epochs": [network_epochs(folder) for folder in folders],
        "mean of the sets": reporting.mean_over_objects(parts),
    }
    result = reporting.summarise(parts, out, "simulated", **about)
    reporting.print_tables(result)
    reporting.print_mean_over_objects(result["mean of the sets"])
    return result


def network_epochs(folder: Path) -> int | None:
    """Number of epochs for which the paper's networks of a run were trained."""
    found = load_paper_networks(folder)
    return None if found is None else found.epochs


def play_part(cfg: Recognition, folder: Path, seed: int, path: Path) -> None:
    """The paper's sets with the pad of one run, kept in `path`."""
    reporting.save(path, play(cfg, folder, seed))


def play(cfg: Recognition, folder: Path, seed: int) -> Results:
    """The paper's sets with the pad of one run.

    Args:
        cfg: Objects, numbers and errors.
        folder: Of the run.
        seed: Of everything that is drawn.

    Returns:
        What each method believed, by set.

    Raises:
        ValueError: The run holds no network of the paper, or did not simulate its touches.
    """
    _, predictor, pad = read_simulated_run(folder)
    found = load_paper_networks(folder)
    if found is None:
        raise ValueError(f"{missing_networks(folder, found)}; train them: python -m experiments.train --out {folder}")
    if said := missing_networks(folder, found):
        print(said)
    predictors = {
        **found.networks,
        **kept_predictor(predictor),
        CONSTANT: constant_predictor(found.mean),
    }
    results: Results = {}
    names = {"primitives": cfg.primitives, "tools": cfg.tools}
    surfaces = iter(prepare_surfaces(list(meshes_by_name(cfg.objects).values())))  # compiled for once
    for i, (name, objects) in enumerate(names.items()):
        some = [next(surfaces) for _ in objects]
        key = jax.random.fold_in(jax.random.key(seed), i)
        scorers = reading_scorers(predictors, some, found.std) | {PROPRIOCEPTION: partial(contact_distances, some)}
        results[name] = play_set(
            key,
            name,
            objects,
            surfaces=some,
            scorers=scorers,
            pad=pad,
            cfg=cfg,
            label=f"pad {pad_name(folder)}, {folder.name}",
        )
    return results


def kept_predictor(predictor: Predictor) -> dict[str, Predictor]:
    """The best predictor on predicted pressure of a run, or the one that it kept, by its row's name."""
    method = (predictor.metadata or {}).get("method", "kept predictor")
    return {RULES_GP if isinstance(predictor.model, GPModel) else f"same rules, {method}": predictor}


def play_set(
    key: jax.Array,
    name: str,
    objects: Sequence[str],
    *,
    surfaces: Sequence[Surface],
    scorers: Mapping[str, Scorer],
    pad: Pad,
    cfg: Recognition,
    label: str,
) -> EpisodeResults:
    """Episodes of every method with one set of objects: the same objects, places, errors and pools."""
    key_sites, key_world, key_choice = jax.random.split(key, 3)
    episodes = cfg.paper_episodes * len(objects)
    truth, pool = np.arange(episodes) % len(objects), np.arange(episodes) // cfg.pool_episodes
    pools = sample_pools(
        key_sites, surfaces, objects, pools=int(pool[-1]) + 1, each=cfg.pool_sites, limits=cfg.site_limits
    )
    config = EpisodeConfig(cfg.errors, cfg.limits, cfg.touches)
    shared: dict[TouchNumber, Touches] = {}
    believed: dict[str, np.ndarray] = {}
    with progress(total=len(scorers) * truth.size * cfg.touches, desc=f"{name}: the paper's loop", unit="touch") as bar:
        for method, score in scorers.items():
            simulator = EpisodeSimulator(
                jax.random.clone(key_world), surfaces, truth,
                sites=pools.joined(), pad=pad, config=config, made_before=shared,
            )  # fmt: skip
            made = run_loop(
                jax.random.clone(key_choice), score, simulator, pools, pool, count=cfg.touches, progress=bar.update
            )
            believed |= {f"{method}, {rule}": p for rule, p in beliefs_by_rule(made.distance).items()}
    labels = np.array([f"{label}, {name}, pool {number}" for number in pool])
    return EpisodeResults(tuple(objects), truth, believed, None, label.split(",")[0], labels)
