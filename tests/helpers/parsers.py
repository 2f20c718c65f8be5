"""All commands with their sub-commands, and what their helps say of each option."""

import io
import os
import re
from contextlib import redirect_stdout, suppress
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from typing import NamedTuple
from unittest import mock

from i2t.__main__ import COMMANDS, EXPERIMENTS

COLUMNS = 80
PARTS = {
    "i2t.convert": (
        "summary", "imagine2touch", "eflesh", "presses", "stream", "pack", "ambient", "npz", "lerobot", "robomimic",
        "csv",
    ),
    "i2t.hardware.hand_eye": ("board", "capture", "estimate"),
    "experiments.recognize": ("simulate", "live"),
}  # fmt: skip
ALONE = ("i2t.emulators.reskin_board", "i2t.emulators.ur_controller")  # parts of a lab that run by themselves too
PARSERS = tuple(
    f"{command} {part}".strip()
    for command in (*COMMANDS, *EXPERIMENTS, *ALONE)
    for part in ("", *PARTS.get(command, ()))
)


class ShownOption(NamedTuple):
    """What a help says of an option."""

    flag: str
    kind: str  # as INT or {a,b}; "" of a switch
    text: str


@cache
def help_of(parser: str) -> str:
    """What a command prints for `--help` on a terminal of 80 columns."""
    module, *part = parser.split()
    spec = find_spec(module)
    assert spec is not None
    main = import_module(f"{module}.__main__" if spec.submodule_search_locations else module).main
    printed = io.TextIOWrapper(io.BytesIO(), encoding="utf-8")
    with mock.patch.dict(os.environ, {"COLUMNS": str(COLUMNS)}), redirect_stdout(printed), suppress(SystemExit):
        main([*part, "--help"])
    printed.flush()
    return printed.buffer.getvalue().decode()


def options_of(parser: str) -> list[ShownOption]:
    """The options that a help lists, but for `--help`."""
    found: list[tuple[str, list[str]]] = []
    for line in help_of(parser).splitlines():
        inside = line.removeprefix("│ ").removesuffix("│").rstrip()
        if not line.startswith("│ "):
            continue
        if inside.startswith("--"):
            name, *text = re.split(r" {2,}", inside, maxsplit=1)
            found.append((name, text))
        elif found and inside.startswith(" "):
            found[-1][1].append(inside.strip())
    shown = []
    for name, text in found:
        flag, *kind = name.split(", --no-")[0].split(maxsplit=1)
        shown.append(ShownOption(flag, "".join(kind), " ".join(text)))
    return shown
