"""Devices by their names: a UR arm and a RealSense, or a third party's by a name that its package registers or by
`package.module:Class`. Drivers are imported only where they are asked for.

A package registers a class under a name in its `pyproject.toml`,

    [project.entry-points."i2t.arms"]
    acme = "acme_devices:AcmeArm"

(likewise `i2t.skins`, `i2t.cameras`), after which `python -m i2t.collect --arm acme` finds it. The class is called with
one `DeviceSetup` and must meet the protocol of its kind (`i2t.hardware.protocols`): an arm the one of `GuardedArm`. A
skin has an attribute `board`, which says where its chips are (a further skin of a rig may leave that to
`skins.NAME.board`). `examples/acme_devices` is a complete package, and `i2t.hardware.contract` holds the tests that
every device must pass.
"""

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Literal, TypeAlias

import numpy as np

from i2t.errors import DeviceError
from i2t.hardware.protocols import Arm, ColourImage, DepthCamera, GuardedArm, Skin
from i2t.hardware.rig import Rig
from i2t.types import Array

DeviceKind: TypeAlias = Literal["arm", "skin", "camera"]

UR, REALSENSE = "ur", "realsense"
GROUPS: dict[DeviceKind, str] = {"arm": "i2t.arms", "skin": "i2t.skins", "camera": "i2t.cameras"}
PROTOCOLS: dict[DeviceKind, type] = {"arm": GuardedArm, "skin": Skin, "camera": DepthCamera}


@dataclass(frozen=True, eq=False)
class DeviceSetup:
    """Setup with which a third party's device is built."""

    rig: Rig  # the lab's calibration: frames, payload, limits
    address: str | None = None  # --host for an arm, --port for a skin, --camera-serial for a camera
    arm: Arm | None = None  # that carries the camera


def require_named(kind: DeviceKind, name: str, built_in: str = "", option: str | None = None) -> None:
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
        known = ", ".join(sorted(each.name for each in entry_points(group=GROUPS[kind]))) or "none"
        ours = f"one of {built_in}, " if built_in else ""
        raise ValueError(
            f"{option or f'--{kind}'} {name} is not known; give {ours}a name that an installed package registers "
            f"({known}), or package.module:Class"
        )


def is_plugin(kind: DeviceKind, name: str) -> bool:
    """Test whether a name means a third party's device.

    Args:
        kind: Arm, skin or camera.
        name: As on the command line.

    Returns:
        True for the full name of a class, and for a name that a package registers.
    """
    return ":" in name or bool(_registered(kind, name))


def load_plugin(kind: DeviceKind, name: str, setup: DeviceSetup) -> Any:
    """Build a third party's device, without connecting it.

    Args:
        kind: Arm, skin or camera.
        name: That a package registers, or package.module:Class.
        setup: What it is built with.

    Returns:
        The device.

    Raises:
        ValueError: It cannot be imported or built, or lacks what its protocol asks for; one sentence says what.
    """
    require_named(kind, name)
    given = f"--{kind} {name}"
    make = _find(kind, name, given)
    try:
        device = make(setup)
    except TypeError as error:
        raise ValueError(f"{given}: cannot be built ({error}); it must take one DeviceSetup") from error
    own, asked = getattr(device, "__dict__", {}), PROTOCOLS[kind]
    missing = [each for each in _members(asked) if each not in own and not hasattr(type(device), each)]
    if missing:
        raise ValueError(f"{given}: lacks {', '.join(missing)} of {asked.__name__} (i2t.hardware.protocols); add that")
    return device


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


def _find(kind: DeviceKind, name: str, given: str) -> Any:
    """The class of a name."""
    found = _registered(kind, name)
    if len(found) > 1:
        owners = ", ".join(each.value for each in found)
        raise ValueError(f"{given}: several packages register it ({owners}); give package.module:Class")
    module, _, attribute = (found[0].value if found else name).partition(":")
    try:
        return getattr(importlib.import_module(module), attribute)
    except AttributeError as error:
        raise ValueError(f"{given}: {module} has no {attribute}; give package.module:Class") from error
    except (ImportError, ValueError) as error:
        raise ValueError(f"{given}: {module} cannot be imported ({error}); install it, or correct it") from error


def _registered(kind: DeviceKind, name: str) -> list[EntryPoint]:
    return list(entry_points(group=GROUPS[kind], name=name))


def _members(protocol: type) -> list[str]:
    """Names of the methods and properties that a protocol asks for."""
    names = {name for base in protocol.__mro__ if getattr(base, "_is_protocol", False) for name in vars(base)}
    return sorted(name for name in names if not name.startswith("_"))


def _require_host(host: str | None) -> str:
    if not host:
        raise ValueError("a UR arm needs the address of its controller; pass --host")
    return host
