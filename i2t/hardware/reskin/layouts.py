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

_NUMBER = rb"(-?\d{1,6}\.\d\d)"
_TENTHS = rb"-?\d{1,6}\.\d"
_LINE_BEGIN = rb"(?:\n|\r[^\r\n0-9.\-]?)?"  # the end of the line before, of which the line feed may be lost or changed


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
    def binary(self) -> struct.Struct:
        """The values and the end of a binary frame."""
        return _binary(self.chips)

    @property
    def framed(self) -> struct.Struct:
        """Header, counter, values and checksum of a framed one."""
        return _framed(self.chips)

    @property
    def size(self) -> int:
        """Bytes of a frame, approximately where it is text."""
        return (self.framed if self.checked else self.binary).size

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

    @property
    def line(self) -> re.Pattern[bytes]:
        """A line of text, from the end of the line before to its own carriage return."""
        return _line(self.form, self.chips)

    @property
    def max_line_bytes(self) -> int:
        """Greatest length of a line (bytes)."""
        return VALUE_TEXT_BYTES * 4 * self.chips


def window(layout: FrameLayout, data: bytes, search: int) -> tuple[int, int | None]:
    """The next stretch that may be a frame. A stretch of text begins with the end of the line before it.

    Args:
        layout: How frames look.
        data: Bytes of the stream.
        search: From where to look.

    Returns:
        Its first byte and its end; or where to look again when more bytes have come, and None.
    """
    if layout.form == Format.BINARY:
        size = layout.binary.size
        found = data.find(LINE_END, search + size - len(LINE_END))
        if found < 0:
            return max(search, len(data) - size + 1), None
        return found + len(LINE_END) - size, found + len(LINE_END)
    if layout.checked:
        begin = data.find(HEADER, search)
        if begin < 0:
            return max(search, len(data) - data.endswith(HEADER[:1])), None
        end = begin + layout.framed.size
        return begin, end if end <= len(data) else None
    while (begin := data.find(b"\n", search)) >= 0:
        end = data.find(b"\n", begin + 1, begin + layout.max_line_bytes)
        if end >= 0:
            # Where a line feed was lost, the carriage return before it is still there.
            return max(begin, data.rfind(b"\r", begin, end - 1)), end
        if len(data) < begin + layout.max_line_bytes:
            return begin, None
        search = begin + 1
    return len(data), None


def adjoining(layout: FrameLayout, data: bytes, end: int) -> int | None:
    """End of the stretch that begins at `end`.

    Args:
        layout: How frames look.
        data: Bytes of the stream.
        end: Of the stretch before.

    Returns:
        Its end; `end` if there is none, None if more bytes must come.
    """
    if not layout.is_text:
        following = end + layout.size
        return following if len(data) >= following else None
    found = data.find(b"\n", end + 1, end + layout.max_line_bytes)
    if found >= 0:
        return found
    return end if len(data) >= end + layout.max_line_bytes else None


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
        *numbers, end = layout.binary.unpack(stretch)
        return FrameValues(np.array(numbers).reshape(chips, 4)) if end == LINE_END else None
    if layout.form == Format.FRAMED:
        if len(stretch) != layout.framed.size:
            return None
        header, count, *numbers, check = layout.framed.unpack(stretch)
        if header != HEADER or check != checksum(stretch[len(HEADER) : -1]):
            return None
        return FrameValues(_without_temperature(np.array(numbers)), count)
    line = layout.line.fullmatch(stretch)
    if line is None:
        return None
    if layout.form == Format.FRAMED_TEXT:
        shown = [b"0,0,0" if chip == b"ERR" else chip for chip in line.groups()]
        return FrameValues(_without_temperature(np.array([float(x) for chip in shown for x in chip.split(b",")])))
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
    if form == Format.FRAMED:
        content = struct.pack(f"<B{3 * chips}f", count % COUNTS, *field.ravel())
        return HEADER + content + bytes([checksum(content)])
    if form == Format.FRAMED_TEXT:
        shown = [b"%.1f,%.1f,%.1f" % tuple(chip) if chip.any() else b"ERR" for chip in field]
        return b"FRAME: " + b" ".join(b"[S%d:%s]" % (i + 1, chip) for i, chip in enumerate(shown)) + LINE_END
    if form == Format.BINARY:
        return _binary(chips).pack(*np.column_stack([temperature, field]).ravel(), LINE_END)
    if form == Format.TEXT:
        return b"".join(b"%.2f\t" % value for value in np.column_stack([field, temperature]).ravel()) + LINE_END
    rows = np.column_stack([temperature, field])
    return b"".join(b"\t".join(b"%.2f" % value for value in chip) for chip in rows) + LINE_END


def numbers_in(line: bytes) -> int:
    """Count the numbers of two decimals in a line.

    Args:
        line: Of text.

    Returns:
        Their count.
    """
    return len(re.findall(_NUMBER, line))


@lru_cache
def _binary(chips: int) -> struct.Struct:
    return struct.Struct(f"<{4 * chips}f{len(LINE_END)}s")


@lru_cache
def _framed(chips: int) -> struct.Struct:
    return struct.Struct(f"<{len(HEADER)}sB{3 * chips}fB")


@lru_cache
def _line(form: Format, chips: int) -> re.Pattern[bytes]:
    if form == Format.FRAMED_TEXT:
        each = [rb"\[S%d:(%b|ERR)\]" % (i + 1, b",".join([_TENTHS] * 3)) for i in range(chips)]
        return re.compile(_LINE_BEGIN + rb"FRAME: " + b" ".join(each) + rb" ?\r?")
    numbers = rb"\t".join([_NUMBER] * (4 * chips)) if form == Format.TEXT else rb"\t".join([_NUMBER] * 4) * chips
    return re.compile(_LINE_BEGIN + numbers + rb"\t?\r?")


def _without_temperature(fields: Float[np.ndarray, " c"]) -> Float[np.ndarray, "chips 4"]:
    return np.column_stack([np.zeros(len(fields) // 3), fields.reshape(-1, 3)])
