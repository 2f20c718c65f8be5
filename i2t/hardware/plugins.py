"""Devices by their names: those of i2t, or a third party's, all by entry points, or by `package.module:Class`.

A package registers a class under a name in its `pyproject.toml`,

    [project.entry-points."i2t.arms"]
    acme = "acme_devices:AcmeArm"

(likewise `i2t.skins`, `i2t.cameras`), after which `python -m i2t.collect --arm acme` finds it. The class is called with
one `DeviceSetup` and must meet the protocol of its kind (`i2t.hardware.protocols`): an arm the one of `GuardedArm`. A
skin has an attribute `board`, which says where its chips are (a further skin of a rig may leave that to
`skins.NAME.board`). In place of the class there may be a `DevicePlugin`, which says what else the device takes; i2t's
own (`i2t.hardware.drivers`, `i2t.emulators.plugins`) are no others. `examples/acme_devices` is a complete package, and
`i2t.hardware.contract` holds the tests that every device must pass.
"""

import importlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Literal, TypeAlias

import numpy as np

from i2t.errors import DeviceError, did_you_mean
from i2t.hardware.carried_skins import CarriedSkin
from i2t.hardware.clock import Clock, MonotonicClock
from i2t.hardware.protocols import Arm, ColourImage, DepthCamera, GuardedArm, Skin
from i2t.hardware.rig import Rig
from i2t.hardware.world import WorldArgs
from i2t.types import Array

DeviceKind: TypeAlias = Literal["arm", "skin", "camera"]

UR, REALSENSE = "ur", "realsense"
GROUPS: dict[DeviceKind, str] = {"arm": "i2t.arms", "skin": "i2t.skins", "camera": "i2t.cameras"}
PROTOCOLS: dict[DeviceKind, type] = {"arm": GuardedArm, "skin": Skin, "camera": DepthCamera}
ADDRESS_FLAGS: dict[DeviceKind, str] = {"arm": "--host", "skin": "--port", "camera": "--camera-serial"}


@dataclass(frozen=True, eq=False)
class DeviceSetup:
    """Setup with which a device is built."""

    rig: Rig  # the lab's calibration: frames, payload, limits
    address: str | None = None  # --host for an arm, --port for a skin, --camera-serial for a camera
    arm: Arm | None = None  # that carries it
    skin: CarriedSkin | None = None  # where a skin is on the tool, and its serial number
    board: str | None = None  # name of the board of the skin, or of the one that the arm carries
    watch: Mapping[str, Any] = field(default_factory=dict)  # state_timeout (s), watchdog_rate (Hz), where given
    size: tuple[int, int] | None = None  # pixels of a camera's images
    world: WorldArgs = field(default_factory=WorldArgs)  # in which it is, unless it is real
    clock: Clock = field(default_factory=MonotonicClock)  # that the devices share
    stack: ExitStack = field(default_factory=ExitStack)  # ends what has to be started for it


@dataclass(frozen=True)
class DevicePlugin:
    """A device that takes more than its address, or needs it."""

    make: Callable[[DeviceSetup], Any]  # builds it, without connecting it; imports what it needs
    takes: frozenset[str] = frozenset({"address"})  # of the options, by their names in a setup or a command line
    needs_address: bool = False
    needs_rig: bool = False  # or the emulators' own lab does
    arms: frozenset[str] = frozenset()  # names of the arms on which a skin feels anything; any if it is real
    with_the_arm_s: bool = False  # whether a skin has an address where its arm has one, and only there
    make_clock: Callable[[float], Clock] = lambda begin: MonotonicClock()  # of a lab of nothing else, from a Unix time


def find_plugin(kind: DeviceKind, name: str, option: str | None = None) -> DevicePlugin:
    """Find a device by its name, without building it.

    Args:
        kind: Arm, skin or camera.
        name: As on the command line.
        option: What names it; by default the flag of its kind.

    Returns:
        The plug-in; a class becomes one.

    Raises:
        ValueError: No installed package registers the name, several do, or what it names cannot be imported.
    """
    given = f"{option or f'--{kind}'} {name}"
    found = _registered(kind, name)
    if not found and ":" not in name:
        names = sorted({entry.name for entry in entry_points(group=GROUPS[kind])})
        listed = ", ".join(names) or "none: install i2t again"
        remedy = f"give a name that an installed package registers ({listed}), or package.module:Class"
        raise ValueError(f"{given} is not known; {did_you_mean(name, names, remedy)}")
    if len(found) > 1:
        owners = ", ".join(each.value for each in found)
        raise ValueError(f"{given}: several packages register it ({owners}); give package.module:Class")
    module, _, attribute = (found[0].value if found else name).partition(":")
    try:
        made = getattr(importlib.import_module(module), attribute)  # noqa: TID251  # of a user's class
    except AttributeError as error:
        raise ValueError(f"{given}: {module} has no {attribute}; give package.module:Class") from error
    except (ImportError, ValueError) as error:
        raise ValueError(f"{given}: {module} cannot be imported ({error}); install it, or correct it") from error
    return made if isinstance(made, DevicePlugin) else DevicePlugin(made)


def check_device(kind: DeviceKind, name: str, options: Mapping[str, Any]) -> None:
    """Refuse options that mean nothing to a device, and the lack of those that it needs.

    Args:
        kind: Arm, skin or camera.
        name: As on the command line.
        options: Their values by their names; None for what is not given.

    Raises:
        ValueError: The device is not known, or the message names the flag.
    """
    plugin = find_plugin(kind, name)
    for option, value in options.items():
        flag = ADDRESS_FLAGS[kind] if option == "address" else f"--{option.replace('_', '-')}"
        if value is not None and option not in plugin.takes:
            raise ValueError(f"{flag} means nothing to --{kind} {name}; leave it out")
        if value is None and option == "address" and plugin.needs_address:
            raise ValueError(f"--{kind} {name} needs an address; pass {flag}")


def load_device(kind: DeviceKind, name: str, setup: DeviceSetup, option: str | None = None) -> Any:
    """Build a device, without connecting it.

    Args:
        kind: Arm, skin or camera.
        name: That a package registers, or package.module:Class.
        setup: What it is built with.
        option: What names it; by default the flag of its kind.

    Returns:
        The device.

    Raises:
        ValueError: It cannot be imported or built, or lacks what its protocol asks for; one sentence says what.
        DeviceError: Its client library is not installed.
    """
    given = f"{option or f'--{kind}'} {name}"
    try:
        device = find_plugin(kind, name, option).make(setup)
    except TypeError as error:
        raise ValueError(f"{given}: cannot be built ({error}); it must take one DeviceSetup") from error
    own, asked = getattr(device, "__dict__", {}), PROTOCOLS[kind]
    missing = [each for each in _members(asked) if each not in own and not hasattr(type(device), each)]
    if missing:
        raise ValueError(f"{given}: lacks {', '.join(missing)} of {asked.__name__} (i2t.hardware.protocols); add that")
    return device


class ToolPose:
    """Pose of an arm's tool, while a person moves it.

    An arm that has a method `tool_pose`, as a UR arm, is listened to and not controlled. Another one is connected for
    each pose and then let go.

    Args:
        name: Of the arm.
        host: Its address.
        rig: Its tool; an arm that is not listened to needs one.

    Raises:
        ValueError: There is no such arm, it cannot be used, or the address or the rig is missing.
    """

    def __init__(self, name: str, host: str | None, rig: Rig | None) -> None:
        check_device("arm", name, {"address": host})
        self._setup = DeviceSetup(rig or Rig(), host)  # whose stack holds what was started
        self._arm = load_device("arm", name, self._setup)
        self._listen: Callable[[], Array] | None = getattr(self._arm, "tool_pose", None)
        self.arm = None if self._listen else self._arm  # that its camera may ask
        if rig is None and not self._listen:
            raise ValueError(f"--arm {name} needs the lab's calibration, which has the tool's frame; pass --rig FILE")

    @contextmanager
    def now(self) -> Iterator[Array]:
        """T_b_t (4, 4), m; an arm that is not listened to stays connected inside.

        Yields:
            The pose.

        Raises:
            DeviceError: The arm does not answer.
        """
        if self._listen is not None:
            yield self._listen()
            return
        with self._arm:
            yield self._arm.state().T_b_t


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


def _registered(kind: DeviceKind, name: str) -> list[EntryPoint]:
    return list(entry_points(group=GROUPS[kind], name=name))


def _members(protocol: type) -> list[str]:
    """Names of the methods and properties that a protocol asks for."""
    names = {name for base in protocol.__mro__ if getattr(base, "_is_protocol", False) for name in vars(base)}
    return sorted(name for name in names if not name.startswith("_"))
