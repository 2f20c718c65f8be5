"""Files of recordings: texts and tables of numbers, plain or gzip-ed, whose damage is told in one sentence."""

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
    """The error about a file that is not as its author wrote it.

    Args:
        path: Of the file.
        problem: What is wrong with it.

    Returns:
        The error, with one sentence.
    """
    return DataError(f"{path}: {problem}; restore it from the source")


@contextmanager
def os_errors_as_data_errors(path: Path) -> Iterator[None]:
    """Turn errors of the system while a file is read into errors that name the file.

    Args:
        path: The file that is read in the block.

    Yields:
        Nothing.

    Raises:
        DataError: The block raised an OSError.
    """
    try:
        yield
    except OSError as error:
        raise data_error(path, f"cannot be read ({error.strerror or error})") from error


def read_bytes(path: Path) -> bytes:
    """The contents of a file, unzipped where it is a gzip archive.

    Args:
        path: Of the file.

    Returns:
        The contents.

    Raises:
        DataError: It cannot be read.
    """
    with os_errors_as_data_errors(path):
        raw = read_file(path)
    return unpacked(path, raw) if raw.startswith(GZIP_MARK) else raw


def read_text(path: Path) -> str:
    """The contents of a text file, unzipped as by `read_bytes`.

    Args:
        path: Of the file.

    Returns:
        The text.

    Raises:
        DataError: It cannot be read, is of another kind, or is not text.
    """
    return decoded(path, read_bytes(path))


def read_numbers(path: Path, columns: tuple[int, ...]) -> np.ndarray:
    """A comma-separated table of numbers without a header.

    Args:
        path: Of the file.
        columns: How many columns it may have.

    Returns:
        (rows, columns) float64.

    Raises:
        DataError: It cannot be read, or is no such table.
    """
    text = read_text(path)
    if not text.strip():
        raise data_error(path, "is empty")
    try:
        table = np.loadtxt(io.StringIO(text), delimiter=",", ndmin=2)
    except (ValueError, OverflowError) as error:
        raise data_error(path, f"is no table of numbers ({repr(str(error))[:200]})") from error
    if table.shape[1] not in columns:
        expected = " or ".join(map(str, columns))
        raise data_error(path, f"has {table.shape[1]} columns, not {expected}")
    return table
