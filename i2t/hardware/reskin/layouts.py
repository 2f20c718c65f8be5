"""Frame layouts of boards, byte by byte: five formats, read and written.

The public firmware of ReSkin and AnySkin sends temperature t (degrees Celsius) and field x, y, z (uT) of n chips, five
by default, in one of three ways, without header, counter or checksum:

    binary       n x little-endian float32 (t, x, y, z), then CR LF: 16 n + 2 bytes
    text         n x "x\\ty\\tz\\tt\\t", two decimals, then CR LF (ReSkin)
    text-glued   n x "t\\tx\\ty\\tz" with nothing between chips, two decimals, then CR LF (AnySkin)

That of eFlesh boards (github Jnkdog-debug/eflesh-touch) sends the field alone, in one of two:

    framed       AA 55, a counter (uint8), n x little-endian float32 (x, y, z), the exclusive or of all bytes after
                 AA 55: 12 n + 4 bytes, at 921600 baud
    framed-text  "FRAME: [S1:x,y,z] [S2:x,y,z] ...", one decimal, then CR LF or LF, at 115200 baud

A chip that fails sends exact zeros there, or "[S2:ERR]". No field is exactly zero on three axes at once, so such a chip
is *missing*, in all five formats: its values are NaN, never zero.
"""

import re
import struct
from enum import StrEnum
from functools import lru_cache, reduce
from operator import xor
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from i2t.skin import boards

DEFAULT_CHIPS = len(boards.reskin_board().chips)
VALUE_TEXT_BYTES = 20  # of a number in a line with its separator; it has at most 9 characters
LINE_END = b"\r\n"
HEADER = b"\xaa\x55"
COUNTS = 256  # of the counter of framed bytes
CONVERTER_COUNTS = 2**16  # of a chip's converter, which begins again at its other end

_NUMBER, _TENTHS = rb"(-?\d{1,6}\.\d\d)", rb"-?\d{1,6}\.\d"


class Format(StrEnum):
    """Formats of boards' frames."""

    BINARY = "binary"
    TEXT = "text"
    TEXT_GLUED = "text-glued"
    FRAMED = "framed"
    FRAMED_TEXT = "framed-text"


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
        """Bytes of a frame, approximately where it is text."""
        return _packed(self.checked, self.chips).size

    @property
    def checked(self) -> bool:
        """Tell whether a frame has a counter and a checksum."""
        return self.form == Format.FRAMED

    @property
    def is_text(self) -> bool:
        """Tell whether a frame is a line."""
        return self.form not in (Format.BINARY, Format.FRAMED)

    @property
    def has_temperature(self) -> bool:
        """Tell whether the board sends its chips' temperatures."""
        return self.form not in (Format.FRAMED, Format.FRAMED_TEXT)


def window(layout: FrameLayout, data: bytes, search: int) -> tuple[int, int | None]:
    """The next stretch that may be a frame. A stretch of text begins with the line feed of the line before it.

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
    if layout.checked:
        begin = data.find(HEADER, search)
        if begin < 0:
            return max(search, len(data) - data.endswith(HEADER[:1])), None
        return begin, begin + size if begin + size <= len(data) else None
    longest = VALUE_TEXT_BYTES * 4 * layout.chips
    while (begin := data.find(b"\n", search)) >= 0:
        end = data.find(b"\n", begin + 1, begin + longest)
        if end >= 0:
            return begin, end
        if len(data) < begin + longest:
            return begin, None
        search = begin + 1
    return len(data), None


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
    if layout.checked:
        header, count, *numbers, check = _packed(True, chips).unpack(stretch)
        if header != HEADER or check != checksum(stretch[len(HEADER) : -1]):
            return None
        return FrameValues(_without_temperature(numbers), count)
    line = _line(layout.form, chips).fullmatch(stretch)
    if line is None:
        return None
    if layout.form == Format.FRAMED_TEXT:
        shown = b",".join(b"0,0,0" if chip == b"ERR" else chip for chip in line.groups())
        return FrameValues(_without_temperature([float(number) for number in shown.split(b",")]))
    table = np.array([float(number) for number in line.groups()]).reshape(chips, 4)
    return FrameValues(np.roll(table, 1, axis=1) if layout.form == Format.TEXT else table)


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
        temperature: (chips,) degrees Celsius; framed formats leave it out.
        form: Which firmware the board has.
        count: Number of the frame, for a format that counts.

    Returns:
        The frame's bytes, with its line end.
    """
    chips = len(temperature)
    field = reading.reshape(chips, 3)
    field = np.where(np.isnan(field).all(1, keepdims=True), 0.0, field)
    rows = np.column_stack([temperature, field])
    if form == Format.FRAMED:
        content = struct.pack(f"<B{3 * chips}f", count % COUNTS, *field.ravel())
        return HEADER + content + bytes([checksum(content)])
    if form == Format.FRAMED_TEXT:
        shown = [b"%.1f,%.1f,%.1f" % tuple(chip) if chip.any() else b"ERR" for chip in field]
        return b"FRAME: " + b" ".join(b"[S%d:%s]" % (i + 1, chip) for i, chip in enumerate(shown)) + LINE_END
    if form == Format.BINARY:
        return _packed(False, chips).pack(*rows.ravel(), LINE_END)
    if form == Format.TEXT:
        return b"".join(b"%.2f\t" % value for value in np.roll(rows, -1, axis=1).ravel()) + LINE_END
    return b"".join(b"\t".join(b"%.2f" % value for value in chip) for chip in rows) + LINE_END


@lru_cache
def _packed(checked: bool, chips: int) -> struct.Struct:
    return struct.Struct(f"<2sB{3 * chips}fB" if checked else f"<{4 * chips}f2s")


@lru_cache
def _line(form: Format, chips: int) -> re.Pattern[bytes]:
    if form == Format.FRAMED_TEXT:
        each = [rb"\[S%d:(%b|ERR)\]" % (i + 1, b",".join([_TENTHS] * 3)) for i in range(chips)]
        return re.compile(b"\nFRAME: " + b" ".join(each) + rb" ?\r?")
    numbers = rb"\t".join([_NUMBER] * (4 * chips)) if form == Format.TEXT else rb"\t".join([_NUMBER] * 4) * chips
    return re.compile(b"\n" + numbers + rb"\t?\r?")


def _without_temperature(fields: list[float]) -> Float[np.ndarray, "chips 4"]:
    return np.column_stack([np.zeros(len(fields) // 3), np.reshape(fields, (-1, 3))])
