"""Reading of `np.save` output from unknown sources, including object arrays, without executing anything in it.

An object array is a pickle, and a pickle is a program: its opcodes build objects and call named functions. Here, all
opcodes are checked first, and only those that build plain values pass. Then every name in the pickle is looked up in a
short table of substitutes defined below (the parts of a NumPy array, of its type and of a NumPy scalar, and a named
tuple called ReSkinData under any module). The pickle itself calls nothing of NumPy or of the standard library, and any
other name is refused before it is imported.
"""

import io
import itertools
import pickle
import pickletools
import re
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from i2t.errors import DataError
from i2t.files.kinds import kind_of
from i2t.files.limits import READ_LIMITS
from i2t.recordings.files import data_error, read_bytes

# Opcodes of pickled NumPy arrays of objects that are accepted; any other is refused, for safety.
OPCODES = re.compile(
    "PROTO|FRAME|STOP|MARK|POP|POP_MARK|MEMOIZE|(LONG_)?BIN(PUT|GET)|PUT|GET|NONE|NEWTRUE|NEWFALSE|(BIN)?INT[12]?"
    "|LONG[14]?|(BIN)?FLOAT|(SHORT_)?BIN(BYTES|STRING|UNICODE)8?|UNICODE|(EMPTY_)?(LIST|TUPLE|DICT)|APPENDS?|TUPLE[123]"
    "|SETITEMS?|(STACK_)?GLOBAL|REDUCE|BUILD|NEWOBJ"
)
# Parts of NumPy that a pickle may ask for: module and name, and the name of the inert part that stands in for it.
_NUMPY_PARTS = {
    **{(f"numpy.{core}.multiarray", name): name for core in ("core", "_core") for name in ("_reconstruct", "scalar")},
    ("numpy", "ndarray"): "ndarray",
    ("numpy", "dtype"): "dtype",
    ("_codecs", "encode"): "encode",
}


class _Refused(pickle.UnpicklingError):
    """The pickle asks for something that only a program needs."""


def find(path: Path) -> Path | None:
    """Find a file of an array by its name, with or without the suffix .npy that `np.save` adds.

    Args:
        path: Name of the file.

    Returns:
        The path of the file that exists, or None if neither does.
    """
    return next((p for p in (path, path.with_name(path.name + ".npy")) if p.is_file()), None)


def read(path: Path) -> np.ndarray | list[Any]:
    """Read an array of numbers, or an object array as nested lists of numbers, texts and None.

    Args:
        path: Path of the file.

    Returns:
        The array or the lists.

    Raises:
        DataError: If the file cannot be read, or holds anything else.
    """
    stream = io.BytesIO(read_bytes(path))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # NumPy warns of headers that only Python 2 wrote
            version = np.lib.format.read_magic(stream)
            read_header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}[
                version
            ]
            shape, fortran, dtype = read_header(stream)
    except Exception as error:  # a damaged header can make its parser fail in any way
        kind, remedy = kind_of(stream.getvalue()[: READ_LIMITS.head_bytes])
        if kind and not kind.startswith("a NumPy array"):
            raise DataError(f"{path}: is {kind}, not an output of np.save; {remedy}") from error
        raise data_error(path, "is not an output of np.save") from error
    payload = stream.read()
    if dtype.hasobject:
        values = _unpickled(path, payload)
        actual = _shape(values, len(shape))
        if actual != shape and not (0 in shape and actual == shape[: shape.index(0) + 1]):
            raise data_error(path, f"holds {actual} values where its header says {shape}")
        return values
    if dtype.kind not in "fiub":
        raise data_error(path, f"holds {dtype} instead of numbers")
    try:
        return np.frombuffer(payload, dtype).reshape(shape, order="F" if fortran else "C")
    except ValueError as error:
        raise data_error(path, f"has {len(payload)} bytes for an array {shape} of {dtype}") from error


def _unpickled(path: Path, payload: bytes) -> Any:
    try:
        for opcode, argument, _ in pickletools.genops(payload):
            if not OPCODES.fullmatch(opcode.name):
                raise _Refused(f"the opcode {opcode.name}")
            if "PUT" in opcode.name and int(argument or 0) > len(payload):
                raise _Refused("a memo of absurd size")
        value = _Unpickler(io.BytesIO(payload), encoding="latin1").load()
        return _plain(value, itertools.count(-len(payload)), levels=16)  # real files have five levels of lists
    except _Refused as error:
        problem = f"refused, because it asks for {error}, which no recording needs"
        raise DataError(f"{path}: {problem}; do not open it with other programs") from error
    except Exception as error:  # a damaged pickle can make its reader fail in any way
        raise data_error(path, f"its object array is damaged ({error})") from error


class _Unpickler(pickle.Unpickler):
    def __init__(self, stream: io.BytesIO, encoding: str) -> None:
        super().__init__(stream, encoding=encoding)
        self._inert_parts = _inert_parts()  # new for each file, because a pickle can set attributes of a class

    def find_class(self, module: str, name: str) -> Any:
        part = "ReSkinData" if name == "ReSkinData" else _NUMPY_PARTS.get((module, name))
        if part is None:
            raise _Refused(f"{module}.{name}")
        return self._inert_parts[part]


class _Parts(NamedTuple):
    """State of a pickled array, not yet checked."""

    shape: tuple[int, ...]
    code: str
    fortran: bool
    data: Any  # array data as bytes, or a list of objects


def _inert_parts() -> dict[str, Callable[..., Any]]:
    """Make the substitutes of the names in a pickle: inert classes and functions that only collect their arguments."""

    class ReSkinData(NamedTuple):
        time: Any
        acquisition_delay: Any
        data: Any
        dev_id: Any

    class Type:
        def __init__(self, code: str, align: bool = False, copy: bool = False) -> None:
            self.code = code

        def __setstate__(self, state: tuple[Any, ...]) -> None:
            self.code = (">" if state[1] == ">" else "<") + self.code

    class Array:
        parts: _Parts

        def __setstate__(self, state: tuple[Any, ...]) -> None:
            _, shape, kind, fortran, data = state
            self.parts = _Parts(shape, kind.code, fortran, data)

    def reconstruct(kind: Any, shape: Any, code: Any) -> Array:
        if kind is not Array:
            raise _Refused("an array of a foreign class")
        return Array()

    def scalar(kind: Type, data: Any) -> _Scalar:
        return _Scalar(_Parts((1,), kind.code, False, data))

    def encode(text: str, encoding: str) -> bytes:
        return text.encode("latin1")

    return {
        "ReSkinData": ReSkinData,
        "dtype": Type,
        "ndarray": Array,
        "_reconstruct": reconstruct,
        "scalar": scalar,
        "encode": encode,
    }


class _Scalar(NamedTuple):
    parts: _Parts


def _plain(value: Any, budget: "itertools.count[int]", levels: int) -> Any:
    """Convert the result of a pickle to nested lists.

    The budget of one value for each byte of the file stops shared lists that multiply.
    """
    if next(budget) > 0 or levels < 0:
        raise _Refused("more values or deeper lists than its size allows")
    if isinstance(value, int) and abs(value) >= 2**63:
        raise _Refused("an integer of absurd size")
    if value is None or isinstance(value, int | float | str):
        return value
    if isinstance(value, _Scalar):
        return _numbers(value.parts)[0]
    if isinstance(value, list | tuple):
        return [_plain(item, budget, levels - 1) for item in value]
    parts = getattr(value, "parts", None)
    if not isinstance(parts, _Parts):
        raise _Refused(f"a {type(value).__name__}")
    if parts.code.lstrip("<>|=") in ("O", "O8"):
        items = [_plain(item, budget, levels - 1) for item in parts.data]
        return _nested(items, parts.shape)
    return _nested([_plain(number, budget, levels - 1) for number in _numbers(parts)], parts.shape)


def _numbers(parts: _Parts) -> list[Any]:
    """Read the numbers of an array in C order."""
    if not re.fullmatch(r"[<>|=]?[fiub][1248]", parts.code) or not isinstance(parts.data, bytes):
        raise _Refused(f"numbers of the type {parts.code!r}")
    flat = np.frombuffer(parts.data, parts.code)
    return flat.reshape(parts.shape, order="F").ravel().tolist() if parts.fortran else flat.tolist()


def _nested(items: list[Any], shape: tuple[int, ...]) -> Any:
    if len(items) != np.prod(shape, dtype=object):
        raise ValueError(f"{len(items)} values for the shape {shape}")
    for length in reversed(shape[1:]):
        items = [items[i : i + length] for i in range(0, len(items), length)] if length else []
    return items if shape else items[0]


def _shape(values: Any, levels: int) -> tuple[int, ...]:
    """Measure the lengths of the first `levels` levels of nested lists."""
    shape: list[int] = []
    while len(shape) < levels and isinstance(values, list):
        shape.append(len(values))
        values = values[0] if values else None
    return tuple(shape)
