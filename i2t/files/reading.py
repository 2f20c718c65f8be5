"""Reading of files made by others, within bounds.

A file may be a pipe that never ends, a kilobyte that unpacks to gigabytes, or a text nested so deeply that its parser
fails. The functions here read text, TOML and JSON, and refuse such files with one sentence that names the file. If a
file is missing or must not be read, they raise the system's own OSError.
"""

import codecs
import contextlib
import gzip
import io
import json
import math
import os
import re
import stat
import tomllib
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path
from typing import Any

from i2t.errors import DataError
from i2t.files.archives import max_unpacked_size, readable_size, unpacked_size_error
from i2t.files.kinds import (
    GZIP_MARK,
    MARK_OF_TOUCHES,
    MESH_SUFFIXES,
    TABLE_SUFFIXES,
    UTF_8,
    decoded,
    encoding_of,
    kind_of,
)
from i2t.files.limits import READ_LIMITS


def open_regular(path: str | Path) -> BufferedReader:
    """Open a regular file for reading, and refuse a pipe or a device, which may never end.

    Args:
        path: The file's path.

    Returns:
        The open file, to be closed by the caller.

    Raises:
        DataError: The path is a folder, a pipe or a device.
        OSError: The file is missing, or cannot be read.
    """
    # Without O_NONBLOCK, opening a pipe waits until somebody writes to it.
    descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        kind = "folder" if Path(path).is_dir() else "pipe or a device"
        raise DataError(f"{path}: is a {kind}, not a regular file; name the file itself")
    return os.fdopen(descriptor, "rb")


def explain_no_dataset(path: Path) -> str:
    """Explain why a file that was named as a data set is not one.

    Args:
        path: The path of an existing file.

    Returns:
        A sentence for the user; empty if the file begins like an HDF5 file of touches.
    """
    with open_regular(path) as file:
        if file.read(len(MARK_OF_TOUCHES)) == MARK_OF_TOUCHES:
            return ""
    if path.suffix.lower() in MESH_SUFFIXES:
        return f"{path}: is the mesh of an object, not a data set; name the folder or file of the touches"
    if path.suffix.lower() in TABLE_SUFFIXES:
        return f"{path}: is a table, not yet a data set; convert it with i2t convert"
    return f"{path}: is not a data set; name a folder or file of touches, or convert it with i2t convert"


def read_bytes(path: str | Path, max_bytes: int = READ_LIMITS.file_bytes) -> bytes:
    """Read a regular file as a whole.

    Args:
        path: The file's path.
        max_bytes: The number of bytes up to which the file is read.

    Returns:
        All bytes of the file.

    Raises:
        DataError: The path is not a regular file (a folder, a pipe, a device), or the file is larger.
        OSError: The file is missing, or cannot be read.
    """
    with open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size > max_bytes:
            raise DataError(
                f"{path}: has {readable_size(size)}, but at most {readable_size(max_bytes)} are read; name another file"
            )
        return file.read(max_bytes)


def encoding_of_file(path: str | Path) -> str:
    """Detect the encoding of a text file, plain or gzipped, from its first bytes (`encoding_of`).

    Args:
        path: The file's path.

    Returns:
        Python's name of the encoding.

    Raises:
        DataError: The path is not a regular file, or the file is of another kind, is not text, or is damaged.
        OSError: The file is missing, or cannot be read.
    """
    with open_regular(path) as raw, _unpacking(path):
        head = _unzip(raw).read(READ_LIMITS.head_bytes)
    return encoding_of(path, head, whole=len(head) < READ_LIMITS.head_bytes)


def read_lines(path: str | Path, encoding: str = UTF_8) -> Iterator[str]:
    """Read the lines of a text file of any size, plain or gzipped, one after the other.

    Args:
        path: The file's path.
        encoding: The encoding of its text, as `encoding_of_file` returns it.

    Yields:
        Each line, without its line break. A last line of zero bytes only is dropped.

    Raises:
        DataError: The path is not a regular file, or the file is not text in this encoding, is damaged, has a line of
            more than `READ_LIMITS.line_bytes` characters, or unpacks to more than any recording.
        OSError: The file is missing, or cannot be read.
    """
    with open_regular(path) as raw, _unpacking(path):
        size, zipped = os.fstat(raw.fileno()).st_size, raw.peek(2).startswith(GZIP_MARK)
        max_total, max_line = max_unpacked_size(size) if zipped else math.inf, READ_LIMITS.line_bytes
        # Bytes that are not UTF-8 are kept as surrogates, so that the message can name their line.
        errors = "surrogateescape" if encoding == UTF_8 else "strict"
        text: io.TextIOWrapper[Any] = io.TextIOWrapper(_unzip(raw), encoding, errors)
        number, total = 0, 0
        try:
            while line := text.readline(max_line):
                number, total = number + 1, total + len(line)
                if total > max_total:
                    raise unpacked_size_error(path, max_total)
                if not line.strip("\0"):  # a power cut leaves zeros at the end of a log
                    continue
                if len(line) == max_line and not line.endswith("\n"):
                    raise DataError(f"{path}: line {number} has more than {max_line} bytes; it is not a table")
                if not line.isascii() and re.search("[\udc80-\udcff]", line):  # the surrogates
                    raise DataError(f"{path}: line {number} is not text in UTF-8; save the file as CSV in UTF-8")
                yield line.removesuffix("\n")
        except UnicodeDecodeError as error:
            raise DataError(
                f"{path}: is not text in {encoding.upper()} after line {number}; save it as CSV in UTF-8"
            ) from error
        finally:
            with contextlib.suppress(ValueError, OSError, EOFError, zlib.error):
                text.detach()  # or it would close the file a second time


def require_unpackable(path: str | Path) -> None:
    """Refuse a gzipped text that unpacks to more than any recording, before it is parsed.

    Args:
        path: The path of a file, plain or gzipped.

    Raises:
        DataError: The path is not a regular file, or the file unpacks to too much or is damaged.
        OSError: The file is missing, or cannot be read.
    """
    with open_regular(path) as raw, _unpacking(path):
        if not raw.peek(2).startswith(GZIP_MARK):
            return
        left, text = max_unpacked_size(os.fstat(raw.fileno()).st_size), _unzip(raw)
        while chunk := text.read(2**20):
            left -= len(chunk)
            if left < 0:
                raise unpacked_size_error(path, max_unpacked_size(os.fstat(raw.fileno()).st_size))


def _unzip(raw: BufferedReader) -> BufferedReader | gzip.GzipFile:
    """Unpack a file while it is read, if it begins like a gzip archive."""
    return gzip.GzipFile(fileobj=raw) if raw.peek(2).startswith(GZIP_MARK) else raw


@contextmanager
def _unpacking(path: str | Path) -> Iterator[None]:
    """Name the file in the error that a damaged gzip archive causes within this block."""
    try:
        yield
    except (gzip.BadGzipFile, EOFError, zlib.error) as error:
        raise DataError(f"{path}: cannot be unpacked ({error}); restore it from the source") from error


def read_text(path: str | Path, max_bytes: int = READ_LIMITS.text_bytes) -> str:
    """Read a text file as a whole.

    Args:
        path: The file's path.
        max_bytes: The number of bytes up to which the file is read.

    Returns:
        The text, without a byte order mark.

    Raises:
        DataError: The path is not a regular file, or the file is larger or not text in UTF-8 or UTF-16.
        OSError: The file is missing, or cannot be read.
    """
    data = read_bytes(path, max_bytes)
    try:
        return data.decode(UTF_8)
    except UnicodeDecodeError as error:
        if Path(path).suffix.lower() in MESH_SUFFIXES:
            raise DataError(f"{path}: is the mesh of an object, not a text file; name another file") from error
        kind, _ = kind_of(data[: READ_LIMITS.head_bytes])
        if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
            return decoded(path, data)
        raise DataError(
            f"{path}: is {kind or f'not text in UTF-8 (byte {error.start})'}; save it in UTF-8, or restore a copy"
        ) from error


def read_toml(path: str | Path) -> dict[str, Any]:
    """Read a TOML file.

    Args:
        path: The file's path.

    Returns:
        The file's keys and tables.

    Raises:
        DataError: The file is not TOML, is too large, or is nested too deeply.
        OSError: The file is missing, or cannot be read.
    """
    text = read_text(path)
    # The parser's time grows with the square of a key's length.
    longest = max(map(len, text.splitlines()), default=0)
    if longest > READ_LIMITS.toml_line_bytes:
        raise DataError(f"{path}: cannot be read as TOML (a line has {longest} characters); restore it from a copy")
    try:
        return tomllib.loads(text)
    except RecursionError as error:
        raise DataError(f"{path}: cannot be read as TOML (nested too deep); restore it from a copy") from error
    except ValueError as error:  # TOMLDecodeError, and integers of thousands of digits
        raise DataError(f"{path}: is not TOML ({error}); correct it there") from error


def parse_json(text: str | bytes, whose: str | Path) -> Any:
    """Parse a text in JSON.

    Args:
        text: The text.
        whose: What messages call the text, such as the path of its file.

    Returns:
        The value that the text describes.

    Raises:
        DataError: The text is not JSON, or is nested too deeply.
    """
    try:
        return json.loads(text)
    except RecursionError as error:
        raise DataError(f"{whose}: cannot be read as JSON (nested too deep); restore it from a copy") from error
    except ValueError as error:
        raise DataError(f"{whose}: is not JSON ({error}); restore it from a copy") from error


def read_json(path: str | Path, max_bytes: int = READ_LIMITS.text_bytes) -> Any:
    """Read a JSON file.

    Args:
        path: The file's path.
        max_bytes: The number of bytes up to which the file is read.

    Returns:
        The value that the file describes.

    Raises:
        DataError: The file is not JSON, is too large, or is nested too deeply.
        OSError: The file is missing, or cannot be read.
    """
    return parse_json(read_text(path, max_bytes), path)
