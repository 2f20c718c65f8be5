"""Frame layouts of boards, byte by byte: three formats, for reading and writing.

The public firmware of ReSkin and AnySkin sends temperature t (degrees Celsius) and field x, y, z (uT) of n chips, five
by default, without header, counter or checksum. The firmware of eFlesh boards (github Jnkdog-debug/eflesh-touch) sends
the field without the temperature, but with header, counter and checksum. Our own sketch (examples/firmware/skin_crc)
sends everything:

    binary  n x little-endian float32 (t, x, y, z), then CR LF: 16 n + 2 bytes
    framed  AA 55, a counter (uint8), n x little-endian float32 (x, y, z), the exclusive or of all bytes after AA 55:
            12 n + 4 bytes, at 921600 baud
    crc     A5 5A, a counter (uint8), n x little-endian float32 (t, x, y, z), the CRC-32 (zlib's, little-endian) of all
            bytes after A5 5A: 16 n + 7 bytes

Two flipped bits at the same place of their bytes pass an exclusive or; a CRC-32 passes one damaged frame in 4e9.

Sketches that print lines of text for a terminal are not supported; flash one of these.

A chip that fails sends exact zeros. No field is exactly zero on three axes at once, so such a chip is *missing* in
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

# number of chips on the ReSkin board, which is assumed if none is stated
DEFAULT_CHIPS = len(boards.reskin_board().chips)
LINE_END = b"\r\n"  # bytes that end a frame in formats without a checksum
COUNTER_SIZE = 256  # number of values after which the frame counter restarts


class Format(StrEnum):
    """Formats in which boards' firmware sends frames: bare values, or with header, counter and checksum."""

    BINARY = "binary"
    FRAMED = "framed"
    CRC = "crc"


class _Checked(NamedTuple):
    """Layout of a format with a header, a counter and a checksum."""

    header: bytes
    columns: int  # number of values of a chip: the last ones of t, x, y, z
    checksum: Callable[[bytes], int]  # function that computes the checksum of the bytes between header and checksum
    checksum_type: str  # format character of the checksum in `struct`


# Layouts of the formats that have a checksum: header, number of values of a chip (the last ones of temperature, x, y
# and z), function that computes the checksum, and the checksum's type in `struct`.
CHECKED_FORMATS = {
    Format.FRAMED: _Checked(b"\xaa\x55", 3, lambda content: reduce(xor, content, 0), "B"),
    Format.CRC: _Checked(b"\xa5\x5a", 4, zlib.crc32, "I"),
}


class FrameValues(NamedTuple):
    """Values parsed from a frame: temperature (degrees Celsius) and field (uT) of each chip, and the counter."""

    # (chips, 4) t, x, y, z in degrees Celsius and uT; 0 for a value that is not sent
    table: Float[np.ndarray, "chips 4"]
    sequence: int | None = None  # value of the frame's counter


class FrameLayout(NamedTuple):
    """Layout of the frames that a board sends: their format and number of chips."""

    form: Format = Format.BINARY
    chips: int = DEFAULT_CHIPS

    @property
    def size(self) -> int:
        """Number of bytes of a frame."""
        return _packed(self.form, self.chips).size

    @property
    def checked(self) -> bool:
        """Whether frames of this format have a counter and a checksum."""
        return self.form in CHECKED_FORMATS

    @property
    def has_temperature(self) -> bool:
        """Whether frames of this format hold the chips' temperatures."""
        return self.form != Format.FRAMED


def window(layout: FrameLayout, data: bytes, search: int) -> tuple[int, int | None]:
    """Find the next stretch of a board's bytes that may be a frame.

    Args:
        layout: Layout of the frames.
        data: Bytes of the stream.
        search: Position at which the search starts.

    Returns:
        The begin and the end of the stretch; or the position from which to search when more bytes have arrived, and
        None.
    """
    size = layout.size
    if layout.form == Format.BINARY:
        line_end = data.find(LINE_END, search + size - len(LINE_END))
        if line_end < 0:
            return max(search, len(data) - size + 1), None
        return line_end + len(LINE_END) - size, line_end + len(LINE_END)
    header = CHECKED_FORMATS[layout.form].header
    begin = data.find(header, search)
    if begin < 0:
        return max(search, len(data) - data.endswith(header[:1])), None
    return begin, begin + size if begin + size <= len(data) else None


def parse(layout: FrameLayout, stretch: bytes) -> FrameValues | None:
    """Parse a stretch of bytes as a frame, whether or not its values are plausible.

    Args:
        layout: Layout of the frames.
        stretch: Bytes as `window` delimits them.

    Returns:
        The values of the frame; None if the bytes do not have the form of a frame, or the checksum does not match.
    """
    form, chips = layout.form, layout.chips
    if form == Format.BINARY:
        *numbers, end = _packed(form, chips).unpack(stretch)
        return FrameValues(np.array(numbers).reshape(chips, 4)) if end == LINE_END else None
    header, columns, checksum, checksum_type = CHECKED_FORMATS[form]
    start, count, *numbers, sent_checksum = _packed(form, chips).unpack(stretch)
    if start != header or sent_checksum != checksum(stretch[len(header) : -struct.calcsize(checksum_type)]):
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
    """Encode a sample as the frame that a board sends.

    Args:
        reading: (3 chips,) values in uT, in the board's order; a chip that fails is NaN, or zero.
        temperature: (chips,) temperatures in degrees Celsius; the framed format leaves them out.
        form: Format of the firmware.
        count: Number of the frame, for a format with a counter.

    Returns:
        The bytes of the frame.
    """
    chips = len(temperature)
    field = reading.reshape(chips, 3)
    field = np.where(np.isnan(field).all(1, keepdims=True), 0.0, field)
    table = np.column_stack([temperature, field])
    if form == Format.BINARY:
        return _packed(form, chips).pack(*table.ravel(), LINE_END)
    header, columns, checksum, checksum_type = CHECKED_FORMATS[form]
    content = struct.pack(f"<B{columns * chips}f", count % COUNTER_SIZE, *table[:, -columns:].ravel())
    return header + content + struct.pack(f"<{checksum_type}", checksum(content))


@lru_cache
def _packed(form: Format, chips: int) -> struct.Struct:
    if form == Format.BINARY:
        return struct.Struct(f"<{4 * chips}f2s")
    layout = CHECKED_FORMATS[form]
    return struct.Struct(f"<2sB{layout.columns * chips}f{layout.checksum_type}")
