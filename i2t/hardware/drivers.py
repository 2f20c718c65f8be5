"""Plug-ins of i2t's own drivers (`i2t.hardware.plugins`); a driver is imported only when it is built."""

from typing import TYPE_CHECKING

from i2t.hardware.plugins import DevicePlugin, DeviceSetup
from i2t.skin.boards import DEFAULT_BOARD, make_board

if TYPE_CHECKING:
    from i2t.hardware.realsense import RealSense
    from i2t.hardware.reskin.driver import ReSkin
    from i2t.hardware.ur.driver import UrArm


def make_ur(setup: DeviceSetup) -> "UrArm":
    """Build the driver of a UR arm, without connecting it.

    Args:
        setup: Setup with the address, the rig (tool, payload, limits), state timeout and heartbeat rate.

    Returns:
        The arm, not connected.

    Raises:
        ValueError: The address is missing, or the timeout or rate is out of range.
        DeviceError: The client library is not installed.
    """
    from i2t.hardware.ur.driver import UrArm

    if not setup.address:
        raise ValueError("a UR arm needs the address of its controller; pass --host")
    rig = setup.rig
    return UrArm(setup.address, rig.limits, rig.T_flange_tool, (rig.mass, rig.centre), **setup.watch)


def make_reskin(setup: DeviceSetup) -> "ReSkin":
    """Build the driver of a ReSkin, AnySkin or eFlesh board, without connecting it.

    Args:
        setup: Setup with the port or the serial number of the board, and the name of the board.

    Returns:
        The skin, not connected.

    Raises:
        DeviceError: pyserial is not installed.
    """
    from i2t.hardware.reskin.driver import ReSkin

    board, serial_number = make_board(setup.board or DEFAULT_BOARD), setup.skin.serial_number if setup.skin else None
    skin = ReSkin(setup.address, chips=board.num_chips, serial_number=serial_number or None)
    skin.board = board
    return skin


def make_realsense(setup: DeviceSetup) -> "RealSense":
    """Build the driver of a RealSense depth camera, without connecting it.

    Args:
        setup: Setup with the serial number and the size of the images. Without a size, that of the rig is taken, and
            `connect` refuses a camera that cannot measure at the rig's looking distance.

    Returns:
        The camera, not connected.

    Raises:
        DeviceError: The client library is not installed.
    """
    from i2t.hardware.realsense import RealSense

    lens = setup.rig.camera
    distance = setup.rig.looking_distance if setup.size is None else None
    return RealSense(setup.address, setup.size or (lens.width, lens.height), distance=distance)


ur = DevicePlugin(
    make_ur, takes=frozenset({"address", "state_timeout", "watchdog_rate"}), needs_address=True, needs_rig=True
)
reskin = DevicePlugin(make_reskin, takes=frozenset({"address", "skin_serial", "board"}))
realsense = DevicePlugin(make_realsense, takes=frozenset({"address", "size"}))
