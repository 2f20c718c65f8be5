"""One HDF5 file that either exists whole or not at all, and that proves its contents.

The first 512 bytes (an HDF5 user block, which every HDF5 reader skips) hold one line of text,

    i2t-touches <schema version> sha256 <64 hexadecimal digits>

filled up with zeros; the digest covers every byte after them, and the line must be exactly this, so that any changed,
missing or added byte is found before the HDF5 library sees it. Anybody can write such a line, so what a file holds is
looked over as well before anything of it is read: groups and arrays in the file itself, packed by gzip at most, that
unpack to what the file's size allows; no links to elsewhere, no arrays kept in other files.

A file is written under a hidden temporary name in the same folder, synchronised to the disk, renamed, and the folder
synchronised: a process killed at any moment leaves a hidden leftover at worst, never a half-written touch.
"""

import hashlib
import io
import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from i2t.errors import DataError
from i2t.files.limits import READ_LIMITS
from i2t.files.reading import open_regular
from i2t.files.writing import replacing, unwritable

SCHEMA = "i2t-touches"
SCHEMA_VERSION = 2  # sessions, which version 1 called runs
READABLE_SCHEMAS = (1, 2)
ENDING = ".h5"
HEADER_BYTES = 512
MAX_OBJECTS = 4096  # groups and arrays in a file; a touch has 60
MAX_LEVELS = 6  # of groups in groups; a touch has 3
MAX_H5_GROWTH = 200  # times its size, that a file may unpack to: patches of a flat object pack well
MAX_TEXT_GROWTH_BYTES = 2**28  # that texts which share their characters may come to
PLAIN_FILTERS = (h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32)

_HEADER = re.compile(rb"i2t-touches ([1-9][0-9]*) sha256 ([0-9a-f]{64})\n\0+")


def write(path: Path, fill: Callable[[h5py.File], None]) -> Path:
    """Write a new HDF5 file of this schema, atomically and durably; an existing file is replaced.

    It is made in memory first, so that a full disk meets a plain write: the HDF5 library, which closes an open file
    with what it could not write, takes the process down where there is no room.

    Args:
        path: Of the file.
        fill: Writes the contents into the open file.

    Returns:
        The path.

    Raises:
        DataError: The folder cannot be written; FullDiskError if the disk is full, or failed.
    """
    with replacing(path) as temporary:
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
            raise DataError(f"{path}: is no HDF5 file that can be read ({error}); restore it from a copy") from error
        yield file


class _Inspection:
    """Looks over a file before anything of it is read: whether all is in the file itself, and how large it is.

    Args:
        size: Of the file, in bytes.
    """

    def __init__(self, size: int) -> None:
        self._size, self._left, self._objects = size, READ_LIMITS.unpacked_spare_bytes + MAX_H5_GROWTH * size, 0

    def group(self, group: h5py.Group, level: int) -> None:
        """Raise DataError, without the file's name, for what no file of this schema holds."""
        if level > MAX_LEVELS:
            raise DataError("its groups are nested too deep")
        self._attributes(group)
        for name in group:
            self._objects += 1
            if self._objects > MAX_OBJECTS:
                raise DataError(f"holds more than {MAX_OBJECTS} groups and arrays")
            link = group.get(name, getlink=True)
            if not isinstance(link, h5py.HardLink):
                kind = "another file" if isinstance(link, h5py.ExternalLink) else "another place"
                raise DataError(f"{name!r} is a link to {kind}, which is not followed")
            found = group[name]
            if isinstance(found, h5py.Group):
                self.group(found, level + 1)
            elif isinstance(found, h5py.Dataset):
                self._attributes(found)
                self._array(name, found)
            else:
                raise DataError(f"{name!r} is neither a group nor an array")

    def _array(self, name: str, array: h5py.Dataset) -> None:
        if array.external or array.is_virtual:
            raise DataError(f"the values of {name!r} lie in another file, which is not read")
        layout = array.id.get_create_plist()
        filters = [layout.get_filter(i)[0] for i in range(layout.get_nfilters())]
        if not set(filters) <= set(PLAIN_FILTERS):
            raise DataError(f"{name!r} is packed in a way that i2t does not use")
        if array.dtype.hasobject and h5py.check_string_dtype(array.dtype) is None:
            raise DataError(f"{name!r} holds neither numbers nor text")
        chunk = int(np.prod(array.chunks or (1,), dtype=object)) * array.dtype.itemsize
        whole = int(np.prod(array.shape or (), dtype=object)) * array.dtype.itemsize
        self._left -= max(whole, chunk)
        if self._left < 0:
            raise DataError(f"{name!r} says that it holds {whole} bytes, more than a file of {self._size} can")
        if array.dtype.hasobject and array.size:
            self._texts(name, array)

    def _texts(self, name: str, array: h5py.Dataset) -> None:
        """Texts may share their characters, so that a small file holds many long ones: a few at a time are counted."""
        flat, total = int(array.size), 0
        if array.ndim > 1:
            raise DataError(f"{name!r} is a table of texts, which no file of this schema holds")
        step = max(1, MAX_TEXT_GROWTH_BYTES // max(self._size, 1))
        for start in range(0, flat, step):
            some: Any = array[start : start + step] if array.ndim else [array[()]]
            total += sum(len(text) for text in some)
            if total > MAX_TEXT_GROWTH_BYTES:
                raise DataError(f"the texts of {name!r} are longer than a file of {self._size} bytes can hold")

    def _attributes(self, item: h5py.Group | h5py.Dataset) -> None:
        for name in item.attrs:
            about = item.attrs.get_id(name)
            count = int(np.prod(about.shape or (), dtype=object))
            shared = about.dtype.hasobject and count > 1 and count * self._size > 8 * MAX_TEXT_GROWTH_BYTES
            if shared or count * about.dtype.itemsize > READ_LIMITS.unpacked_spare_bytes:
                raise DataError(f"the attribute {name!r} says that it holds {count} values, more than any does")


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
