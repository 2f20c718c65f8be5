"""Devices of third parties: found by a name that their package registers, or by `package.module:Class`.

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
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Literal, TypeAlias

from i2t.hardware.protocols import Arm, DepthCamera, GuardedArm, Skin
from i2t.hardware.rig import Rig

DeviceKind: TypeAlias = Literal["arm", "skin", "camera"]

GROUPS: dict[DeviceKind, str] = {"arm": "i2t.arms", "skin": "i2t.skins", "camera": "i2t.cameras"}
PROTOCOLS: dict[DeviceKind, type] = {"arm": GuardedArm, "skin": Skin, "camera": DepthCamera}


@dataclass(frozen=True, eq=False)
class DeviceSetup:
    """Setup with which a third party's device is built."""

    rig: Rig  # the lab's calibration: frames, payload, limits
    address: str | None = None  # --host for an arm, --port for a skin, --camera-serial for a camera
    arm: Arm | None = None  # that carries the camera


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


def _find(kind: DeviceKind, name: str, given: str) -> Any:
    """The class of a name."""
    found = _registered(kind, name)
    if len(found) > 1:
        owners = ", ".join(each.value for each in found)
        raise ValueError(f"{given}: several packages register it ({owners}); give package.module:Class")
    if ":" not in name and not found:
        known = ", ".join(sorted(each.name for each in entry_points(group=GROUPS[kind]))) or "none"
        there = f"registered under {GROUPS[kind]}: {known}"
        raise ValueError(f"{given}: there is no such {kind} ({there}); give package.module:Class")
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
