"""Cost of one wrong assumption: each world differs in one respect from the one that the belief assumes.

The same objects are touched in all worlds at the same sites, with common random numbers.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.common.runs import Part
from experiments.studies.lab import StudyLab, StudyWorld
from i2t.geometry import from_twist
from i2t.objects import Mesh
from i2t.objects.named import read_meshes
from i2t.patches.dimensions import TWIST_LEVER_M
from i2t.recognition.episodes import run_belief
from i2t.recognition.site_pool import prepare_surfaces
from i2t.simulation.touches import SimulationErrors
from i2t.types import Surface

KINDS = ("fused", "readings")
DEBUG_WORLDS = ("matched", "twice the hysteresis", "meshes 3 % larger")


def placed(errors: SimulationErrors, factor: float) -> SimulationErrors:
    """Scale the errors of placement by a factor."""
    return replace(errors, placement=factor * errors.placement, placement_angle=factor * errors.placement_angle)


def faulty(errors: SimulationErrors, **faults: Any) -> SimulationErrors:
    """Change some faults of the sensor."""
    return replace(errors, faults=replace(errors.faults, **faults))


def _scaled(mesh: Mesh, factor: float) -> Mesh:
    return mesh._replace(vertices=np.asarray(mesh.vertices) * factor)


def _shifted(mesh: Mesh) -> Mesh:
    """Shift a mesh by 1 mm and 1 degree, the effect of a biased camera."""
    bias = np.array([0.6e-3, -0.6e-3, 0.6e-3, *(TWIST_LEVER_M * np.radians([0.6, 0.6, -0.6]))])
    T = np.asarray(from_twist(jnp.float32(bias)), float)
    return mesh._replace(vertices=np.asarray(mesh.vertices) @ T[:3, :3].T + T[:3, 3])


def worlds(lab: StudyLab) -> dict[str, StudyWorld]:
    """Worlds by name; the first matches the assumptions."""
    errors, limits = lab.cfg.errors, lab.cfg.limits
    all_worlds = {
        "matched": StudyWorld(),
        "twice the hysteresis": StudyWorld(errors=faulty(errors, hysteresis=0.6)),
        "ambient measured only before the episode": StudyWorld(errors=faulty(errors, ambient_every=0)),
        "arm twice as stiff": StudyWorld(limits=replace(limits, stiffness=2 * limits.stiffness)),
        "arm half as stiff": StudyWorld(limits=replace(limits, stiffness=0.5 * limits.stiffness)),
        **{
            f"meshes {abs(percent)} % {'larger' if percent > 0 else 'smaller'}": StudyWorld(
                mesh=partial(_scaled, factor=1 + percent / 100)
            )
            for percent in (-3, -1, 1, 3)
        },
        "camera biased by 1 mm and 1 degree": StudyWorld(mesh=_shifted),
    }
    return {name: world for name, world in all_worlds.items() if name in DEBUG_WORLDS or not lab.size.debug}


def evaluate(lab: StudyLab) -> Part:
    """Compute beliefs `(e, t, objects)` in every world, keyed by "evidence, world"."""
    key_sites, key_episodes = jax.random.split(lab.key)
    truth, particles, model = lab.truth(), lab.particles(), lab.pad_model
    plan = lab.plan(key_sites, len(truth))
    (table,) = lab.predict(plan.sites, particles, [model.reading_model], "possible objects")
    part: Part = {"truth": truth, "pool": plan.pool}
    study_worlds = worlds(lab)
    surfaces = _surfaces_of(lab, study_worlds)
    for name, world in study_worlds.items():
        key = jax.random.clone(key_episodes)
        episodes = lab.simulate(key, plan, truth, name, surfaces=surfaces[name], world=world)
        beliefs = run_belief(table, episodes, model.likelihood, particles, KINDS)
        part |= {f"{kind}, {name}": p for kind, p in beliefs.items()}
    return part


def _surfaces_of(lab: StudyLab, study_worlds: Mapping[str, StudyWorld]) -> dict[str, list[Surface]]:
    """Prepare the surfaces of each world, all changed meshes together so that they share one size and compile once."""
    meshes = list(read_meshes(lab.names).values())
    others = [world.mesh(mesh) for world in study_worlds.values() if world.mesh for mesh in meshes]
    prepared = iter(prepare_surfaces(others) if others else [])
    return {
        name: [next(prepared) for _ in meshes] if world.mesh else lab.surfaces for name, world in study_worlds.items()
    }
