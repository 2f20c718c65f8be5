"""Rigs and sites in simulated labs over objects: mistakes in a calibration file, and presses on all sides.

A mistake is tried against a lab that is as the right file says: is it refused, or shown? The arm reports its tool by
the wrong TCP and carries a payload of another weight than it was told; camera, skin and object are where they really
are. As in `i2t collect` the file is read, checked for plausibility (`i2t.hardware.rig_checks`), compared with
the camera's lens, and then the first looks and the first slow touches are made.

Sites are drawn on the surface by trimesh, with normals that point up, sideways and a little down. After each press a
ray caster that is not ours (Embree, by trimesh) casts rays over the skin's square along its approach: a press that is
said to have met something must have, and one without contact must not have gone through anything. All simulated.
"""

from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import numpy as np
import trimesh

from i2t.collect.first_touch import RigContradictedError, check_rig_by_touch
from i2t.collect.procedure import Procedure
from i2t.collect.site_plan import SiteSampler, extract_patch
from i2t.collect.touch import TOOL, Site, SkinOnTool, UnreachableError
from i2t.emulators.in_process import SimulatedArm, SimulatedCamera, SimulatedLab, SimulatedSkin, VirtualClock
from i2t.emulators.scene import ObjectScene
from i2t.errors import DeviceError
from i2t.geometry import contact_frame, inverse, nearest_rigid
from i2t.hardware.poses import pose_from_vector
from i2t.hardware.protocols import ArmState, View
from i2t.hardware.rig import Rig
from i2t.hardware.rig_checks import compare_lens, require_plausible
from i2t.objects.solids import Object
from i2t.patches.dimensions import PAD_WINDOW
from i2t.simulation.site_limits import SiteLimits
from i2t.simulation.touches import SimulationErrors
from i2t.skin.pad import sample_pad
from i2t.types import Array, ReturnCode
from tests.faults.closed_form import WALL_TIME_S, MemoryLog
from tests.faults.rig_mistakes import WRONG_RIGS, RigMistake, right_rig
from tests.faults.rig_objects import RIG_OBJECTS, SHINY, STRETCHED, rig_object
from tests.faults.table import Fault, Measure, Trial

GRAVITY_M_S2 = 9.81
RIGHT_RIGS, REFUSED_SHARE = 100, 0.01
WRONG_SHARE = 3 / 50  # of wrong rigs, that may pass
OBJECT_SPREAD_M, PAYLOAD_SPREAD_KG = 20e-3, 0.05  # of right rigs, either way: of the object's place, of the payload
LOW_OBJECT_M, LOW_BOX_M = 15e-3, -30e-3  # an object's height, and where its box ends in the base
STIFFNESS_N_M = 2e3  # that rigs state: understated, so that motions in the air are quick and trials short
HOLE_SHARE, HOLE_PIXELS = 0.3, 12  # of a shiny object's view, and the edge of a hole
PRESSED_OBJECTS = ("hexagon", "star", "square", "cylinder", "parallelogram", "flower", "screwdriver", "hammer")
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
        lab: Lab in which its tool moves.
        right: True rig.
        wrong: Rig that the arm is configured with.
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


class ShinyCamera(SimulatedCamera):
    """A camera to which a shiny object's depth is full of holes."""

    def capture(self, timeout: float = 2.0) -> View:
        """A view with holes."""
        view = super().capture(timeout)
        holes = self._random.random(np.array(view.depth.shape) // HOLE_PIXELS + 1) < HOLE_SHARE
        holes = np.kron(holes, np.ones((HOLE_PIXELS, HOLE_PIXELS), bool))[tuple(map(slice, view.depth.shape))]
        return view._replace(depth=np.where(holes, np.nan, view.depth))


def object_lab(name: str, rig: Rig, seed: int, believed: Rig | None = None) -> tuple[Procedure, ObjectScene]:
    """A procedure over an object whose devices are connected.

    Args:
        name: Name of the object.
        rig: True rig of the lab.
        seed: Seed of the lab's errors.
        believed: Rig that the procedure assumes; by default, the true one.

    Returns:
        The procedure and what its tool meets.
    """
    clock, mesh, wrong = VirtualClock(WALL_TIME_S), rig_object(name), believed or rig
    scene = ObjectScene(mesh, rig.T_base_world @ rig.T_world_object, _pad(), SimulationErrors(), seed=seed)
    lab = SimulatedLab(scene, clock, seed=seed)
    arm, skin = MistakenArm(lab, rig, wrong), SimulatedSkin(lab)
    camera_type = ShinyCamera if name == SHINY else SimulatedCamera
    camera = camera_type(scene, rig.camera, rig.T_tool_camera, lambda: arm.tool, clock, seed=seed)
    for device in (arm, skin, camera):
        device.connect()
    top = float(np.max(mesh.vertices @ wrong.T_world_object[2, :3]) + wrong.T_world_object[2, 3])
    skins = [SkinOnTool(TOOL, skin, skin.board)]
    return Procedure(arm, skins, camera, wrong, extract_patch, top, clock=clock), scene


# Mistakes


def try_mistake(mistake: RigMistake, name: str, seed: int = 0) -> Found:
    """Try a mistake.

    Args:
        mistake: Mistake from the list.
        name: Name of the object.
        seed: Seed of the lab's errors.

    Returns:
        Where it was noticed.
    """
    try:
        wrong = mistake.make(_lab_rig(name))
    except ValueError as error:
        return Found("file", str(error))
    return try_rig(wrong, name, seed)


def try_rig(wrong: Rig, name: str, seed: int = 0, right: Rig | None = None) -> Found:
    """Try a rig in a lab.

    Args:
        wrong: The rig that is believed.
        name: Name of the object.
        seed: Seed of the lab's errors.
        right: True rig of the lab; by default, that of `right_rig`.

    Returns:
        Where it was contradicted.
    """
    right, mesh, said = right or _lab_rig(name), rig_object(name), list[str]()
    try:
        require_plausible(wrong, mesh.vertices)
    except ValueError as error:
        return Found("plausibility", str(error))
    if different := compare_lens(wrong.camera, right.camera):
        return Found("lens", different)
    try:
        sampler = SiteSampler(Object(name, mesh, "file"), wrong.T_world_object, SiteLimits(), seed, name)
        check_rig_by_touch(object_lab(name, right, seed, wrong)[0], sampler, said.append)
    except RigContradictedError as error:
        return Found("first touch", str(error))
    except (DeviceError, ValueError) as error:
        return Found("arm", str(error))
    return Found("accepted", "; ".join(said))


def right_rig_refused(number: int) -> Trial:
    """A right rig, whose object stands elsewhere than in others and whose payload is as a careful user knows it."""
    rng, name = np.random.default_rng((number, 6)), RIG_OBJECTS[number % len(RIG_OBJECTS)]
    right = _lab_rig(name)
    x, y = right.T_world_object[:2, 3] + rng.uniform(-OBJECT_SPREAD_M, OBJECT_SPREAD_M, 2)
    T_world_object = pose_from_vector([x, y, 0.0, 0.0, 0.0, rng.uniform(-np.pi, np.pi)])
    right = replace(right, T_world_object=T_world_object)
    believed = replace(right, mass=right.mass + rng.uniform(-PAYLOAD_SPREAD_KG, PAYLOAD_SPREAD_KG))
    found = try_rig(believed, name, number, right)
    refused = found.where != "accepted"
    said = f"{name}: {found.sentence}" if refused else found.where
    return {"refused": refused, "rigs": 1, "said": said, "object": name, "found": found.sentence}


def wrong_rig_accepted(number: int) -> Trial:
    """A wrong rig of a list over many objects."""
    mistake, name = WRONG_RIGS[number]
    found = try_mistake(mistake, name, number)
    accepted = found.where == "accepted"
    said = f"accepted: {mistake.name}, {name}" if accepted else found.where
    return {
        "accepted": accepted,
        "rigs": 1,
        "said": said,
        "mistake": mistake.name,
        "object": name,
        "found": found.sentence,
    }


def _lab_rig(name: str) -> Rig:
    """A right rig with quick motions in the air; under a low object its box ends below the table, where presses that
    meet nothing end.
    """
    rig, low = right_rig(), float(rig_object(name).vertices[:, 2].max()) < LOW_OBJECT_M
    x, y, z = rig.limits.lower
    limits = replace(rig.limits, lower=(x, y, LOW_BOX_M if low else z), stiffness=STIFFNESS_N_M)
    return replace(rig, limits=limits)


# Sites


def press_judged(number: int) -> Trial | None:
    """A press at a random site, and the ray caster's word on it; None where no site could be reached."""
    names = (*PRESSED_OBJECTS, *STRETCHED)
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
def _witness(name: str) -> trimesh.Trimesh:
    mesh = rig_object(name)
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


@lru_cache
def _pad() -> Any:
    return jax.jit(sample_pad)(jax.random.key(1000))


RIG_FAULTS = (
    Fault("rig", "wrong rigs over many objects", wrong_rig_accepted, len(WRONG_RIGS),
          (Measure("accepted", WRONG_SHARE, of="rigs"),)),
    Fault("rig", "right rigs over many objects", right_rig_refused, RIGHT_RIGS,
          (Measure("refused", REFUSED_SHARE, of="rigs"),)),
    Fault("sites", "press at a random site, judged by a ray caster", press_judged, 500, (Measure("wrong", 0),)),
)  # fmt: skip
