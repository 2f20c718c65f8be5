"""Packages that only some of i2t needs, and the extra of the distribution that brings each.

A command asks before it works whether what it needs is there, so that nobody waits for an answer that was known.
"""

from importlib.util import find_spec
from typing import NamedTuple

from i2t.errors import MissingExtraError


class Extra(NamedTuple):
    """A package by its own name, and the extra that brings it."""

    package: str
    extra: str


EXTRAS = {  # by the name under which each is imported
    "ContactMechanics": Extra("ContactMechanics", "bench"),
    "embreex": Extra("embreex", "bench"),
    "gymnasium": Extra("Gymnasium", "environments"),
    "manifold3d": Extra("manifold3d", "shapes"),
    "mcap": Extra("mcap", "view"),
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
        need: What needs it, the subject of a sentence, such as "an MCAP file".

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
