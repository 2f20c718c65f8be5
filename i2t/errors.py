"""Exceptions that i2t raises, for users to catch. Each message is one sentence that names the fault and the remedy.

Before a command starts work it checks with `require_extra` that the optional packages it needs are installed.
"""

import difflib
import re
from collections.abc import Iterable
from importlib.util import find_spec
from typing import NamedTuple

from i2t.installation import extra_advice

# Operating-system errors that mean that the user gave a wrong path, not that the system failed.
WRONG_PATH_ERRORS = (FileNotFoundError, FileExistsError, NotADirectoryError, IsADirectoryError, PermissionError)
# Characters that messages escape: control characters, line and paragraph separators, marks that reverse the direction
# of writing, and lone surrogates.
_CONTROLS = re.compile("[\x00-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")


def printable(text: object) -> str:
    """Put a text on one line and escape its control characters; letters of every script stay.

    Args:
        text: A name, a path or a message.

    Returns:
        The text, with `\\x1b` for an escape character and `\\n` for the end of a line.
    """
    return _CONTROLS.sub(lambda match: match[0].encode("unicode_escape").decode(), str(text))


class I2TError(Exception):
    """Base of all exceptions of i2t: an error that the user can correct."""


class DataError(I2TError, ValueError):
    """A file or data set cannot be used. The message is one line that names it, the fault and the remedy.

    Args:
        message: What happened. Line breaks become spaces, and control characters are escaped.
    """

    def __init__(self, message: str) -> None:
        super().__init__(printable(" ".join(message.splitlines())))  # messages of libraries may have several lines


class SerializationError(I2TError, ValueError):
    """A file of arrays is damaged, or is of another kind than requested."""


class FullDiskError(DataError, SerializationError):
    """A file could not be written because the disk is full or has failed."""


class MissingExtraError(I2TError, ModuleNotFoundError, ValueError):
    """An optional package is not installed. The message names the extra that installs it."""


class CheckpointError(I2TError, ValueError):
    """A checkpoint (the folder of a trained model) cannot be read."""


class DeviceError(I2TError, RuntimeError):
    """An arm, skin or camera failed."""


class MissingDriverError(DeviceError, MissingExtraError):
    """A device cannot be used because the package that drives it is missing or too old."""


class NotConnectedError(DeviceError):
    """A device was used before `connect` or after `close`."""


class DeviceTimeoutError(DeviceError):
    """A device sent nothing new in time. It may recover by itself."""


class MotionStoppedError(DeviceError):
    """A motion of an arm ended because `stop` was called."""


class Extra(NamedTuple):
    """An optional package: its name, and the extra of i2t that installs it."""

    package: str
    extra: str


# Optional packages and the extras of i2t that install them, by the name to import.
EXTRAS = {
    "ContactMechanics": Extra("ContactMechanics", "bench"),
    "embreex": Extra("embreex", "bench"),
    "gymnasium": Extra("Gymnasium", "environments"),
    "manifold3d": Extra("manifold3d", "shapes"),
    "open3d": Extra("Open3D", "bench"),
    "pyarrow": Extra("pyarrow", "lerobot"),
    "pyvista": Extra("pyvista", "notebooks"),
    "rerun": Extra("rerun-sdk", "view"),
    "torch": Extra("torch", "bench"),
    "skfem": Extra("scikit-fem", "test"),
    "skimage": Extra("scikit-image", "reconstruct"),
    "sklearn": Extra("scikit-learn", "notebooks"),
    "viser": Extra("viser", "view"),
}


def explain_missing_extra(module: str, need: str) -> str:
    """Explain which extra installs a missing package. The package is not imported.

    Args:
        module: Name of the module, one of `EXTRAS`.
        need: What needs the package, as the subject of a sentence, such as "a Rerun recording".

    Returns:
        One sentence with the remedy, or "" if the package is installed.
    """
    if find_spec(module) is not None:
        return ""
    package, extra = EXTRAS[module]
    return f"{need} needs {package}, which is missing: {extra_advice(extra, package)}"


def require_extra(module: str, need: str) -> None:
    """Raise an error if an optional package is not installed.

    Args:
        module: Name of the module, one of `EXTRAS`.
        need: What needs the package, as for `explain_missing_extra`.

    Raises:
        MissingExtraError: The package is not installed.
    """
    if message := explain_missing_extra(module, need):
        raise MissingExtraError(message)


def did_you_mean(name: str, names: Iterable[str], otherwise: str | None = None) -> str:
    """Suggest a remedy for an unknown name.

    Args:
        name: The unknown name.
        names: All names that exist.
        otherwise: The remedy if no name is similar; by default, a list of all names to choose from.

    Returns:
        Half a sentence, such as "did you mean hammer?" if a name is similar.
    """
    names = list(names)
    if close := closest(name, names):
        return f"did you mean {close}?"
    return f"choose one of {', '.join(names)}" if otherwise is None else otherwise


def closest(name: str, names: Iterable[str]) -> str | None:
    """Find the name that was probably meant by a misspelt one.

    Args:
        name: The misspelt name.
        names: All names that exist.

    Returns:
        The most similar name, ignoring case, or None if no name is similar.
    """
    spelled = {candidate.lower(): candidate for candidate in names}
    close = difflib.get_close_matches(name.lower(), spelled, 1, cutoff=0.7)
    return spelled[close[0]] if close else None
