"""Options of an earlier run, read from its config.json. This module has no slow imports."""

import typing
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from types import UnionType
from typing import Any, Literal, TypeVar

from experiments.common.runs import CONFIG, RUN_OPTIONS
from i2t.errors import did_you_mean
from i2t.files.reading import read_json

Options = TypeVar("Options")
FLAG = "--config"


def config_path(words: Sequence[str]) -> Path | None:
    """Find the file that --config names on a command line.

    Args:
        words: The words after the program's name.

    Returns:
        The config.json, also if its folder is named; None without --config.
    """
    path = None
    for word, following in zip(words, [*words[1:], ""], strict=False):
        flag, equals, value = word.partition("=")
        if flag == FLAG and (equals or following):
            path = Path(value if equals else following)
    return path / CONFIG if path is not None and path.is_dir() else path


def options_of_config(path: Path, kind: type[Options], program: str) -> Options:
    """Read the options of an earlier run.

    Args:
        path: The config.json of the run.
        kind: The dataclass of the command's options.
        program: The command as a user types it, for messages.

    Returns:
        The options. Those that config.json does not hold, such as --out, have their defaults.

    Raises:
        ValueError: The file is not a config.json of this command, or one of its options is unknown, was renamed, is
            missing or has a wrong value.
        OSError: The file cannot be read.
    """
    about = read_json(path)
    if not isinstance(about, dict) or not isinstance(about.get("args"), dict):
        raise ValueError(f"{FLAG} {path}: is not the {CONFIG} of a run; name the one in the folder of its results")
    if about.get("kind", kind.__name__) != kind.__name__:
        raise ValueError(f"{FLAG} {path}: is of a run of another command than {program}; name one of this command")
    try:
        return typing.cast("Options", _dataclass(kind, about["args"]))
    except (TypeError, ValueError) as error:
        raise ValueError(f"{FLAG} {path}: {error}") from error


def _dataclass(kind: Any, values: Mapping[str, Any], group: str = "") -> Any:
    """Make a dataclass of options from the values of a JSON object, and refuse names that are not its fields."""
    hints = typing.get_type_hints(kind)
    names = [field.name for field in fields(kind) if group or field.name not in RUN_OPTIONS]
    former_names: Mapping[str, str] = getattr(kind, "FORMER_NAMES", {})
    for name in values:
        if name not in names:
            flag = f"--{group}{name}".replace("_", "-")
            if flag in former_names:
                raise ValueError(f"its option {flag} is called {former_names[flag]} now; rename it in the file")
            raise ValueError(f"its option {name} is unknown; {did_you_mean(name, names, 'delete it from the file')}")
    for field in fields(kind):
        if field.name not in values and field.default is MISSING and field.default_factory is MISSING:
            raise ValueError(f"its option {field.name} is missing; add it to the file")
    return kind(**{name: _value(hints[name], value, f"{group}{name}") for name, value in values.items()})


def _value(hint: Any, value: Any, name: str) -> Any:
    """Convert a value of JSON to the type of an option."""
    for candidate in _candidates(hint, value, name):
        return candidate
    raise ValueError(f"its option {name} cannot be {value!r}; correct it in the file")


def _candidates(hint: Any, value: Any, name: str) -> Iterator[Any]:
    """Generate the values of a type that a value of JSON can mean."""
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    if is_dataclass(hint) and isinstance(value, dict):
        yield _dataclass(hint, value, f"{name}.")
    elif origin in (typing.Union, UnionType):
        for part in parts:
            yield from _candidates(part, value, name)
    elif origin is tuple and isinstance(value, list):
        hints = len(value) * parts[:1] if parts[-1] is Ellipsis else parts
        if len(hints) == len(value):
            yield tuple(_value(part, item, name) for part, item in zip(hints, value, strict=True))
    elif origin is Literal:
        yield from (part for part in parts if part == value and type(part) is type(value))
    elif hint is Path and isinstance(value, str):
        yield Path(value)
    elif hint is float and type(value) in (int, float):
        yield float(value)
    elif isinstance(hint, type) and type(value) is hint:
        yield value
