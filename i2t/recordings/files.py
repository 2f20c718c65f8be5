"""Files of recordings: texts and tables of numbers, plain or gzipped. One sentence describes any damage."""

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from i2t.errors import DataError
from i2t.files.archives import unpacked
from i2t.files.kinds import GZIP_MARK, decoded
from i2t.files.reading import read_bytes as read_file


def data_error(path: Path, problem: str) -> DataError:
    """Create the error about a damaged file.

    Args:
        path: Path of the file.
        problem: What is wrong with it, as a predicate ("is empty").

    Returns:
        The error, whose message is one sentence with a remedy.
    """
    return DataError(f"{path}: {problem}; restore it from the source")


@contextmanager
def os_errors_as_data_errors(path: Path) -> Iterator[None]:
    """Convert errors of the operating system during reading to errors that name the file.

    Args:
        path: Path of the file that the block reads.

    Yields:
        Control to the block, without a value.

    Raises:
        DataError: The block raised an OSError.
    """
    try:
        yield
    except OSError as error:
        raise data_error(path, f"cannot be read ({error.strerror or error})") from error


def read_bytes(path: Path) -> bytes:
    """Read a file, and unzip it if it is a gzip archive.

    Args:
        path: Path of the file.

    Returns:
        The contents of the file, unzipped.

    Raises:
        DataError: The file cannot be read.
    """
    with os_errors_as_data_errors(path):
        raw = read_file(path)
    return unpacked(path, raw) if raw.startswith(GZIP_MARK) else raw


def read_text(path: Path) -> str:
    """Read a text file, plain or gzipped.

    Args:
        path: Path of the file.

    Returns:
        The decoded text of the file.

    Raises:
        DataError: The file cannot be read, is of another kind, or is not text.
    """
    return decoded(path, read_bytes(path))


def read_numbers(path: Path, columns: tuple[int, ...]) -> np.ndarray:
    """Read a comma-separated table of numbers without a header.

    Args:
        path: Path of the file.
        columns: Permitted numbers of columns.

    Returns:
        `(rows, columns)` numbers as float64.

    Raises:
        DataError: The file cannot be read, or is not a table of numbers with these columns.
    """
    text = read_text(path)
    if not text.strip():
        raise data_error(path, "is empty")
    try:
        table = np.loadtxt(io.StringIO(text), delimiter=",", ndmin=2)
    except (ValueError, OverflowError) as error:
        raise data_error(path, f"is not a table of numbers ({repr(str(error))[:200]})") from error
    if table.shape[1] not in columns:
        expected = " or ".join(map(str, columns))
        raise data_error(path, f"has {table.shape[1]} columns, not {expected}")
    return table
