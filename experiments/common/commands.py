"""Command-line entry points of the experiments, which read and check options before slow imports.

An experiment is a folder with `arguments.py`, a dataclass of its options that imports neither JAX nor NumPy, and
`run.py`, whose docstring is the command's help and whose `run` does the work. `--help` and error messages about options
therefore appear at once. The experiment's `__main__.py` names both:

    main = command(TrainArgs, "experiments.train.run")
"""

import importlib
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeAlias

from experiments.common.config_file import config_path, options_of_config
from experiments.common.runs import METRICS, check_folder, check_out, exit_code_of_run, folder_of, pictures_in
from i2t.cli.options import check_options, docstring_of, read_options, refuse_renamed
from i2t.cli.pipes import ExitCode
from i2t.errors import did_you_mean
from i2t.models.finished import kind_of_config

# Function from the command line (by default that of the process) to the exit code.
Main: TypeAlias = Callable[..., int]


def command(kind: type[Any], module: str) -> Main:
    """Make the `main` function of a command.

    Args:
        kind: The dataclass of its options. It may have a method `check` that refuses wrong combinations.
        module: Name of the module whose docstring is the help, and whose `run` takes the options.

    Returns:
        The command's `main` function, which takes the command line and returns the exit code.
    """
    program = f"python -m {module.removesuffix('.run').removesuffix('.__main__')}"

    def main(argv: Sequence[str] | None = None) -> int:
        return _carry_out(kind, module, _words(argv), program)

    return main


def command_of_parts(
    package: str, parts: Mapping[str, tuple[type[Any], str]], by_option: Mapping[str, str] = MappingProxyType({})
) -> Main:
    """Make the `main` function of a command whose first word names one of its parts. Without such a word, the part is
    that of the run whose config.json is given, or else the first.

    Args:
        package: Package of the command, such as `experiments.registration`.
        parts: Options and module of each part, as `command` takes them, by name.
        by_option: Parts that an option selects instead of the first part, by the option.

    Returns:
        The command's `main` function.
    """
    first = next(iter(parts))

    def main(argv: Sequence[str] | None = None) -> int:
        words = _words(argv)
        path = config_path(words)
        if words and words[0] in parts:
            name = words.pop(0)
        elif words and not words[0].startswith("-"):  # no part has positional arguments
            remedy = did_you_mean(words[0], parts, f"its parts are {', '.join(parts)}")
            print(f"error: {words[0]} is no part of python -m {package}; {remedy}", file=sys.stderr)
            return ExitCode.WRONG_USE
        else:
            kind = None if path is None else kind_of_config(path)
            name = next((part for part, (options, _) in parts.items() if options.__name__ == kind), first)
        if name == first:
            name = next((by_option[flag] for word in words if (flag := word.partition("=")[0]) in by_option), first)
        about = f"\n\nParts of this command, each with its own --help: {', '.join(parts)}."
        return _carry_out(*parts[name], words, f"python -m {package} {name}", about)

    return main


def _words(argv: Sequence[str] | None) -> list[str]:
    return list(sys.argv[1:] if argv is None else argv)


def _carry_out(kind: type[Any], module: str, words: Sequence[str], program: str, about: str = "") -> int:
    """Read and check the options, then import and run the module that does the work, and return the exit code."""
    default: Any = None

    def prepare() -> None:
        nonlocal default
        refuse_renamed(kind, words)
        path = config_path(words)
        if path is not None and hasattr(kind, "config"):
            default = options_of_config(path, kind, program)

    if code := exit_code_of_run(prepare):
        return code
    description = docstring_of(module) + about
    args = read_options(kind, words, program=program, description=description, config=(), default=default)
    out = folder_of(args)

    def work() -> Any:
        check_options(args, words)
        if hasattr(args, "check"):
            args.check()
        if out is not None and hasattr(args, "overwrite"):
            check_out(args, out)
        elif out is not None:
            check_folder(out)
        result = importlib.import_module(module).run(args)
        print_outcome(out, getattr(args, "next_command", ""))
        return result

    return exit_code_of_run(work, out if hasattr(args, "resume") else None)


def print_outcome(out: Path | None, next_command: str) -> None:
    """Print where the results of a finished run are, the names of its pictures, and what to try next.

    Args:
        out: Folder of the run. Nothing is printed if it does not exist or the run is not finished.
        next_command: The whole command to try next; empty if there is none.
    """
    if out is None or not (out / METRICS).exists():
        return
    pictures = pictures_in(out)
    print(f"\nresults{f' and pictures ({pictures})' if pictures else ''} are in {out}")
    if next_command:
        print(f"next: {next_command}")
