"""Mistakes in a calibration file, each tried against a lab that is as the right file says: is it refused, or shown?

Everything is simulated. The arm reports its tool by the wrong TCP and carries a payload of another weight than it was
told; camera, skin and object are where they really are. As in `python -m i2t.collect` the file is read, checked for
plausibility (`i2t.hardware.rig_checks`), compared with the camera's lens, and then the first looks and the first slow
touch are made.
"""

from collections import Counter
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import numpy as np

from experiments.faults.rig_mistakes import MISTAKES, RigMistake, right_rig
from experiments.faults.rows import FaultCounts, FaultRow
from experiments.faults.trials import Trial, TrialStore
from i2t.collect.first_touch import RigContradictedError, first_touch
from i2t.collect.procedure import Procedure
from i2t.collect.site_plan import SiteSampler, patch_extractor
from i2t.emulators.in_process import SimulatedArm, SimulatedCamera, SimulatedLab, SimulatedSkin, VirtualClock
from i2t.emulators.scene import ObjectScene
from i2t.errors import DeviceError
from i2t.geometry import inverse
from i2t.hardware.poses import pose_to_vector
from i2t.hardware.protocols import ArmState
from i2t.hardware.rig import Rig
from i2t.hardware.rig_checks import other_lens, require_plausible
from i2t.objects.catalogue import make_object
from i2t.objects.solids import Mesh
from i2t.simulation.site_limits import SiteLimits
from i2t.simulation.touches import SimulationErrors
from i2t.skin.pad import sample_pad
from i2t.types import Array

RIG_OBJECTS = ("star", "hammer")  # a prism, and a tool that is another one upside down
GOAL_SHARE = 48 / 53
GRAVITY_M_S2 = 9.81
WALL_TIME_S = 1.8e9  # Unix time at which simulated time begins
RIGHT_SEEDS = 10  # labs of each object in which the right rig is tried


class Found(NamedTuple):
    """Result of trying a rig."""

    where: str  # file, plausibility, lens, first touch, or accepted
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
        return super().state().T_b_t

    def state(self, timeout: float = 0.1) -> ArmState:
        """The present state by the wrong TCP."""
        real = super().state(timeout)
        reported = real.T_b_t @ self._to_reported
        wrench = real.wrench.reshape(2, 3) @ real.T_b_t[:3, :3].T @ reported[:3, :3]
        return real._replace(T_b_t=reported, wrench=wrench.ravel())

    def move(self, T_b_t: Array, speed: float | None = None, acceleration: float | None = None) -> Array:
        """Start a straight motion of what it takes for its tool."""
        self._check()
        speed, acceleration = self.limits.checked(T_b_t, speed, acceleration)
        if self.lab.robot.motion is not None:
            self.stop()
        with self.lab.lock:
            robot = self.lab.robot
            self.lab.contact_model.stands(robot.position, robot.rotation)
            robot.line_to(np.array(pose_to_vector(T_b_t @ inverse(self._to_reported))), speed, acceleration)
        return T_b_t


def rig(sizes: FaultCounts, trials: TrialStore) -> list[FaultRow]:
    """All mistakes with each object, and the right rig in labs of many seeds."""
    mistakes = MISTAKES[: sizes.mistakes]
    seeds = max(1, round(RIGHT_SEEDS * len(mistakes) / len(MISTAKES)))
    tries: list[tuple[str, RigMistake | None, int]] = [
        (name, mistake, 0) for name in RIG_OBJECTS for mistake in mistakes
    ]
    tries += [(name, None, seed) for name in RIG_OBJECTS for seed in range(seeds)]

    def trial(number: int) -> Trial:
        name, mistake, seed = tries[number]
        found = try_rig(right_rig(), name, seed) if mistake is None else try_mistake(mistake, name, seed)
        return {"object": name, "mistake": mistake and mistake.name, "seed": seed, **found._asdict()}

    made = trials.run(len(tries), trial)
    wrong = [[each for each in made if each["mistake"] and each["object"] == name] for name in RIG_OBJECTS]
    right = [each for each in made if not each["mistake"]]
    refused = [f"{each['object']} {each['seed']}: {each['sentence']}" for each in right if each["where"] != "accepted"]
    said = f"{len(refused)}" + (f" ({min(refused)})" if refused else "")
    return [
        *(_mistakes_row(each) for each in wrong),
        FaultRow("rig", "right rigs refused", f"{len(right)} labs", said, "0", not refused),
    ]


def _mistakes_row(made: list[Trial]) -> FaultRow:
    """Count the mistakes caught with one object, by place."""
    accepted = [each["mistake"] for each in made if each["where"] == "accepted"]
    counts = Counter(each["where"] for each in made)
    caught = len(made) - len(accepted)
    said = ", ".join(f"{count} {where}" for where, count in counts.most_common())
    return FaultRow(
        "rig",
        f"mistakes refused or shown, {made[0]['object']}",
        f"{len(made)} mistakes",
        f"{caught} ({said})" + (f"; accepted: {'; '.join(accepted)}" if accepted else ""),
        f"{100 * GOAL_SHARE:.0f} %",
        caught >= GOAL_SHARE * len(made),
    )


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
        first_touch(_procedure(right, wrong, mesh, sampler, seed=seed), sampler, report=lambda line: None)
    except RigContradictedError as error:
        return Found("first touch", str(error))
    except (DeviceError, ValueError) as error:
        return Found("arm", str(error))
    return Found("accepted", "")


def _procedure(right: Rig, wrong: Rig, mesh: Mesh, sampler: SiteSampler, *, seed: int) -> Procedure:
    """A procedure that believes the wrong rig, in a lab that is as the right one says; its devices are connected."""
    clock = VirtualClock(WALL_TIME_S)
    T_b_o = right.T_base_world @ right.T_world_object
    scene = ObjectScene(mesh, T_b_o, _pad(), SimulationErrors(), seed=seed)
    lab = SimulatedLab(scene, clock, seed=seed)
    arm, skin = MistakenArm(lab, right, wrong), SimulatedSkin(lab)
    eye: Any = SimulatedCamera(scene, right.camera, right.T_tool_camera, lambda: arm.tool, clock, seed=seed)
    for device in (arm, skin, eye):
        device.connect()
    return Procedure(arm, skin, eye, wrong, skin.board, patch_extractor(), sampler.top, clock=clock)


@lru_cache
def _mesh(name: str) -> Mesh:
    return make_object(name).mesh


@lru_cache
def _pad() -> Any:
    return jax.jit(sample_pad)(jax.random.key(1000))
