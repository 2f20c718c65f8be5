"""Checks the fields of a NamedTuple of arrays against their annotations, which JAX leaves unchecked."""

import types
import typing
from typing import Any

from jaxtyping import jaxtyped


def wrong_fields(value: Any, prefix: str = "") -> list[str]:
    """The names of fields that are not as annotated: dtype, number of axes, and axes of one name of one length."""
    wrong, nested = [], []
    hints = typing.get_type_hints(type(value))
    with jaxtyped("context"):
        for name, field in value._asdict().items():
            hint = hints[name]
            choices = typing.get_args(hint) if isinstance(hint, types.UnionType) else (hint,)
            if hasattr(field, "_fields"):
                nested.append((f"{prefix}{name}.", field))
            elif not any(field is None if choice is type(None) else isinstance(field, choice) for choice in choices):
                wrong.append(prefix + name)
    return wrong + [inner for where, field in nested for inner in wrong_fields(field, where)]
