"""One HDF5 file that either exists whole or not at all, and that proves its contents.

The first 512 bytes (an HDF5 user block, which every HDF5 reader skips) hold one line of text,

    i2t-touches <schema version> sha256 <64 hexadecimal digits>

filled up with zeros; the digest covers every byte after them, and the line must be exactly this, so that any changed,
missing or added byte is found before the HDF5 library sees it. A file is written under a hidden temporary name in the
same folder, synchronised to the disk, renamed, and the folder synchronised: a process killed at any moment leaves a
hidden leftover at worst, never a half-written touch.
"""

import hashlib
import io
import os
import re
import secrets
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py

from i2t.errors import DataError

SCHEMA = "i2t-touches"
SCHEMA_VERSION = 2  # sessions, which version 1 called runs
READABLE_SCHEMAS = (1, 2)
ENDING = ".h5"
HEADER_BYTES = 512

_HEADER = re.compile(rb"i2t-touches ([1-9][0-9]*) sha256 ([0-9a-f]{64})\n\0+")


def write(path: Path, fill: Callable[[h5py.File], None], small: bool = False) -> Path:
    """Write a new HDF5 file of this schema, atomically and durably; an existing file is replaced.

    Args:
        path: Of the file.
        fill: Writes the contents into the open file.
        small: Make it in memory first: a full disk then meets a plain write, where the HDF5 library would stumble over
            what it cannot write any more.

    Returns:
        The path.

    Raises:
        DataError: The folder cannot be written.
    """
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            if small:
                image = io.BytesIO()
                _make(image, fill)
                temporary.write_bytes(image.getbuffer())
            else:
                _make(temporary, fill)
            with temporary.open("r+b") as raw:
                raw.seek(HEADER_BYTES)
                digest = hashlib.file_digest(raw, "sha256").hexdigest()
                raw.seek(0)
                raw.write(f"{SCHEMA} {SCHEMA_VERSION} sha256 {digest}\n".encode().ljust(HEADER_BYTES, b"\0"))
                raw.flush()
                os.fsync(raw.fileno())
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)
        sync_folder(path.parent)
    except OSError as error:
        raise DataError(
            f"{path}: cannot be written ({error.strerror or error}); choose a folder you may write to"
        ) from error
    return path


def _make(where: Path | io.BytesIO, fill: Callable[[h5py.File], None]) -> None:
    with h5py.File(where, "w", userblock_size=HEADER_BYTES) as file:
        file.attrs["schema"] = SCHEMA
        file.attrs["version"] = SCHEMA_VERSION
        fill(file)


def sync_folder(folder: Path) -> None:
    """Make a rename durable (where the system can synchronise folders; Windows cannot and need not).

    Args:
        folder: In which something was renamed.
    """
    if os.name == "posix":
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def checksum(path: Path) -> str:
    """The SHA-256 that a file's header states; nothing but the header is read.

    Args:
        path: Of the file.

    Returns:
        The SHA-256.

    Raises:
        DataError: It is a file of another kind.
    """
    with path.open("rb") as raw:
        return _header(path, raw.read(HEADER_BYTES))


@contextmanager
def verified(path: Path) -> Iterator[h5py.File]:
    """Open a file of this schema for reading, after proving that no byte of it changed.

    Args:
        path: Of the file.

    Yields:
        The open file.

    Raises:
        DataError: It cannot be read, or has changed.
    """
    try:
        with path.open("rb") as raw:
            expected = _header(path, raw.read(HEADER_BYTES))
            if hashlib.file_digest(raw, "sha256").hexdigest() != expected:
                raise DataError(
                    f"{path}: the contents do not match their SHA-256, so the file is damaged; restore it from a copy"
                )
        file = h5py.File(path, "r")
    except OSError as error:
        raise DataError(
            f"{path}: cannot be read ({error.strerror or error}); check the path and its permissions"
        ) from error
    with file:
        yield file


def _header(path: Path, block: bytes) -> str:
    match = _HEADER.fullmatch(block)
    if match is None or len(block) != HEADER_BYTES:
        raise DataError(
            f"{path}: not an {SCHEMA} file; move it out of the data set, or convert it with python -m i2t.convert"
        )
    if int(match[1]) not in READABLE_SCHEMAS:
        raise DataError(
            f"{path}: written in schema version {int(match[1])}, and this program reads {SCHEMA_VERSION}; "
            "install a newer i2t"
        )
    return match[2].decode()
