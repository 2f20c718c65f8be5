"""Writing of files whole or not at all, and checks that file names stay inside their folder."""

import json
import math
import os
import re
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from i2t.errors import WRONG_PATH_ERRORS, DataError, FullDiskError


def as_path(name: str, value: Any) -> Path:
    """Check the path of a file or folder that a user gave.

    Args:
        name: The name of the argument, for messages.
        value: The value that the user gave.

    Returns:
        The value as a Path.

    Raises:
        TypeError: The value is neither text nor a path.
        ValueError: The value is empty.
    """
    if not isinstance(value, str | os.PathLike):
        raise TypeError(f"{name}: is {repr(value)[:40]}, not a path; give the name of a file or folder")
    if not os.fspath(value):
        raise ValueError(f"{name}: is empty; give the name of a file or folder")
    return Path(value)


def unwritable(path: str | Path, error: OSError) -> DataError:
    """Make the error for a file that could not be written.

    Args:
        path: The file's path.
        error: The error of the system or of the HDF5 library.

    Returns:
        A DataError if the path is at fault (it does not exist or is forbidden), otherwise a FullDiskError.
    """
    inner = re.search("error message = '([^']*)'", str(error))  # as HDF5 words it
    why = error.strerror or (inner[1] if inner else str(error))
    if isinstance(error, WRONG_PATH_ERRORS):
        return DataError(f"{path}: cannot be written ({why}); choose a folder you may write to")
    return FullDiskError(f"{path}: cannot be written ({why}); make room on its disk, or choose another")


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Within the block, write a file whole or not at all: it gets its name when the block ends without an error.

    Args:
        path: The file's path. Its folder is created if it does not exist, and an existing file is replaced.

    Yields:
        The path of a hidden file in the same folder, which the block has to write. It is removed if the block fails.

    Raises:
        DataError: The folder cannot be written to, or, as a FullDiskError, the disk is full or failed.
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


def write_json(path: Path, values: dict[str, Any]) -> None:
    """Write JSON atomically.

    Args:
        path: Path of the file.
        values: Values by name. Numbers that are not finite become null, and objects of other types texts.

    Raises:
        DataError: The file cannot be written.
    """

    def clean(node: Any) -> Any:
        if isinstance(node, dict):
            return {str(key): clean(value) for key, value in node.items()}
        if isinstance(node, list | tuple):
            return [clean(value) for value in node]
        return None if isinstance(node, float) and not math.isfinite(node) else node

    with replacing(path) as temporary:
        temporary.write_text(json.dumps(clean(values), indent=1, default=str) + "\n")


def end_with_whole_line(path: Path, max_bytes: int = 2**16) -> None:
    """Remove the last line of a text file if it was written in part, as when the disk is full.

    Args:
        path: Path of the file.
        max_bytes: Largest number of bytes of a line.

    Raises:
        OSError: The file cannot be read or shortened.
    """
    with path.open("rb+") as file:
        size = file.seek(0, os.SEEK_END)
        start = file.seek(max(0, size - max_bytes))
        end = file.read().rfind(b"\n") + 1
        if end or not start:
            file.truncate(start + end)


def file_in(folder: Path, name: str, listed_in: str | Path, *, below: bool = False) -> Path:
    """Find a file by a name that another file gives for it, within one folder.

    Args:
        folder: The folder that the file must be in.
        name: The file's name.
        listed_in: The file that gives the name, for messages.
        below: Whether the file may be in a subfolder of the folder.

    Returns:
        The path of the file, which need not exist.

    Raises:
        DataError: The name leads out of the folder, by itself or through a symbolic link.
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


def open_without_links(path: str, flags: int) -> int:
    """Open a file unless it is a symbolic link, as in `open(path, "wb", opener=open_without_links)`.

    Args:
        path: The file's path.
        flags: The flags that `open` passes to its opener.

    Returns:
        The descriptor of the open file.

    Raises:
        OSError: The path is a symbolic link, or cannot be opened.
    """
    return os.open(path, flags | getattr(os, "O_NOFOLLOW", 0), 0o666)


def slug(name: str) -> str:
    """Make a folder name from any text.

    Args:
        name: The text.

    Returns:
        The letters and digits of the text, with hyphens between words and without a possessive "'s".
    """
    return "-".join("".join(c if c.isalnum() else " " for c in name.replace("'s", "")).split())
