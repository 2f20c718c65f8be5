"""How a command of the experiments is run: its options are read and checked before anything large is imported.

An experiment is a folder with `arguments.py`, a dataclass of its options that imports neither JAX nor NumPy, and
`run.py`, whose docstring is the command's help and whose `run` does the work. So `--help` is there at once, and so is
the answer to a wrong name or number.
"""

import importlib
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, Protocol, TypeVar

from experiments.common.presets import RENAMED, answer_renamed_value
from experiments.common.runs import METRICS, check_folder, check_out, exit_code_of_run, pictures_in
from i2t.cli import check_options, docstring_of, renamed_flags
from i2t.options import read_options


class CheckedOptions(Protocol):
    """A dataclass of options that knows what does not go together."""

    def check(self) -> None:
        """Refuse what does not go together, and files that are not there (ValueError); imports nothing large."""


Checked = TypeVar("Checked", bound=CheckedOptions)


def run_command(
    kind: type[Checked],
    argv: Sequence[str] | None,
    module: str,
    *,
    renamed: Mapping[str, str] | None = None,
    work: Callable[[Checked], Any] | None = None,
) -> int:
    """Read a command line, check it, and only then import what does the work.

    Args:
        kind: The dataclass of its options.
        argv: The command line without the program's name; None takes the process's.
        module: Name of the module whose docstring is the help, and whose `run` takes the options.
        renamed: Flags of earlier versions, and what they are called now.
        work: Takes the options in place of that `run`.

    Returns:
        The exit code.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    if any(each.name == "preset" for each in fields(kind)):  # type: ignore[arg-type]  # a dataclass
        answer_renamed_value(words, "--preset", RENAMED)
    renamed_flags(words, renamed or {})
    args = read_options(kind, words, program=program_of(module), description=docstring_of(module), config=())
    return carry_out(args, words, work or (lambda args: importlib.import_module(module).run(args)))


def carry_out(args: Checked, words: Sequence[str], work: Callable[[Checked], Any]) -> int:
    """Check options and do the work.

    Args:
        args: The options.
        words: The command line that they were read from.
        work: Takes the options; imports what it needs.

    Returns:
        The exit code.
    """
    out: Path | None = getattr(args, "folder", getattr(args, "out", None))

    def checked() -> Any:
        check_options(args, words)
        args.check()
        if out is not None and hasattr(args, "overwrite"):
            check_out(out, getattr(args, "resume", None), args.overwrite, kind=type(args).__name__)
        elif out is not None:
            check_folder(out)
        result = work(args)
        say_where(out, getattr(args, "next_command", ""))
        return result

    return exit_code_of_run(checked, out if hasattr(args, "resume") else None)


def say_where(out: Path | None, next_command: str) -> None:
    """Print where a finished run's results are, the names of its pictures, and what to try next.

    Args:
        out: Folder of the run; nothing is said of one that is not there, or not finished.
        next_command: The whole command; "" where none suggests itself.
    """
    if out is None or not (out / METRICS).exists():
        return
    pictures = pictures_in(out)
    print(f"\nresults{f' and pictures ({pictures})' if pictures else ''} are in {out}")
    if next_command:
        print(f"next: {next_command}")


def program_of(module: str) -> str:
    """What a user types to run a module of an experiment.

    Args:
        module: Its name.

    Returns:
        Such as `python -m experiments.train`.
    """
    return f"python -m {module.removesuffix('.run').removesuffix('.__main__')}"
