"""Skins on the tool: besides the skin that presses, the tables `[skins.NAME]` of a rig's file.

    [tool]
    skin = "left"                    # the skin in the tool's frame: it presses, and the command line names its device

    [skins.right]                    # a further skin, such as that of a gripper's other jaw
    T_tool_skin = [...]              # its frame in the tool (origin at its centre, z out of it)
    device = "reskin"                # as --skin of i2t collect
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

TOOL_SKIN = "tool"  # default name of the skin in the tool's frame, which presses
# keys of a skin's table in a rig file whose values are texts
TEXT_KEYS = ("device", "board", "address", "serial_number", "pad")


@dataclass(frozen=True, eq=False)
class CarriedSkin:
    """A further skin on the tool, from a rig: name, driver, pose in the tool (m), board, port or serial number, pad.

    Raises ValueError for an unknown board, and for a serial number with an address or with a driver other than reskin.
    """

    name: str
    device: str = "reskin"  # reskin, simulated, emulated, or a device of another package, as --skin
    T_tool_skin: Array = field(default_factory=lambda: np.eye(4))  # (4, 4) pose of the skin in the tool, m
    # Name for `i2t.skin.boards.make_board`; empty if the device of another package brings its own.
    board: str = DEFAULT_BOARD
    address: str = ""  # port of the skin; empty to find it by its serial number
    serial_number: str = ""  # serial number of the skin's USB board
    pad: str = ""  # name of the pad in the data set; by default, the name of the skin

    def __post_init__(self) -> None:
        try:
            make_board(self.board or DEFAULT_BOARD)
        except (ValueError, OSError) as error:
            raise ValueError(f"skins.{self.name}.board: {error}") from error
        if self.serial_number and self.device != "reskin":
            raise ValueError(f"skins.{self.name}.serial_number applies to a USB board only; leave it out")
        if self.serial_number and self.address:
            raise ValueError(f"skins.{self.name} has an address and a serial_number; keep one of them")


def require_distinct(tool_skin: str, skins: tuple[CarriedSkin, ...]) -> None:
    """Refuse skins on a tool that share a name or a board, or cannot be identified.

    Args:
        tool_skin: Name of the pressing skin, which is in the tool's frame.
        skins: Further skins on the tool.

    Raises:
        ValueError: A name is invalid, a further skin of device reskin has neither address nor serial number, or two
            skins share a name or a board.
    """
    for skin in skins:
        if skin.device == "reskin" and not (skin.serial_number or skin.address):
            raise ValueError(f"skins.{skin.name} identifies no board; add its address or its serial_number")
    names = [tool_skin, *(skin.name for skin in skins)]
    boards = [skin.serial_number or skin.address for skin in skins if skin.device == "reskin"]
    for name in names:
        if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z][A-Za-z0-9_-]{0,31}", name):
            raise ValueError(f"{name!r} is not a valid name of a skin; give a letter, and then letters, digits, - or _")
    for values in (names, boards):
        twice = [value for value in values if values.count(value) > 1]
        if twice:
            raise ValueError(f"[skins] and tool.skin use {twice[0]} twice; each skin has its own name and board")
