"""Detection of unknown objects. Half of the episodes have an unknown object of the same families as the known ones.

The unknown class consists of surrogates (`i2t.objects.catalogue.surrogate_unknown`): objects similar to the known ones
but different from all of them. Surrogates have pose particles and take part in the posterior as known objects do; the
sum of their probabilities is that of the unknown class. It is calibrated (Platt scaling) on validation objects and
other unknown objects.
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

# Disjoint sets; no pad model was fitted to touches of these objects.
TEST_UNKNOWN = ("triangle", "cross", "wedge", "dome", "torus", "spanner", "cutter", "scissors")
VALIDATION_UNKNOWN = ("pentagon", "pyramid", "cone", "ellipsoid", "pliers")
VALIDATION_KNOWN = ("flower", "octagon", "stairs", "ridge", "marker")
UNKNOWN_PRIOR = 0.5


class OpenSetObjects(NamedTuple):
    """Known objects, unknown objects, and surrogates, in this order."""

    known: tuple[str, ...]
    unknown: tuple[str, ...]
    surrogates: int

    def meshes(self) -> list[Mesh]:
        """Meshes of all objects."""
        known_meshes = [catalogue.make_object(name).mesh for name in self.known]
        unknown_meshes = [catalogue.make_object(name).mesh for name in self.unknown]
        return (
            known_meshes
            + unknown_meshes
            + [catalogue.surrogate_unknown(known_meshes, i).mesh for i in range(self.surrogates)]
        )


class OpenSetEpisodes(NamedTuple):
    """Episodes with known objects and as many with unknown ones."""

    truth: np.ndarray  # (e,), -1 for an unknown object
    p: np.ndarray  # (e, t, known)
    p_unknown: np.ndarray  # (e, t) probability of the unknown class
    there: np.ndarray  # (e,) index of the touched object: known ones first, then unknown ones
    pool: np.ndarray  # (e,) index of the pool of sites


def evaluate(lab: StudyLab) -> Part:
    """Compute beliefs in episodes with validation objects and with test objects."""
    key_test, key_validation = jax.random.split(lab.key)
    limit, surrogates = (2, 2) if lab.size.debug else (None, 48)
    validation = OpenSetObjects(VALIDATION_KNOWN[:limit], VALIDATION_UNKNOWN[:limit], surrogates)
    test = OpenSetObjects(lab.names, TEST_UNKNOWN[:limit], surrogates)
    meshes = validation.meshes(), test.meshes()
    surfaces = prepare_surfaces([*meshes[0], *meshes[1]])  # together, so that they share one size and compile once
    count = len(meshes[0])
    fitted = evaluate_set(lab, key_validation, validation, surfaces[:count], "validation")
    tested = evaluate_set(lab, key_test, test, surfaces[count:], "test")
    return {"validation": fitted._asdict(), "test": tested._asdict()}


def evaluate_set(
    lab: StudyLab, key: jax.Array, objects: OpenSetObjects, surfaces: list[Surface], label: str
) -> OpenSetEpisodes:
    """Compute beliefs in episodes with known objects, then in as many with unknown ones."""
    key_sites, key_episodes = jax.random.split(key)
    num_known, num_unknown = len(objects.known), len(objects.unknown)
    lab = replace(lab, surfaces=surfaces[:num_known], names=objects.known)
    there = draw_objects(num_known, num_unknown, lab.size.episodes, lab.seed)
    plan = lab.plan(key_sites, len(there))
    believed = surfaces[:num_known] + surfaces[num_known + num_unknown :]
    lab, particles = replace(lab, surfaces=believed), lab.particles()
    (table,) = jax.device_put(lab.predict(plan.sites, particles, [lab.pad_model.reading_model], label))
    episodes = lab.simulate(key_episodes, plan, there, label, surfaces=surfaces[: num_known + num_unknown])
    p = posteriors(jnp.asarray(plan.chosen), episodes.observations, table, lab.pad_model.likelihood, particles)
    p = np.asarray(p, np.float64)
    share = (len(believed) - num_known) / len(believed)  # prior of the unknown class if all objects are equally likely
    p, p_unknown = calibrated.with_unknown_prior(p[..., :num_known], p[..., num_known:].sum(-1), share, UNKNOWN_PRIOR)
    return OpenSetEpisodes(np.where(there < num_known, there, -1), p, p_unknown, there, plan.pool)


def draw_objects(known: int, unknown: int, episodes: int, seed: int) -> np.ndarray:
    """Draw each episode's object: the known ones in turn, then as many unknown ones, each about equally often."""
    rng, count = np.random.default_rng(seed), known * episodes
    drawn = np.concatenate([rng.permutation(unknown) for _ in range(-(-count // unknown))])[:count]
    return np.concatenate([np.arange(count) % known, known + drawn])


def report(parts: Sequence[Part], pads: Sequence[str]) -> dict[str, Any]:
    """Report the detection of unknown objects and the calibration of the unknown class."""
    validation, test = (_pooled([OpenSetEpisodes(**part[name]) for part in parts]) for name in ("validation", "test"))
    scaling = calibrated.fit_platt(validation.p_unknown, validation.truth < 0)
    p, p_unknown = calibrated.apply_platt(test.p, test.p_unknown, scaling)
    # Unknown objects are few and differ in difficulty, so the bootstrap resamples objects too.
    clusters = clusters_of([part["test"] for part in parts], pads, objects="there")
    unknown = test.truth < 0
    area = metrics.auroc(test.p_unknown, unknown, clusters=clusters)
    truth = np.where(unknown, p.shape[-1], test.truth)
    rows = []
    for share in (0.01, 0.25, 0.5):
        at_share = calibrated.with_unknown_prior(p, p_unknown, UNKNOWN_PRIOR, share)
        hit = metrics.hits(np.concatenate([at_share[0], at_share[1][..., None]], axis=-1), truth)[:, -1]
        rates = (rate_interval(hit[some], rows_of(clusters, some)) for some in (~unknown, unknown))
        rows.append([f"{share:.0%}", *rates])
    last = p_unknown[:, -1]
    error = metrics.calibration_error(np.maximum(last, 1 - last), (last > 0.5) == unknown, 10)
    shown = [[str(t), estimate_at(area, t - 1)] for t in sorted({min(t, len(area.mean)) for t in (1, 3, 5, 10)})]
    head = [
        "prior share of unknown objects", "known objects identified correctly", "unknown objects reported as unknown",
    ]  # fmt: skip
    tables = {
        "auroc": make_table(["touches", "AUROC of the unknown class [95 %]"], shown),
        "accuracy": make_table(head, rows),
    }
    return {
        "episodes": len(truth), "platt": to_json(scaling), "calibration_error": to_json(error), "tables": tables,
    }  # fmt: skip


def _pooled(parts: Sequence[OpenSetEpisodes]) -> OpenSetEpisodes:
    return OpenSetEpisodes(*(np.concatenate(column) for column in zip(*parts, strict=True)))
