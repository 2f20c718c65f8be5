"""Is it none of the objects that are known? Half of the sittings have a stranger of the same families."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments import plots
from experiments import recognition_figures as drawing
from experiments import recognition_scores as scores
from experiments.recognition import beliefs, places_about, pool, random_sites, surfaces_of
from experiments.recognition_scores import plain
from experiments.studies.lab import Lab, imagine, placements_of, sit
from i2t import objects

STRANGERS = ("hexagon", "parallelogram", "flower", "cross", "spanner", "pliers", "marker", "scissors")
DECOYS = 24  # random objects whose touches stand for all that is not known
DECOY_PLACES = 4


def play(lab: Lab) -> dict[str, Any]:
    """Sittings with the known objects and as many with others of the same families."""
    key_pool, key_play, key_site = jax.random.split(lab.key, 3)
    known = len(lab.surfaces)
    debug = lab.args.preset == "debug"
    decoys, strangers = (2, STRANGERS[:2]) if debug else (DECOYS, STRANGERS)
    meshes = [objects.make(name).mesh for name in lab.names + strangers]
    meshes += [objects.random_object(1000 * lab.seed + i).mesh for i in range(decoys)]
    surfaces = surfaces_of(meshes)
    lab = lab._replace(surfaces=surfaces[:known])
    sites = pool(key_pool, lab.surfaces, lab.names, lab.cfg.sites, lab.cfg.reach)
    places = placements_of(lab)
    (table,) = imagine(lab, sites, places, [lab.learnt.skin], "open")
    others = lab._replace(surfaces=surfaces[known + len(strangers) :])
    few = places_about(lab.cfg.errors, DECOY_PLACES, lab.seed)
    (background,) = imagine(others, sites, few, [lab.learnt.skin], "none of these")
    background = jax.tree.map(lambda x: x.reshape(len(x), -1, *x.shape[3:]), background)
    rng = np.random.default_rng(lab.seed)
    truth = np.repeat(np.arange(known), lab.sittings)
    strange = rng.integers(known, known + len(strangers), len(truth))
    everything = np.concatenate([truth, strange])
    chosen = random_sites(key_site, sites, len(everything), lab.cfg.touches)
    played = surfaces[: known + len(strangers)]
    episodes = sit(lab, key_play, sites, everything, chosen, "open", surfaces=played)
    p, none = beliefs(
        jax.device_put(table), jnp.asarray(chosen), episodes.measured, lab.learnt.like, places,
        jax.device_put(background), unknown=0.5,
    )  # fmt: skip
    return {"truth": np.where(everything < known, everything, -1), "p": np.asarray(p), "none": np.asarray(none)}


def report(parts: Sequence[dict[str, Any]], out: Path) -> dict[str, Any]:
    """How well strangers are told from known objects."""
    truth, p, none = (np.concatenate([part[key] for part in parts]) for key in ("truth", "p", "none"))
    p, none = p.astype(np.float64), none.astype(np.float64)
    area = scores.auroc(none, truth < 0)
    result: dict[str, Any] = {"sittings": len(truth), "auroc": plain(area), "shares": {}}
    print("AUROC after each touch: " + " ".join(f"{x:.2f}" for x in area.mean))
    for share in (0.01, 0.25, 0.5):
        found = scores.open_set(p, none, truth, share, prior=0.5)
        result["shares"][str(share)] = plain(found)
        print(
            f"{share:.0%} unknown: right of known {found.known.mean[-1]:.3f}, of unknown {found.unknown.mean[-1]:.3f}"
        )
    sure, right = none[:, -1], truth < 0
    result["calibration_of_none"] = plain(scores.calibration_error(np.maximum(sure, 1 - sure), (sure > 0.5) == right))
    plots.save(drawing.accuracy({"AUROC of none of these": area}, "Telling strangers", True), out / "auroc.png")
    return result
