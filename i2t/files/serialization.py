"""NamedTuples of arrays on disk: one npz file each, which appears whole or not at all and never holds a pickle.

Each array is stored under its field's name, those of nested NamedTuples with dots between; None is left out. One more
entry is text (JSON): what kind of thing the file holds, in which version, and whatever the caller wants to remember.
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

TREE_VERSION = 1
ABOUT = "about"

Tree = TypeVar("Tree")


def save(path: Path | str, kind: str, tree: Any, about: dict[str, Any] | None = None, *, beside: Any = None) -> None:
    """Write a NamedTuple of arrays as a file.

    Args:
        path: Of the file.
        kind: Of file, which `load` must name too.
        tree: The NamedTuple; its fields may be NamedTuples.
        about: Anything that JSON can hold, kept with it.
        beside: A second NamedTuple with other fields, which `load` gives where its type is named.

    Raises:
        SerializationError: The file cannot be written.
    """
    path, arrays = Path(path), flatten(tree) | ({} if beside is None else flatten(beside))
    header = {"format": kind, "version": TREE_VERSION, "sha256": _digest(arrays), "about": about or {}}
    try:
        with replacing(path) as temporary, temporary.open("wb") as file:
            np.savez_compressed(file, allow_pickle=False, **{ABOUT: np.array(json.dumps(header))}, **arrays)
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
        path: Of the file.
        kind: Of file.
        form: Type of the NamedTuple.
        renamed: Fields that files of earlier versions call otherwise: the name there, and the name now.
        missing: Ends the sentence where there is no such file.

    Returns:
        The NamedTuple, with NumPy arrays, and what was kept with it.

    Raises:
        SerializationError: There is no such file, or it is of another kind or damaged.
        TypeError: The path is neither text nor a path.
    """
    arrays, header = _read(path, f"{kind} file", missing)
    found, version, digest = header["format"], header["version"], header["sha256"]
    if found != kind:
        raise SerializationError(f"{path}: holds a {found}, not a {kind}; name the right file")
    if version != TREE_VERSION:
        raise SerializationError(
            f"{path}: has version {version}, but this i2t reads version {TREE_VERSION}; make it again"
        )
    if digest != _digest(arrays):
        raise SerializationError(
            f"{path}: its contents have changed since it was written; restore a copy or make it again"
        )
    if renamed:
        now = {name: ".".join(renamed.get(part, part) for part in name.split(".")) for name in arrays}
        arrays = {now[name]: array for name, array in arrays.items()}
    try:
        return _build(form, arrays, ""), header["about"]
    except KeyError as error:
        raise SerializationError(f"{path}: lacks {error}; it was written by another i2t, make it again") from error


def file_kind(path: Path | str) -> str:
    """Kind of a file's contents.

    Args:
        path: Of a file that `save` wrote.

    Returns:
        The kind that `load` must name.

    Raises:
        SerializationError: There is no such file, or it was not written by `save`.
    """
    return str(_read(path, "file")[1]["format"])


@contextmanager
def fitting(path: Path | str) -> Iterator[None]:
    """Name the file in errors of this block, where the parts that `load` read do not fit each other.

    Args:
        path: Of the file.

    Yields:
        Nothing.

    Raises:
        SerializationError: A part is missing, of another shape or of another type.
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
    """Refuse arrays of another shape, and such as are not finite.

    Args:
        path: Of the file that they come from.
        tree: The NamedTuple that `load` gave.
        shapes: Shapes by the arrays' dotted names.
        remedy: Ends the sentence: what to do.

    Raises:
        SerializationError: An array has another shape or is not finite.
    """
    arrays = flatten(tree)
    for name, shape in shapes.items():
        if arrays[name].shape != shape or not np.isfinite(arrays[name]).all():
            raise SerializationError(f"{path}: {name} is not {shape} finite numbers; {remedy}")


def flatten(tree: Any, prefix: str = "") -> dict[str, np.ndarray]:
    """Arrays by their dotted names.

    Args:
        tree: A NamedTuple of arrays and of NamedTuples.
        prefix: Before each name.

    Returns:
        The arrays.
    """
    arrays: dict[str, np.ndarray] = {}
    for name, value in tree._asdict().items():
        if hasattr(value, "_asdict"):
            arrays |= flatten(value, f"{prefix}{name}.")
        elif value is not None:
            arrays[prefix + name] = np.asarray(value)
    return arrays


def _build(form: Any, arrays: dict[str, np.ndarray], prefix: str) -> Any:
    """A NamedTuple from its arrays; fields that may be None are where nothing is stored."""
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
    """Arrays of a file, and its header."""
    path = as_path("path", path)
    if not path.is_file():
        raise SerializationError(f"{path}: there is no such file; name a {what} that i2t wrote{missing}")
    try:
        data = read_bytes(path)
        check_archive(path, data)
        with np.load(io.BytesIO(data), allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        header = json.loads(str(arrays.pop(ABOUT)))
        if any(array.dtype.kind not in "biufU" for array in arrays.values()):
            raise ValueError("neither numbers nor text")
        if not {"format", "version", "sha256", "about"} <= header.keys():
            raise ValueError("no header")
    except DataError as error:  # says itself what it is
        raise SerializationError(str(error)) from error
    except (OSError, ValueError, KeyError, TypeError, AttributeError, EOFError, zipfile.BadZipFile) as error:
        raise SerializationError(
            f"{path}: is damaged or was not written by i2t; restore a copy or make it again"
        ) from error
    except Exception as error:  # zlib's and the zip reader's own kinds, which have no common parent
        raise SerializationError(f"{path}: is damaged; restore a copy or make it again") from error
    return arrays, header


def _digest(arrays: dict[str, np.ndarray]) -> str:
    """Digest of all names, types, shapes and values."""
    digest = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()
