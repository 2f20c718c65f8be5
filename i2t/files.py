"""Reading files that somebody else made, within bounds, and writing files that are there whole or not at all.

A file can be a pipe that never ends, a kilobyte that unpacks to gigabytes, or a text nested so deep that its parser
falls over. The functions here read text, tables in TOML and JSON, gzip and zip archives and lists of file names, and
answer all of that with one sentence that names the file. Where a file is missing or forbidden they raise the system's
own OSError.
"""

import codecs
import contextlib
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
GZIP_MARK = b"\x1f\x8b"
UNPACKED_AT_ONCE = 2**20  # bytes
HEAD_BYTES = 2**16  # first bytes of a file, from which its kind and its encoding are detected
EXPORT, UNPACK = "export what you need of it as CSV in UTF-8", "unpack it first"
# First bytes of files that are not tables, by the specification of each format, and how their numbers become a table.
FILE_MARKS: tuple[tuple[bytes, str, str], ...] = (
    (b"\x93NUMPY", "a NumPy array (.npy)", "write its columns with numpy.savetxt, with their names as the header"),
    (b"PK\x03\x04", "a zip archive", UNPACK),
    (b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1", "an old Excel workbook (.xls)", "save it as CSV in UTF-8"),
    (b"PAR1", "an Apache Parquet file", "write it with pandas: read_parquet(...).to_csv(..., index=False)"),
    (b"ARROW1", "an Apache Arrow (Feather) file", "write it with pandas: read_feather(...).to_csv(..., index=False)"),
    (b"\x89MCAP0\r\n", "an MCAP recording", EXPORT),
    (b"#ROSBAG V", "a ROS bag", EXPORT),
    (b"SQLite format 3\0", "an SQLite database, as ROS 2 bags (.db3) are", EXPORT),
    (MARK_OF_TOUCHES, "a data set of i2t, and converted already", "use it as it is"),
    (b"\x89HDF\r\n\x1a\n", "an HDF5 file", EXPORT),
    (b"MATLAB 5.0 MAT-file", "a MATLAB file (.mat)", "write it in MATLAB with writetable"),
    (b"MATLAB 7.3 MAT-file", "a MATLAB file (.mat)", "write it in MATLAB with writetable"),
    (b"TDSm", "a LabVIEW recording (TDMS)", EXPORT),
    *((mark, "a compressed archive", UNPACK) for mark in (b"BZh", b"\xfd7zXZ\0", b"\x28\xb5\x2f\xfd")),
    *((mark, "an image", "name a table") for mark in (b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff", b"II*\0", b"MM\0*")),
    (b"version https://git-lfs", "a Git LFS pointer and not the file itself", "fetch it with git lfs pull"),
    (b"<!doctype html", "a web page (HTML)", "download the file itself"),
    (b"<html", "a web page (HTML)", "download the file itself"),
    (b"<?xml", "an XML document", EXPORT),
    (b"{\\rtf", "a document in rich text (RTF)", "save its table as plain text, in CSV and UTF-8"),
    (GZIP_MARK, "a gzip archive", UNPACK),
    *((b"\x80" + bytes([protocol]), "a Python pickle", EXPORT) for protocol in range(2, 6)),
)
JSON_BEGINS = re.compile(rb'\s*(\{\s*["{}]|\[\s*[\[{"\]]|\[\s+[-0-9tfn])')  # indented or not
ZIP_NAMES: tuple[tuple[bytes, str, str], ...] = (  # names of entries in zip archives that are documents
    (b"xl/", "an Excel workbook (.xlsx)", "save it as CSV in UTF-8"),
    (b"[Content_Types].xml", "an Excel workbook or another Office document", "save it as CSV in UTF-8"),
    (b"opendocument.spreadsheet", "an OpenDocument spreadsheet (.ods)", "save it as CSV in UTF-8"),
    (b".npy", "a NumPy archive (.npz)", "write its columns with numpy.savetxt, with their names as the header"),
)
UNICODE_MARKS = (  # those of UTF-32 first, which begin with those of UTF-16
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
UNDECODED = re.compile("[\udc80-\udcff]")  # bytes that are not UTF-8, as `surrogateescape` keeps them
UTF_8, WINDOWS_1252 = "utf-8-sig", "cp1252"
NO_TEXT_BYTES = frozenset(range(32)) - set(b"\t\n\v\f\r\x1a\x1b")  # control characters that no text has
ARCHIVE_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)


def as_path(name: str, value: Any) -> Path:
    """The path of a file or folder that a user gave.

    Args:
        name: Of the argument, for the message.
        value: That was given.

    Returns:
        The path.

    Raises:
        TypeError: It is neither text nor a path.
        ValueError: It is empty.
    """
    if not isinstance(value, str | os.PathLike):
        raise TypeError(f"{name}: is {repr(value)[:40]}, and no path; give the name of a file or folder")
    if not os.fspath(value):
        raise ValueError(f"{name}: is empty; give the name of a file or folder")
    return Path(value)


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
            raise DataError(f"{path}: has {_size(size)} where at most {_size(most)} are read; name another file")
        return file.read(most)


def kind_of(head: bytes) -> tuple[str, str]:
    """Recognise a file that is not a table by its first bytes.

    Args:
        head: The first `HEAD_BYTES` bytes, or all of a smaller file.

    Returns:
        The kind of file, with its article, and how its numbers can be read; two empty texts for any other file.
    """
    if head.startswith(b"PK\x03\x04"):
        for name, kind, remedy in ZIP_NAMES:
            if name in head:
                return kind, remedy
    text = head.removeprefix(codecs.BOM_UTF8)
    markup = text.lstrip().lower()
    for mark, kind, remedy in FILE_MARKS:
        if (markup if mark.startswith((b"<", b"{")) else head).startswith(mark):
            return kind, remedy
    return ("a JSON document", EXPORT) if JSON_BEGINS.match(text) else ("", "")


def encoding_of(path: str | Path, head: bytes, *, whole: bool) -> str:
    """Detect the encoding of a text.

    UTF-8, UTF-16 and UTF-32 are recognised by their marks, and UTF-16 of ASCII characters without one. Other texts are
    in UTF-8 if their bytes allow it, else in Windows-1252, which spreadsheets write.

    Args:
        path: The file, for messages.
        head: The first `HEAD_BYTES` bytes, or all of a smaller file.
        whole: Whether `head` is all of the file.

    Returns:
        Python's name of the encoding; that of UTF-8 is "utf-8-sig".

    Raises:
        DataError: The file is of another kind, or is not text.
    """
    kind, remedy = kind_of(head)
    if kind:
        raise DataError(f"{path}: is {kind}; {remedy}")
    for mark, encoding in UNICODE_MARKS:
        if head.startswith(mark):
            return encoding
    for first, encoding in ((1, "utf-16-le"), (0, "utf-16-be")):  # zeros stand after, or before, each character
        if len(head) > 3 and not any(head[first::2]) and all(head[1 - first : -1 : 2]):
            return encoding
    if NO_TEXT_BYTES & set(head.rstrip(b"\0")):  # a power cut leaves zeros at the end of a log
        raise DataError(f"{path}: is binary data, not text; save it as CSV in UTF-8")
    for encoding in (UTF_8, WINDOWS_1252):
        try:
            codecs.getincrementaldecoder(encoding)().decode(head, final=whole)
        except UnicodeDecodeError:
            continue
        return encoding
    raise DataError(f"{path}: is not text in UTF-8 or Windows-1252; save it as CSV in UTF-8")


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


def decoded(path: str | Path, data: bytes) -> str:
    """Decode the bytes of a text file by the encoding that `encoding_of` detects.

    Args:
        path: Of the file, for messages.
        data: Its bytes.

    Returns:
        The text, without a byte order mark.

    Raises:
        DataError: The file is of another kind, or is not text.
    """
    encoding = encoding_of(path, data[:HEAD_BYTES], whole=len(data) <= HEAD_BYTES)
    try:
        return data.decode(encoding)
    except UnicodeDecodeError as error:
        name = encoding.removesuffix("-sig").upper()
        raise DataError(f"{path}: is not text in {name} (byte {error.start}); save it as CSV in UTF-8") from error


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
                    raise _unpacks_to_too_much(path, most)
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
                raise _unpacks_to_too_much(path, may_grow_to(os.fstat(raw.fileno()).st_size))


def _unpacks_to_too_much(path: str | Path, most: float) -> DataError:
    return DataError(
        f"{path}: unpacks to more than {_size(int(most))}, as no recording does; restore it from the source"
    )


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


def file_in(folder: Path, name: str, listed_in: str | Path, *, below: bool = False) -> Path:
    """The file in a folder that a list names.

    Args:
        folder: The folder.
        name: Of the file.
        listed_in: The list, for messages.
        below: Whether the name may lead into a folder in the folder.

    Returns:
        The file's path.

    Raises:
        DataError: The name leads out of the folder, by itself or as a symbolic link.
    """
    path = folder / name
    if below:
        inside = name not in ("", ".") and ".." not in Path(name).parts and "\0" not in name
        inside = inside and path.resolve().is_relative_to(folder.resolve())
    else:
        inside = name not in ("", ".", "..") and not set(name) & {"/", "\\", "\0"}
        inside = inside and (not path.is_symlink() or path.resolve().parent == folder.resolve())
    if not inside:
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
