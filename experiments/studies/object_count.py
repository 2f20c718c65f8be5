"""10, 25 and 50 objects: the catalogue's, the meshes of a folder, and random ones."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import trimesh

from experiments.recognize import figures as drawing
from experiments.studies.lab import Lab, imagine, placements_of, sit
from i2t import viz
from i2t.objects import catalogue
from i2t.objects.catalogue import Mesh
from i2t.recognition import metrics as scores
from i2t.recognition.episodes import posteriors
from i2t.recognition.metrics import to_json
from i2t.recognition.site_pool import draw_random_sites, prepare_surfaces, sample_sites

COUNTS = (10, 25, 50)
FACES = 2048  # at most, of a scanned mesh
MANY_TOUCHES, MANY_SITES, MANY_PLACES, MANY_SITTINGS = 20, 8, 64, 100


def play(lab: Lab) -> dict[str, Any]:
    """Sittings with the first 10, 25 and 50 of a list of objects: the catalogue's, the folder's, and random ones."""
    small = lab.args.preset == "debug"
    counts = (3,) if small else COUNTS
    touches, places_count = (3, 8) if small else (MANY_TOUCHES, MANY_PLACES)
    trained_on = ("hexagon", "parallelogram")
    meshes = {name: catalogue.make_object(name).mesh for name in lab.names}
    for path in sorted(lab.args.meshes.glob("*.stl")) if lab.args.meshes else ():
        meshes[path.stem] = coarse(catalogue.load_mesh(path, "m")[0].mesh)
    for name in catalogue.PRIMITIVES + catalogue.TOOLS:
        if name not in trained_on:
            meshes.setdefault(name, catalogue.make_object(name).mesh)
    for i in range(max(counts)):
        meshes[f"random {i}"] = catalogue.random_object(7000 + i).mesh
    found: dict[str, Any] = {}
    key_pool, key_play, key_site = jax.random.split(lab.key, 3)
    order = np.random.default_rng(0).permutation(list(meshes)[: max(counts)] if not small else list(meshes)[:3])
    cfg = replace(lab.cfg, touches=touches, num_sites=2 if small else MANY_SITES, num_particles=places_count)
    for count in counts:
        names = tuple(str(name) for name in order[:count])
        some = lab._replace(names=names, surfaces=prepare_surfaces([meshes[name] for name in names]), cfg=cfg)
        sites = sample_sites(key_pool, some.surfaces, names, cfg.num_sites, cfg.site_limits)
        places = placements_of(some)
        (table,) = imagine(some, sites, places, [lab.learnt.reading_model], f"{count} objects")
        truth = np.resize(np.arange(count), 4 if small else max(MANY_SITTINGS, count))
        chosen = draw_random_sites(key_site, sites, len(truth), touches)
        episodes = sit(some, key_play, sites, truth, chosen, f"{count} objects")
        p = posteriors(jax.device_put(table), jnp.asarray(chosen), episodes.observations, lab.learnt.likelihood, places)
        found[f"{count} objects"] = {"truth": truth, "p": np.asarray(p)}
    return found


def coarse(mesh: Mesh, faces: int = FACES) -> Mesh:
    """A scanned mesh with fewer faces, by quadric decimation (Garland and Heckbert, SIGGRAPH 1997): imagining takes as
    long as the object with the most of them. Raises ValueError where pyvista is missing.
    """
    if len(mesh.faces) <= faces:
        return mesh
    try:
        import pyvista as pv
    except ImportError as error:
        raise ValueError("scanned meshes are simplified with pyvista; run pip install 'i2t[notebooks]'") from error
    fewer = pv.wrap(trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)).decimate(1 - faces / len(mesh.faces))
    return Mesh(np.asarray(fewer.points, np.float64), np.asarray(fewer.regular_faces, np.int32))


def report(parts: Sequence[dict[str, Any]], out: Path) -> dict[str, Any]:
    """Accuracy against touches for each number of objects."""
    result: dict[str, Any] = {}
    curves = {}
    for name in parts[0]:
        p = np.concatenate([part[name]["p"] for part in parts]).astype(np.float64)
        truth = np.concatenate([part[name]["truth"] for part in parts])
        curves[name] = scores.accuracy(p, truth)
        result[name] = {"sittings": len(truth), "accuracy": to_json(curves[name])}
        print(f"{name:12} " + " ".join(f"{t + 1}: {curves[name].mean[t]:.2f}" for t in range(0, p.shape[1], 3)))
    viz.save_figure(drawing.accuracy(curves, "Accuracy with more objects", True), out / "accuracy.png")
    return result
