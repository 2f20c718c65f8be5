"""Frame layouts of boards, byte by byte: two formats, read and written.

The public firmware of ReSkin and AnySkin sends temperature t (degrees Celsius) and field x, y, z (uT) of n chips, five
by default, without header, counter or checksum; that of eFlesh boards (github Jnkdog-debug/eflesh-touch) sends the
field alone, with them:

    binary  n x little-endian float32 (t, x, y, z), then CR LF: 16 n + 2 bytes
    framed  AA 55, a counter (uint8), n x little-endian float32 (x, y, z), the exclusive or of all bytes after AA 55:
            12 n + 4 bytes, at 921600 baud

Sketches that print lines of text for a terminal are not read; flash the binary one.

A chip that fails sends exact zeros. No field is exactly zero on three axes at once, so such a chip is *missing*, in
both formats: its values are NaN, never zero.
"""

import struct
from enum import StrEnum
from functools import lru_cache, reduce
from operator import xor
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from i2t.skin import boards

DEFAULT_CHIPS = len(boards.reskin_board().chips)
LINE_END = b"\r\n"
HEADER = b"\xaa\x55"
COUNTS = 256  # of the counter of framed bytes
CONVERTER_COUNTS = 2**16  # of a chip's converter, which begins again at its other end


class Format(StrEnum):
    """Formats of boards' frames."""

    BINARY = "binary"
    FRAMED = "framed"


class FrameValues(NamedTuple):
    """Values of a stretch of bytes."""

    table: Float[np.ndarray, "chips 4"]  # t, x, y, z: degrees Celsius and uT; 0 where there is none
    sequence: int | None = None  # of the frame's counter


class FrameLayout(NamedTuple):
    """Layout of a board's frames."""

    form: Format = Format.BINARY
    chips: int = DEFAULT_CHIPS

    @property
    def size(self) -> int:
        """Bytes of a frame."""
        return _packed(self.checked, self.chips).size

    @property
    def checked(self) -> bool:
        """Tell whether a frame has a counter and a checksum."""
        return self.form == Format.FRAMED


def window(layout: FrameLayout, data: bytes, search: int) -> tuple[int, int | None]:
    """The next stretch that may be a frame.

    Args:
        layout: How frames look.
        data: Bytes of the stream.
        search: From where to look.

    Returns:
        Its first byte and its end; or where to look again when more bytes have come, and None.
    """
    size = layout.size
    if layout.form == Format.BINARY:
        found = data.find(LINE_END, search + size - len(LINE_END))
        if found < 0:
            return max(search, len(data) - size + 1), None
        return found + len(LINE_END) - size, found + len(LINE_END)
    begin = data.find(HEADER, search)
    if begin < 0:
        return max(search, len(data) - data.endswith(HEADER[:1])), None
    return begin, begin + size if begin + size <= len(data) else None


def parse(layout: FrameLayout, stretch: bytes) -> FrameValues | None:
    """Parse a stretch, whether or not its values are plausible.

    Args:
        layout: How frames look.
        stretch: As `window` found it.

    Returns:
        Its values; None if it has not the form of a frame, or its checksum does not fit.
    """
    chips = layout.chips
    if layout.form == Format.BINARY:
        *numbers, end = _packed(False, chips).unpack(stretch)
        return FrameValues(np.array(numbers).reshape(chips, 4)) if end == LINE_END else None
    header, count, *numbers, check = _packed(True, chips).unpack(stretch)
    if header != HEADER or check != checksum(stretch[len(HEADER) : -1]):
        return None
    return FrameValues(np.column_stack([np.zeros(chips), np.reshape(numbers, (chips, 3))]), count)


def checksum(content: bytes) -> int:
    """The exclusive or of bytes.

    Args:
        content: Of a framed frame, from its counter to its last value.

    Returns:
        0 to 255.
    """
    return reduce(xor, content, 0)


def encode(
    reading: Float[np.ndarray, " c"],
    temperature: Float[np.ndarray, " chips"],
    form: Format = Format.BINARY,
    count: int = 0,
) -> bytes:
    """A frame as a board sends it.

    Args:
        reading: (3 chips,) uT, in the board's order; a chip that fails is NaN, or zero.
        temperature: (chips,) degrees Celsius; a framed frame leaves it out.
        form: Which firmware the board has.
        count: Number of the frame, for a format that counts.

    Returns:
        The frame's bytes.
    """
    chips = len(temperature)
    field = reading.reshape(chips, 3)
    field = np.where(np.isnan(field).all(1, keepdims=True), 0.0, field)
    if form == Format.BINARY:
        return _packed(False, chips).pack(*np.column_stack([temperature, field]).ravel(), LINE_END)
    content = struct.pack(f"<B{3 * chips}f", count % COUNTS, *field.ravel())
    return HEADER + content + bytes([checksum(content)])


@lru_cache
def _packed(checked: bool, chips: int) -> struct.Struct:
    return struct.Struct(f"<2sB{3 * chips}fB" if checked else f"<{4 * chips}f2s")
