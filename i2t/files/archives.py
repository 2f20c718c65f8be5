"""Archives, unpacked within bounds: a kilobyte may unpack to gigabytes."""

import gzip
import io
import zipfile
import zlib
from pathlib import Path

from i2t.errors import DataError

SPARE_BYTES = 16 * 2**20  # that a small archive may unpack to, however small it is
MAX_INFLATION = 40  # times its size, that an archive may unpack to beyond that: numbers as text reach 10
MAX_ARCHIVE_ENTRIES = 4096
ARCHIVE_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)


def unpacks_to_too_much(path: str | Path, most: float) -> DataError:
    """Error for an archive that unpacks to more than numbers ever do.

    Args:
        path: The file.
        most: Bytes that it may unpack to.

    Returns:
        The error, which names the file.
    """
    return DataError(
        f"{path}: unpacks to more than {readable_size(int(most))}, as no recording does; restore it from the source"
    )


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
        raise unpacks_to_too_much(path, most)
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
            f"{path}: is an archive of {len(entries)} entries that unpacks to {readable_size(total)}, as none of i2t's "
            "does; restore a copy or make it again"
        )
    if any(entry.compress_type not in ARCHIVE_METHODS for entry in entries):
        raise DataError(f"{path}: is packed in a way that i2t does not use; restore a copy or make it again")


def readable_size(count: int) -> str:
    """A number of bytes, as a message names it.

    Args:
        count: Bytes.

    Returns:
        The number in MiB, or in bytes where it is smaller than one MiB.
    """
    return f"{count / 2**20:.3g} MiB" if count >= 2**20 else f"{count} bytes"
