"""Notes of a collection in its folder, which ensure that it is resumed with the same object, rig, devices and settings.

Boards, cameras and arms are recognised by their serial numbers if they have one.
"""

import hashlib
import json
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from i2t.collect.arguments import CollectArgs
from i2t.collect.devices import configured_skins
from i2t.collect.out_folder import NOTES_FILE, check_out
from i2t.collect.recorder import list_touches, site_number_of, touch_time
from i2t.collect.touch import TOOL, SkinOnTool
from i2t.dataset import read_touch
from i2t.dataset.files import sync_folder
from i2t.errors import DataError
from i2t.files.reading import read_json
from i2t.files.writing import replacing
from i2t.hardware.rig import Rig
from i2t.objects.solids import Mesh
from i2t.skin.boards import DEFAULT_BOARD


def write_notes(folder: Path, notes: Mapping[str, Any]) -> None:
    """Write the notes of a collection (its settings and devices) to its folder, completely or not at all.

    Args:
        folder: Folder of the touches.
        notes: Names and values that can be written as JSON.

    Raises:
        DataError: If the notes cannot be written.
    """
    with replacing(folder / NOTES_FILE) as temporary:
        temporary.write_text(json.dumps(notes, indent=1))
    sync_folder(folder)


def read_notes(folder: Path) -> dict[str, Any] | None:
    """Read the notes of a collection that `write_notes` wrote.

    Args:
        folder: Folder of the touches.

    Returns:
        The notes by name, or None if the folder holds none.

    Raises:
        DataError: If the notes are damaged.
    """
    path = folder / NOTES_FILE
    try:
        notes = dict(read_json(path, 2**26))
        if "sites" in notes:
            former = {"half": "half_edge"}  # name of a site limit in notes of earlier versions
            notes["sites"] = {former.get(limit, limit): value for limit, value in notes["sites"].items()}
        return notes | {"session": str(notes["session"])}
    except FileNotFoundError:
        return None
    except (OSError, ValueError, TypeError, LookupError, AttributeError) as error:
        reason = str(error).removeprefix(f"{path}: ")
        raise DataError(f"{path}: cannot be read ({reason}); restore it from a copy, or pass another --out") from error


def resume(args: CollectArgs, name: str, rig: Rig, mesh: Mesh) -> tuple[dict[int, float], dict[str, Any]]:
    """Begin a collection, or resume the one that was begun in its folder.

    Args:
        args: Arguments as on the command line.
        name: Name of the object.
        rig: Calibration of the lab.
        mesh: Mesh of the object.

    Returns:
        Unix time (s) of each touch that the folder holds, by the number of its site, and the notes of the collection.

    Raises:
        DataError: If a collection with other values was begun in the folder `args.out`, or its notes are damaged.
        ValueError: If no touches can be collected in the folder (`check_out`).
    """
    check_out(args.out)
    files = list_touches(args.out) if args.out.is_dir() else []
    notes = read_notes(args.out)
    notes = notes or {"session": f"{name}, {datetime.now(UTC):%Y-%m-%d %H:%M:%S} UTC"}
    notes["session"] = args.session or notes["session"]
    if files and "pad-name" not in notes:  # begun by an earlier version
        record = read_touch(files[0])
        notes |= {_pad_flag(name): touches.pads[0] for name, touches in {TOOL: record.touch, **record.skins}.items()}
    changeable = ("retries", "failures", "patience")  # settings that decide when to give up, and do not affect a touch
    same = {
        "object": name,
        "seed": args.world.seed,
        "devices": [args.arm.kind, args.skin.kind, args.camera.kind],
        "board": args.skin.board or DEFAULT_BOARD,
        "pose": args.lab.pose,
        "sites": vars(args.sites),
        "settings": {key: value for key, value in vars(args.settings).items() if key not in changeable},
        "rig": rig_hash(rig),
        "mesh": _hash(np.asarray(mesh.vertices, np.float64)[np.asarray(mesh.faces)].round(7).tobytes()),
        **{_pad_flag(skin.name): skin.pad for skin in configured_skins(args, rig)},
    }
    require_same(notes, same, args.out)
    return {site_number_of(file): touch_time(file) for file in files}, notes


def require_same(notes: dict[str, Any], same: Mapping[str, Any], out: Path) -> None:
    """Refuse values that differ from those a folder was begun with, and add new ones to its notes.

    Args:
        notes: Notes of the folder, to which missing values are added.
        same: Values of this run that all touches of the folder must share, by name; "" if unknown.
        out: Folder of the touches, for messages.

    Raises:
        DataError: If the folder was begun with other values.
    """
    same = json.loads(json.dumps(dict(same)))
    before, now = _by_flag(notes), _by_flag(same)
    different = [key for key, value in now.items() if "" not in (value, before.get(key, "")) and before[key] != value]
    if different:
        changes = "; ".join(f"{key}: {before[key]}, now {now[key]}" for key in different)
        difference = f"{' and '.join(different)} ({changes})".replace("chips ", "layout of chips ")
        raise DataError(f"{out} was begun with another {difference}; use the earlier value, or another --out")
    notes |= {key: value for key, value in same.items() if value != "" or key not in notes}


def device_notes(kind: str, device: object, name: str = "") -> dict[str, str]:
    """Make the note of a device's serial number, by which a resumed collection recognises the device.

    Args:
        kind: Kind of device: arm, camera or skin.
        device: The connected device.
        name: Name of a further skin; empty for any other device.

    Returns:
        The note's name and the serial number, for `require_same`.
    """
    return {f"{kind}_serial {name}".strip(): serial_number(device)}


def board_notes(skin: SkinOnTool) -> dict[str, str]:
    """Make the note of the positions and rotations of a board's chips, which all touches of a folder must share.

    Args:
        skin: The skin, with its board.

    Returns:
        The note's name and a hash, for `require_same`.
    """
    board = np.concatenate([np.ravel(part) for part in skin.board]).astype(np.float32).round(5)
    return {f"chips {skin.name}": _hash(board.tobytes())}


def serial_number(device: object) -> str:
    """Read the serial number of a connected device: a board on USB, a camera, an arm's controller.

    Args:
        device: The connected device.

    Returns:
        The serial number, or "" if the device has none.
    """
    number = getattr(device, "serial_number", None) or getattr(getattr(device, "info", None), "serial_number", None)
    return str(number or "")


def rig_hash(rig: Rig) -> str:
    """Hash a rig, including the object's pose, so that a resumed collection detects a changed rig.

    Args:
        rig: Calibration of the lab.

    Returns:
        Ten hexadecimal digits.
    """
    # A key keeps its earlier name, so that collections of an earlier version can be resumed.
    return _hash(rig.text().replace("\napproach_distance = ", "\ntravel = ").encode())


def _pad_flag(skin: str) -> str:
    return "pad-name" if skin == TOOL else f"skins.{skin}.pad"


def _hash(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:10]


def _by_flag(values: Mapping[str, Any]) -> dict[str, Any]:
    """Flatten values to the names of the command line, such as `settings.press` in a group."""
    named: dict[str, Any] = {}
    for key, value in values.items():
        named |= {f"{key}.{name}": part for name, part in value.items()} if isinstance(value, dict) else {key: value}
    return named
