"""Arm and camera by the names of the command line, for the commands that measure a lab: a UR arm and a RealSense, or
another package's (`i2t.hardware.plugins`). Their drivers are imported only where they are asked for.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from i2t.errors import DeviceError
from i2t.hardware.plugins import DeviceKind, DeviceSetup, is_plugin, load_plugin
from i2t.hardware.protocols import Arm, ColourImage, GuardedArm
from i2t.hardware.rig import Rig
from i2t.types import Array

UR, REALSENSE = "ur", "realsense"


def named_arm(name: str, host: str | None, rig: Rig, **watch: Any) -> GuardedArm:
    """An arm by its name.

    Args:
        name: ur, a name that a package registers, or package.module:Class.
        host: Its address; a UR arm needs one.
        rig: Its limits, its tool and payload.
        **watch: `state_timeout` and `watchdog_rate` of a UR arm.

    Returns:
        The arm, not connected.

    Raises:
        ValueError: There is no such arm, it cannot be used, or the address or an option does not belong to it.
        DeviceError: Its client library is not installed.
    """
    require_named("arm", name, UR)
    if name == UR:
        from i2t.hardware.ur.driver import UrArm

        return UrArm(_require_host(host), rig.limits, rig.T_flange_tool, (rig.mass, rig.centre), **watch)
    if watch:
        flags = " and ".join(f"--{each.replace('_', '-')}" for each in watch)
        raise ValueError(f"{flags}: of a UR arm, and --arm is {name}; leave it out")
    arm: GuardedArm = load_plugin("arm", name, DeviceSetup(rig, host))
    return arm


def named_camera(
    name: str, address: str | None, rig: Rig, arm: Arm | None = None, *, size: tuple[int, int] | None = None
) -> Any:
    """A depth camera (`i2t.hardware.protocols.DepthCamera`) by its name.

    Args:
        name: realsense, a name that a package registers, or package.module:Class.
        address: Serial number of a RealSense, or what another package's camera takes.
        rig: Its lens, and from where it looks.
        arm: That carries it, for another package's.
        size: Width and height in pixels of a RealSense's images; by default as the rig has them.

    Returns:
        The camera, not connected.

    Raises:
        ValueError: There is no such camera, or it cannot be used.
        DeviceError: Its client library is not installed.
    """
    require_named("camera", name, REALSENSE)
    if name != REALSENSE:
        return load_plugin("camera", name, DeviceSetup(rig, address, arm))
    from i2t.hardware.realsense import RealSense

    own_size, distance = (rig.camera.width, rig.camera.height), rig.looking_distance if size is None else None
    return RealSense(address, size or own_size, distance=distance)


def require_named(kind: DeviceKind, name: str, built_in: str, option: str | None = None) -> None:
    """Refuse the name of a device that is not there.

    Args:
        kind: Arm, skin or camera.
        name: As on the command line.
        built_in: Names that need no other package, for the message.
        option: What names it; by default the flag of its kind.

    Raises:
        ValueError: Neither i2t nor an installed package knows it.
    """
    if name not in built_in.split(", ") and not is_plugin(kind, name):
        raise ValueError(
            f"{option or f'--{kind}'} {name} is not known; give one of {built_in}, a name that an installed package "
            "registers, or package.module:Class"
        )


class ToolPose:
    """Pose of an arm's tool, while a person moves it.

    A UR arm is listened to and not controlled. Another package's arm is connected for each pose and then let go.

    Args:
        name: Of the arm, as in `named_arm`.
        host: Its address; a UR arm needs one.
        rig: Its tool; another package's arm needs one.

    Raises:
        ValueError: There is no such arm, it cannot be used, or the address or the rig is missing.
    """

    def __init__(self, name: str, host: str | None, rig: Rig | None) -> None:
        require_named("arm", name, UR)
        if name != UR and rig is None:
            raise ValueError(f"--arm {name} needs the lab's calibration, which has the tool's frame; pass --rig FILE")
        self._host = _require_host(host) if name == UR else ""
        self.arm = None if rig is None or name == UR else named_arm(name, host, rig)  # another package's

    @contextmanager
    def now(self) -> Iterator[Array]:
        """T_b_t (4, 4), m; another package's arm stays connected inside.

        Yields:
            The pose.

        Raises:
            DeviceError: The arm does not answer.
        """
        if self.arm is None:
            from i2t.hardware.ur.access import tool_pose

            yield tool_pose(self._host)
            return
        with self.arm:
            yield self.arm.state().T_b_t


def colour_view(camera: Any) -> ColourImage:
    """A colour image of a camera.

    Args:
        camera: Connected. One whose colour images have a lens of their own has a method `colour`, as `RealSense` has;
            of others the colours of a depth view are taken, which are aligned with depth.

    Returns:
        The image and its lens.

    Raises:
        DeviceError: It gives no colours, or no image.
    """
    if hasattr(camera, "colour"):
        own: ColourImage = camera.colour()
        return own
    view = camera.capture()
    if view.colour is None:
        raise DeviceError(f"{camera.features.name} gives no colours, in which the board could be found")
    return ColourImage(view.time, np.asarray(view.colour), camera.camera, np.eye(4))


def _require_host(host: str | None) -> str:
    if not host:
        raise ValueError("a UR arm needs the address of its controller; pass --host")
    return host
