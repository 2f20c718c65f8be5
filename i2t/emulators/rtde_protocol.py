"""RTDE, the protocol by which a UR controller streams its state and takes registers, seen from the controller's side.

A packet is a big-endian uint16 size (with header), one byte of type, and a body. The client agrees on the protocol,
names the outputs it wants and the inputs it will write, each a *recipe* with a number, and starts the stream; from then
on data packets with values in the recipe's order go both ways. Everything here is a pure function of bytes.

Source: Universal Robots, "Real-Time Data Exchange (RTDE) guide", protocol version 2.
"""

import struct
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple, TypeAlias

Value: TypeAlias = int | float | Sequence[int | float]

PACKET_HEADER = struct.Struct(">HB")
PROTOCOL, VERSION, MESSAGE, DATA, OUTPUTS, INPUTS, START, PAUSE = b"VvMUOISP"

FORMATS = {
    "BOOL": "?",
    "UINT8": "B",
    "UINT32": "I",
    "UINT64": "Q",
    "INT32": "i",
    "DOUBLE": "d",
    "VECTOR3D": "3d",
    "VECTOR6D": "6d",
    "VECTOR6INT32": "6i",
}


def _table(**names: str) -> dict[str, str]:
    return {name: kind for kind, listed in names.items() for name in listed.split()}


OUTPUT_TYPES = _table(
    DOUBLE="timestamp actual_execution_time speed_scaling target_speed_fraction actual_momentum actual_main_voltage "
    "actual_robot_voltage actual_robot_current standard_analog_input0 standard_analog_input1 standard_analog_output0 "
    "standard_analog_output1 payload " + " ".join(f"output_double_register_{i}" for i in range(48)),
    VECTOR6D="target_q target_qd target_qdd target_current target_moment actual_q actual_qd actual_current "
    "joint_control_output actual_TCP_pose actual_TCP_speed actual_TCP_force target_TCP_pose target_TCP_speed "
    "joint_temperatures actual_joint_voltage ft_raw_wrench payload_inertia",
    VECTOR3D="actual_tool_accelerometer payload_cog",
    VECTOR6INT32="joint_mode",
    INT32="robot_mode safety_mode " + " ".join(f"output_int_register_{i}" for i in range(48)),
    UINT32="runtime_state robot_status_bits safety_status_bits output_bit_registers0_to_31 "
    "output_bit_registers32_to_63",
    UINT64="actual_digital_input_bits actual_digital_output_bits",
)
INPUT_TYPES = _table(
    DOUBLE="speed_slider_fraction standard_analog_output_0 standard_analog_output_1 "
    + " ".join(f"input_double_register_{i}" for i in range(48)),
    INT32=" ".join(f"input_int_register_{i}" for i in range(48)),
    UINT32="speed_slider_mask input_bit_registers0_to_31 input_bit_registers32_to_63",
    UINT8="standard_digital_output_mask standard_digital_output configurable_digital_output_mask "
    "configurable_digital_output tool_digital_output_mask tool_digital_output standard_analog_output_mask "
    "standard_analog_output_type",
    VECTOR6D="external_force_torque",
)


class Recipe(NamedTuple):
    """Names of the values in a data packet, in order, and how they are laid out behind the recipe's number."""

    names: tuple[str, ...]
    types: tuple[str, ...]

    @property
    def known(self) -> bool:
        """Tell whether every name exists on this controller."""
        return "NOT_FOUND" not in self.types

    @property
    def layout(self) -> struct.Struct:
        """Big-endian layout of the number and the values."""
        return struct.Struct(">B" + "".join(FORMATS[kind] for kind in self.types))


def recipe(names: str, table: Mapping[str, str]) -> Recipe:
    """Look up the types of a recipe.

    Args:
        names: Separated by commas, maybe with one at the end.
        table: Type of each name that the controller knows.

    Returns:
        The recipe; an unknown name has type NOT_FOUND.
    """
    listed = tuple(name.strip() for name in names.split(",") if name.strip())
    return Recipe(listed, tuple(table.get(name, "NOT_FOUND") for name in listed))


def packet(kind: int, body: bytes = b"") -> bytes:
    """Put a header before a body.

    Args:
        kind: Type of the packet.
        body: Its contents.

    Returns:
        The packet.
    """
    return PACKET_HEADER.pack(PACKET_HEADER.size + len(body), kind) + body


def split(buffer: bytes) -> tuple[list[tuple[int, bytes]], bytes]:
    """Split a byte stream into packets.

    Args:
        buffer: Bytes that have come and were not used.

    Returns:
        (type, body) of each whole packet, and the bytes that are left over.

    Raises:
        ValueError: A header says a size that cannot be.
    """
    packets, start = [], 0
    while len(buffer) - start >= PACKET_HEADER.size:
        size, kind = PACKET_HEADER.unpack_from(buffer, start)
        if size < PACKET_HEADER.size:
            raise ValueError(f"an RTDE packet cannot be {size} bytes long")
        if len(buffer) - start < size:
            break
        packets.append((kind, buffer[start + PACKET_HEADER.size : start + size]))
        start += size
    return packets, buffer[start:]


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
        if isinstance(value, int | float):
            flat.append(value)
        else:
            flat.extend(value)
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
    flat = wanted.layout.unpack(body)[1:]
    found: dict[str, Value] = {}
    at = 0
    for name, kind in zip(wanted.names, wanted.types, strict=True):
        count = int(FORMATS[kind][:-1] or 1)
        found[name] = flat[at] if count == 1 else flat[at : at + count]
        at += count
    return found
