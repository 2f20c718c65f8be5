"""Presets by one set of names, whichever experiment.

  debug    everything once: too small to mean anything; mostly the time to compile, so quicker the second time
  short    the main result in a fraction of the time
  paper    what the README and the docs print; the default
  study    several pads and seeds, for intervals; the default where no single one means anything (pads)

An experiment keeps a dict of those it has, `PRESETS: dict[str, Config]`, and states their names in the type of its
`--preset`, so that `--help` lists them.
"""

import itertools
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, TypeVar

PRESET_NAMES = ("debug", "short", "paper", "study")
RENAMED = {"full": "paper", "default": "paper"}  # of earlier versions

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
        remedy = f"is called {RENAMED[name]} now" if name in RENAMED else f"is none of {', '.join(presets)}"
        raise ValueError(f"--preset {name} {remedy}")
    given = {field: value for field, value in changes.items() if value is not None}
    config: Any = presets[name]
    return replace(config, **given)


def answer_renamed_value(argv: Sequence[str] | None, flag: str, renamed: Mapping[str, str]) -> None:
    """Answer a flag's values of earlier versions with the name they have now.

    Args:
        argv: The command line without the program's name; None takes the process's.
        flag: Such as `--preset`.
        renamed: Old value to new value.

    Raises:
        SystemExit: The flag has an old value; a message says what it is called now.
    """
    args = list(sys.argv[1:] if argv is None else argv)
    given = [arg.split("=", 1)[1] for arg in args if arg.startswith(f"{flag}=")]
    given += [after for arg, after in itertools.pairwise(args) if arg == flag]
    for value in given:
        if value in renamed:
            print(f"error: {flag} {value} is called {flag} {renamed[value]} now", file=sys.stderr)
            raise SystemExit(2)
