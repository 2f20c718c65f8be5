"""Notes of a collection in its folder: what was begun there, so that only the same goes on.

Board, camera and arm are told by their serial numbers where they have them.
"""

import hashlib
import json
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from i2t.collect.arguments import CollectArgs
from i2t.collect.devices import wanted_skins
from i2t.collect.recorder import site_number_of, touches_in, written_at
from i2t.collect.touch import TOOL, SkinOnTool
from i2t.dataset import read_touch
from i2t.dataset.files import sync_folder
from i2t.errors import DataError
from i2t.files.reading import read_json
from i2t.files.writing import replacing
from i2t.hardware.rig import Rig
from i2t.objects.solids import Mesh
from i2t.skin.boards import DEFAULT_BOARD

NOTES = ".collection.json"
MAX_NOTES_BYTES = 2**26
CHANGEABLE_SETTINGS = ("retries", "failures", "patience")  # settings that say when to give up, and nothing of a touch


def write_notes(folder: Path, notes: Mapping[str, Any]) -> None:
    """Keep what a session must know when it is resumed, whole or not at all.

    Args:
        folder: Of the touches.
        notes: What can be written as JSON.

    Raises:
        DataError: They cannot be written.
    """
    with replacing(folder / NOTES) as temporary:
        temporary.write_text(json.dumps(notes, indent=1))
    sync_folder(folder)


def read_notes(folder: Path) -> dict[str, Any] | None:
    """Read the notes that `write_notes` kept.

    Args:
        folder: Of the touches.

    Returns:
        The notes, None if there are none.

    Raises:
        DataError: They are damaged.
    """
    path = folder / NOTES
    try:
        notes = dict(read_json(path, MAX_NOTES_BYTES))
        return notes | {"session": str(notes["session"])}
    except FileNotFoundError:
        return None
    except (OSError, ValueError, TypeError, LookupError) as error:
        reason = str(error).removeprefix(f"{path}: ")
        raise DataError(f"{path}: cannot be read ({reason}); restore it from a copy, or pass another --out") from error


def resume(args: CollectArgs, name: str, rig: Rig, mesh: Mesh) -> tuple[dict[int, float], dict[str, Any]]:
    """Begin a collection, or go on with the one that was begun in its folder.

    Args:
        args: As on the command line.
        name: Of the object.
        rig: Where everything is.
        mesh: Of the object.

    Returns:
        Sites that were touched and when (Unix time), and the notes of the collection.

    Raises:
        DataError: Another collection was begun there, or its notes are damaged.
    """
    files = touches_in(args.out) if args.out.is_dir() else []
    notes = read_notes(args.out)
    if notes is None and files:
        raise DataError(f"{args.out} holds touches of another making; choose another --out")
    notes = notes or {"session": f"{name}, {datetime.now(UTC):%Y-%m-%d %H:%M:%S} UTC"}
    notes["session"] = args.session or notes["session"]
    if files and "pad-name" not in notes:  # begun by an earlier version
        record = read_touch(files[0])
        notes |= {_pad_flag(name): each.pads[0] for name, each in {TOOL: record.touch, **record.skins}.items()}
    same = {
        "object": name,
        "seed": args.world.seed,
        "devices": [args.arm.kind, args.skin.kind, args.camera.kind],
        "board": args.skin.board or DEFAULT_BOARD,
        "pose": args.lab.pose,
        "sites": vars(args.sites),
        "settings": {key: value for key, value in vars(args.settings).items() if key not in CHANGEABLE_SETTINGS},
        "rig": rig_hash(rig),
        "mesh": _hash(np.asarray(mesh.vertices, np.float64)[np.asarray(mesh.faces)].round(7).tobytes()),
        **{_pad_flag(each.name): each.pad for each in wanted_skins(args, rig)},
    }
    keep_same(notes, same, args.out)
    return {site_number_of(file): written_at(file) for file in files}, notes


def keep_same(notes: dict[str, Any], same: Mapping[str, Any], out: Path) -> None:
    """Note what all touches of a folder must have in common.

    Args:
        notes: Of the folder; what they do not say yet is added.
        same: What holds now; "" where it is not known.
        out: The folder.

    Raises:
        DataError: The folder was begun with something else.
    """
    same = json.loads(json.dumps(dict(same)))
    before, now = _by_flag(notes), _by_flag(same)
    different = [key for key, value in now.items() if "" not in (value, before.get(key, "")) and before[key] != value]
    if different:
        changes = "; ".join(f"{key}: {before[key]}, now {now[key]}" for key in different)
        said = f"{' and '.join(different)} ({changes})".replace("chips ", "layout of chips ")
        raise DataError(f"{out} was begun with another {said}; use that again, or another --out")
    notes |= {key: value for key, value in same.items() if value != "" or key not in notes}


def device_notes(kind: str, device: object, name: str = "") -> dict[str, str]:
    """The serial number of a device, for its folder.

    Args:
        kind: arm, camera or skin.
        device: Connected.
        name: Of a further skin.

    Returns:
        For `keep_same`.
    """
    return {f"{kind}_serial {name}".strip(): serial_number(device)}


def board_notes(skin: SkinOnTool) -> dict[str, str]:
    """Where the chips of a board lie and how they turn, for its folder: no set could hold touches with others.

    Args:
        skin: With its board.

    Returns:
        For `keep_same`.
    """
    board = np.concatenate([np.ravel(part) for part in skin.board]).astype(np.float32).round(5)
    return {f"chips {skin.name}": _hash(board.tobytes())}


def serial_number(device: object) -> str:
    """Serial number of a connected device: a board on USB, a camera, an arm's controller.

    Args:
        device: Connected.

    Returns:
        The number; "" where it has none.
    """
    number = getattr(device, "serial_number", None) or getattr(getattr(device, "info", None), "serial_number", None)
    return str(number or "")


def rig_hash(rig: Rig) -> str:
    """Hash of a rig and of the object's pose in it.

    Args:
        rig: Where everything is.

    Returns:
        Ten hexadecimal digits.
    """
    # A key has its earlier name, so that a collection that an earlier version began goes on.
    return _hash(rig.text().replace("\napproach_distance = ", "\ntravel = ").encode())


def _pad_flag(skin: str) -> str:
    return "pad-name" if skin == TOOL else f"skins.{skin}.pad"


def _hash(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:10]


def _by_flag(values: Mapping[str, Any]) -> dict[str, Any]:
    """Values by the names of the command line, those of groups as `settings.press`."""
    named: dict[str, Any] = {}
    for key, value in values.items():
        named |= {f"{key}.{name}": each for name, each in value.items()} if isinstance(value, dict) else {key: value}
    return named
