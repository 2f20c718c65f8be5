"""Frame layouts of boards, byte by byte: three formats, read and written.

The public firmware of ReSkin and AnySkin sends temperature t (degrees Celsius) and field x, y, z (uT) of n chips, five
by default, without header, counter or checksum; that of eFlesh boards (github Jnkdog-debug/eflesh-touch) sends the
field alone, with them; our own sketch (examples/firmware/skin_crc) has all of it:

    binary  n x little-endian float32 (t, x, y, z), then CR LF: 16 n + 2 bytes
    framed  AA 55, a counter (uint8), n x little-endian float32 (x, y, z), the exclusive or of all bytes after AA 55:
            12 n + 4 bytes, at 921600 baud
    crc     A5 5A, a counter (uint8), n x little-endian float32 (t, x, y, z), the CRC-32 (zlib's, little-endian) of all
            bytes after A5 5A: 16 n + 7 bytes

Two flipped bits of the same place in their bytes pass an exclusive or; a CRC-32 lets one damaged frame in 4e9 pass.

Sketches that print lines of text for a terminal are not read; flash one of these.

A chip that fails sends exact zeros. No field is exactly zero on three axes at once, so such a chip is *missing*, in
every format: its values are NaN, never zero.
"""

import struct
import zlib
from collections.abc import Callable
from enum import StrEnum
from functools import lru_cache, reduce
from operator import xor
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from i2t.skin import boards

DEFAULT_CHIPS = len(boards.reskin_board().chips)
LINE_END = b"\r\n"
COUNTS = 256  # of the counter of checked frames
CONVERTER_COUNTS = 2**16  # of a chip's converter, which begins again at its other end


class Format(StrEnum):
    """Formats of boards' frames."""

    BINARY = "binary"
    FRAMED = "framed"
    CRC = "crc"


class _Checked(NamedTuple):
    """Look of the frames of a format that has a header, a counter and a check."""

    header: bytes
    columns: int  # values of a chip, the last of t, x, y, z
    check: Callable[[bytes], int]  # of all bytes between header and check
    check_type: str  # as `struct` names it


_CHECKED = {
    Format.FRAMED: _Checked(b"\xaa\x55", 3, lambda content: reduce(xor, content, 0), "B"),
    Format.CRC: _Checked(b"\xa5\x5a", 4, zlib.crc32, "I"),
}


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
        return _packed(self.form, self.chips).size

    @property
    def checked(self) -> bool:
        """Tell whether a frame has a counter and a checksum."""
        return self.form in _CHECKED

    @property
    def warm(self) -> bool:
        """Tell whether a frame has temperatures."""
        return self.form != Format.FRAMED


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
    header = _CHECKED[layout.form].header
    begin = data.find(header, search)
    if begin < 0:
        return max(search, len(data) - data.endswith(header[:1])), None
    return begin, begin + size if begin + size <= len(data) else None


def parse(layout: FrameLayout, stretch: bytes) -> FrameValues | None:
    """Parse a stretch, whether or not its values are plausible.

    Args:
        layout: How frames look.
        stretch: As `window` found it.

    Returns:
        Its values; None if it has not the form of a frame, or its checksum does not fit.
    """
    form, chips = layout.form, layout.chips
    if form == Format.BINARY:
        *numbers, end = _packed(form, chips).unpack(stretch)
        return FrameValues(np.array(numbers).reshape(chips, 4)) if end == LINE_END else None
    header, columns, check, check_type = _CHECKED[form]
    begins, count, *numbers, said = _packed(form, chips).unpack(stretch)
    if begins != header or said != check(stretch[len(header) : -struct.calcsize(check_type)]):
        return None
    table = np.zeros((chips, 4))
    table[:, -columns:] = np.reshape(numbers, (chips, columns))
    return FrameValues(table, count)


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
    table = np.column_stack([temperature, field])
    if form == Format.BINARY:
        return _packed(form, chips).pack(*table.ravel(), LINE_END)
    header, columns, check, check_type = _CHECKED[form]
    content = struct.pack(f"<B{columns * chips}f", count % COUNTS, *table[:, -columns:].ravel())
    return header + content + struct.pack(f"<{check_type}", check(content))


@lru_cache
def _packed(form: Format, chips: int) -> struct.Struct:
    if form == Format.BINARY:
        return struct.Struct(f"<{4 * chips}f2s")
    look = _CHECKED[form]
    return struct.Struct(f"<2sB{look.columns * chips}f{look.check_type}")
