"""Reading files that somebody else made, within bounds.

A file can be a pipe that never ends, a kilobyte that unpacks to gigabytes, or a text nested so deep that its parser
falls over. The functions here read text and tables in TOML and JSON, and answer all of that with one sentence that
names the file. Where a file is missing or forbidden they raise the system's own OSError.
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
from i2t.files.archives import may_grow_to, readable_size, unpacks_to_too_much
from i2t.files.kinds import (
    GZIP_MARK,
    HEAD_BYTES,
    MARK_OF_TOUCHES,
    MESH_SUFFIXES,
    TABLE_SUFFIXES,
    UTF_8,
    decoded,
    encoding_of,
    kind_of,
)

MAX_BYTES = 2 * 2**30  # of any file that is read as a whole
MAX_TEXT_BYTES = 2**20  # of a settings file: real ones have a few kilobytes
MAX_TOML_LINE_BYTES = 4096  # a matrix of 6 x 6 numbers in one line has 900
MAX_LINE_BYTES = 2**16  # of a text that is read line by line: a row of 25 chips has some 1000
UNPACKED_AT_ONCE = 2**20  # bytes
UNDECODED = re.compile("[\udc80-\udcff]")  # bytes that are not UTF-8, as `surrogateescape` keeps them


def open_regular(path: str | Path) -> BufferedReader:
    """Open a regular file for reading. A pipe would be waited for, and a device may never end.

    Args:
        path: Of the file.

    Returns:
        The open file.

    Raises:
        DataError: It is a folder, a pipe or a device.
        OSError: It is missing, or cannot be read.
    """
    # A pipe without a writer would keep whoever opens it waiting.
    descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        kind = "folder" if Path(path).is_dir() else "pipe or a device"
        raise DataError(f"{path}: is a {kind}, not a regular file; name the file itself")
    return os.fdopen(descriptor, "rb")


def why_no_touches(path: Path) -> str:
    """Message for a file that is named as a data set and is none.

    Args:
        path: Of a file that exists.

    Returns:
        The sentence; "" where the file begins as those of touches do.
    """
    with open_regular(path) as file:
        if file.read(len(MARK_OF_TOUCHES)) == MARK_OF_TOUCHES:
            return ""
    if path.suffix.lower() in MESH_SUFFIXES:
        return f"{path}: is the mesh of an object, and no data set; name the folder or file of the touches"
    if path.suffix.lower() in TABLE_SUFFIXES:
        return f"{path}: is a table, and no data set yet; convert it with python -m i2t.convert"
    return f"{path}: is no data set; name a folder or file of touches, or convert it with python -m i2t.convert"


def read_bytes(path: str | Path, most: int = MAX_BYTES) -> bytes:
    """The contents of a regular file.

    Args:
        path: Of the file.
        most: Bytes that it may have.

    Returns:
        The contents.

    Raises:
        DataError: It is no regular file (a folder, a pipe, a device), or larger.
        OSError: It is missing, or cannot be read.
    """
    with open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size > most:
            raise DataError(
                f"{path}: has {readable_size(size)} where at most {readable_size(most)} are read; name another file"
            )
        return file.read(most)


def encoding_of_file(path: str | Path) -> str:
    """Detect the encoding of a text file, plain or gzip-ed, by its first bytes (`encoding_of`).

    Args:
        path: The file.

    Returns:
        Python's name of the encoding.

    Raises:
        DataError: It is not a regular file, is of another kind, is not text, or is damaged.
        OSError: It is missing, or cannot be read.
    """
    with open_regular(path) as raw, _unpacking(path):
        head = _unzipped(raw).read(HEAD_BYTES)
    return encoding_of(path, head, whole=len(head) < HEAD_BYTES)


def read_lines(path: str | Path, encoding: str = UTF_8) -> Iterator[str]:
    """The lines of a text file of any size, plain or gzip-ed, one after the other.

    Args:
        path: Of the file.
        encoding: Of its text, as of `encoding_of_file`.

    Yields:
        Each line, without its end.

    Raises:
        DataError: It is no regular file, no text in this encoding, damaged, has a line of more than `MAX_LINE_BYTES`
            characters, or unpacks to more than numbers ever do.
        OSError: It is missing, or cannot be read.
    """
    with open_regular(path) as raw, _unpacking(path):
        size, zipped = os.fstat(raw.fileno()).st_size, raw.peek(2).startswith(GZIP_MARK)
        most = may_grow_to(size) if zipped else math.inf
        # Bytes that are not UTF-8 are kept as surrogates, so that the message can name their line.
        errors = "surrogateescape" if encoding == UTF_8 else "strict"
        text: io.TextIOWrapper[Any] = io.TextIOWrapper(_unzipped(raw), encoding, errors)
        number, total = 0, 0
        try:
            while line := text.readline(MAX_LINE_BYTES):
                number, total = number + 1, total + len(line)
                if total > most:
                    raise unpacks_to_too_much(path, most)
                if not line.strip("\0"):  # a power cut leaves zeros at the end of a log
                    continue
                if len(line) == MAX_LINE_BYTES and not line.endswith("\n"):
                    raise DataError(f"{path}: line {number} has more than {MAX_LINE_BYTES} bytes; it is no table")
                if not line.isascii() and UNDECODED.search(line):
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
    """Refuse a gzip-ed text that unpacks to more than numbers ever do, before any of it is parsed.

    Args:
        path: The file, plain or gzip-ed.

    Raises:
        DataError: It unpacks to too much, is damaged, or is no regular file.
        OSError: It is missing, or cannot be read.
    """
    with open_regular(path) as raw, _unpacking(path):
        if not raw.peek(2).startswith(GZIP_MARK):
            return
        left, text = may_grow_to(os.fstat(raw.fileno()).st_size), _unzipped(raw)
        while chunk := text.read(UNPACKED_AT_ONCE):
            left -= len(chunk)
            if left < 0:
                raise unpacks_to_too_much(path, may_grow_to(os.fstat(raw.fileno()).st_size))


def _unzipped(raw: BufferedReader) -> BufferedReader | gzip.GzipFile:
    """What a file holds, unpacked where it begins as gzip archives do."""
    return gzip.GzipFile(fileobj=raw) if raw.peek(2).startswith(GZIP_MARK) else raw


@contextmanager
def _unpacking(path: str | Path) -> Iterator[None]:
    """Name a gzip archive that is damaged."""
    try:
        yield
    except (gzip.BadGzipFile, EOFError, zlib.error) as error:
        raise DataError(f"{path}: cannot be unpacked ({error}); restore it from the source") from error


def read_text(path: str | Path, most: int = MAX_TEXT_BYTES) -> str:
    """The contents of a text file.

    Args:
        path: Of the file.
        most: Bytes that it may have.

    Returns:
        The text, without a byte order mark.

    Raises:
        DataError: It is no regular file, larger, or no text in UTF-8.
        OSError: It is missing, or cannot be read.
    """
    data = read_bytes(path, most)
    try:
        return data.decode(UTF_8)
    except UnicodeDecodeError as error:
        if Path(path).suffix.lower() in MESH_SUFFIXES:
            raise DataError(f"{path}: is the mesh of an object, and text is read here; name another file") from error
        kind, _ = kind_of(data[:HEAD_BYTES])
        if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
            return decoded(path, data)
        raise DataError(
            f"{path}: is {kind or f'not text in UTF-8 (byte {error.start})'}; save it in UTF-8, or restore a copy"
        ) from error


def read_toml(path: str | Path) -> dict[str, Any]:
    """The tables of a TOML file.

    Args:
        path: Of the file.

    Returns:
        The tables.

    Raises:
        DataError: It is no TOML, too large, or nested too deep.
        OSError: It is missing, or cannot be read.
    """
    text = read_text(path)
    # The parser's time grows with the square of a key's length.
    longest = max(map(len, text.splitlines()), default=0)
    if longest > MAX_TOML_LINE_BYTES:
        raise DataError(
            f"{path}: is not TOML that can be read (a line has {longest} characters); restore it from a copy"
        )
    try:
        return tomllib.loads(text)
    except RecursionError as error:
        raise DataError(f"{path}: is not TOML that can be read (nested too deep); restore it from a copy") from error
    except ValueError as error:  # TOMLDecodeError, and whole numbers of thousands of digits
        raise DataError(f"{path}: is not TOML ({error}); correct it there") from error


def parse_json(text: str | bytes, whose: str | Path) -> Any:
    """Parse a text in JSON.

    Args:
        text: The text.
        whose: Names the file in messages.

    Returns:
        The value.

    Raises:
        DataError: It is no JSON, or nested too deep.
    """
    try:
        return json.loads(text)
    except RecursionError as error:
        raise DataError(f"{whose}: is not JSON that can be read (nested too deep); restore it from a copy") from error
    except ValueError as error:
        raise DataError(f"{whose}: is not JSON ({error}); restore it from a copy") from error


def read_json(path: str | Path, most: int = MAX_TEXT_BYTES) -> Any:
    """Read a JSON file.

    Args:
        path: Of the file.
        most: Bytes that it may have.

    Returns:
        The value.

    Raises:
        DataError: It is no JSON, too large, or nested too deep.
        OSError: It is missing, or cannot be read.
    """
    return parse_json(read_text(path, most), path)
