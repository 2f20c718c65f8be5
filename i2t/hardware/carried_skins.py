"""Skins that the tool carries; those next to the one that presses are the tables `[skins.NAME]` of a rig's file.

    [tool]
    skin = "left"                    # the skin in the tool's frame: it presses, and the command line names its device

    [skins.right]                    # one more, such as that of a gripper's other jaw
    T_tool_skin = [...]              # its frame in the tool (origin at its centre, z out of it)
    device = "reskin"                # as --skin of python -m i2t.collect
    serial_number = "E6612483CB"     # or address = "/dev/ttyACM1": its port
    board = "anyskin"                # as --board
    pad = "right pad, July"          # as --pad-name

NumPy only. Metres.
"""

import re
from dataclasses import dataclass, field

import numpy as np

from i2t.skin.boards import DEFAULT_BOARD, make_board
from i2t.types import Array

TOOL_SKIN = "tool"  # name of the skin in the tool's frame, where a rig gives none
TEXT_KEYS = ("device", "board", "address", "serial_number", "pad")  # keys of a table that are texts

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]{0,31}")


@dataclass(frozen=True, eq=False)
class CarriedSkin:
    """A skin on the tool. Raises ValueError, with one sentence that names the field, for what cannot be."""

    name: str
    device: str = "reskin"  # reskin, simulated, emulated, or another package's, as --skin
    T_tool_skin: Array = field(default_factory=lambda: np.eye(4))  # (4, 4)
    # As `i2t.skin.boards.make_board` knows it, or empty: another package's device knows its own.
    board: str = DEFAULT_BOARD
    address: str = ""  # its port; empty: by its serial number
    serial_number: str = ""  # of a board on USB
    pad: str = ""  # of the skin in the data set; empty: its own name

    def __post_init__(self) -> None:
        try:
            make_board(self.board or DEFAULT_BOARD)
        except (ValueError, OSError) as error:
            raise ValueError(f"skins.{self.name}.board: {error}") from error
        if self.serial_number and self.device != "reskin":
            raise ValueError(f"skins.{self.name}.serial_number is of a board on USB; leave it out")
        if self.serial_number and self.address:
            raise ValueError(f"skins.{self.name} has an address and a serial_number; keep one of them")


def require_distinct(tool_skin: str, skins: tuple[CarriedSkin, ...]) -> None:
    """Refuse skins that cannot be told apart.

    Args:
        tool_skin: Name of the skin in the tool's frame.
        skins: The others.

    Raises:
        ValueError: A name is none, a board is not named, or a name or a board is there twice.
    """
    for each in skins:
        if each.device == "reskin" and not (each.serial_number or each.address):
            raise ValueError(f"skins.{each.name} names no board; add its address or its serial_number")
    names = [tool_skin, *(each.name for each in skins)]
    boards = [each.serial_number or each.address for each in skins if each.device == "reskin"]
    for name in names:
        if not isinstance(name, str) or not _NAME.fullmatch(name):
            raise ValueError(f"{name!r} is no name of a skin; give a letter, and then letters, digits, - or _")
    for what in (names, boards):
        twice = [each for each in what if what.count(each) > 1]
        if twice:
            raise ValueError(f"[skins] and tool.skin name {twice[0]} twice; each skin has its own name and board")
