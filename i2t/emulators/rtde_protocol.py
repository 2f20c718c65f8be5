"""RTDE, the protocol by which a UR controller streams its state and takes registers, seen from the controller's side.

A packet is a big-endian uint16 size (with header), one byte of type, and a body. The client agrees on the protocol,
names the outputs it wants and the inputs it will write, each a *recipe* with a number, and starts the stream; from then
on data packets with values in the recipe's order go both ways. Everything here is a pure function of bytes.

Source: Universal Robots, "Real-Time Data Exchange (RTDE) guide", protocol version 2; of its outputs those that are
emulated, besides the registers.
"""

import re
import struct
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple, TypeAlias

Value: TypeAlias = int | float | Sequence[int | float]

PACKET_HEADER = struct.Struct(">HB")
PROTOCOL, VERSION, MESSAGE, DATA, OUTPUTS, INPUTS, START, PAUSE = b"VvMUOISP"

FORMATS = {"UINT32": "I", "INT32": "i", "DOUBLE": "d", "VECTOR6D": "6d"}
TYPES = (  # of values, by the form of their names
    ("INT32", r"(in|out)put_int_register_\d+"),
    ("DOUBLE", r"(in|out)put_double_register_\d+|timestamp|target_speed_fraction|speed_slider_fraction"),
    ("UINT32", r"runtime_state|robot_status_bits|safety_status_bits|speed_slider_mask"),
    ("VECTOR6D", r"actual_(q|TCP_(pose|speed|force))|external_force_torque"),
)
NOT_FOUND = "NOT_FOUND"


class Recipe(NamedTuple):
    """Names of the values in a data packet, in order, and how they are laid out behind the recipe's number."""

    names: tuple[str, ...]
    types: tuple[str, ...]

    @property
    def known(self) -> bool:
        """Tell whether every name exists on this controller."""
        return NOT_FOUND not in self.types

    @property
    def layout(self) -> struct.Struct:
        """Big-endian layout of the number and the values."""
        return struct.Struct(">B" + "".join(FORMATS[kind] for kind in self.types))


def recipe(names: str) -> Recipe:
    """Look up the types of a recipe.

    Args:
        names: Separated by commas, maybe with one at the end.

    Returns:
        The recipe; an unknown name has type NOT_FOUND.
    """
    listed = tuple(name.strip() for name in names.split(",") if name.strip())
    return Recipe(listed, tuple(_type(name) for name in listed))


def _type(name: str) -> str:
    return next((kind for kind, form in TYPES if re.fullmatch(form, name)), NOT_FOUND)


def packet(kind: int, body: bytes = b"") -> bytes:
    """Put a header before a body.

    Args:
        kind: Type of the packet.
        body: Its contents.

    Returns:
        The packet.
    """
    return PACKET_HEADER.pack(PACKET_HEADER.size + len(body), kind) + body


def encode(number: int, layout: struct.Struct, values: Iterable[Value]) -> bytes:
    """A data packet.

    Args:
        number: Of the recipe.
        layout: Of the recipe.
        values: In the recipe's order.

    Returns:
        The packet.
    """
    flat: list[int | float] = []
    for value in values:
        flat.extend([value] if isinstance(value, int | float) else value)
    return packet(DATA, layout.pack(number, *flat))


def decode(body: bytes, recipes: Mapping[int, Recipe]) -> dict[str, Value]:
    """Read the body of a data packet.

    Args:
        body: The number of a recipe, and values.
        recipes: By number.

    Returns:
        Values by name.

    Raises:
        ValueError: The recipe or the size is not as agreed.
    """
    if not body or body[0] not in recipes:
        raise ValueError("a data packet names no agreed recipe")
    wanted = recipes[body[0]]
    if len(body) != wanted.layout.size:
        raise ValueError(f"a data packet of recipe {body[0]} must have {wanted.layout.size} bytes, not {len(body)}")
    flat, found = list(wanted.layout.unpack(body)[1:]), {}
    for name, kind in zip(wanted.names, wanted.types, strict=True):
        found[name] = flat[:6] if kind == "VECTOR6D" else flat[0]
        del flat[: 6 if kind == "VECTOR6D" else 1]
    return found
