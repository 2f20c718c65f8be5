"""Errors that i2t raises for users to catch. Each message is one sentence that names what is wrong and the remedy.

A command asks before it works whether the packages of extras that it needs are there (`require_extra`), so that nobody
waits for an answer that was known.
"""

import difflib
import re
from collections.abc import Iterable
from importlib.util import find_spec
from typing import NamedTuple

NAMED_WRONGLY = (FileNotFoundError, FileExistsError, NotADirectoryError, IsADirectoryError, PermissionError)
MIN_LIKENESS = 0.7  # smallest ratio of `difflib` at which one name is taken for a misspelling of another
# Controls, ends of lines and paragraphs, marks that turn the direction of writing, and halves of characters.
_CONTROLS = re.compile("[\x00-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")


def printable(text: object) -> str:
    """A text in one line, with its control characters escaped; letters of every script stay.

    Args:
        text: A name, a path or a message.

    Returns:
        The text, with `\\x1b` for an escape and `\\n` for the end of a line.
    """
    return _CONTROLS.sub(lambda found: found[0].encode("unicode_escape").decode(), str(text))


class I2TError(Exception):
    """An error that the reader of its message can mend."""


class DataError(I2TError, ValueError):
    """A file or a data set that cannot be used; the message is one line that names it, what is wrong and the remedy.

    Args:
        message: What happened; line breaks become spaces, and control characters are escaped.
    """

    def __init__(self, message: str) -> None:
        super().__init__(printable(" ".join(message.splitlines())))  # what a library reported may have several lines


class SerializationError(I2TError, ValueError):
    """A file of arrays that is damaged, or of another kind than asked for."""


class FullDiskError(DataError, SerializationError):
    """A file could not be kept, for no fault of its name: the disk is full, or failed."""


class MissingExtraError(I2TError, ModuleNotFoundError, ValueError):
    """A package that only some of i2t needs is not installed; the message names the extra that brings it."""


class CheckpointError(I2TError, ValueError):
    """A checkpoint that cannot be read back."""


class DeviceError(I2TError, RuntimeError):
    """A device failed, in one sentence."""


class NotConnectedError(DeviceError):
    """The device was used before `connect` or after `close`."""


class DeviceTimeoutError(DeviceError):
    """Nothing new came in time. The device may speak again by itself."""


class MotionStoppedError(DeviceError):
    """A motion ended because somebody called `stop`."""


class Extra(NamedTuple):
    """A package by its own name, and the extra that brings it."""

    package: str
    extra: str


EXTRAS = {  # by the name under which each is imported
    "ContactMechanics": Extra("ContactMechanics", "bench"),
    "embreex": Extra("embreex", "bench"),
    "gymnasium": Extra("Gymnasium", "environments"),
    "manifold3d": Extra("manifold3d", "shapes"),
    "open3d": Extra("Open3D", "bench"),
    "nbconvert": Extra("Jupyter", "notebooks"),
    "ipykernel": Extra("Jupyter", "notebooks"),
    "pyarrow": Extra("pyarrow", "lerobot"),
    "pyvista": Extra("pyvista", "notebooks"),
    "rerun": Extra("rerun-sdk", "view"),
    "torch": Extra("torch", "bench"),
    "skfem": Extra("scikit-fem", "test"),
    "skimage": Extra("scikit-image", "reconstruct"),
    "sklearn": Extra("scikit-learn", "notebooks"),
}


def why_missing(module: str, need: str) -> str:
    """Message for a package that is not installed; it is looked for and not imported.

    Args:
        module: One of `EXTRAS`.
        need: What needs it, the subject of a sentence, such as "a Rerun recording".

    Returns:
        One sentence with the remedy; "" where the package is there.
    """
    if find_spec(module) is not None:
        return ""
    package, extra = EXTRAS[module]
    return f"{need} needs {package}, which is missing: pip install 'imagine2touch[{extra}]'"


def require_extra(module: str, need: str) -> None:
    """Raise an error for a package that is not installed.

    Args:
        module: One of `EXTRAS`.
        need: What needs it, as for `why_missing`.

    Raises:
        MissingExtraError: It is missing.
    """
    if why := why_missing(module, need):
        raise MissingExtraError(why)


def did_you_mean(name: str, names: Iterable[str], otherwise: str | None = None) -> str:
    """Suggest what to do about an unknown name.

    Args:
        name: The unknown name.
        names: The names that exist.
        otherwise: The remedy where no name is like it; by default, to choose one of all names.

    Returns:
        Half a sentence, such as "did you mean hammer?" where a name is like it.
    """
    names = list(names)
    if close := closest(name, names):
        return f"did you mean {close}?"
    return f"choose one of {', '.join(names)}" if otherwise is None else otherwise


def closest(name: str, names: Iterable[str]) -> str | None:
    """Find the name that was probably meant by a misspelt one.

    Args:
        name: The misspelt name.
        names: The names that exist.

    Returns:
        The name that is most like it, ignoring capitals; None where no name is like it.
    """
    spelled = {candidate.lower(): candidate for candidate in names}
    close = difflib.get_close_matches(name.lower(), spelled, 1, MIN_LIKENESS)
    return spelled[close[0]] if close else None
