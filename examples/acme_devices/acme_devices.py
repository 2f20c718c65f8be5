"""An arm, a skin and a depth camera of a third party, for `python -m i2t.collect --arm acme --skin acme --camera acme`.

Acme's controller is played by i2t's simulated lab; a real package would talk to its own library in these places.
"""

from functools import lru_cache

import jax

from i2t.depth.camera import Camera
from i2t.emulators.in_process import SimulatedArm, SimulatedCamera, SimulatedLab, SimulatedSkin
from i2t.emulators.scene import ObjectScene
from i2t.hardware.clock import MonotonicClock
from i2t.hardware.plugins import DeviceSetup
from i2t.hardware.protocols import ArmFeatures, CameraFeatures, SkinFeatures
from i2t.hardware.rig import Rig
from i2t.objects.catalogue import make_object
from i2t.simulation.touches import SimulationErrors
from i2t.skin.boards import grid_board
from i2t.skin.pad import nominal_pad

BOARD = grid_board(2, 2)  # Acme's skin has four chips and so twelve values


@lru_cache(1)
def connection(rig: Rig) -> SimulatedLab:
    """Acme's controller, which arm and skin share: a hexagon stands on its table where the rig says."""
    T_b_o = rig.T_base_world @ rig.T_world_object
    pad = jax.jit(lambda: nominal_pad(board=BOARD))()
    scene = ObjectScene(make_object("hexagon").mesh, T_b_o, pad, SimulationErrors())
    return SimulatedLab(scene, MonotonicClock())


class AcmeArm(SimulatedArm):
    """Acme's arm (`i2t.hardware.protocols.GuardedArm`), within the rig's limits."""

    def __init__(self, setup: DeviceSetup) -> None:
        super().__init__(connection(setup.rig), setup.rig.limits)

    @property
    def features(self) -> ArmFeatures:
        """Known before `connect`; a real arm says that its source is real."""
        return super().features._replace(name="Acme's arm")


class AcmeSkin(SimulatedSkin):
    """Acme's skin (`i2t.hardware.protocols.Skin`); `board` says where its four chips are."""

    def __init__(self, setup: DeviceSetup) -> None:
        super().__init__(connection(setup.rig))
        self.board = BOARD

    @property
    def features(self) -> SkinFeatures:
        """Known before `connect`."""
        return super().features._replace(name="Acme's skin")


class AcmeCamera(SimulatedCamera):
    """Acme's camera (`i2t.hardware.protocols.DepthCamera`), which the arm carries."""

    def __init__(self, setup: DeviceSetup) -> None:
        lab, arm, lens = connection(setup.rig), setup.arm or AcmeArm(setup), setup.rig.camera
        pinhole = Camera(lens.width, lens.height, lens.fx, lens.fy, lens.cx, lens.cy)
        super().__init__(lab.scene, pinhole, setup.rig.T_tool_camera, lambda: arm.state().T_b_t, lab.clock)

    @property
    def features(self) -> CameraFeatures:
        """Known before `connect`."""
        return super().features._replace(name="Acme's camera")
