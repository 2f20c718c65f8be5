"""Presses at random sites over all sides of ten objects, judged by a ray caster that is not ours (Embree, by trimesh).

Sites are drawn on the surface by trimesh, with normals that point up, sideways and a little down; what the arm may not
reach is drawn anew. After each press the judge casts rays over the skin's square along its approach, against the mesh
where it really stands: a press that is said to have met something must have, and one that met air must not have gone
through anything. All simulated.
"""

from functools import lru_cache
from typing import Any

import jax
import numpy as np
import trimesh

from experiments.faults.rows import FaultCounts, FaultRow
from experiments.faults.simulated import WALL_TIME_S, NullRecorder
from experiments.faults.trials import Trial, TrialStore
from i2t.collect.procedure import Procedure
from i2t.collect.settings import TouchSettings
from i2t.collect.site_plan import patch_extractor
from i2t.collect.touch import Site, UnreachableError
from i2t.emulators.in_process import SimulatedArm, SimulatedCamera, SimulatedLab, SimulatedSkin, VirtualClock
from i2t.emulators.scene import ObjectScene
from i2t.errors import DeviceError
from i2t.geometry import contact_frame, inverse, nearest_rigid
from i2t.hardware.rig import Rig
from i2t.objects.catalogue import make_object
from i2t.objects.solids import Mesh
from i2t.simulation.touches import SimulationErrors
from i2t.skin.pad import sample_pad
from i2t.types import PAD_WINDOW, Array, ReturnCode

PRESSED_OBJECTS = ("hexagon", "star", "square", "cylinder", "parallelogram", "flower", "screwdriver", "hammer")
TALL = {"tall star": ("star", (0.5, 0.5, 2.2)), "tall cylinder": ("cylinder", (0.4, 0.4, 2.5))}
LEAST_UP = -0.1  # cosine between a normal and up
RAYS = 41  # along an edge of the skin
TOLERANCE_M = 0.6e-3  # of a judgement: repeatability, the tilt of an approach at the skin's edge, and the pitch of rays
ATTEMPTS = 400  # sites that are drawn until one can be reached


def sites(sizes: FaultCounts, trials: TrialStore) -> list[FaultRow]:
    """The presses and their judgements."""
    made = trials.run(sizes.sites, _press)
    judged = [trial for trial in made if trial["code"] != ReturnCode.FAILED]
    met = [trial for trial in judged if trial["code"] != ReturnCode.AIR]
    false_air = [trial for trial in judged if trial["code"] == ReturnCode.AIR and trial["through"] > TOLERANCE_M]
    false_met = [trial for trial in met if trial["through"] < -TOLERANCE_M]
    sides = sum(trial["up"] < 0.3 for trial in judged)
    failed = len(made) - len(judged)
    said = (
        f"{len(met)} met something and {len(judged) - len(met)} air; wrong: {len(false_air)} air, {len(false_met)} "
        f"contacts; {failed} refused before or by the camera"
    )
    tried = f"{len(judged)} presses on {len({trial['object'] for trial in judged})} objects, {sides} from the side"
    wrong = len(false_air) + len(false_met)
    return [FaultRow("sites", "contact or air, as a ray caster says", tried, said, "0 wrong", wrong == 0)]


def _press(number: int) -> Trial | None:
    names = (*PRESSED_OBJECTS, *TALL)
    name, rng = names[number % len(names)], np.random.default_rng((number, 5))
    procedure, scene = _lab(name, number)
    site = _drawn_site(procedure, name, number, rng)
    if site is None:
        return None
    up = float(-site.T_w_t[2, 2])
    try:
        touched = procedure.touch(site, NullRecorder())
    except UnreachableError:
        return None
    except DeviceError as error:
        return {"object": name, "up": up, "code": int(ReturnCode.FAILED), "through": 0.0, "why": str(error)[:100]}
    T_b_t = procedure.rig.T_base_world @ touched.T_w_t
    return {"object": name, "up": up, "code": int(touched.code), "through": _through(name, scene.T_b_o, T_b_t)}


def _through(name: str, T_b_o: Array, T_b_t: Array) -> float:
    """Distance (m) of the skin past the first surface on its way, by Embree; negative where it did not reach it."""
    place = (np.linspace(-0.5, 0.5, RAYS)) * PAD_WINDOW
    x, y = (each.ravel() for each in np.meshgrid(place, place))
    back = 0.04
    T_o_t = inverse(T_b_o) @ T_b_t
    origins = np.column_stack([x, y, np.full(x.size, -back)]) @ T_o_t[:3, :3].T + T_o_t[:3, 3]
    directions = np.tile(T_o_t[:3, 2], (x.size, 1))
    hits, rays, _ = _witness(name).ray.intersects_location(origins, directions, multiple_hits=False)
    if not len(hits):
        return -1.0
    return float(back - ((hits - origins[rays]) @ T_o_t[:3, 2]).min())


def _drawn_site(procedure: Procedure, name: str, number: int, rng: np.random.Generator) -> Site | None:
    """A site that the arm may go to."""
    mesh = _witness(name)
    for _ in range(ATTEMPTS):
        points, faces = trimesh.sample.sample_surface(mesh, 1, seed=int(rng.integers(1 << 31)))
        normal = mesh.face_normals[faces[0]]
        if normal[2] < LEAST_UP:
            continue
        pose = contact_frame(np.asarray(points[0]), np.asarray(normal), float(rng.uniform(0, 2 * np.pi)))
        site = Site(number, nearest_rigid(pose))
        try:
            procedure.path.check(site)
        except UnreachableError:
            continue
        return site
    return None


def _lab(name: str, seed: int) -> tuple[Procedure, ObjectScene]:
    """A procedure whose devices are connected, over one object."""
    rig, clock = Rig(), VirtualClock(WALL_TIME_S)
    mesh = _mesh(name)
    scene = ObjectScene(mesh, rig.T_base_world @ rig.T_world_object, _pad(), SimulationErrors(), seed=seed)
    lab = SimulatedLab(scene, clock, seed=seed)
    arm, skin = SimulatedArm(lab, rig.limits), SimulatedSkin(lab)
    eye: Any = SimulatedCamera(scene, rig.camera, rig.T_tool_camera, lambda: arm.state().T_b_t, clock, seed=seed)
    for device in (arm, skin, eye):
        device.connect()
    top = float(mesh.vertices[:, 2].max())
    return Procedure(arm, skin, eye, rig, skin.board, patch_extractor(), top, TouchSettings(), clock), scene


@lru_cache
def _mesh(name: str) -> Mesh:
    if name not in TALL:
        return make_object(name).mesh
    of, scale = TALL[name]
    mesh = make_object(of).mesh
    return Mesh(mesh.vertices * np.array(scale), mesh.faces)


@lru_cache
def _witness(name: str) -> trimesh.Trimesh:
    mesh = _mesh(name)
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


@lru_cache
def _pad() -> Any:
    return jax.jit(sample_pad)(jax.random.key(1000))
