"""Options of a command: limits of their numbers, and refusals before any large import.

Options are the fields of a dataclass. The limits of a number are part of its type (`Count`, `Seed`, `Probability` or
`Annotated[float, Limits(...)]`), so that `check_options` can refuse other numbers.
"""

import ast
import importlib.util
import math
import os
import sys
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from numbers import Real
from pathlib import Path
from typing import Annotated, Any, TypeAlias, TypeVar

from i2t.cli.pipes import ExitCode, output_is_closed

Options = TypeVar("Options")


@dataclass(frozen=True)
class Limits:
    """Smallest (allowed or excluded) and largest number of a command-line option, as an annotation of its type."""

    minimum: int | float = -math.inf
    maximum: int | float = math.inf
    above: bool = False  # whether `minimum` itself is excluded

    def allow(self, value: int | float) -> bool:
        """Test whether a number is allowed.

        Args:
            value: Any number.

        Returns:
            Whether the number is within the limits; never for NaN.
        """
        return (value > self.minimum if self.above else value >= self.minimum) and value <= self.maximum

    def __str__(self) -> str:
        if self.maximum < math.inf:
            return (
                f"more than {self.minimum:g} and at most {self.maximum:.10g}"
                if self.above
                else f"{self.minimum:g} to {self.maximum:.10g}"
            )
        return f"more than {self.minimum:g}" if self.above else f"at least {self.minimum:g}"


Count: TypeAlias = Annotated[int, Limits(1)]
Seed: TypeAlias = Annotated[int, Limits(0, 2**31 - 1)]
Positive: TypeAlias = Annotated[float, Limits(0, above=True)]
Probability: TypeAlias = Annotated[float, Limits(0, 1)]


def read_options(
    kind: Callable[..., Options],
    words: Sequence[str] | None,
    *,
    program: str,
    description: str = "",
    config: Sequence[Any] | None = None,
    default: Options | None = None,
) -> Options:
    """Read a command line into a dataclass.

    Args:
        kind: The dataclass of options, or a union of those of the sub-commands.
        words: The words after the program's name; None takes those of `sys.argv`.
        program: The command as a user types it.
        description: Text of the help; if it is empty, the docstring of the dataclass.
        config: Configuration of tyro. By default, flags that are off have no counterpart that turns them off.
        default: Options that apply unless the command line gives them; None takes the defaults of the dataclass.

    Returns:
        The options as an instance of the dataclass.

    Raises:
        SystemExit: After the help, or with tyro's message on stderr after a wrong word; with code 141 if the reader of
            the help has ended.
    """
    import tyro  # here, because functions that check options do not need it

    config = (tyro.conf.FlagCreatePairsOff,) if config is None else config
    try:
        try:
            text = description or None
            cli: Any = tyro.cli
            more = {} if default is None else {"default": default}
            options: Options = cli(
                kind, args=words, prog=program, description=text, config=config, registry=_registry(), **more
            )
            return options
        except SystemExit:
            sys.stdout.flush()  # here, where a failure can be handled
            raise
    except BrokenPipeError:
        output_is_closed()
        raise SystemExit(ExitCode.OUTPUT_CLOSED) from None


@cache
def _registry() -> Any:
    """Make tyro's rules for numbers, whose messages Python would word for programmers."""
    import tyro.constructors

    registry = tyro.constructors.ConstructorRegistry()

    @registry.primitive_rule
    def number_rule(about: tyro.constructors.PrimitiveTypeInfo) -> Any:
        kind = about.type
        if kind not in (int, float):
            return None

        def read(words: list[str]) -> Any:
            try:
                return kind(words[0])
            except ValueError:
                whole = "a whole number" if kind is int else "a number"
                raise ValueError(f"{words[0]!r} is not {whole}; give one, without a unit") from None

        return tyro.constructors.PrimitiveConstructorSpec(
            nargs=1, metavar=kind.__name__.upper(), instance_from_str=read,
            is_instance=lambda value: isinstance(value, int if kind is int else (int, float)),
            str_from_instance=lambda value: [str(value)],
        )  # fmt: skip

    return registry


def refuse_renamed(kind: Any, words: Sequence[str] | None) -> None:
    """Refuse options and values by their former names.

    Args:
        kind: The dataclass of options. Its `FORMER_NAMES`, if it has them, are the current names by the former ones, as
            a user types them: `--flag`, or `--flag value` for a value of an option.
        words: The words after the program's name; None takes those of this process.

    Raises:
        ValueError: The command line has a former name; the message gives the current one.
    """
    former_names: Mapping[str, str] = getattr(kind, "FORMER_NAMES", {})
    flag = ""
    for word in sys.argv[1:] if words is None else words:
        value = word
        if word.startswith("--"):
            flag, _, value = word.partition("=")
            flag = flag.replace("_", "-")
        for name in (flag, f"{flag} {value}"):
            if name in former_names:
                raise ValueError(f"{name} is called {former_names[name]} now; pass that option, which --help explains")


def check_options(options: Any, given: Sequence[str] = (), *, group: str = "") -> None:
    """Refuse option values that are outside their `Limits`, and list options that were given without values.

    Args:
        options: A dataclass that was read from a command line; groups of options are dataclasses within it.
        given: The words of the command line.
        group: Prefix of the flags of a group of options, such as `settings.`.

    Raises:
        ValueError: A number is outside its limits or NaN, or a list is empty; the message names its flag.
    """
    for flag, hint, value in _options(options, group):
        limits = _limits(hint)
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, bool) or not isinstance(number, Real):  # NumPy's numbers are Real too
                continue
            if limits is not None and not limits.allow(float(number)):
                raise ValueError(f"--{flag} is {number:.10g}; give {limits}")
            if math.isnan(number):
                raise ValueError(f"--{flag} is NaN; give a number")
        if isinstance(value, tuple) and not value and any(word.replace("_", "-") == f"--{flag}" for word in given):
            raise ValueError(f"--{flag} has no values; give at least one, or leave it out")


def require_path(flag: str, path: Path | None, what: str = "file or folder") -> None:
    """Refuse a path that does not exist, and a file where a folder should be.

    Args:
        flag: The option that names it, such as `--pad`.
        path: The given path; None if the option was left out.
        what: Kind of the path in the message; "folder" accepts folders only.

    Raises:
        ValueError: The path does not exist.
    """
    if path is not None and not (path.is_dir() if what == "folder" else path.exists()):
        raise ValueError(f"{flag} {path}: there is no such {what}; check the name")


def require_writable(flag: str, path: Path) -> None:
    """Refuse a file or folder that cannot be created or written, before the work whose result it will hold.

    Args:
        flag: The option that names it, such as `--out`.
        path: The given path; it and the folders above it need not exist yet.

    Raises:
        ValueError: A file is where a folder should be, or writing there is not permitted.
    """
    existing = next((place for place in (path, *path.parents) if place.exists()), Path())
    if existing != path and not existing.is_dir():
        raise ValueError(f"{flag} {path}: {existing} is a file; name a folder")
    if not os.access(existing, os.W_OK | (os.X_OK if existing.is_dir() else 0)):
        raise ValueError(f"{flag} {path}: {existing} is write-protected; name another place")


def require_with(flag: str, given: bool, needed: str, holds: bool) -> None:
    """Refuse an option that has no effect without another.

    Args:
        flag: The option that may have no effect.
        given: Whether that option was given.
        needed: The option without which the first one has no effect, as a user types it.
        holds: Whether the needed option was given.

    Raises:
        ValueError: The option has no effect.
    """
    if given and not holds:
        raise ValueError(f"{flag} has no effect without {needed}; pass both, or leave {flag} out")


@cache
def docstring_of(module: str) -> str:
    """Read the docstring of a module without importing it.

    Args:
        module: Name of the module.

    Returns:
        The docstring, or "" if the module has none.
    """
    spec = importlib.util.find_spec(module)
    if spec is None or spec.origin is None:
        return ""
    return ast.get_docstring(ast.parse(Path(spec.origin).read_text())) or ""


def _options(options: Any, group: str = "") -> Iterator[tuple[str, Any, Any]]:
    """List flag, type and value of every option. Flags of groups are `settings.press`, or `press` in a FLAT group."""
    hints = typing.get_type_hints(type(options), include_extras=True)
    for field in fields(options):
        value = getattr(options, field.name)
        flag = group + field.name.replace("_", "-")
        if is_dataclass(value):
            yield from _options(value, group if getattr(value, "FLAT", False) else f"{flag}.")
        else:
            yield flag, hints[field.name], value


def _limits(hint: Any) -> Limits | None:
    """Find the limits in a type or in its parts."""
    for note in getattr(hint, "__metadata__", ()):
        if isinstance(note, Limits):
            return note
    return next((limits for part in typing.get_args(hint) if (limits := _limits(part)) is not None), None)
