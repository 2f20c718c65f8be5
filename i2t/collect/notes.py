"""Notes of a collection in its folder: what was begun there, so that only the same goes on.

Board, camera and arm are told by their serial numbers where they have them. Sites that cannot be reached are noted too.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from i2t.collect.arguments import CollectArgs
from i2t.collect.recorder import site_number_of, touches_in, written_at
from i2t.collect.touch import SkinOnTool
from i2t.dataset import read_touch
from i2t.dataset.files import sync_folder
from i2t.errors import DataError
from i2t.files import read_json, replacing
from i2t.hardware.rig import Rig
from i2t.objects.solids import Mesh
from i2t.skin.boards import DEFAULT_BOARD
from i2t.types import Board

NOTES = ".collection.json"
MAX_NOTES_BYTES = 2**26  # a line for each site that cannot be reached
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
        return dict(read_json(path, MAX_NOTES_BYTES))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, TypeError) as error:
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
    }
    same = json.loads(json.dumps(same))
    if notes is None:
        if files:
            raise DataError(f"{args.out} holds touches of another making; choose another --out")
        session = args.session or f"{name}, {datetime.now(UTC):%Y-%m-%d %H:%M:%S} UTC"
        return {}, {**same, "session": session, "unreachable": {}}
    notes = {"board": DEFAULT_BOARD, **{key: same[key] for key in ("settings", "rig", "mesh")}, **notes}
    try:
        session = notes["session"] if "session" in notes else notes["run"]  # as earlier versions called it
        notes["session"] = args.session or str(session)
        notes["unreachable"] = {str(int(number)): str(why) for number, why in notes["unreachable"].items()}
    except (LookupError, ValueError, AttributeError) as error:
        raise DataError(
            f"{args.out / NOTES}: is damaged ({error!r}); restore it from a copy, or pass another --out"
        ) from error
    before, now = _by_flag(notes), _by_flag(same)
    different = [key for key, value in now.items() if before.get(key) != value]
    if different:
        raise DataError(
            f"{args.out} was begun with another {' and '.join(different)} "
            f"({'; '.join(f'{key}: {before.get(key)}' for key in different)}); pass that again, or another --out"
        )
    if files and "chips " not in notes:  # which earlier versions did not note
        record = read_touch(files[0])
        boards = {"": record.touch.board, **{name: each.board for name, each in record.skins.items()}}
        notes |= {f"chips {name}": _chips(board) for name, board in boards.items()}
    return {site_number_of(file): written_at(file) for file in files}, notes


def rig_hash(rig: Rig) -> str:
    """Hash of a rig and of the object's pose in it.

    Args:
        rig: Where everything is.

    Returns:
        Ten hexadecimal digits.
    """
    # A key has its earlier name, so that a collection that an earlier version began goes on.
    return _hash(rig.text().replace("\napproach_distance = ", "\ntravel = ").encode())


def _chips(board: Board) -> str:
    return _hash(np.concatenate([np.ravel(part) for part in board]).astype(np.float32).round(5).tobytes())


def _hash(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:10]


def _by_flag(values: Mapping[str, Any]) -> dict[str, Any]:
    """Values by the names of the command line, those of groups as `settings.press`."""
    named: dict[str, Any] = {}
    for key, value in values.items():
        named |= {f"{key}.{name}": each for name, each in value.items()} if isinstance(value, dict) else {key: value}
    return named


def keep_devices(notes: dict[str, Any], kind: str, devices: Mapping[str, object], out: Path) -> None:
    """Note the serial numbers of devices, each one for all touches of a folder.

    Args:
        notes: Of the folder.
        kind: arm, camera or skin.
        devices: Connected, by the names of skins; one without a number is not told apart.
        out: The folder.

    Raises:
        DataError: The folder was begun with another device.
    """
    for name, device in devices.items():
        serial, key = serial_number(device), f"{kind}_serial {name}".strip()
        before = notes.get(key) or serial
        notes[key] = before
        if serial and before != serial:
            raise DataError(
                f"{out} was begun with the {kind} {before}, and this one is {serial}; "
                f"{'use' if kind == 'arm' else 'plug in'} that one, or pass another --out"
            )


def serial_number(device: object) -> str:
    """Serial number of a connected device: a board on USB, a camera, an arm's controller.

    Args:
        device: Connected.

    Returns:
        The number; "" where it has none.
    """
    number = getattr(device, "serial_number", None) or getattr(getattr(device, "info", None), "serial_number", None)
    return str(number or "")


def keep_boards(notes: dict[str, Any], skins: Sequence[SkinOnTool], out: Path) -> None:
    """Note where the chips of boards lie and how they turn: no set could hold touches with others.

    Args:
        notes: Of the folder.
        skins: With their boards.
        out: The folder.

    Raises:
        DataError: The folder was begun with another board.
    """
    for each in skins:
        if notes.setdefault(f"chips {each.name}", _chips(each.board)) != _chips(each.board):
            which = f"of the skin {each.name} " if each.name else ""
            raise DataError(
                f"{out} was begun with a board {which}whose chips lie or turn otherwise; pass that board, as a file if "
                "it has no name (--board my_board.toml), or another --out"
            )
