"""Arms of i2t meet the contract of all arms: the real driver with an emulated controller, and the simulated one."""

import sys
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from helpers.spring_plane import SpringPlane

from i2t.emulators import ur_controller
from i2t.emulators.in_process import SimulatedArm, SimulatedLab
from i2t.hardware.clock import MonotonicClock
from i2t.hardware.contract import ArmContract
from i2t.hardware.motion_limits import MotionLimits
from i2t.hardware.poses import pose_from_vector
from i2t.hardware.protocols import GuardedArm
from i2t.hardware.ur.driver import UrArm
from i2t.simulation.touches import SimulationErrors
from i2t.skin import boards

LIMITS = MotionLimits((0.2, -0.3, 0.1), (0.6, 0.3, 0.5))
FLOOR, STIFFNESS = 0.25, 5000.0  # m, N/m: a plane below the tool


class OurArms(ArmContract):
    limits, floor, stiffness = LIMITS, FLOOR, STIFFNESS
    pose_tolerance, force_tolerance, speed_tolerance = 1e-6, 1e-3, 1e-6
    home = pose_from_vector([0.4, 0.0, 0.3, np.pi, 0.0, 0.0])


class TestSimulatedArm(OurArms):
    @staticmethod
    def make_device() -> GuardedArm:
        board = boards.reskin_board()
        plane = SpringPlane(FLOOR, STIFFNESS, np.zeros(board.num_readings), SimulationErrors.error_free(), board)
        return SimulatedArm(SimulatedLab(plane, MonotonicClock()), LIMITS)


@pytest.mark.skipif(sys.platform != "linux", reason="needs the addresses 127.x.y.z, which only Linux gives")
class TestEmulatedArm(OurArms):
    @pytest.fixture
    def make(self) -> Iterator[Callable[[], GuardedArm]]:
        """Make a new controller for each test."""
        pytest.importorskip("rtde_control", reason="ur_rtde is not installed (wheels are for Python 3.10 to 3.12)")
        host = ur_controller.loopback(219)
        with ur_controller.process(host, "--plane", str(FLOOR), str(STIFFNESS)):
            yield lambda: UrArm(host, LIMITS, state_timeout=3.0, watchdog_rate=0.3)
