"""Worlds that differ in one thing from what the belief was fitted to, which does not know it."""

from dataclasses import replace
from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from experiments.studies.lab import Setting, StudyLab, StudyWorld
from i2t.geometry import from_twist
from i2t.objects import Mesh
from i2t.simulation.touches import SimulationErrors
from i2t.windows import TWIST_LEVER_M

WITH_READINGS = ("fused", "readings")
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


def settings(lab: StudyLab, _: Array) -> dict[str, Setting]:
    """Worlds of which the belief knows nothing but for the first."""
    errors, limits = lab.cfg.errors, lab.cfg.limits
    worlds = {
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
    found = {name: Setting(world, WITH_READINGS, lab.pad_model, errors) for name, world in worlds.items()}
    return {name: each for name, each in found.items() if name in DEBUG_WORLDS or not lab.args.debug}
