"""Rigs and sites in simulated labs over objects: mistakes in a calibration file, and presses on all sides.

A mistake is tried against a lab that is as the right file says: is it refused, or shown? The arm reports its tool by
the wrong TCP and carries a payload of another weight than it was told; camera, skin and object are where they really
are. As in `python -m i2t.collect` the file is read, checked for plausibility (`i2t.hardware.rig_checks`), compared with
the camera's lens, and then the first looks and the first slow touch are made.

Sites are drawn on the surface by trimesh, with normals that point up, sideways and a little down. After each press a
ray caster that is not ours (Embree, by trimesh) casts rays over the skin's square along its approach: a press that is
said to have met something must have, and one that met air must not have gone through anything. All simulated.
"""

from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import numpy as np
import trimesh

from experiments.faults.closed_form import WALL_TIME_S, MemoryLog
from experiments.faults.rig_mistakes import MISTAKES, RigMistake, right_rig
from experiments.faults.table import Fault, Measure, Trial
from i2t.collect.first_touch import RigContradictedError, first_touch
from i2t.collect.procedure import Procedure
from i2t.collect.site_plan import SiteSampler, patch_extractor
from i2t.collect.touch import TOOL, Site, SkinOnTool, UnreachableError
from i2t.emulators.in_process import SimulatedArm, SimulatedCamera, SimulatedLab, SimulatedSkin, VirtualClock
from i2t.emulators.scene import ObjectScene
from i2t.errors import DeviceError
from i2t.geometry import contact_frame, inverse, nearest_rigid
from i2t.hardware.protocols import ArmState
from i2t.hardware.rig import Rig
from i2t.hardware.rig_checks import other_lens, require_plausible
from i2t.objects.catalogue import make_object
from i2t.objects.solids import Mesh
from i2t.simulation.site_limits import SiteLimits
from i2t.simulation.touches import SimulationErrors
from i2t.skin.pad import sample_pad
from i2t.types import Array, ReturnCode
from i2t.windows import PAD_WINDOW

RIG_OBJECTS = ("star", "hammer")  # a prism, and a tool that is another one upside down
ACCEPTED_SHARE = 5 / 53
GRAVITY_M_S2 = 9.81
RIGHT_SEEDS = 10  # labs of each object in which the right rig is tried
PRESSED_OBJECTS = ("hexagon", "star", "square", "cylinder", "parallelogram", "flower", "screwdriver", "hammer")
TALL = {"tall star": ("star", (0.5, 0.5, 2.2)), "tall cylinder": ("cylinder", (0.4, 0.4, 2.5))}
LEAST_UP = -0.1  # cosine between a normal and up
RAYS, RAYS_BEGIN_M = 41, 0.04  # along an edge of the skin; behind the skin
TOLERANCE_M = 0.6e-3  # of a judgement: repeatability, the tilt of an approach at the skin's edge, and the pitch of rays
ATTEMPTS = 400  # sites that are drawn until one can be reached


class Found(NamedTuple):
    """Result of trying a rig."""

    where: str  # file, plausibility, lens, first touch, arm, or accepted
    sentence: str


class MistakenArm(SimulatedArm):
    """An arm that reports its tool by a wrong TCP, and was told a wrong payload.

    Args:
        lab: In which its tool moves.
        right: What is true.
        wrong: What it was told.
    """

    def __init__(self, lab: SimulatedLab, right: Rig, wrong: Rig) -> None:
        super().__init__(lab, wrong.limits)
        self._to_reported = inverse(right.T_flange_tool) @ wrong.T_flange_tool
        lab.robot.external_wrench = np.array([0.0, 0.0, GRAVITY_M_S2 * (wrong.mass - right.mass), 0.0, 0.0, 0.0])

    @property
    def tool(self) -> Array:
        """T_b_t (4, 4), m, of the real tool."""
        return super().read_state().T_b_t

    def read_state(self) -> ArmState:
        """The present state by the wrong TCP."""
        real = super().read_state()
        reported = real.T_b_t @ self._to_reported
        wrench = real.wrench.reshape(2, 3) @ real.T_b_t[:3, :3].T @ reported[:3, :3]
        return real._replace(T_b_t=reported, wrench=wrench.ravel())

    def begin_line(self, T_b_t: Array, speed: float, acceleration: float) -> None:
        """Start a straight motion of what it takes for its tool."""
        super().begin_line(T_b_t @ inverse(self._to_reported), speed, acceleration)


def object_lab(name: str, rig: Rig, seed: int, believed: Rig | None = None) -> tuple[Procedure, ObjectScene]:
    """A procedure over an object whose devices are connected.

    Args:
        name: Of the object.
        rig: How the lab is.
        seed: Of its errors.
        believed: How the procedure takes it to be; by default as it is.

    Returns:
        The procedure and what its tool meets.
    """
    clock, mesh, wrong = VirtualClock(WALL_TIME_S), _mesh(name), believed or rig
    scene = ObjectScene(mesh, rig.T_base_world @ rig.T_world_object, _pad(), SimulationErrors(), seed=seed)
    lab = SimulatedLab(scene, clock, seed=seed)
    arm, skin = MistakenArm(lab, rig, wrong), SimulatedSkin(lab)
    camera = SimulatedCamera(scene, rig.camera, rig.T_tool_camera, lambda: arm.tool, clock, seed=seed)
    for device in (arm, skin, camera):
        device.connect()
    top = float(np.max(mesh.vertices @ wrong.T_world_object[2, :3]) + wrong.T_world_object[2, 3])
    skins = [SkinOnTool(TOOL, skin, skin.board)]
    return Procedure(arm, skins, camera, wrong, patch_extractor(), top, clock=clock), scene


# Mistakes


def try_mistake(mistake: RigMistake, name: str, seed: int = 0) -> Found:
    """Try a mistake.

    Args:
        mistake: Of `MISTAKES`.
        name: Of the object.
        seed: Of the lab's errors.

    Returns:
        Where it was noticed.
    """
    try:
        wrong = mistake.make(right_rig())
    except ValueError as error:
        return Found("file", str(error))
    return try_rig(wrong, name, seed)


def try_rig(wrong: Rig, name: str, seed: int = 0) -> Found:
    """Try a rig in a lab that is as `right_rig` says.

    Args:
        wrong: The rig that is believed.
        name: Of the object.
        seed: Of the lab's errors.

    Returns:
        Where it was contradicted.
    """
    right, mesh = right_rig(), _mesh(name)
    try:
        require_plausible(wrong, mesh.vertices)
    except ValueError as error:
        return Found("plausibility", str(error))
    if different := other_lens(wrong.camera, right.camera):
        return Found("lens", different)
    try:
        sampler = SiteSampler(mesh, wrong.T_world_object, SiteLimits(), seed, name)
        first_touch(object_lab(name, right, seed, wrong)[0], sampler, report=lambda line: None)
    except RigContradictedError as error:
        return Found("first touch", str(error))
    except (DeviceError, ValueError) as error:
        return Found("arm", str(error))
    return Found("accepted", "")


def rig_mistake(name: str, number: int) -> Trial:
    """One of all mistakes."""
    where = try_mistake(MISTAKES[number], name).where
    accepted = where == "accepted"
    return {"accepted": accepted, "mistakes": 1, "said": f"accepted: {MISTAKES[number].name}" if accepted else where}


def refused_right_rig(name: str, seed: int) -> Trial:
    """The right rig in a lab of some seed."""
    found = try_rig(right_rig(), name, seed)
    return {"refused": found.where != "accepted", "said": found.sentence or found.where}


# Sites


def press_judged(number: int) -> Trial | None:
    """A press at a random site, and the ray caster's word on it; None where no site could be reached."""
    names = (*PRESSED_OBJECTS, *TALL)
    name, rng = names[number % len(names)], np.random.default_rng((number, 5))
    procedure, scene = object_lab(name, Rig(), number)
    site = _drawn_site(procedure, name, number, rng)
    if site is None:
        return None
    try:
        touched = procedure.touch(site, MemoryLog())
    except UnreachableError:
        return None
    except DeviceError:
        return {"wrong": 0, "said": "refused before or by the camera"}
    through = _through(name, scene.T_b_o, procedure.rig.T_base_world @ touched.T_w_t)
    air = touched.code == ReturnCode.AIR
    wrong = through > TOLERANCE_M if air else not through >= -TOLERANCE_M
    side = ", from the side" if -site.T_w_t[2, 2] < 0.3 else ""
    return {"wrong": bool(wrong), "said": ("air" if air else "contact") + side}


def _through(name: str, T_b_o: Array, T_b_t: Array) -> float:
    """Distance (m) of the skin past the first surface on its way, by Embree; negative where it did not reach it."""
    place = np.linspace(-0.5, 0.5, RAYS) * PAD_WINDOW
    x, y = (each.ravel() for each in np.meshgrid(place, place))
    T_o_t = inverse(T_b_o) @ T_b_t
    origins = np.column_stack([x, y, np.full(x.size, -RAYS_BEGIN_M)]) @ T_o_t[:3, :3].T + T_o_t[:3, 3]
    directions = np.tile(T_o_t[:3, 2], (x.size, 1))
    hits, rays, _ = _witness(name).ray.intersects_location(origins, directions, multiple_hits=False)
    if not len(hits):
        return -1.0
    return float(RAYS_BEGIN_M - ((hits - origins[rays]) @ T_o_t[:3, 2]).min())


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


@lru_cache
def _mesh(name: str) -> Mesh:
    of, scale = TALL.get(name, (name, (1.0, 1.0, 1.0)))
    mesh = make_object(of).mesh
    return Mesh(mesh.vertices * np.array(scale), mesh.faces)


@lru_cache
def _witness(name: str) -> trimesh.Trimesh:
    mesh = _mesh(name)
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


@lru_cache
def _pad() -> Any:
    return jax.jit(sample_pad)(jax.random.key(1000))


RIG_FAULTS = (
    *(Fault("rig", f"mistake in a rig, {name}", partial(rig_mistake, name), len(MISTAKES),
            (Measure("accepted", ACCEPTED_SHARE, of="mistakes"),)) for name in RIG_OBJECTS),
    *(Fault("rig", f"right rig, {name}", partial(refused_right_rig, name), RIGHT_SEEDS, (Measure("refused", 0),))
      for name in RIG_OBJECTS),
    Fault("sites", "press at a random site, judged by a ray caster", press_judged, 500, (Measure("wrong", 0),)),
)  # fmt: skip
