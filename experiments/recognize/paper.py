"""Question: how often does the paper's own method recognise an object?

    python -m experiments.recognize --method paper                              on runs/train of experiments.train
    python -m experiments.recognize --preset paper --method paper --pad-model runs/study     every pad of a study

The paper's network predicts the reading of each possible object at the end of a touch, for the expected pose. Each
touch votes for the object with the nearest prediction (exp(-|tau - tau~|), tau in standard deviations). A hypothesis is
sampled from the votes so far, and the paper's heuristic draws the next touch on it (`i2t.recognition.paper_rules`).
Every method chooses the touches of its own episodes by its own scores:

  Imagine2touch            the paper's network, on contact masks (its published code) and on depths (its text)
  and measured force       the same network with the measured force of each touch as an additional input
  same rules, GP           the same rules with the run's predictor, which also uses the measured force
  ... at the median force  the same predictor with the median force of the training touches, like the network
  constant reading         the same rules with the mean training reading wherever an object is seen
  proprioception           the paper's baseline: distance of the contact from each object's model

All methods have the same objects, placements and errors, so their differences are paired. Each episode has its own pool
of sites (with --preset paper, five episodes share one). Intervals are over pads and pools, for these objects.
Everything is simulated. A touch takes about 1/30 s on two cores, and six pads with 100 episodes of each object take a
few hours.
"""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from experiments.common.runs import Part
from experiments.recognize import report as reporting
from experiments.recognize.config import Recognition
from experiments.recognize.report import (
    CONSTANT_READING,
    FORCE_NETWORKS,
    IMAGINE2TOUCH,
    MEDIAN_FORCE,
    RULES_GP,
    EpisodeResults,
    Results,
)
from i2t.models.finished import FinishedRun
from i2t.objects.named import read_meshes
from i2t.patches.dimensions import PATCH_PIXELS
from i2t.prediction.gp_method import GPModel
from i2t.prediction.model import ModelConfig
from i2t.prediction.predictor import Predictor, load_predictor
from i2t.recognition.paper_rules import at_median_force, beliefs_by_rule, constant_predictor, run_paper_loop
from i2t.recognition.site_pool import prepare_surfaces
from i2t.runtime.progress import progress
from i2t.skin.files import load_pad
from i2t.types import Pad, Surface

NETWORKS = IMAGINE2TOUCH | {name: name for name in FORCE_NETWORKS.values()}  # methods by their rows in tables


class PaperNetworks(NamedTuple):
    """The paper's networks of a finished run, with and without a measured force, and statistics of its readings."""

    networks: dict[str, Predictor]  # by row; empty if the run trained none
    mean: np.ndarray | None = None  # (c,) uT
    std: np.ndarray | None = None  # (c,) uT
    epochs: int | None = None  # maximum epochs of training, the least over the networks


def load_paper_networks(run: FinishedRun) -> PaperNetworks:
    """Load the paper's networks of a finished run of `experiments.train`.

    Args:
        run: The finished run.

    Returns:
        The networks that the run trained.
    """
    networks: dict[str, Predictor] = {}
    epochs = []
    for row, name in NETWORKS.items():
        folder = run.checkpoint(name)
        if folder is None:
            continue
        predictor = load_predictor(folder)
        model: Any = predictor.model
        if model.cfg.pixels != PATCH_PIXELS or isinstance(model.cfg, ModelConfig) == (row in IMAGINE2TOUCH):
            continue  # a network of another camera, or with other inputs than its name states
        networks[row], norm = predictor, model.normalisation
        epochs.append((predictor.metadata or {})["epochs"])
    if not networks:
        return PaperNetworks({})
    return PaperNetworks(networks, np.asarray(norm.reading.mean), np.asarray(norm.reading.std), min(epochs))


def rule_predictors(
    folder: Path, paper: PaperNetworks, kept: Predictor, mean: np.ndarray, *, paper_epochs: int = 120
) -> dict[str, Predictor]:
    """Collect the predictors for the paper's rules, by row: the paper's networks, the run's predictor, and the mean
    reading (c,). Prints which rows are left out, and whether networks were trained for fewer than `paper_epochs`, the
    default of `experiments.train`.
    """
    missing = [name for row, name in NETWORKS.items() if row not in paper.networks]
    if missing:
        print(f"{folder} lacks some networks, whose rows are left out: {'; '.join(missing)}")
    if paper.epochs is not None and paper.epochs < paper_epochs:
        print(
            f"the networks of {folder} were trained for at most {paper.epochs} epochs; the default of "
            f"experiments.train is {paper_epochs}"
        )
    method = (kept.metadata or {}).get("method", "kept predictor")
    row = RULES_GP if isinstance(kept.model, GPModel) else f"same rules, {method}"
    others = {row: kept, row + MEDIAN_FORCE: at_median_force(kept), CONSTANT_READING: constant_predictor(mean)}
    return {**paper.networks, **others}


def report(out: Path, runs: Iterable[FinishedRun], parts: Sequence[Results]) -> dict[str, Any]:
    """Write and print the tables over the pads, and the paper's last column.

    Args:
        out: Folder for the results.
        runs: The finished runs.
        parts: Episodes with the pad of each run.

    Returns:
        The content of metrics.json.
    """
    epochs = [load_paper_networks(run).epochs for run in runs]
    about = {"method": "the paper's loop", "epochs": epochs, **reporting.mean_over_objects(parts)}
    result = reporting.summarise(parts, out, "simulated", **about)
    reporting.print_tables(result)
    reporting.print_mean_over_objects(result)
    return result


def play(cfg: Recognition, run: FinishedRun, seed: int) -> Part:
    """Simulate the episodes of the paper's sets with the pad of one run.

    Args:
        cfg: Objects, numbers and errors.
        run: The finished run, which holds the paper's networks and a simulated pad.
        seed: Seed of all random choices.

    Returns:
        The beliefs of each method, by set.

    Raises:
        ValueError: The run holds no network of the paper, or did not simulate its touches.
    """
    pad, predictor, paper = load_pad(run.simulated_pad), load_predictor(run.on_pressure), load_paper_networks(run)
    if paper.mean is None or paper.std is None:
        raise ValueError(
            f"{run.folder} lacks the networks {' and '.join(map(repr, IMAGINE2TOUCH.values()))}; train them: "
            f"python -m experiments.train --out {run.folder}"
        )
    predictors = rule_predictors(run.folder, paper, predictor, paper.mean)
    results: Results = {}
    names = {"primitives": cfg.primitives, "tools": cfg.tools}
    surfaces = iter(prepare_surfaces(list(read_meshes(cfg.objects).values())))  # all at once, to compile once
    for i, (name, objects) in enumerate(names.items()):
        own = [next(surfaces) for _ in objects]
        key = jax.random.fold_in(jax.random.key(seed), i)
        label = f"pad {run.pad_name}, {run.folder.name}"
        results[name] = play_set(
            key, name, objects,
            surfaces=own, predictors=predictors, reading_std=paper.std, pad=pad, cfg=cfg, label=label,
        )  # fmt: skip
    return reporting.to_part(results)


def play_set(
    key: jax.Array,
    name: str,
    objects: Sequence[str],
    *,
    surfaces: Sequence[Surface],
    predictors: Mapping[str, Predictor],
    reading_std: np.ndarray,
    pad: Pad,
    cfg: Recognition,
    label: str,
) -> EpisodeResults:
    """Simulate the episodes of every method with one set of objects, with the same placements, errors and pools."""
    named, count = dict(zip(objects, surfaces, strict=True)), cfg.paper_episodes * len(objects)
    total = (len(predictors) + 1) * count * cfg.touches  # proprioception is one more method
    with progress(total=total, desc=f"{name}: the paper's loop", unit="touches") as bar:
        results = run_paper_loop(
            jax.random.split(key, 3), predictors, named, pad,
            reading_std=reading_std, episodes=count, touches=cfg.touches, errors=cfg.errors, limits=cfg.limits,
            site_limits=cfg.site_limits, sites_per_object=cfg.pool_sites, episodes_per_pool=cfg.pool_episodes,
            progress=bar.update,
        )  # fmt: skip
    beliefs = {
        f"{method}, {rule}": p
        for method, episodes in results.items()
        for rule, p in beliefs_by_rule(episodes.distance).items()
    }
    first = next(iter(results.values()))
    truth, pool = first.truth, first.pool
    labels = np.array([f"{label}, {name}, pool {number}" for number in pool])
    return EpisodeResults(tuple(objects), truth, beliefs, None, label.split(",")[0], labels)
