"""Worlds that differ in one thing from what the belief was fitted to, which does not know it: the same objects are
touched in all of them at the same sites, with common random numbers.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.common.runs import Part
from experiments.recognize.plans import meshes_by_name
from experiments.studies.lab import StudyLab, StudyWorld
from i2t.geometry import from_twist
from i2t.objects import Mesh
from i2t.patches.dimensions import TWIST_LEVER_M
from i2t.recognition.episodes import run_belief
from i2t.recognition.site_pool import prepare_surfaces
from i2t.simulation.touches import SimulationErrors
from i2t.types import Surface

KINDS = ("fused", "readings")
CAMERA_BIAS = np.array([0.6e-3, -0.6e-3, 0.6e-3, *(TWIST_LEVER_M * np.radians([0.6, 0.6, -0.6]))])  # 1 mm, 1 degree
MESH_PERCENT = (-3, -1, 1, 3)
DEBUG_WORLDS = ("matched", "chip remembers twice as much", "meshes 3 % larger")


def placed(errors: SimulationErrors, factor: float) -> SimulationErrors:
    """Errors of placement larger by a factor."""
    return replace(errors, placement=factor * errors.placement, placement_angle=factor * errors.placement_angle)


def faulty(errors: SimulationErrors, **faults: Any) -> SimulationErrors:
    """Errors with other faults of the sensor."""
    return replace(errors, faults=replace(errors.faults, **faults))


def _scaled(mesh: Mesh, factor: float) -> Mesh:
    return mesh._replace(vertices=np.asarray(mesh.vertices) * factor)


def _shifted(mesh: Mesh) -> Mesh:
    T = np.asarray(from_twist(jnp.float32(CAMERA_BIAS)), float)
    return mesh._replace(vertices=np.asarray(mesh.vertices) @ T[:3, :3].T + T[:3, 3])


def worlds(lab: StudyLab) -> dict[str, StudyWorld]:
    """Worlds by name; the first is the lab's."""
    errors, limits = lab.cfg.errors, lab.cfg.limits
    found = {
        "matched": StudyWorld(),
        "chip remembers twice as much": StudyWorld(errors=faulty(errors, hysteresis=0.6)),
        "ambient once, before the episode": StudyWorld(errors=faulty(errors, ambient_every=0)),
        "arm twice as stiff": StudyWorld(limits=replace(limits, stiffness=2 * limits.stiffness)),
        "arm half as stiff": StudyWorld(limits=replace(limits, stiffness=0.5 * limits.stiffness)),
        **{
            f"meshes {abs(percent)} % {'larger' if percent > 0 else 'smaller'}": StudyWorld(
                mesh=partial(_scaled, factor=1 + percent / 100)
            )
            for percent in MESH_PERCENT
        },
        "camera biased by 1 mm and degree": StudyWorld(mesh=_shifted),
    }
    return {name: each for name, each in found.items() if name in DEBUG_WORLDS or not lab.size.debug}


def evaluate(lab: StudyLab) -> Part:
    """Beliefs (e, t, objects) in every world, by "evidence, world"."""
    key_sites, key_episodes = jax.random.split(lab.key)
    truth, particles, model = lab.truth(), lab.particles(), lab.pad_model
    plan = lab.plan(key_sites, len(truth))
    (table,) = lab.predict(plan.sites, particles, [model.reading_model], "possible objects")
    found: Part = {"truth": truth, "pool": plan.pool}
    made = worlds(lab)
    surfaces = _surfaces_of(lab, made)
    for name, world in made.items():
        key = jax.random.clone(key_episodes)
        episodes = lab.simulate(key, plan, truth, name, surfaces=surfaces[name], world=world)
        beliefs = run_belief(table, episodes, model.likelihood, particles, KINDS)
        found |= {f"{kind}, {name}": p for kind, p in beliefs.items()}
    return found


def _surfaces_of(lab: StudyLab, made: Mapping[str, StudyWorld]) -> dict[str, list[Surface]]:
    """Surfaces of each world, those of other meshes prepared at once: they are of one size class, and compile once."""
    meshes = list(meshes_by_name(lab.names).values())
    others = [world.mesh(mesh) for world in made.values() if world.mesh for mesh in meshes]
    prepared = iter(prepare_surfaces(others) if others else [])
    return {name: [next(prepared) for _ in meshes] if world.mesh else lab.surfaces for name, world in made.items()}
