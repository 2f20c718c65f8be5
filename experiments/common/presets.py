"""Presets by one set of names, whichever experiment.

  debug    everything once: too small to mean anything; mostly the time to compile, so quicker the second time
  short    the main result in a fraction of the time
  paper    what the README and the docs print; the default
  study    several pads and seeds, for intervals

An experiment keeps a dict of those it has, `PRESETS: dict[str, Config]`, and states their names in the type of its
`--preset`, so that `--help` lists them.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, TypeVar

Config = TypeVar("Config")


def choose_preset(presets: Mapping[str, Config], name: str, **changes: Any) -> Config:
    """The preset of a name, with the changes a user asked for.

    Args:
        presets: An experiment's presets, frozen dataclasses by name.
        name: One of them.
        changes: Fields and their values; None leaves the preset's.

    Returns:
        The changed preset.

    Raises:
        ValueError: The experiment has no such preset.
    """
    if name not in presets:
        raise ValueError(f"--preset {name} is none of {', '.join(presets)}")
    given = {field: value for field, value in changes.items() if value is not None}
    config: Any = presets[name]
    return replace(config, **given)
