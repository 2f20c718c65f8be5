"""Detection of unknown objects. Half of the episodes have an unknown object of the same families as the known ones.

The unknown class is represented by surrogate unknowns (`i2t.objects.catalogue.surrogate_unknown`): objects like the
known ones, but none of them. They have pose particles as the known ones have and take part in the posterior throughout
an episode; together they are the unknown class. Its probability is calibrated (Platt) on validation objects and other
unknown ones.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.common.runs import Part
from experiments.studies.lab import StudyLab
from experiments.studies.report import clusters_of, make_table
from i2t.intervals import estimate_at, rate_interval, rows_of
from i2t.objects import Mesh, catalogue
from i2t.recognition import calibrated, metrics
from i2t.recognition.episodes import posteriors
from i2t.recognition.metrics import to_json
from i2t.recognition.site_pool import prepare_surfaces
from i2t.types import Surface

# No pad model was fitted to touches of any of these, and none is in two sets.
TEST_UNKNOWN = ("triangle", "cross", "wedge", "dome", "torus", "spanner", "cutter", "scissors")
VALIDATION_UNKNOWN = ("pentagon", "pyramid", "cone", "ellipsoid", "pliers")
VALIDATION_KNOWN = ("flower", "octagon", "stairs", "ridge", "marker")
NUM_SURROGATES, DEBUG_NUM_SURROGATES = 48, 2
DEBUG_OBJECTS = 2  # of each kind
PRIOR_UNKNOWN = 0.5
UNKNOWN_SHARES = (0.01, 0.25, 0.5)  # of the episodes, for which accuracies are reported
AUROC_TOUCHES = (1, 3, 5, 10)  # in tables
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
    some = DEBUG_OBJECTS if lab.size.debug else None
    surrogates = DEBUG_NUM_SURROGATES if lab.size.debug else NUM_SURROGATES
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
    lab = replace(lab, surfaces=surfaces[:known], names=objects.known)
    there = draw_objects(known, unknown, lab.size.episodes, lab.seed)
    plan = lab.plan(key_sites, len(there))
    believed = surfaces[:known] + surfaces[known + unknown :]
    lab, particles = replace(lab, surfaces=believed), lab.particles()
    (table,) = jax.device_put(lab.predict(plan.sites, particles, [lab.pad_model.reading_model], label))
    episodes = lab.simulate(key_episodes, plan, there, label, surfaces=surfaces[: known + unknown])
    p = posteriors(jnp.asarray(plan.chosen), episodes.observations, table, lab.pad_model.likelihood, particles)
    p = np.asarray(p, np.float64)
    share = (len(believed) - known) / len(believed)  # prior of the unknown class: all objects alike
    p, p_unknown = calibrated.with_unknown_prior(p[..., :known], p[..., known:].sum(-1), share, PRIOR_UNKNOWN)
    return OpenSetEpisodes(np.where(there < known, there, -1), p, p_unknown, there, plan.pool)


def draw_objects(known: int, unknown: int, episodes: int, seed: int) -> np.ndarray:
    """Draw each episode's object: the known in turn, then as many episodes with unknown ones, each about as often."""
    rng, count = np.random.default_rng(seed), known * episodes
    drawn = np.concatenate([rng.permutation(unknown) for _ in range(-(-count // unknown))])[:count]
    return np.concatenate([np.arange(count) % known, known + drawn])


def report(parts: Sequence[Part], pads: Sequence[str]) -> dict[str, Any]:
    """Detection of unknown objects among known ones, and calibration of the unknown class."""
    validation, test = (_pooled([OpenSetEpisodes(**part[name]) for part in parts]) for name in ("validation", "test"))
    scaling = calibrated.fit_platt(validation.p_unknown, validation.truth < 0)
    p, p_unknown = calibrated.apply_platt(test.p, test.p_unknown, scaling)
    # Unknown objects are few, and another one may be told apart less or more easily: they are drawn again, too.
    clusters = clusters_of([part["test"] for part in parts], pads, objects="there")
    unknown = test.truth < 0
    area = metrics.auroc(test.p_unknown, unknown, clusters=clusters)
    truth = np.where(unknown, p.shape[-1], test.truth)
    rows = []
    for share in UNKNOWN_SHARES:
        at_share = calibrated.with_unknown_prior(p, p_unknown, PRIOR_UNKNOWN, share)
        hit = metrics.hits(np.concatenate([at_share[0], at_share[1][..., None]], axis=-1), truth)[:, -1]
        rates = (rate_interval(hit[some], rows_of(clusters, some)) for some in (~unknown, unknown))
        rows.append([f"{share:.0%}", *rates])
    last = p_unknown[:, -1]
    error = metrics.calibration_error(np.maximum(last, 1 - last), (last > 0.5) == unknown, NUM_BINS)
    shown = [[str(t), estimate_at(area, t - 1)] for t in sorted({min(t, len(area.mean)) for t in AUROC_TOUCHES})]
    head = ["share of unknown objects", "known objects named right", "unknown objects called unknown"]
    tables = {
        "auroc": make_table(["touches", "AUROC of the unknown class [95 %]"], shown),
        "accuracy": make_table(head, rows),
    }
    return {
        "episodes": len(truth), "platt": to_json(scaling), "calibration_error": to_json(error), "tables": tables,
    }  # fmt: skip


def _pooled(parts: Sequence[OpenSetEpisodes]) -> OpenSetEpisodes:
    return OpenSetEpisodes(*(np.concatenate(column) for column in zip(*parts, strict=True)))
