"""HDF5 files that are written atomically and verified when they are read.

The first 512 bytes are an HDF5 user block, which every HDF5 reader skips. They hold one line of text, padded with
zeros:

    i2t-touches <schema version> sha256 <64 hexadecimal digits>

The digest covers all bytes after the block, and the line must match exactly, so that any changed, missing or added byte
is detected before the HDF5 library reads the file. A hostile file may have a valid digest. Its contents are therefore
inspected before they are read: groups and arrays must be in the file itself, compressed by gzip at most, and unpack to
no more than the file's size allows, without links and without arrays in other files.

A file is written under a hidden temporary name in the same folder, synchronised to the disk and renamed, and then the
folder is synchronised. A process that is killed at any moment leaves at worst a hidden temporary file, never a partial
touch.
"""

import hashlib
import io
import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from i2t.errors import DataError
from i2t.files.limits import READ_LIMITS
from i2t.files.reading import open_regular
from i2t.files.writing import replacing, unwritable

SCHEMA = "i2t-touches"  # name of the schema, at the start of the header of each file of touches
# version of the schema that is written; versions 1 and 2, which name some fields differently, are still read
SCHEMA_VERSION = 3
ENDING = ".h5"  # ending of the name of a packed data set's file
HEADER_BYTES = 512  # size of the text header in front of the HDF5 data of a file of touches


@dataclass(frozen=True)
class _H5Limits:
    """Largest contents of a file that are accepted, far above those of real files."""

    entries: int = 4096  # largest number of groups and arrays; a touch has 60
    levels: int = 6  # largest number of nested groups; a touch has 3
    growth: int = 200  # largest ratio of unpacked size to file size; patches of a flat object compress well
    # largest size (bytes) of a variable-length text array, whose texts may share their characters
    text_bytes: int = 2**28


_H5_LIMITS = _H5Limits()  # largest contents of a file of touches, far above real ones; larger ones are refused


def write(path: Path, fill: Callable[[h5py.File], None]) -> Path:
    """Write a new HDF5 file of touches, atomically and durably; an existing file is replaced.

    Args:
        path: Path of the file.
        fill: Function that writes the contents into the open file.

    Returns:
        The path of the file.

    Raises:
        DataError: The folder cannot be written. It is a FullDiskError if the disk is full or failed.
    """
    with replacing(path) as temporary:
        # The HDF5 library aborts the process if it cannot write to a full disk, so the file is made in memory first.
        image = io.BytesIO()
        with h5py.File(image, "w", userblock_size=HEADER_BYTES) as file:
            file.attrs["schema"] = SCHEMA
            file.attrs["version"] = SCHEMA_VERSION
            fill(file)
        content = image.getbuffer()[HEADER_BYTES:]
        header = f"{SCHEMA} {SCHEMA_VERSION} sha256 {hashlib.sha256(content).hexdigest()}\n".encode()
        with temporary.open("wb") as raw:
            raw.write(header.ljust(HEADER_BYTES, b"\0"))
            raw.write(content)
    try:
        sync_folder(path.parent)
    except OSError as error:
        raise unwritable(path, error) from error
    return path


def sync_folder(folder: Path) -> None:
    """Make a rename in a folder survive a power cut, where the system can synchronise folders (not on Windows).

    Args:
        folder: The folder in which a file was renamed.
    """
    if os.name == "posix":
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


@contextmanager
def verified(path: Path) -> Iterator[h5py.File]:
    """Open an HDF5 file of touches for reading, after verifying by its checksum that no byte of it changed.

    Args:
        path: Path of the file.

    Yields:
        The file, open for reading.

    Raises:
        DataError: The file cannot be read or was changed.
    """
    try:
        with open_regular(path) as raw:
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
        try:
            _Inspection(path.stat().st_size).group(file, 0)
        except DataError as error:
            raise DataError(f"{path}: {error}; write it with i2t.dataset.save_dataset") from None
        except (RuntimeError, OSError, ValueError, KeyError, TypeError) as error:
            raise DataError(f"{path}: is not a readable HDF5 file ({error}); restore it from a copy") from error
        yield file


class _Inspection:
    """Inspection of a file before it is read: all contents must be in the file itself and must not be too large.

    Args:
        size: Size of the file in bytes.
    """

    def __init__(self, size: int) -> None:
        self._size, self._left, self._entries = size, READ_LIMITS.unpacked_spare_bytes + _H5_LIMITS.growth * size, 0

    def group(self, group: h5py.Group, level: int) -> None:
        """Raise DataError, without the file's name, for contents that no file of this schema has."""
        if level > _H5_LIMITS.levels:
            raise DataError("its groups are nested too deeply")
        self._attributes(group)
        for name in group:
            self._entries += 1
            if self._entries > _H5_LIMITS.entries:
                raise DataError(f"it holds more than {_H5_LIMITS.entries} groups and arrays")
            link = group.get(name, getlink=True)
            if not isinstance(link, h5py.HardLink):
                kind = "another file" if isinstance(link, h5py.ExternalLink) else "another place"
                raise DataError(f"{name!r} is a link to {kind}, and links are not followed")
            item = group[name]
            if isinstance(item, h5py.Group):
                self.group(item, level + 1)
            elif isinstance(item, h5py.Dataset):
                self._attributes(item)
                self._array(name, item)
            else:
                raise DataError(f"{name!r} is neither a group nor an array")

    def _array(self, name: str, array: h5py.Dataset) -> None:
        if array.external or array.is_virtual:
            raise DataError(f"the values of {name!r} are in another file, which is not read")
        layout = array.id.get_create_plist()
        filters = [layout.get_filter(i)[0] for i in range(layout.get_nfilters())]
        if not set(filters) <= {h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32}:
            raise DataError(f"{name!r} has a compression that i2t does not use")
        if array.dtype.hasobject and h5py.check_string_dtype(array.dtype) is None:
            raise DataError(f"{name!r} holds neither numbers nor text")
        chunk = int(np.prod(array.chunks or (1,), dtype=object)) * array.dtype.itemsize
        whole = int(np.prod(array.shape or (), dtype=object)) * array.dtype.itemsize
        self._left -= max(whole, chunk)
        if self._left < 0:
            raise DataError(f"{name!r} claims to hold {whole} bytes, more than a file of {self._size} bytes can")
        if array.dtype.hasobject and array.size:
            self._texts(name, array)

    def _texts(self, name: str, array: h5py.Dataset) -> None:
        """Check the total length of texts a few at a time: they may share characters, so a small file can hold many."""
        flat, total = int(array.size), 0
        if array.ndim > 1:
            raise DataError(f"{name!r} is a table of texts, which the schema does not have")
        step = max(1, _H5_LIMITS.text_bytes // max(self._size, 1))
        for start in range(0, flat, step):
            texts: Any = array[start : start + step] if array.ndim else [array[()]]
            total += sum(len(text) for text in texts)
            if total > _H5_LIMITS.text_bytes:
                raise DataError(f"the texts of {name!r} are longer than a file of {self._size} bytes can hold")

    def _attributes(self, item: h5py.Group | h5py.Dataset) -> None:
        for name in item.attrs:
            attribute = item.attrs.get_id(name)
            count = int(np.prod(attribute.shape or (), dtype=object))
            shared = attribute.dtype.hasobject and count > 1 and count * self._size > 8 * _H5_LIMITS.text_bytes
            if shared or count * attribute.dtype.itemsize > READ_LIMITS.unpacked_spare_bytes:
                raise DataError(f"the attribute {name!r} claims to hold {count} values, more than any attribute has")


def _header(path: Path, block: bytes) -> str:
    match = re.fullmatch(rb"i2t-touches ([1-9][0-9]*) sha256 ([0-9a-f]{64})\n\0+", block)
    if match is None or len(block) != HEADER_BYTES:
        raise DataError(f"{path}: not an {SCHEMA} file; move it out of the data set, or convert it with i2t convert")
    if int(match[1]) > SCHEMA_VERSION:
        raise DataError(
            f"{path}: written in schema version {int(match[1])}, but this program reads at most {SCHEMA_VERSION}; "
            "install a newer i2t"
        )
    return match[2].decode()
