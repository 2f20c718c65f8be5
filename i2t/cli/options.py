"""Options of a command: limits of their numbers, and refusals before anything large is imported.

Options are fields of a dataclass. What numbers a field allows is part of its type (`Count`, `Seed`, `Probability` or
`Annotated[float, Limits(...)]`), so that `check_options` can refuse others.
"""

import ast
import importlib.util
import math
import os
import sys
import typing
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from numbers import Real
from pathlib import Path
from typing import Annotated, Any, TypeAlias, TypeVar

from i2t.cli.pipes import NOBODY_READS, nobody_reads

T = TypeVar("T")


@dataclass(frozen=True)
class Limits:
    """Numbers that an option allows, part of its type."""

    least: int | float = -math.inf
    most: int | float = math.inf
    above: bool = False  # whether the least itself is too small

    def allow(self, value: int | float) -> bool:
        """Test a number against the limits.

        Args:
            value: Any number.

        Returns:
            Whether it is; NaN never is.
        """
        return (value > self.least if self.above else value >= self.least) and value <= self.most

    def __str__(self) -> str:
        if self.most < math.inf:
            return (
                f"more than {self.least:g} and at most {self.most:.10g}"
                if self.above
                else f"{self.least:g} to {self.most:.10g}"
            )
        return f"more than {self.least:g}" if self.above else f"at least {self.least:g}"


Count: TypeAlias = Annotated[int, Limits(1)]
Seed: TypeAlias = Annotated[int, Limits(0, 2**31 - 1)]
Positive: TypeAlias = Annotated[float, Limits(0, above=True)]
Probability: TypeAlias = Annotated[float, Limits(0, 1)]


def read_options(
    kind: Callable[..., T],
    words: Sequence[str] | None,
    *,
    program: str,
    description: str = "",
    config: Sequence[Any] | None = None,
) -> T:
    """Read a command line into a dataclass.

    Args:
        kind: The dataclass, or a union of those of sub-commands.
        words: The command line without the program's name; None takes the process's.
        program: What a user types to run the command.
        description: For the help; where it is empty the docstring of the dataclass.
        config: Of tyro; by default a flag that is off has no other that turns it off.

    Returns:
        The options.

    Raises:
        SystemExit: After help, or with tyro's answer on stderr where a word makes no sense; 141 without a word if
            nobody reads the help to its end.
    """
    import tyro  # here, as functions that check options need it not

    config = (tyro.conf.FlagCreatePairsOff,) if config is None else config
    try:
        try:
            return tyro.cli(kind, args=words, prog=program, description=description or None, config=config)
        except SystemExit:
            sys.stdout.flush()  # here, where it is known what to say if that fails
            raise
    except BrokenPipeError:
        nobody_reads()
        raise SystemExit(NOBODY_READS) from None


def check_options(options: Any, given: Sequence[str] = (), *, group: str = "") -> None:
    """Refuse numbers outside their limits, and lists that were named and left empty.

    Args:
        options: A dataclass as a command line was read into it; groups of options are dataclasses in it.
        given: The words of the command line.
        group: Of the options, such as `settings.`.

    Raises:
        ValueError: A number, NaN or an empty list; the message names its flag.
    """
    for flag, hint, value in _options(options, group):
        limits = _limits(hint)
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, bool) or not isinstance(number, Real):  # NumPy's numbers are Real too
                continue
            if limits is not None and not limits.allow(float(number)):
                raise ValueError(f"--{flag} is {number:.10g}; give {limits}")
            if math.isnan(number):
                raise ValueError(f"--{flag} is not a number; give one")
        if isinstance(value, tuple) and not value and any(word.replace("_", "-") == f"--{flag}" for word in given):
            raise ValueError(f"--{flag} names nothing; give one value at least, or leave it out")


def require_path(flag: str, path: Path | None, what: str = "file or folder") -> None:
    """Refuse a path that does not exist, and a file where a folder should be.

    Args:
        flag: The option that names it, such as `--pad`.
        path: As given; None where the option was left out.
        what: What should be there; only a folder is a "folder".

    Raises:
        ValueError: It is not there.
    """
    if path is not None and not (path.is_dir() if what == "folder" else path.exists()):
        raise ValueError(f"{flag} {path}: there is no such {what}; check the name")


def require_writable(flag: str, path: Path) -> None:
    """Refuse a file or folder that cannot be made or written, before the work of which it is the result.

    Args:
        flag: The option that names it, such as `--out`.
        path: As given; it and folders above it need not be there yet.

    Raises:
        ValueError: A file stands where a folder should, or nothing may be written there.
    """
    there = next((each for each in (path, *path.parents) if each.exists()), Path())
    if there != path and not there.is_dir():
        raise ValueError(f"{flag} {path}: {there} is a file; name a folder")
    if not os.access(there, os.W_OK | (os.X_OK if there.is_dir() else 0)):
        raise ValueError(f"{flag} {path}: {there} may not be written; name a place where you may write")


def require_with(flag: str, given: bool, needed: str, holds: bool) -> None:
    """Refuse an option that has no effect without another.

    Args:
        flag: The option.
        given: Whether it was given.
        needed: The option without which it has no effect, as a user types it.
        holds: Whether that was given.

    Raises:
        ValueError: The option has no effect.
    """
    if given and not holds:
        raise ValueError(f"{flag} has no effect without {needed}; pass both, or leave {flag} out")


@cache
def docstring_of(module: str) -> str:
    """The docstring of a module that is not imported.

    Args:
        module: Its name.

    Returns:
        The text, "" where it has none.
    """
    spec = importlib.util.find_spec(module)
    if spec is None or spec.origin is None:
        return ""
    return ast.get_docstring(ast.parse(Path(spec.origin).read_text())) or ""


def _options(options: Any, group: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Flag, type and value of every option, those of groups as `settings.press`; as `press` where a group is FLAT."""
    hints = typing.get_type_hints(type(options), include_extras=True)
    for each in fields(options):
        value = getattr(options, each.name)
        flag = group + each.name.replace("_", "-")
        if is_dataclass(value):
            yield from _options(value, group if getattr(value, "FLAT", False) else f"{flag}.")
        else:
            yield flag, hints[each.name], value


def _limits(hint: Any) -> Limits | None:
    """The limits in a type, or in one that it is made of."""
    for note in getattr(hint, "__metadata__", ()):
        if isinstance(note, Limits):
            return note
    return next((found for part in typing.get_args(hint) if (found := _limits(part)) is not None), None)
