"""Files that are there whole or not at all, and names of files that stay in their folder."""

import os
import re
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from i2t.errors import NAMED_WRONGLY, DataError, FullDiskError


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


def slug(name: str) -> str:
    """A folder name.

    Args:
        name: Any text.

    Returns:
        Its letters and digits, with lines between.
    """
    return "-".join("".join(c if c.isalnum() else " " for c in name.replace("'s", "")).split())
