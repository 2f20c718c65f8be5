"""10, 25 and 50 objects: the catalogue's, the meshes of a folder, and random ones."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import trimesh

from experiments.common.runs import Part
from experiments.studies.lab import StudyLab
from experiments.studies.report import Column, clusters_of, make_table, touches_shown
from i2t.errors import require_extra
from i2t.objects import Mesh, catalogue, read_mesh
from i2t.recognition import metrics
from i2t.recognition.episodes import posteriors
from i2t.recognition.intervals import estimate_at
from i2t.recognition.site_pool import prepare_surfaces

OBJECT_COUNTS, DEBUG_OBJECT_COUNTS = (10, 25, 50), (3,)
EPISODES_EACH, DEBUG_COUNT_EPISODES = 10, 4  # with each number of objects: so many of --episodes, and one of each
TOUCHES, NUM_PARTICLES = 20, 64
DEBUG_TOUCHES, DEBUG_NUM_PARTICLES = 3, 8
COUNTED_TOUCHES = (1, 3, 5, 10, 20)
MAX_FACES = 2048  # of a scanned mesh
TRAINED_ON = ("hexagon", "parallelogram")
FIRST_RANDOM_SEED = 7000  # of the random objects


def evaluate(lab: StudyLab) -> Part:
    """Beliefs in episodes with the first 10, 25 and 50 of the objects in random order."""
    debug = lab.args.debug
    counts = DEBUG_OBJECT_COUNTS if debug else OBJECT_COUNTS
    meshes = collect_meshes(lab, max(counts))
    names = np.random.default_rng(0).permutation(list(meshes)[: max(counts)])
    touches, particles = (DEBUG_TOUCHES, DEBUG_NUM_PARTICLES) if debug else (TOUCHES, NUM_PARTICLES)
    cfg = replace(lab.cfg, touches=touches, num_particles=particles)
    found: Part = {}
    for count in counts:
        chosen = tuple(str(name) for name in names[:count])
        some = replace(lab, names=chosen, surfaces=prepare_surfaces([meshes[name] for name in chosen]), cfg=cfg)
        episodes = DEBUG_COUNT_EPISODES if debug else max(EPISODES_EACH * lab.episodes, count)
        found[f"{count} objects"] = evaluate_objects(some, episodes)
    return found


def evaluate_objects(lab: StudyLab, count: int) -> Part:
    """Truth and beliefs (e, t, objects) in some episodes with the lab's objects."""
    key_sites, key_episodes = jax.random.split(jax.random.clone(lab.key))
    label, particles = f"{len(lab.names)} objects", lab.particles()
    plan = lab.plan(key_sites, np.arange(count) % len(lab.names))
    (table,) = jax.device_put(lab.predict(plan.sites, particles, [lab.pad_model.reading_model], label))
    observations = lab.simulate(key_episodes, plan, label).observations
    p = posteriors(jnp.asarray(plan.chosen), observations, table, lab.pad_model.likelihood, particles)
    return {"truth": plan.truth, "pool": plan.pool, "p": np.asarray(p)}


def collect_meshes(lab: StudyLab, count: int) -> dict[str, Mesh]:
    """Meshes by name: the lab's objects, those of the folder, the rest of the catalogue, and `count` random ones."""
    meshes = {name: catalogue.make_object(name).mesh for name in lab.names}
    for path in sorted(lab.args.meshes.glob("*.stl")) if lab.args.meshes else ():
        meshes[path.stem] = decimate(read_mesh(path, "m")[0].mesh)
    for name in catalogue.PRIMITIVES + catalogue.TOOLS:
        if name not in TRAINED_ON:
            meshes.setdefault(name, catalogue.make_object(name).mesh)
    for i in range(count):
        meshes[f"random {i}"] = catalogue.random_object(FIRST_RANDOM_SEED + i).mesh
    return meshes


def decimate(mesh: Mesh, faces: int = MAX_FACES) -> Mesh:
    """A scanned mesh with fewer faces, by quadric decimation (Garland and Heckbert, SIGGRAPH 1997): predictions take as
    long as those of the object with the most of them. Raises MissingExtraError where pyvista is missing.
    """
    if len(mesh.faces) <= faces:
        return mesh
    require_extra("pyvista", "a scanned mesh of --meshes")
    import pyvista as pv

    fewer = pv.wrap(trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)).decimate(1 - faces / len(mesh.faces))
    return Mesh(np.asarray(fewer.points, np.float64), np.asarray(fewer.regular_faces, np.int32))


def report(parts: Sequence[Part], pads: Sequence[str]) -> dict[str, Any]:
    """Accuracy against touches for each number of objects."""
    rows = []
    for name in parts[0]:
        p, truth = (np.concatenate([part[name][column] for part in parts]) for column in ("p", "truth"))
        curve = metrics.accuracy(p, truth, clusters=clusters_of([part[name] for part in parts], pads))
        shown = touches_shown(p.shape[1], COUNTED_TOUCHES)
        rows.append([name, *(estimate_at(curve, t - 1) for t in shown)])
    head = ["", *(Column(f"after {t} [95 %]", 2) for t in shown)]
    return {"tables": {"curves": make_table(head, rows)}}
