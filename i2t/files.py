"""Reading files that somebody else made, within bounds, and writing files that are there whole or not at all.

A file can be a pipe that never ends, a kilobyte that unpacks to gigabytes, or a text nested so deep that its parser
falls over. The functions here read text, tables in TOML and JSON, gzip and zip archives and lists of file names, and
answer all of that with one sentence that names the file. Where a file is missing or forbidden they raise the system's
own OSError.
"""

import codecs
import gzip
import io
import json
import math
import os
import re
import secrets
import stat
import tomllib
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path
from typing import Any

from i2t.errors import NAMED_WRONGLY, DataError, FullDiskError

MAX_BYTES = 2 * 2**30  # of any file that is read as a whole
MAX_TEXT_BYTES = 2**20  # of a settings file: real ones have a few kilobytes
MAX_TOML_LINE_BYTES = 4096  # a matrix of 6 x 6 numbers in one line has 900
SPARE_BYTES = 16 * 2**20  # that a small archive may unpack to, however small it is
MAX_INFLATION = 40  # times its size, that an archive may unpack to beyond that: numbers as text reach 10
MAX_ARCHIVE_ENTRIES = 4096
MAX_LINE_BYTES = 2**16  # of a text that is read line by line: a row of 25 chips has some 1000
MAX_MESH_BYTES = 2**28  # of a file of a mesh, and of the files that it names
MARK_OF_TOUCHES = b"i2t-touches "  # with which a file of touches begins (`i2t.dataset.files`)
TABLE_SUFFIXES, MESH_SUFFIXES = (".csv", ".tsv", ".txt"), (".stl", ".obj", ".ply", ".off", ".glb", ".gltf")
ARCHIVE_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)


def unwritable(path: str | Path, error: OSError) -> DataError:
    """Error for a file that could not be written.

    Args:
        path: Of the file.
        error: Of the system, or of the HDF5 library.

    Returns:
        A FullDiskError, unless the folder is to blame.
    """
    inner = re.search("error message = '([^']*)'", str(error))  # as HDF5 words it
    why = error.strerror or (inner[1] if inner else str(error))
    if isinstance(error, NAMED_WRONGLY):
        return DataError(f"{path}: cannot be written ({why}); choose a folder you may write to")
    return FullDiskError(f"{path}: cannot be written ({why}); make room on its disk, or choose another")


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Write a file whole or not at all: what is written in the block appears under its name when the block is done.

    Args:
        path: Of the file; its folder is made, and a file that is there is replaced.

    Yields:
        The hidden name next to it under which the file is to be written. Nothing is left of it if the block fails.

    Raises:
        DataError: Its folder cannot be written to; FullDiskError if the disk is full, or failed.
    """
    temporary = path.with_name(f".{secrets.token_hex(4)}.{path.name}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            yield temporary
            with temporary.open("r+b") as file:  # the contents reach the disk before their name does
                os.fsync(file.fileno())
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)
    except OSError as error:
        raise unwritable(path, error) from error


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
        if Path(path).is_dir():
            raise DataError(f"{path}: is no file of its own but a folder; name the file itself")
        raise DataError(f"{path}: is no file of its own but a pipe or a device; name the file itself")
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
            raise DataError(f"{path}: has {_size(size)} where at most {_size(most)} are read; name another file")
        return file.read(most)


def read_lines(path: str | Path) -> Iterator[str]:
    """The lines of a text file of any size, one after the other, unzipped where its name ends in .gz.

    Args:
        path: Of the file.

    Yields:
        Each line, without its end.

    Raises:
        DataError: It is no regular file, no text in UTF-8, damaged, has a line of more than `MAX_LINE_BYTES`, or
            unpacks to more than numbers ever do.
        OSError: It is missing, or cannot be read.
    """
    with open_regular(path) as raw:
        zipped = Path(path).suffix == ".gz"
        most = may_grow_to(os.fstat(raw.fileno()).st_size) if zipped else math.inf
        text = gzip.GzipFile(fileobj=raw) if zipped else raw
        number, total, mark = 0, 0, codecs.BOM_UTF8
        try:
            while line := text.readline(MAX_LINE_BYTES):
                number, total = number + 1, total + len(line)
                if total > most:
                    raise DataError(
                        f"{path}: unpacks to more than {_size(int(most))}, as no recording does; restore it from the "
                        "source"
                    )
                if len(line) == MAX_LINE_BYTES and not line.endswith(b"\n"):
                    raise DataError(f"{path}: line {number} has more than {MAX_LINE_BYTES} bytes; it is no table")
                yield line.removeprefix(mark).decode().rstrip("\r\n")
                mark = b""
        except UnicodeDecodeError as error:
            raise DataError(f"{path}: line {number} is no text in UTF-8; restore it from the source") from error
        except (gzip.BadGzipFile, EOFError, zlib.error) as error:
            raise DataError(f"{path}: cannot be unpacked ({error}); restore it from the source") from error


def read_text(path: str | Path, most: int = MAX_TEXT_BYTES) -> str:
    """The contents of a text file.

    Args:
        path: Of the file.
        most: Bytes that it may have.

    Returns:
        The text.

    Raises:
        DataError: It is no regular file, larger, or no text in UTF-8.
        OSError: It is missing, or cannot be read.
    """
    try:
        return read_bytes(path, most).decode("utf-8")
    except UnicodeDecodeError as error:
        if Path(path).suffix.lower() in MESH_SUFFIXES:
            raise DataError(f"{path}: is the mesh of an object, and text is read here; name another file") from error
        raise DataError(f"{path}: is not text in UTF-8 (byte {error.start}); restore it from a copy") from error


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


def unpacked(path: str | Path, data: bytes) -> bytes:
    """The contents of a gzip file.

    Args:
        path: Of the file, for messages.
        data: Its bytes.

    Returns:
        What they unpack to.

    Raises:
        DataError: They are damaged, or unpack to more than numbers ever do.
    """
    most = may_grow_to(len(data))
    try:
        with gzip.open(io.BytesIO(data)) as file:
            found = file.read(most + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise DataError(f"{path}: cannot be unpacked ({error}); restore it from the source") from error
    if len(found) > most:
        raise DataError(f"{path}: unpacks to more than {_size(most)}, as no recording does; restore it from the source")
    return found


def may_grow_to(size: int) -> int:
    """Bytes that a packed file may unpack to.

    Args:
        size: Bytes of the file.

    Returns:
        A bound that recordings and models stay far below.
    """
    return SPARE_BYTES + MAX_INFLATION * size


def check_archive(path: str | Path, data: bytes) -> None:
    """Refuse a zip archive (an .npz file) that would unpack to more than it can rightly hold.

    Args:
        path: Of the file, for messages.
        data: Its bytes.

    Raises:
        DataError: It has too many entries, entries packed in an unusual way, or says that it unpacks to too much.
        zipfile.BadZipFile: It is no archive.
    """
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        entries = archive.infolist()
    most, total = may_grow_to(len(data)), sum(entry.file_size for entry in entries)
    if len(entries) > MAX_ARCHIVE_ENTRIES or total > most or len({entry.filename for entry in entries}) < len(entries):
        raise DataError(
            f"{path}: is an archive of {len(entries)} entries that unpacks to {_size(total)}, as none of i2t's does; "
            "restore a copy or make it again"
        )
    if any(entry.compress_type not in ARCHIVE_METHODS for entry in entries):
        raise DataError(f"{path}: is packed in a way that i2t does not use; restore a copy or make it again")


def file_in(folder: Path, name: str, listed_in: str | Path) -> Path:
    """The file in a folder that a list names.

    Args:
        folder: The folder.
        name: Of the file.
        listed_in: The list, for messages.

    Returns:
        The file's path.

    Raises:
        DataError: The name leads out of the folder, by itself or as a symbolic link.
    """
    path = folder / name
    plain = name not in ("", ".", "..") and not set(name) & {"/", "\\", "\0"}
    if not plain or (path.is_symlink() and path.resolve().parent != folder.resolve()):
        raise DataError(f"{listed_in}: names {name!r}, which lies outside of {folder}; name files of that folder only")
    return path


def not_through_links(path: str, flags: int) -> int:
    """Opens a file, but not what a symbolic link of its name leads to: `open(path, "wb", opener=not_through_links)`.

    Args:
        path: Of the file.
        flags: As `open` has them.

    Returns:
        The descriptor.

    Raises:
        OSError: It is a symbolic link, or cannot be opened.
    """
    return os.open(path, flags | getattr(os, "O_NOFOLLOW", 0), 0o666)


def _size(count: int) -> str:
    return f"{count / 2**20:.3g} MiB" if count >= 2**20 else f"{count} bytes"


def slug(name: str) -> str:
    """A folder name.

    Args:
        name: Any text.

    Returns:
        Its letters and digits, with lines between.
    """
    return "-".join("".join(c if c.isalnum() else " " for c in name.replace("'s", "")).split())
