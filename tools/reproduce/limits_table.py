"""Table of the safety limits of `i2t.hardware.limits`."""

from dataclasses import fields
from typing import Any

from experiments.common.tables import markdown
from i2t.hardware.limits import SAFETY


def safety_limits() -> str:
    """List every safety limit with its value and unit, its purpose, and its test."""
    rows = []
    for limit in fields(SAFETY):
        value = f"{_number(getattr(SAFETY, limit.name))} {limit.metadata['unit']}"
        rows.append([f"`{limit.name}`", value, limit.metadata["protects"], f"`{limit.metadata['tried']}`"])
    return markdown(["limit", "value", "purpose", "test"], rows)


def _number(value: Any) -> str:
    return " to ".join(f"{end:g}" for end in value) if isinstance(value, tuple) else f"{value:.3g}"
