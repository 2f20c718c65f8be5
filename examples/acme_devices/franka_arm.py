"""A Franka arm of seven joints for `python -m i2t.collect --arm franka_arm:FrankaArm`, with its own planning.

The arm is not there: it moves the tool in Acme's simulated lab, and its joints are those that the maker's table of
links gives for it. A real one is built the same way: `state` and `move` call the controller's library in place of the
lab (libfranka through `panda-py` or `franky`), `stop` brakes through it, and `why_unreachable` stays as it is.
"""

from collections.abc import Sequence

import numpy as np
from acme_devices import connection

from i2t.emulators.in_process import SimulatedArm
from i2t.errors import DeviceError
from i2t.geometry import inverse
from i2t.hardware.kinematics import JointPath, arms, plan, solve
from i2t.hardware.plugins import DeviceSetup
from i2t.hardware.protocols import ArmFeatures, ArmState
from i2t.types import Array

PANDA = arms()["panda"]
READY = np.array([0.0, -np.pi / 4, 0.0, -3 * np.pi / 4, 0.0, np.pi / 2, np.pi / 4])  # rad, as its maker calls it


class FrankaArm(SimulatedArm):
    """A Franka arm (`GuardedArm` and `PlanningArm` of `i2t.hardware.protocols`), within the rig's limits."""

    def __init__(self, setup: DeviceSetup) -> None:
        self._T_tool_flange = inverse(setup.rig.T_flange_tool)
        super().__init__(connection(setup.rig), setup.rig.limits)
        self._joints = READY

    @property
    def features(self) -> ArmFeatures:
        """Features known before `connect`; a real arm says that its source is real."""
        return super().features._replace(name="the Franka arm")

    def state(self, timeout: float = 0.1) -> ArmState:
        """The present state, with seven joints that go on from where they were."""
        state = super().state(timeout)
        T_b_f = state.T_b_t @ self._T_tool_flange
        found = solve(PANDA, T_b_f, near=self._joints)
        if not len(found):
            found = solve(PANDA, T_b_f)
        if not len(found):
            raise DeviceError(f"{self.features.name} cannot stand where its tool is; check T_flange_tool of the rig")
        self._joints = found[0]
        return state._replace(joints=self._joints.copy())

    def why_unreachable(self, goals: Sequence[Array]) -> str:
        """Reason against straight lines of its tool; empty where they work."""
        way = plan(PANDA, [goal @ self._T_tool_flange for goal in goals])
        return "" if isinstance(way, JointPath) else way
