"""Contract tests of Acme's devices, one class for each."""

import numpy as np
from acme_devices import AcmeArm, AcmeCamera, AcmeSkin

from i2t.hardware.contract import ArmContract, CameraContract, SkinContract
from i2t.hardware.plugins import DeviceSetup
from i2t.hardware.poses import pose_from_vector
from i2t.hardware.rig import Rig


class TestAcmeArm(ArmContract):
    """Acme's arm, with its tool 300 mm above the table and out of contact."""

    limits, home = Rig().limits, pose_from_vector([0.4, 0.0, 0.3, np.pi, 0.0, 0.0])
    make_device = staticmethod(lambda: AcmeArm(DeviceSetup(Rig())))


class TestAcmeSkin(SkinContract):
    """Four chips at 400 Hz."""

    make_device = staticmethod(lambda: AcmeSkin(DeviceSetup(Rig())))


class TestAcmeCamera(CameraContract):
    """Acme's camera on an arm at rest, 364 mm above the table with the hexagon."""

    depth_range, min_measured_share = (0.32, 0.38), 0.5  # the edge of the table is in view

    @staticmethod
    def make_device() -> AcmeCamera:
        """Create a camera on a connected arm."""
        rig = Rig()
        arm = AcmeArm(DeviceSetup(rig))
        arm.connect()
        return AcmeCamera(DeviceSetup(rig, arm=arm))
