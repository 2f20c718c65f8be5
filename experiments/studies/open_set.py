"""Detection of unknown objects. Half of the episodes have an unknown object of the same families as the known ones.

The unknown class is represented by surrogate unknowns (`i2t.objects.catalogue.surrogate_unknown`): objects like the
known ones, but none of them. They have pose particles as the known ones have and take part in the posterior throughout
an episode; together they are the unknown class. Its probability is calibrated (Platt) on validation objects and other
unknown ones.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.common.runs import Part
from experiments.recognize import figures
from experiments.studies.lab import StudyLab, clusters_of, format_estimate, make_table, touches_shown
from i2t import viz
from i2t.objects import Mesh, catalogue
from i2t.recognition import calibrated, metrics, open_set
from i2t.recognition.episodes import posteriors
from i2t.recognition.intervals import Clusters, estimate_at
from i2t.recognition.metrics import to_json
from i2t.recognition.site_pool import prepare_surfaces
from i2t.types import Surface

TEST_UNKNOWN = ("hexagon", "parallelogram", "flower", "cross", "spanner", "pliers", "marker", "scissors")
# Of the validation: neither known nor unknown objects of the test.
VALIDATION_UNKNOWN = ("pentagon", "pyramid", "dome", "cone", "ellipsoid", "torus", "wedge")
VALIDATION_KNOWN = ("triangle", "octagon", "stairs", "ridge", "cutter")
NUM_SURROGATES, DEBUG_NUM_SURROGATES = 48, 2
DEBUG_OBJECTS = 2  # of each kind
OPEN_SET_PARTICLES = 64  # of each object, of surrogates too
PRIOR_UNKNOWN = 0.5
UNKNOWN_SHARES = (0.01, 0.25, 0.5)  # of the episodes, for which accuracies are reported
AUROC_TOUCHES, OPEN_SET_KINDS = (1, 3, 5, 10), ("known", "unknown")  # in tables
NUM_BINS = 10  # of a calibration error


class OpenSetObjects(NamedTuple):
    """Known objects, unknown ones, and surrogates, in this order."""

    known: tuple[str, ...]
    unknown: tuple[str, ...]
    surrogates: int

    def meshes(self) -> list[Mesh]:
        """Meshes of all objects."""
        known = [catalogue.make_object(name).mesh for name in self.known]
        unknown = [catalogue.make_object(name).mesh for name in self.unknown]
        return known + unknown + [catalogue.surrogate_unknown(known, i).mesh for i in range(self.surrogates)]


class OpenSetEpisodes(NamedTuple):
    """Episodes with known objects and as many with unknown ones."""

    truth: np.ndarray  # (e,), -1 for an unknown object
    p: np.ndarray  # (e, t, known)
    p_unknown: np.ndarray  # (e, t) of the unknown class
    there: np.ndarray  # (e,) the object that was there: known ones first, unknown ones after them
    pool: np.ndarray  # (e,) number of the sites' draw


def evaluate(lab: StudyLab) -> Part:
    """Beliefs on validation objects and on test objects."""
    key_test, key_validation = jax.random.split(lab.key)
    some = DEBUG_OBJECTS if lab.args.debug else None
    surrogates = DEBUG_NUM_SURROGATES if lab.args.debug else NUM_SURROGATES
    validation = OpenSetObjects(VALIDATION_KNOWN[:some], VALIDATION_UNKNOWN[:some], surrogates)
    test = OpenSetObjects(lab.names, TEST_UNKNOWN[:some], surrogates)
    meshes = validation.meshes(), test.meshes()
    surfaces = prepare_surfaces([*meshes[0], *meshes[1]])  # of one size class, so that they compile once
    count = len(meshes[0])
    fitted = evaluate_set(lab, key_validation, validation, surfaces[:count], "validation")
    tested = evaluate_set(lab, key_test, test, surfaces[count:], "test")
    return {"validation": fitted._asdict(), "test": tested._asdict()}


def evaluate_set(
    lab: StudyLab, key: jax.Array, objects: OpenSetObjects, surfaces: list[Surface], label: str
) -> OpenSetEpisodes:
    """Beliefs in episodes with known objects, then in as many with unknown ones."""
    key_sites, key_episodes = jax.random.split(key)
    known, unknown = len(objects.known), len(objects.unknown)
    cfg = replace(lab.cfg, num_particles=min(lab.cfg.num_particles, OPEN_SET_PARTICLES))
    lab = replace(lab, surfaces=surfaces[:known], names=objects.known, cfg=cfg)
    plan = lab.plan(key_sites, truth=draw_objects(known, unknown, lab.episodes, lab.seed))
    believed = surfaces[:known] + surfaces[known + unknown :]
    lab, there, particles = replace(lab, surfaces=believed), plan.truth, lab.particles()
    (table,) = lab.predict(plan.sites, particles, [lab.pad_model.reading_model], label)
    observations = lab.simulate(key_episodes, plan, label, surfaces=surfaces[: known + unknown]).observations
    likelihood = lab.pad_model.likelihood
    p = posteriors(jax.device_put(table), jnp.asarray(plan.chosen), observations, likelihood, particles)
    p = np.asarray(p, np.float64)
    share = (len(believed) - known) / len(believed)  # prior of the unknown class: all objects alike
    p, p_unknown = open_set.with_unknown_prior(p[..., :known], p[..., known:].sum(-1), share, PRIOR_UNKNOWN)
    return OpenSetEpisodes(np.where(there < known, there, -1), p, p_unknown, there, plan.pool)


def draw_objects(known: int, unknown: int, episodes: int, seed: int) -> np.ndarray:
    """Draw each episode's object: the known in turn, then as many episodes with unknown ones, each about as often."""
    rng, count = np.random.default_rng(seed), known * episodes
    drawn = np.concatenate([rng.permutation(unknown) for _ in range(-(-count // unknown))])[:count]
    return np.concatenate([np.arange(count) % known, known + drawn])


def report(parts: Sequence[Part], out: Path, pads: Sequence[str]) -> dict[str, Any]:
    """Detection of unknown objects among known ones, and calibration of the unknown class."""
    validation, test = (_pooled([OpenSetEpisodes(**part[name]) for part in parts]) for name in ("validation", "test"))
    scaling = calibrated.fit_platt(validation.p_unknown, validation.truth < 0)
    p, p_unknown = calibrated.apply_platt(test.p, test.p_unknown, scaling)
    # Unknown objects are few, and another one may be told apart less or more easily: they are drawn again, too.
    clusters = clusters_of([part["test"] for part in parts], pads, objects="there")
    area = open_set.auroc(test.p_unknown, test.truth < 0, clusters=clusters)
    print("AUROC after each touch: " + " ".join(f"{x:.2f}" for x in area.mean))
    print("after the last: " + format_estimate(estimate_at(area, -1)))
    result = {"episodes": len(test.truth), "auroc": to_json(area), "platt": to_json(scaling)}
    for name, episodes in (("uncalibrated", test), ("calibrated", test._replace(p=p, p_unknown=p_unknown))):
        result[name] = score_episodes(name, episodes, clusters)
    result["tables"] = tables_of_detection(result)
    figure = figures.accuracy({"unknown class": area}, "Detecting unknown objects", True, ylabel="AUROC")
    viz.save_figure(figure, out / "auroc.png")
    return result


def score_episodes(name: str, episodes: OpenSetEpisodes, clusters: Clusters) -> dict[str, Any]:
    """Accuracies for several shares of unknown objects, and the calibration error of the unknown class at the end."""
    truth, p, p_unknown = episodes.truth, episodes.p, episodes.p_unknown
    scores: dict[str, Any] = {"accuracy": {}}
    for share in UNKNOWN_SHARES:
        found = open_set.open_set_accuracy(p, p_unknown, truth, share, prior=PRIOR_UNKNOWN, clusters=clusters)
        scores["accuracy"][str(share)] = to_json(found)
        known, unknown = (format_estimate(estimate_at(one, -1)) for one in (found.known, found.unknown))
        print(f"{name}, {share:.0%} unknown: accuracy on known objects {known}, on unknown ones {unknown}")
    last = p_unknown[:, -1]
    right = (last > 0.5) == (truth < 0)
    error = metrics.calibration_error(np.maximum(last, 1 - last), right, NUM_BINS)
    print(f"{name}, calibration error of the unknown class after the last touch: {error.error:.3f}")
    return scores | {"calibration_error": to_json(error)}


def tables_of_detection(result: dict[str, Any]) -> dict[str, Any]:
    """Rates at which unknown objects are recognised as such, and accuracies at each share of them, calibrated."""
    area = result["auroc"]
    at = [
        [str(t), {key: values[t - 1] for key, values in area.items()}]
        for t in touches_shown(len(area["mean"]), AUROC_TOUCHES)
    ]
    shares = [
        [f"{float(share):.0%}", *({key: values[-1] for key, values in scores[kind].items()} for kind in OPEN_SET_KINDS)]
        for share, scores in result["calibrated"]["accuracy"].items()
    ]
    return {
        "auroc": make_table(["touches", "AUROC of the unknown class [95 %]"], at),
        "accuracy": make_table(
            ["share of unknown objects", "known objects named right", "unknown objects called unknown"], shares
        ),
    }


def _pooled(parts: Sequence[OpenSetEpisodes]) -> OpenSetEpisodes:
    return OpenSetEpisodes(*(np.concatenate(column) for column in zip(*parts, strict=True)))
