"""Presets, which have the same names in all experiments.

  debug    every step once, too small for meaningful results; mostly compilation, so faster the second time
  short    the main result in a fraction of the time
  paper    the results in the README and the docs; the default
  study    several pads and seeds, for intervals

An experiment has a dict of its presets, `PRESETS: dict[str, Config]`, and the type of its `--preset` lists their
names, so that `--help` shows them.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, TypeVar

Config = TypeVar("Config")


def choose_preset(presets: Mapping[str, Config], name: str, **changes: Any) -> Config:
    """Choose a preset by its name, and apply the user's changes.

    Args:
        presets: An experiment's presets, frozen dataclasses by name.
        name: Name of the preset.
        changes: Values by field; None keeps the preset's value.

    Returns:
        The changed preset.

    Raises:
        ValueError: The experiment has no preset of this name.
    """
    if name not in presets:
        raise ValueError(f"--preset {name} is none of {', '.join(presets)}")
    given = {field: value for field, value in changes.items() if value is not None}
    config: Any = presets[name]
    return replace(config, **given)
