"""NamedTuples of arrays on disk: one npz file each, which is written whole or not at all and never holds a pickle.

Each array is stored under the name of its field. Names of fields in nested NamedTuples are joined by dots, and fields
that are None are left out. One more entry, a text in JSON, records the kind and version of the file and whatever the
caller wants to remember.
"""

import hashlib
import io
import json
import types
import typing
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from i2t.errors import DataError, SerializationError
from i2t.files.archives import check_archive
from i2t.files.reading import read_bytes
from i2t.files.writing import as_path, replacing

FORMAT_VERSION = 1  # version of the archives that `save` writes and `load` reads
HEADER_ENTRY = "about"  # name of the archive's entry that holds kind and version of the file

Tree = TypeVar("Tree")


def save(path: Path | str, kind: str, tree: Any, about: dict[str, Any] | None = None, *, extra: Any = None) -> None:
    """Write a NamedTuple of arrays to a file in .npz format, which `load` reads.

    Args:
        path: The file's path.
        kind: Name of the kind of file; `load` refuses a file of another kind.
        tree: The NamedTuple, whose fields may be NamedTuples.
        about: Anything that JSON can hold; `load` returns it with the arrays.
        extra: A second NamedTuple with other fields; `load` returns it instead if it is given that type.

    Raises:
        SerializationError: The file cannot be written.
    """
    path, arrays = Path(path), flatten(tree) | ({} if extra is None else flatten(extra))
    header = {"format": kind, "version": FORMAT_VERSION, "sha256": _digest(arrays), "about": about or {}}
    try:
        with replacing(path) as temporary, temporary.open("wb") as file:
            np.savez_compressed(file, allow_pickle=False, **{HEADER_ENTRY: np.array(json.dumps(header))}, **arrays)
    except DataError as error:
        raise (error if isinstance(error, SerializationError) else SerializationError(str(error))) from error


def load(
    path: Path | str,
    kind: str,
    form: type[Tree],
    *,
    renamed: Mapping[str, str] | None = None,
    missing: str = "",
) -> tuple[Tree, dict[str, Any]]:
    """Read a NamedTuple that `save` wrote.

    Args:
        path: The file's path.
        kind: The kind of file, as `save` was given it.
        form: The type of the NamedTuple to return.
        renamed: Names of fields in files of earlier versions, mapped to the names of today.
        missing: The end of the message for a file that does not exist.

    Returns:
        The NamedTuple, with NumPy arrays, and the `about` that `save` was given.

    Raises:
        SerializationError: The file does not exist, is of another kind, or is damaged.
        TypeError: The path is neither text nor a path.
    """
    arrays, header = _read(path, f"{kind} file", missing)
    stored_kind, version, digest = header["format"], header["version"], header["sha256"]
    if stored_kind != kind:
        raise SerializationError(f"{path}: holds a {stored_kind}, not a {kind}; name the right file")
    if version != FORMAT_VERSION:
        raise SerializationError(
            f"{path}: has version {version}, but this i2t reads version {FORMAT_VERSION}; make it again"
        )
    if digest != _digest(arrays):
        raise SerializationError(
            f"{path}: its contents have changed since it was written; restore a copy or make it again"
        )
    if renamed:
        arrays = {
            ".".join(renamed.get(part, part) for part in name.split(".")): array for name, array in arrays.items()
        }
    try:
        return _build(form, arrays, ""), header["about"]
    except KeyError as error:
        raise SerializationError(
            f"{path}: lacks {error}; it was written by another version of i2t; make it again"
        ) from error


def file_kind(path: Path | str) -> str:
    """Read the kind of a file that `save` wrote.

    Args:
        path: The file's path.

    Returns:
        The kind that `save` was given.

    Raises:
        SerializationError: The file does not exist, or was not written by `save`.
    """
    return str(_read(path, "file")[1]["format"])


@contextmanager
def fitting(path: Path | str) -> Iterator[None]:
    """Within the block, turn errors into one that names a loaded file whose arrays do not fit each other.

    Args:
        path: The path of the file that `load` read.

    Yields:
        Nothing.

    Raises:
        SerializationError: The block failed, because a part is missing or has another shape or type.
    """
    try:
        yield
    except SerializationError:
        raise
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        reason = " ".join(str(error).split())[:100]
        raise SerializationError(
            f"{path}: its parts do not fit each other ({reason}); restore a copy or make it again"
        ) from error


def check_arrays(path: Path | str, tree: Any, shapes: Mapping[str, tuple[int, ...]], remedy: str) -> None:
    """Refuse a loaded NamedTuple whose arrays have a wrong shape or non-finite values.

    Args:
        path: The path of the file that the arrays come from.
        tree: The NamedTuple that `load` returned.
        shapes: The required shape of each array to check, by the array's dotted name.
        remedy: The end of the message, which states the remedy.

    Raises:
        SerializationError: An array has another shape or a non-finite value.
    """
    arrays = flatten(tree)
    for name, shape in shapes.items():
        if arrays[name].shape != shape or not np.isfinite(arrays[name]).all():
            raise SerializationError(f"{path}: {name} is not {shape} finite numbers; {remedy}")


def flatten(tree: Any, prefix: str = "") -> dict[str, np.ndarray]:
    """Collect the arrays of nested NamedTuples by their dotted names.

    Args:
        tree: A NamedTuple of arrays and of NamedTuples.
        prefix: Text that is put in front of each name.

    Returns:
        The arrays by their dotted names, without fields that are None.
    """
    arrays: dict[str, np.ndarray] = {}
    for name, value in tree._asdict().items():
        if hasattr(value, "_asdict"):
            arrays |= flatten(value, f"{prefix}{name}.")
        elif value is not None:
            arrays[prefix + name] = np.asarray(value)
    return arrays


def _build(form: Any, arrays: dict[str, np.ndarray], prefix: str) -> Any:
    """Build a NamedTuple from its arrays; a field that is not stored is None if its type allows that."""
    values: dict[str, Any] = {}
    for name, hint in typing.get_type_hints(form).items():
        several = typing.get_origin(hint) in (typing.Union, types.UnionType)
        choices = typing.get_args(hint) if several else (hint,)
        nested = next((choice for choice in choices if hasattr(choice, "_fields")), None)
        stored = prefix + name in arrays or any(key.startswith(f"{prefix}{name}.") for key in arrays)
        if not stored and type(None) in choices:
            values[name] = None
        elif nested is not None and stored:
            values[name] = _build(nested, arrays, f"{prefix}{name}.")
        else:
            values[name] = arrays[prefix + name]
    return form(**values)


def _read(path: Path | str, what: str, missing: str = "") -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Read the arrays of a file and its header."""
    path = as_path("path", path)
    if not path.is_file():
        raise SerializationError(f"{path}: there is no such file; name an {what} that i2t wrote{missing}")
    try:
        data = read_bytes(path)
        check_archive(path, data)
        with np.load(io.BytesIO(data), allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        header = json.loads(str(arrays.pop(HEADER_ENTRY)))
        if any(array.dtype.kind not in "biufU" for array in arrays.values()):
            raise ValueError("neither numbers nor text")
        if not {"format", "version", "sha256", "about"} <= header.keys():
            raise ValueError("no header")
    except DataError as error:  # its message names the file already
        raise SerializationError(str(error)) from error
    except (OSError, ValueError, KeyError, TypeError, AttributeError, EOFError, zipfile.BadZipFile) as error:
        raise SerializationError(
            f"{path}: is damaged or was not written by i2t; restore a copy or make it again"
        ) from error
    except Exception as error:  # zlib and the zip reader raise errors of their own, which share no base class
        raise SerializationError(f"{path}: is damaged; restore a copy or make it again") from error
    return arrays, header


def _digest(arrays: dict[str, np.ndarray]) -> str:
    """Compute the SHA-256 digest of all names, types, shapes and values."""
    digest = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()
