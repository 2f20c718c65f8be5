"""Text and numbers in mesh files, and the errors that their readers raise."""

import codecs
import re
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from i2t.errors import DataError

TRAILING_PADDING = b"\0\n\r\t \x1a"  # meaningless bytes that programs append to mesh files


def unreadable_file(path: Path, reason: str, remedy: str) -> DataError:
    """Make the error for a file that does not follow its format.

    Args:
        path: The file's path, whose suffix names the format.
        reason: What is wrong with the file.
        remedy: What the user can do about it.

    Returns:
        The error, for the caller to raise.
    """
    return DataError(f"{path}: cannot be read as {path.suffix[1:].upper()} ({reason}); {remedy}")


def truncated_file(path: Path, announced: str, present: int | str) -> DataError:
    """Make the error for a file that ends too early.

    Args:
        path: The file's path, whose suffix names the format.
        announced: What the header announces.
        present: How much of it the file holds.

    Returns:
        The error, for the caller to raise.
    """
    reason = f"it is cut off: its header announces {announced}, but only {present} are present"
    return unreadable_file(path, reason, "export or copy it again")


def plain_text(path: Path, data: bytes) -> bytes:
    """Normalise the line ends and spaces of a text mesh file.

    Args:
        path: The file's path, for messages.
        data: The file's bytes in UTF-8, UTF-16 or any encoding that extends ASCII.

    Returns:
        The text with line feeds between lines and spaces between words.

    Raises:
        DataError: The file is binary.
    """
    data = to_utf8(data).rstrip(b"\x1a")  # marks the end of a file in DOS
    if b"\0" in data:
        raise unreadable_file(path, "it is not text", "export it again, or check its ending")
    return data.replace(b"\r\n", b"\n").replace(b"\r", b"\n").replace(b"\t", b" ")


def to_utf8(data: bytes) -> bytes:
    """Decode UTF-16 and drop byte order marks.

    Args:
        data: The bytes of a text, with or without a byte order mark.

    Returns:
        The text without a byte order mark, in UTF-8 if it was UTF-16.
    """
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return data.decode("utf-16", "replace").encode()
    return data.removeprefix(codecs.BOM_UTF8)


def number_rows(path: Path, rows: Sequence[bytes], dtype: type = np.float64) -> tuple[NDArray, NDArray]:
    """Parse rows of numbers of varying length.

    Args:
        path: The file's path, for messages.
        rows: Lines of numbers.
        dtype: The type of the numbers: `float64` or `int64`.

    Returns:
        All numbers, row after row, and the count of numbers in each row.

    Raises:
        DataError: A word is not a number.
    """
    counts = np.fromiter((len(row.split()) for row in rows), np.int64, len(rows))
    return parse_numbers(path, b" ".join(rows), int(counts.sum()), dtype), counts


def parse_numbers(path: Path, text: bytes, count: int, dtype: type = np.float64) -> NDArray:
    """Parse numbers separated by spaces.

    Args:
        path: The file's path, for messages.
        text: The words that represent the numbers.
        count: The number of words.
        dtype: The type of the numbers: `float64` or `int64`.

    Returns:
        `(count,)` numbers in the order of the text.

    Raises:
        DataError: A word is not a number.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)  # NumPy warns about a word that is not a number
        try:
            values: NDArray = np.fromstring(text, dtype, sep=" ")
        except (DeprecationWarning, ValueError):
            values = np.array([], dtype)
    if len(values) == count:
        return values
    return np.array([_number(path, word, dtype) for word in text.split()], dtype)


def _number(path: Path, word: bytes, dtype: type) -> int | float:
    try:
        return int(word) if dtype is np.int64 else float(word)
    except ValueError:
        pass
    if dtype is np.float64 and re.fullmatch(rb"[-+]?(1\.#(qnan|snan|ind|inf)\d*|nan\(.*\))", word, re.IGNORECASE):
        return np.nan  # Windows writes NaN and infinity like this
    shown = word[:40].decode("utf-8", "replace")
    if dtype is np.float64 and re.fullmatch(rb"[-+]?[\d.]*,\d+(e[-+]?\d+)?", word, re.IGNORECASE):
        raise DataError(
            f"{path}: its numbers have decimal commas ({shown}); export it with decimal points, as the format has them"
        )
    raise DataError(f"{path}: has {shown!r} where a number belongs; export it again")


def ranges(starts: NDArray, counts: NDArray) -> NDArray:
    """Concatenate integer ranges.

    Args:
        starts: `(n,)` first integer of each range.
        counts: `(n,)` length of each range.

    Returns:
        `(sum of counts,)` integers start, start + 1, ... of each range, range after range.
    """
    before = np.cumsum(counts) - counts
    return np.repeat(starts - before, counts) + np.arange(counts.sum())
