"""RTDE, the protocol in which a UR controller streams its state and receives registers, from the controller's side.

A packet is a big-endian uint16 size (with header), one byte of type, and a body. The client agrees on the protocol,
names the outputs that it wants and the inputs that it will write, each as a *recipe* with a number, and starts the
stream. From then on, data packets with values in the recipe's order go both ways. Everything here is a pure function of
bytes.

Source: Universal Robots, "Real-Time Data Exchange (RTDE) guide", protocol version 2. The registers and the emulated
outputs are implemented.
"""

import re
import struct
from collections.abc import Iterable, Mapping, Sequence
from enum import IntEnum
from typing import NamedTuple, TypeAlias

Value: TypeAlias = int | float | Sequence[int | float]

PACKET_HEADER = struct.Struct(">HB")  # header of an RTDE packet: its size in bytes and its type
# codes of the `struct` module for RTDE's types of values
STRUCT_CODES = {"UINT32": "I", "INT32": "i", "DOUBLE": "d", "VECTOR6D": "6d"}
# RTDE's type of a value, and the pattern of the names of values of that type.
TYPE_OF_NAME = (
    ("INT32", r"(in|out)put_int_register_\d+"),
    ("DOUBLE", r"(in|out)put_double_register_\d+|timestamp|target_speed_fraction|speed_slider_fraction"),
    ("UINT32", r"runtime_state|robot_status_bits|safety_status_bits|speed_slider_mask"),
    ("VECTOR6D", r"actual_(q|TCP_(pose|speed|force))|external_force_torque"),
)
NOT_FOUND = "NOT_FOUND"  # type that RTDE reports for an unknown name of a value


class PacketType(IntEnum):
    """Types of RTDE packets, as the byte after the size encodes them."""

    PROTOCOL = ord("V")
    VERSION = ord("v")
    DATA = ord("U")
    OUTPUTS = ord("O")
    INPUTS = ord("I")
    START = ord("S")
    PAUSE = ord("P")


class Recipe(NamedTuple):
    """Names and types of the values in an RTDE data packet, in order."""

    names: tuple[str, ...]
    types: tuple[str, ...]

    @property
    def valid(self) -> bool:
        """Whether the emulated controller has every value of the recipe."""
        return NOT_FOUND not in self.types

    @property
    def layout(self) -> struct.Struct:
        """Big-endian binary layout of a data packet's body: the recipe's number and the values."""
        return struct.Struct(">B" + "".join(STRUCT_CODES[kind] for kind in self.types))


def recipe(names: str) -> Recipe:
    """Make an RTDE recipe by looking up the types of the values with given names.

    Args:
        names: Names separated by commas, with an optional comma at the end.

    Returns:
        The recipe, in which an unknown name has the type NOT_FOUND.
    """
    listed = tuple(name.strip() for name in names.split(",") if name.strip())
    return Recipe(listed, tuple(_type(name) for name in listed))


def _type(name: str) -> str:
    return next((kind for kind, form in TYPE_OF_NAME if re.fullmatch(form, name)), NOT_FOUND)


def packet(kind: int, body: bytes = b"") -> bytes:
    """Make an RTDE packet: put a header with size and type before its contents.

    Args:
        kind: Type of the packet.
        body: Contents of the packet.

    Returns:
        Bytes of the whole packet.
    """
    return PACKET_HEADER.pack(PACKET_HEADER.size + len(body), kind) + body


def encode(number: int, layout: struct.Struct, values: Iterable[Value]) -> bytes:
    """Encode values as an RTDE data packet.

    Args:
        number: Number of the recipe.
        layout: Layout of the recipe (`Recipe.layout`).
        values: Values in the recipe's order.

    Returns:
        Bytes of the whole packet.
    """
    flat: list[int | float] = []
    for value in values:
        flat.extend([value] if isinstance(value, int | float) else value)
    return packet(PacketType.DATA, layout.pack(number, *flat))


def decode(body: bytes, recipes: Mapping[int, Recipe]) -> dict[str, Value]:
    """Decode the body of an RTDE data packet.

    Args:
        body: Number of a recipe, followed by values.
        recipes: Recipes by their numbers.

    Returns:
        Values by their names.

    Raises:
        ValueError: If the recipe is unknown, or the size is not that of the recipe.
    """
    if not body or body[0] not in recipes:
        raise ValueError("a data packet names no agreed recipe")
    wanted = recipes[body[0]]
    if len(body) != wanted.layout.size:
        raise ValueError(f"a data packet of recipe {body[0]} must have {wanted.layout.size} bytes, not {len(body)}")
    flat, values = list(wanted.layout.unpack(body)[1:]), {}
    for name, kind in zip(wanted.names, wanted.types, strict=True):
        values[name] = flat[:6] if kind == "VECTOR6D" else flat[0]
        del flat[: 6 if kind == "VECTOR6D" else 1]
    return values
