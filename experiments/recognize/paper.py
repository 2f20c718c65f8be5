"""Question: which object is it, by the paper's own method?

    python -m experiments.recognize --method paper                              on runs/train of experiments.train
    python -m experiments.recognize --preset paper --method paper --pad-model runs/study     every pad of a study

The paper's network predicts what each possible object would feel like where a touch ended, at the believed pose; each
touch votes for the object whose prediction is nearest (exp(-|tau - tau~|), tau in standard deviations); a hypothesis is
sampled from the votes so far, and the paper's heuristic draws the next touch on it (`i2t.recognition.paper_rules`).
Every method drives its own episodes by its own scores:

  Imagine2touch            the paper's network, on contact masks (its published code) and on depths (its text)
  and measured force       the same network with the measured force of each touch as a further input
  same rules, GP           the same with the predictor that the run kept, which is given that force, too
  ... at the median force  and without it: given the median of the training touches, it knows what the network knows
  constant reading         the same with the mean of the training readings wherever an object is seen
  proprioception           the paper's baseline: distance of the contact from each object's model

Methods meet the same objects in the same places with the same errors, so their differences are paired. Each episode
has a pool of sites of its own (by --preset paper each five). Intervals are over pads and pools, for these objects.
Everything is simulated; a touch costs about 1/30 s on two cores, and six pads with 100 episodes of each object a few
hours.
"""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from experiments.common.runs import Part
from experiments.recognize import report as reporting
from experiments.recognize.config import Recognition
from experiments.recognize.plans import meshes_by_name
from experiments.recognize.report import (
    CONSTANT,
    IMAGINE2TOUCH,
    MEDIAN_FORCE,
    RULES_GP,
    WITH_FORCE,
    EpisodeResults,
    Results,
)
from experiments.train.finished import FinishedRun
from i2t.patches.dimensions import PATCH_PIXELS
from i2t.prediction.gp_method import GPModel
from i2t.prediction.model import ModelConfig
from i2t.prediction.predictor import Predictor, load_predictor
from i2t.recognition.paper_rules import at_median_force, beliefs_by_rule, constant_predictor, run_paper_loop
from i2t.recognition.site_pool import prepare_surfaces
from i2t.runtime.progress import progress
from i2t.skin.files import load_pad
from i2t.types import Pad, Surface

PAPER_EPOCHS = 120  # for which experiments.train trains the paper's network


NETWORKS = IMAGINE2TOUCH | {name: name for name in WITH_FORCE.values()}  # by rows, as IMAGINE2TOUCH is


class PaperNetworks(NamedTuple):
    """The paper's networks of a finished run, those with a measured force included, and what their training readings
    were like.
    """

    networks: dict[str, Predictor]  # by the rows' names; empty where the run trained none
    mean: np.ndarray | None = None  # (c,) uT, of the training readings
    std: np.ndarray | None = None  # (c,) uT
    epochs: int | None = None  # for which they were trained at most; the least of them


def load_paper_networks(run: FinishedRun) -> PaperNetworks:
    """The paper's networks of a finished run of `experiments.train`.

    Args:
        run: Whose folder is read.

    Returns:
        The networks.
    """
    found: dict[str, Predictor] = {}
    epochs = []
    for row, name in NETWORKS.items():
        place = run.checkpoint(name)
        if place is None:
            continue
        predictor = load_predictor(place)
        model: Any = predictor.model
        if model.cfg.pixels != PATCH_PIXELS or isinstance(model.cfg, ModelConfig) == (row in IMAGINE2TOUCH):
            continue  # a network of another camera, or more than the paper's under its name
        found[row], norm = predictor, model.normalisation
        epochs.append((predictor.metadata or {})["epochs"])
    if not found:
        return PaperNetworks({})
    return PaperNetworks(found, np.asarray(norm.reading.mean), np.asarray(norm.reading.std), min(epochs))


def rule_predictors(folder: Path, found: PaperNetworks, kept: Predictor, mean: np.ndarray) -> dict[str, Predictor]:
    """Predictors to which the paper's rules are applied, by the names of their rows: the paper's networks, the one that
    the run kept, and the mean reading (c,). Says which rows are left out, or are not what the paper's were.
    """
    missing = [name for row, name in NETWORKS.items() if row not in found.networks]
    if missing:
        print(f"{folder} holds no {' and no '.join(missing)}, so these rows are left out")
    if found.epochs is not None and found.epochs < PAPER_EPOCHS:
        print(
            f"the networks of {folder} were trained for at most {found.epochs} epochs; the defaults of "
            f"experiments.train are {PAPER_EPOCHS}"
        )
    method = (kept.metadata or {}).get("method", "kept predictor")
    row = RULES_GP if isinstance(kept.model, GPModel) else f"same rules, {method}"
    given = {row: kept, row + MEDIAN_FORCE: at_median_force(kept), CONSTANT: constant_predictor(mean)}
    return {**found.networks, **given}


def report(out: Path, runs: Iterable[FinishedRun], parts: Sequence[Results]) -> dict[str, Any]:
    """Tables over the pads, and the paper's last column.

    Args:
        out: Folder for everything that is made.
        runs: The finished runs.
        parts: What was believed with the pad of each.

    Returns:
        What is written to metrics.json.
    """
    epochs = [load_paper_networks(run).epochs for run in runs]
    about = {"method": "the paper's loop", "epochs": epochs, **reporting.mean_over_objects(parts)}
    result = reporting.summarise(parts, out, "simulated", **about)
    reporting.print_tables(result)
    reporting.print_mean_over_objects(result)
    return result


def play(cfg: Recognition, run: FinishedRun, seed: int) -> Part:
    """The paper's sets with the pad of one run.

    Args:
        cfg: Objects, numbers and errors.
        run: With the paper's networks, and a pad.
        seed: Of everything that is drawn.

    Returns:
        What each method believed, by set.

    Raises:
        ValueError: The run holds no network of the paper, or did not simulate its touches.
    """
    pad, predictor, found = load_pad(run.simulated_pad), load_predictor(run.on_pressure), load_paper_networks(run)
    if found.mean is None or found.std is None:
        raise ValueError(
            f"{run.folder} holds no {' and no '.join(IMAGINE2TOUCH.values())}; train them: "
            f"python -m experiments.train --out {run.folder}"
        )
    predictors = rule_predictors(run.folder, found, predictor, found.mean)
    results: Results = {}
    names = {"primitives": cfg.primitives, "tools": cfg.tools}
    surfaces = iter(prepare_surfaces(list(meshes_by_name(cfg.objects).values())))  # compiled for once
    for i, (name, objects) in enumerate(names.items()):
        some = [next(surfaces) for _ in objects]
        key = jax.random.fold_in(jax.random.key(seed), i)
        label = f"pad {run.pad_name}, {run.folder.name}"
        results[name] = play_set(
            key, name, objects,
            surfaces=some, predictors=predictors, reading_std=found.std, pad=pad, cfg=cfg, label=label,
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
    """Episodes of every method with one set of objects: the same objects, places, errors and pools."""
    named, count = dict(zip(objects, surfaces, strict=True)), cfg.paper_episodes * len(objects)
    total = (len(predictors) + 1) * count * cfg.touches  # proprioception is one more method
    with progress(total=total, desc=f"{name}: the paper's loop", unit="touch") as bar:
        results = run_paper_loop(
            jax.random.split(key, 3), predictors, named, pad,
            reading_std=reading_std, episodes=count, touches=cfg.touches, errors=cfg.errors, limits=cfg.limits,
            site_limits=cfg.site_limits, sites_per_object=cfg.pool_sites, episodes_per_pool=cfg.pool_episodes,
            progress=bar.update,
        )  # fmt: skip
    believed = {
        f"{method}, {rule}": p
        for method, episodes in results.items()
        for rule, p in beliefs_by_rule(episodes.distance).items()
    }
    first = next(iter(results.values()))
    truth, pool = first.truth, first.pool
    labels = np.array([f"{label}, {name}, pool {number}" for number in pool])
    return EpisodeResults(tuple(objects), truth, believed, None, label.split(",")[0], labels)
