"""Is it none of the objects that are known? Half of the sittings have a stranger of the same families.

What is not known is stood for by decoys (`i2t.objects.catalogue.decoy`): objects like those known, but none of them.
They have places as the known ones have and take part in the posterior through the whole sitting; "none of these" is
what they have together. How much that is to be trusted is fitted on validation objects and other strangers.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.common.runs import Part
from experiments.recognize import figures as drawing
from experiments.studies.lab import Lab, imagine, shown, sit
from i2t import viz
from i2t.objects import catalogue
from i2t.objects.catalogue import Mesh
from i2t.recognition import calibrated
from i2t.recognition import metrics as scores
from i2t.recognition.episodes import posteriors
from i2t.recognition.metrics import to_json
from i2t.recognition.site_pool import draw_random_sites, pose_particles, prepare_surfaces, sample_sites
from i2t.types import Surface

STRANGERS = ("hexagon", "parallelogram", "flower", "cross", "spanner", "pliers", "marker", "scissors")
# Of the validation: neither known in the test nor strangers there.
OTHERS = ("pentagon", "pyramid", "dome", "cone", "ellipsoid", "torus", "wedge")
KNOWN = ("triangle", "octagon", "stairs", "ridge", "cutter")
DECOYS, PLACES = 48, 64  # places of each object, of decoys too
PRIOR = 0.5  # of a stranger


class Game(NamedTuple):
    """Sittings with known objects and as many with strangers."""

    truth: np.ndarray  # (e,), -1 for a stranger
    p: np.ndarray  # (e, t, known)
    none: np.ndarray  # (e, t)


def play(lab: Lab) -> Part:
    """The game on validation objects and that on test objects."""
    debug = lab.args.preset == "debug"
    test, validation = jax.random.split(lab.key)
    strangers, others, known = (STRANGERS[:2], OTHERS[:2], KNOWN[:2]) if debug else (STRANGERS, OTHERS, KNOWN)
    decoys = 2 if debug else DECOYS
    first, second = _things(known, others, decoys), _things(lab.names, strangers, decoys)
    prepared = prepare_surfaces(first + second)  # compiled for once
    tuned = _game(lab, validation, known, others, prepared[: len(first)], "validation")
    tested = _game(lab, test, lab.names, strangers, prepared[len(first) :], "strangers")
    return {"validation": tuned._asdict(), "test": tested._asdict()}


def _things(names: Sequence[str], strangers: Sequence[str], decoys: int) -> list[Mesh]:
    """What is known, what is strange, and decoys."""
    known = [catalogue.make_object(name).mesh for name in names]
    others = [catalogue.make_object(name).mesh for name in strangers]
    return known + others + [catalogue.surrogate_unknown(known, i).mesh for i in range(decoys)]


def _game(
    lab: Lab, key: jax.Array, names: Sequence[str], strangers: Sequence[str], surfaces: list[Surface], what: str
) -> Game:
    key_pool, key_play, key_site = jax.random.split(key, 3)
    imagined = surfaces[: len(names)] + surfaces[len(names) + len(strangers) :]
    sites = sample_sites(key_pool, surfaces[: len(names)], list(names), lab.cfg.num_sites, lab.cfg.site_limits)
    places = pose_particles(lab.cfg.errors, min(lab.cfg.num_particles, PLACES), lab.seed)
    (table,) = imagine(lab._replace(surfaces=imagined), sites, places, [lab.learnt.reading_model], what)
    truth = np.repeat(np.arange(len(names)), lab.sittings)
    rng = np.random.default_rng(lab.seed)
    strange = rng.integers(len(names), len(names) + len(strangers), len(truth))
    everything = np.concatenate([truth, strange])
    chosen = draw_random_sites(key_site, sites, len(everything), lab.cfg.touches)
    played = surfaces[: len(names) + len(strangers)]
    episodes = sit(lab, key_play, sites, everything, chosen, what, surfaces=played)
    p = posteriors(jax.device_put(table), jnp.asarray(chosen), episodes.observations, lab.learnt.likelihood, places)
    p = np.asarray(p, np.float64)
    share = (len(imagined) - len(names)) / len(imagined)
    named, none = scores.with_unknown_prior(p[..., : len(names)], p[..., len(names) :].sum(-1), share, PRIOR)
    return Game(np.where(everything < len(names), everything, -1), named, none)


def report(parts: Sequence[Part], out: Path) -> dict[str, Any]:
    """How well strangers are told from known objects, and how sure one may be."""
    validation, test = (_pooled([Game(**part[name]) for part in parts]) for name in ("validation", "test"))
    odds = calibrated.fit_platt(validation.none, validation.truth < 0)
    area, raw = scores.auroc(test.none, test.truth < 0), test.none
    p, none = calibrated.apply_platt(test.p, test.none, odds)
    result: dict[str, Any] = {"sittings": len(test.truth), "auroc": to_json(area), "odds": to_json(odds), "shares": {}}
    print("AUROC after each touch: " + " ".join(f"{x:.2f}" for x in area.mean))
    print("after the last: " + shown(scores.Estimate(*(x[-1] for x in area))))
    for name, each in (("as imagined", (test.p, raw)), ("trusted as on validation objects", (p, none))):
        for share in (0.01, 0.25, 0.5):
            found = scores.open_set_accuracy(*each, test.truth, share, prior=PRIOR)
            result["shares"][f"{name}, {share}"] = to_json(found)
            last = [shown(scores.Estimate(*(x[-1] for x in one))) for one in (found.known, found.unknown)]
            print(f"{name}, {share:.0%} unknown: right of known {last[0]}, of unknown {last[1]}")
        sure, right = each[1][:, -1], test.truth < 0
        wrong = scores.calibration_error(np.maximum(sure, 1 - sure), (sure > 0.5) == right, 10)
        result[f"calibration_of_none, {name}"] = to_json(wrong)
        print(f"{name}, calibration error of none of these after the last touch: {wrong.error:.3f}")
    viz.save_figure(
        drawing.accuracy({"none of these": area}, "Telling strangers", True, ylabel="AUROC"), out / "auroc.png"
    )
    return result


def _pooled(games: Sequence[Game]) -> Game:
    return Game(*(np.concatenate(column) for column in zip(*games, strict=True)))
