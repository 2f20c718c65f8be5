"""Options of a command, read by tyro into a dataclass."""

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import tyro

T = TypeVar("T")


def read_options(
    kind: Callable[..., T],
    words: Sequence[str] | None,
    *,
    program: str,
    description: str = "",
    config: Sequence[Any] = (tyro.conf.FlagCreatePairsOff,),
) -> T:
    """Read a command line into a dataclass.

    Args:
        kind: The dataclass, or a union of those of sub-commands.
        words: The command line without the program's name; None takes the process's.
        program: What a user types to run the command.
        description: For the help; where it is empty the docstring of the dataclass.
        config: Of tyro.

    Returns:
        The options.

    Raises:
        SystemExit: After help, or with tyro's answer on stderr where a word makes no sense.
    """
    return tyro.cli(kind, args=words, prog=program, description=description or None, config=config)
