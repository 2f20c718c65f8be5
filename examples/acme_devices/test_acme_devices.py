"""Acme's devices pass the tests of all devices; one line for each."""

import numpy as np
from acme_devices import AcmeArm, AcmeSkin

from i2t.hardware.contract import ArmContract, SkinContract
from i2t.hardware.plugins import DeviceSetup
from i2t.hardware.poses import pose_from_vector
from i2t.hardware.rig import Rig


class TestAcmeArm(ArmContract):
    """Its tool stands 300 mm above the table; nothing is touched."""

    limits, home = Rig().limits, pose_from_vector([0.4, 0.0, 0.3, np.pi, 0.0, 0.0])
    make_device = staticmethod(lambda: AcmeArm(DeviceSetup(Rig())))


class TestAcmeSkin(SkinContract):
    """Four chips at 400 Hz."""

    make_device = staticmethod(lambda: AcmeSkin(DeviceSetup(Rig())))
