"""Further skins that the tool carries next to the one that presses: the tables `[skins.NAME]` of a rig's file.

    [tool]
    skin = "left"                    # the skin in the tool's frame: it presses, and the command line names its device

    [skins.right]                    # one more, such as that of a gripper's other jaw
    T_tool_skin = [...]              # its frame in the tool (origin at its centre, z out of it)
    device = "reskin"                # as --skin of python -m i2t.collect
    serial_number = "E6612483CB"     # or address = "/dev/ttyACM1": its port, or the recording of a replay
    board = "anyskin"                # as --board
    pad = "right pad, July"          # as --pad-name

NumPy only. Metres.
"""

import json
import re
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from i2t.skin.boards import DEFAULT_BOARD, make_board
from i2t.types import Array

TOOL_SKIN = "tool"  # name of the skin in the tool's frame, where a rig gives none
MAX_CARRIED_SKINS = 8  # next to the one that presses
TEXT_KEYS = ("device", "board", "address", "serial_number", "pad")  # keys of a table that are texts

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]{0,31}")


@dataclass(frozen=True, eq=False)
class CarriedSkin:
    """A further skin on the tool. Raises ValueError, with one sentence that names the field, for what cannot be."""

    name: str
    device: str = "reskin"  # reskin, simulated, emulated, replay, or another package's, as --skin
    T_tool_skin: Array = field(default_factory=lambda: np.eye(4))  # (4, 4)
    board: str = DEFAULT_BOARD  # as `i2t.skin.boards.make_board` knows it; another package's device knows its own
    address: str = ""  # its port, or the recording of a replay; empty: by its serial number
    serial_number: str = ""  # of a board on USB
    pad: str = ""  # of the skin in the data set; empty: its own name

    def __post_init__(self) -> None:
        require_skin_name(f"[skins.{self.name}]", self.name)
        try:
            make_board(self.board)
        except (ValueError, OSError) as error:
            raise ValueError(f"skins.{self.name}.board: {error}") from error
        if self.serial_number and self.device != "reskin":
            raise ValueError(
                f"skins.{self.name}.serial_number is of a board on USB, and its device is {self.device!r}; leave it "
                'out, or make that "reskin"'
            )
        if self.serial_number and self.address:
            raise ValueError(f"skins.{self.name} has an address and a serial_number; keep one of them")
        if self.device in ("reskin", "replay") and not (self.serial_number or self.address):
            what = "its recording" if self.device == "replay" else "its port, or serial_number,"
            raise ValueError(f"skins.{self.name} names no board; add address, {what} so that no other is taken for it")

    def text(self, pose: str) -> list[str]:
        """The skin as lines of TOML.

        Args:
            pose: `T_tool_skin` as TOML.

        Returns:
            The lines.
        """
        given = [(key, getattr(self, key)) for key in TEXT_KEYS if getattr(self, key)]
        quoted = [f"{key} = {json.dumps(value, ensure_ascii=False)}" for key, value in given]
        return [f"[skins.{self.name}]", f"T_tool_skin = {pose}", *quoted]


def carried_keys() -> list[str]:
    """The keys of a table of a carried skin.

    Returns:
        All of them, in order.
    """
    return [each.name for each in fields(CarriedSkin) if each.name != "name"]


def require_skin_name(key: str, name: Any) -> str:
    """A skin's name, which becomes part of names in files.

    Args:
        key: That holds it, for the message.
        name: As given.

    Returns:
        The name.

    Raises:
        ValueError: It is none.
    """
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise ValueError(f"{key}: {name!r} is no name of a skin; give a letter, and then letters, digits, - or _")
    return name


def require_distinct(tool_skin: str, skins: tuple[CarriedSkin, ...]) -> None:
    """Refuse skins that cannot be told apart, or too many.

    Args:
        tool_skin: Name of the skin in the tool's frame.
        skins: The others.

    Raises:
        ValueError: A name or a board is there twice.
    """
    names = [tool_skin, *(each.name for each in skins)]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"skins.{name} is also the name of the skin at the tool; give tool.skin another name")
    boards = [each.serial_number or each.address for each in skins if each.device == "reskin"]
    twice = [board for board in boards if boards.count(board) > 1]
    if twice:
        raise ValueError(f"two tables of [skins] name the board {twice[0]}; each skin has a board of its own")
    if len(skins) > MAX_CARRIED_SKINS:
        raise ValueError(f"[skins] has {len(skins)} tables; {MAX_CARRIED_SKINS} are the most")
