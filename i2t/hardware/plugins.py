"""Devices by name: i2t's own and those of other packages, found as entry points or as `package.module:Class`.

A package registers a class under a name in its `pyproject.toml`,

    [project.entry-points."i2t.arms"]
    acme = "acme_devices:AcmeArm"

(likewise `i2t.skins`, `i2t.cameras`), after which `i2t collect --arm acme` finds it. The class is called with
one `DeviceSetup` and must implement the protocol of its kind (`i2t.hardware.protocols`; `GuardedArm` for an arm). A
skin has an attribute `board` that describes its chips (a further skin of a rig may leave that to `skins.NAME.board`).
Instead of the class, the entry point may name a `DevicePlugin`, which lists further options of the device; i2t's own
devices (`i2t.hardware.drivers`, `i2t.emulators.plugins`) do so. `examples/acme_devices` is a complete package, and
`i2t.hardware.contract` holds the tests that every device must pass.
"""

import importlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np

from i2t.errors import DeviceError, did_you_mean
from i2t.hardware.carried_skins import CarriedSkin
from i2t.hardware.clock import Clock, MonotonicClock
from i2t.hardware.protocols import Arm, ColourImage, DepthCamera, GuardedArm, Skin
from i2t.hardware.rig import Rig
from i2t.hardware.world import WorldArgs
from i2t.types import Array

DeviceKind: TypeAlias = Literal["arm", "skin", "camera"]

UR, REALSENSE = "ur", "realsense"  # registered names of two of i2t's drivers


class _KindOfDevice(NamedTuple):
    """Group of entry points, protocol, and flag of the address of a kind of device."""

    group: str
    protocol: type
    address_flag: str


# Kinds of devices: entry-point group of their drivers, protocol, and command-line option for the device's address
# (host, port or serial number).
KINDS: dict[DeviceKind, _KindOfDevice] = {
    "arm": _KindOfDevice("i2t.arms", GuardedArm, "--host"),
    "skin": _KindOfDevice("i2t.skins", Skin, "--port"),
    "camera": _KindOfDevice("i2t.cameras", DepthCamera, "--camera-serial"),
}


@dataclass(frozen=True, eq=False)
class DeviceSetup:
    """Everything that the driver of an arm, skin or camera is built from.

    That is the rig, the address, the arm that carries the device, options of the command line, the simulated world, a
    clock, and a stack that closes what was started for the device.
    """

    rig: Rig  # the lab's calibration: frames, payload, limits
    address: str | None = None  # --host for an arm, --port for a skin, --camera-serial for a camera
    arm: Arm | None = None  # arm that carries the device
    skin: CarriedSkin | None = None  # pose of a skin on the tool, and its serial number
    board: str | None = None  # board of the skin, or of the skin that the arm carries
    # timeouts of the arm's watch that were given: state_timeout (s), watchdog_rate (Hz)
    watch: Mapping[str, Any] = field(default_factory=dict)
    size: tuple[int, int] | None = None  # image size of a camera in pixels
    world: WorldArgs = field(default_factory=WorldArgs)  # world of a simulated or emulated device
    clock: Clock = field(default_factory=MonotonicClock)  # clock that the devices share
    stack: ExitStack = field(default_factory=ExitStack)  # stack that closes what was started for the device


@dataclass(frozen=True)
class DevicePlugin:
    """Registered driver: function that builds the device, and options of the command line that it accepts or requires.

    For simulated devices, it also has the arms on which a skin works, and a function that makes the lab's clock.
    """

    make: Callable[[DeviceSetup], Any]  # function that builds the device without connecting it, and imports its library
    takes: frozenset[str] = frozenset({"address"})  # names of the accepted options, as on the command line
    needs_address: bool = False
    needs_rig: bool = False  # whether a rig must be given; otherwise the emulated lab's rig is the default
    arms: frozenset[str] = frozenset()  # names of the arms on which a simulated skin works; empty for a real skin
    address_follows_arm: bool = False  # whether a skin needs an address if and only if its arm has one
    # function that makes, from a Unix time, the clock of a lab of simulated devices only
    make_clock: Callable[[float], Clock] = lambda begin: MonotonicClock()


def find_plugin(kind: DeviceKind, name: str, option: str | None = None) -> DevicePlugin:
    """Find the driver of a device by its name, without building the device.

    Args:
        kind: Kind of the device: "arm", "skin" or "camera".
        name: Registered name of the driver, as after --arm or --skin, or package.module:Class.
        option: Option that gave the name, for messages; by default --arm, --skin or --camera.

    Returns:
        The plug-in of the device; a registered class is wrapped in a plug-in.

    Raises:
        ValueError: No installed package registers the name, several do, or the device cannot be imported.
    """
    given = f"{option or f'--{kind}'} {name}"
    group = KINDS[kind].group
    entries = list(entry_points(group=group, name=name))
    if not entries and ":" not in name:
        names = sorted({entry.name for entry in entry_points(group=group)})
        listed = ", ".join(names) or "none: install i2t again"
        remedy = f"give a name that an installed package registers ({listed}), or package.module:Class"
        raise ValueError(f"{given} is not known; {did_you_mean(name, names, remedy)}")
    if len(entries) > 1:
        owners = ", ".join(entry.value for entry in entries)
        raise ValueError(f"{given}: several packages register it ({owners}); give package.module:Class")
    module, _, attribute = (entries[0].value if entries else name).partition(":")
    try:
        device = getattr(importlib.import_module(module), attribute)  # noqa: TID251  # a user's class
    except AttributeError as error:
        raise ValueError(f"{given}: {module} has no {attribute}; give package.module:Class") from error
    except (ImportError, ValueError) as error:
        raise ValueError(f"{given}: {module} cannot be imported ({error}); install it, or correct it") from error
    return device if isinstance(device, DevicePlugin) else DevicePlugin(device)


def check_device(kind: DeviceKind, name: str, options: Mapping[str, Any]) -> None:
    """Refuse options that a device does not accept, and the lack of an address that it requires.

    Args:
        kind: Kind of the device: "arm", "skin" or "camera".
        name: Registered name of the driver, as after --arm or --skin, or package.module:Class.
        options: Values of the options by name, such as "address" or "size"; None for an option that was not given.

    Raises:
        ValueError: The device is unknown, or an option is superfluous or missing; the message names its flag.
    """
    plugin = find_plugin(kind, name)
    for option, value in options.items():
        flag = KINDS[kind].address_flag if option == "address" else f"--{option.replace('_', '-')}"
        if value is not None and option not in plugin.takes:
            raise ValueError(f"{flag} has no effect with --{kind} {name}; leave it out")
        if value is None and option == "address" and plugin.needs_address:
            raise ValueError(f"--{kind} {name} needs an address; pass {flag}")


def load_device(kind: DeviceKind, name: str, setup: DeviceSetup, option: str | None = None) -> Any:
    """Find the driver of a device by its name and build the device, without connecting it.

    Args:
        kind: Kind of the device: "arm", "skin" or "camera".
        name: Registered name of the driver, as after --arm or --skin, or package.module:Class.
        setup: Setup that the device is built from.
        option: Option that gave the name, for messages; by default --arm, --skin or --camera.

    Returns:
        The device, not connected.

    Raises:
        ValueError: The device cannot be imported or built, or lacks members of its protocol, which the message lists.
        DeviceError: The client library of the device is not installed.
    """
    given = f"{option or f'--{kind}'} {name}"
    try:
        device = find_plugin(kind, name, option).make(setup)
    except TypeError as error:
        raise ValueError(f"{given}: cannot be built ({error}); it must take one DeviceSetup") from error
    own, protocol = getattr(device, "__dict__", {}), KINDS[kind].protocol
    missing = [member for member in _members(protocol) if member not in own and not hasattr(type(device), member)]
    if missing:
        raise ValueError(f"{given}: lacks {', '.join(missing)} of i2t.hardware.protocols.{protocol.__name__}; add that")
    return device


class ToolPose:
    """Reader of the pose of an arm's tool, while a person moves the arm.

    An arm with a method `tool_pose`, such as a UR arm, is read without being controlled. Another arm is connected for
    each pose and then released.

    Args:
        name: Registered name of the arm's driver, as after --arm, or package.module:Class.
        host: Address of the arm.
        rig: Calibration with the tool's frame; required for an arm without `tool_pose`.

    Raises:
        ValueError: The arm is unknown or unusable, or the address or the rig is missing.
    """

    def __init__(self, name: str, host: str | None, rig: Rig | None) -> None:
        check_device("arm", name, {"address": host})
        self._setup = DeviceSetup(rig or Rig(), host)  # its stack holds what was started for the arm
        self._arm = load_device("arm", name, self._setup)
        self._read_pose: Callable[[], Array] | None = getattr(self._arm, "tool_pose", None)
        self.arm = None if self._read_pose else self._arm  # for a camera that needs the arm
        if rig is None and not self._read_pose:
            raise ValueError(f"--arm {name} needs the lab's calibration, which has the tool's frame; pass --rig FILE")

    @contextmanager
    def now(self) -> Iterator[Array]:
        """Read the pose of the tool; an arm without `tool_pose` stays connected inside the block.

        Yields:
            (4, 4) T_b_t, m.

        Raises:
            DeviceError: The arm does not answer.
        """
        if self._read_pose is not None:
            yield self._read_pose()
            return
        with self._arm:
            yield self._arm.state().T_b_t


def colour_view(camera: Any) -> ColourImage:
    """Take a colour image with a camera.

    Args:
        camera: Connected camera. If its colour images have their own lens, it has a method `colour`, like `RealSense`;
            otherwise the colours of a depth view are taken, which are aligned with depth.

    Returns:
        The colour image with its lens.

    Raises:
        DeviceError: The camera provides no colours, or no image.
    """
    if hasattr(camera, "colour"):
        image: ColourImage = camera.colour()
        return image
    view = camera.capture()
    if view.colour is None:
        raise DeviceError(f"{camera.features.name} provides no colours, which the search for the board needs")
    return ColourImage(view.time, np.asarray(view.colour), camera.camera, np.eye(4))


def _members(protocol: type) -> list[str]:
    """List the methods and properties of a protocol."""
    names = {name for base in protocol.__mro__ if getattr(base, "_is_protocol", False) for name in vars(base)}
    return sorted(name for name in names if not name.startswith("_"))
