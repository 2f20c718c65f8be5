"""Plug-ins of i2t's own drivers (`i2t.hardware.plugins`); each is imported only where it is asked for."""

from typing import TYPE_CHECKING

from i2t.hardware.plugins import DevicePlugin, DeviceSetup
from i2t.skin.boards import DEFAULT_BOARD, make_board

if TYPE_CHECKING:
    from i2t.hardware.realsense import RealSense
    from i2t.hardware.reskin.driver import ReSkin
    from i2t.hardware.ur.driver import UrArm


def make_ur(setup: DeviceSetup) -> "UrArm":
    """A UR arm, not connected.

    Args:
        setup: Its address, tool, payload, limits and watch.

    Returns:
        The arm.

    Raises:
        ValueError: The address is missing, or a time of the watch protects nobody.
        DeviceError: Its client library is not installed.
    """
    from i2t.hardware.ur.driver import UrArm

    if not setup.address:
        raise ValueError("a UR arm needs the address of its controller; pass --host")
    rig = setup.rig
    return UrArm(setup.address, rig.limits, rig.T_flange_tool, (rig.mass, rig.centre), **setup.watch)


def make_reskin(setup: DeviceSetup) -> "ReSkin":
    """A ReSkin, AnySkin or eFlesh board, not connected.

    Args:
        setup: Its port or its board's serial number, and the name of its board.

    Returns:
        The skin.

    Raises:
        DeviceError: pyserial is missing.
    """
    from i2t.hardware.reskin.driver import ReSkin

    board, serial_number = make_board(setup.board or DEFAULT_BOARD), setup.skin.serial_number if setup.skin else None
    skin = ReSkin(setup.address, chips=board.num_chips, serial_number=serial_number or None)
    skin.board = board
    return skin


def make_realsense(setup: DeviceSetup) -> "RealSense":
    """A RealSense, not connected.

    Args:
        setup: Its serial number, and the size of its images, by default as the rig has them.

    Returns:
        The camera.

    Raises:
        DeviceError: Its client library is not installed.
    """
    from i2t.hardware.realsense import RealSense

    lens = setup.rig.camera
    distance = setup.rig.looking_distance if setup.size is None else None
    return RealSense(setup.address, setup.size or (lens.width, lens.height), distance=distance)


WATCH = frozenset({"address", "state_timeout", "watchdog_rate"})
BOARD = frozenset({"address", "skin_serial", "board"})
ur = DevicePlugin(make_ur, takes=WATCH, needs_address=True, needs_rig=True)
reskin = DevicePlugin(make_reskin, takes=BOARD)
realsense = DevicePlugin(make_realsense, takes=frozenset({"address", "size"}))
