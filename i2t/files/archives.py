"""Unpacking of archives within bounds, because a kilobyte may unpack to gigabytes."""

import gzip
import io
import zipfile
import zlib
from pathlib import Path

from i2t.errors import DataError
from i2t.files.limits import READ_LIMITS


def unpacked_size_error(path: str | Path, max_bytes: float) -> DataError:
    """Make the error for a compressed file that unpacks to more bytes than any recording has.

    Args:
        path: The archive's path.
        max_bytes: The number of bytes that the archive may unpack to.

    Returns:
        The error, whose message names the file.
    """
    return DataError(
        f"{path}: unpacks to more than {readable_size(int(max_bytes))}, as no recording does; restore it from the "
        "source"
    )


def unpacked(path: str | Path, data: bytes) -> bytes:
    """Unpack a gzip file.

    Args:
        path: The file's path, for messages.
        data: The packed bytes.

    Returns:
        The unpacked bytes.

    Raises:
        DataError: The file is damaged, or unpacks to more than any recording.
    """
    max_bytes = max_unpacked_size(len(data))
    try:
        with gzip.open(io.BytesIO(data)) as file:
            contents = file.read(max_bytes + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise DataError(f"{path}: cannot be unpacked ({error}); restore it from the source") from error
    if len(contents) > max_bytes:
        raise unpacked_size_error(path, max_bytes)
    return contents


def max_unpacked_size(size: int) -> int:
    """Compute the largest number of bytes that a compressed file may unpack to before it is refused.

    Args:
        size: The number of bytes of the packed file.

    Returns:
        `READ_LIMITS.unpacked_spare_bytes` plus `unpacked_growth` times the size; recordings stay far below it.
    """
    return READ_LIMITS.unpacked_spare_bytes + READ_LIMITS.unpacked_growth * size


def check_archive(path: str | Path, data: bytes) -> None:
    """Refuse a zip archive (an .npz file) that no program of i2t can have written.

    Args:
        path: The archive's path, for messages.
        data: The archive's bytes.

    Raises:
        DataError: The archive has too many entries or two of one name, announces too large a size, or is packed by
            another method than stored or deflated.
        zipfile.BadZipFile: The data are not a zip archive.
    """
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        entries = archive.infolist()
    max_bytes, total = max_unpacked_size(len(data)), sum(entry.file_size for entry in entries)
    too_many = len(entries) > READ_LIMITS.archive_entries
    if too_many or total > max_bytes or len({entry.filename for entry in entries}) < len(entries):
        raise DataError(
            f"{path}: is an archive of {len(entries)} entries that unpacks to {readable_size(total)}, unlike any file "
            "of i2t; restore a copy or make it again"
        )
    if any(entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) for entry in entries):
        raise DataError(f"{path}: is packed in a way that i2t does not use; restore a copy or make it again")


def readable_size(count: int) -> str:
    """Format a number of bytes for a message.

    Args:
        count: The number of bytes.

    Returns:
        The size as text, in MiB, or in bytes if it is below one MiB.
    """
    return f"{count / 2**20:.3g} MiB" if count >= 2**20 else f"{count} bytes"
