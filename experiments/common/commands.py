"""Commands of the experiments: options are read and checked before anything large is imported.

An experiment is a folder with `arguments.py`, a dataclass of its options that imports neither JAX nor NumPy, and
`run.py`, whose docstring is the command's help and whose `run` does the work. So `--help` is there at once, and so is
the answer to a wrong name or number.
"""

import importlib
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

from experiments.common.runs import METRICS, check_folder, check_out, ending_of_run, pictures_in
from i2t.cli import Ending, check_options, docstring_of, read_options


class CheckedOptions(Protocol):
    """A dataclass of options that knows what does not go together."""

    def check(self) -> None:
        """Refuse what does not go together, and files that are not there (ValueError); imports nothing large."""


Checked = TypeVar("Checked", bound=CheckedOptions)


class Command(Generic[Checked]):
    """A command line that was read."""

    def __init__(self, args: Checked, words: Sequence[str], module: str, *, out: Path | None, end: Ending) -> None:
        self.args, self.words, self.module, self.out, self.end = args, words, module, out, end

    @property
    def code(self) -> int:
        """The exit code, when the work is done."""
        return self.end.code

    @property
    def run(self) -> Callable[[Checked], Any]:
        """Function that does the work, imported only now."""
        work: Callable[[Checked], Any] = importlib.import_module(self.module).run
        return work

    def checked(self) -> Checked:
        """The options, or a refusal (ValueError) of what does not go together."""
        check_options(self.args, self.words)
        self.args.check()
        if self.out is not None and hasattr(self.args, "overwrite"):
            check_out(self.out, getattr(self.args, "resume", None), self.args.overwrite, kind=type(self.args).__name__)
        elif self.out is not None:
            check_folder(self.out)
        return self.args


@contextmanager
def command(kind: type[Checked], argv: Sequence[str] | None, module: str) -> Iterator[Command[Checked]]:
    """Read a command line, run the block with it, and keep how that ended as its `code`.

        with command(MyArgs, argv, "experiments.mine.run") as this:
            args = this.checked()
            this.run(args)
        return this.code

    Args:
        kind: The dataclass of its options.
        argv: The command line without the program's name; None takes the process's.
        module: Name of the module whose docstring is the help, and whose `run` takes the options.

    Yields:
        The command.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    args = read_options(kind, words, program=program_of(module), description=docstring_of(module), config=())
    with carrying_out(args, words, module) as this:
        yield this


@contextmanager
def carrying_out(args: Checked, words: Sequence[str], module: str) -> Iterator[Command[Checked]]:
    """Run `command` with options that were read before."""
    out: Path | None = getattr(args, "folder", getattr(args, "out", None))
    with ending_of_run(out if hasattr(args, "resume") else None) as end:
        yield Command(args, words, module, out=out, end=end)
        say_where(out, getattr(args, "next_command", ""))


def run_command(
    kind: type[Checked],
    argv: Sequence[str] | None,
    module: str,
    *,
    work: Callable[[Checked], Any] | None = None,
) -> int:
    """Read a command line, check it, and only then import what does the work.

    Args:
        kind: The dataclass of its options.
        argv: The command line without the program's name; None takes the process's.
        module: Name of the module whose docstring is the help, and whose `run` takes the options.
        work: Takes the options in place of that `run`.

    Returns:
        The exit code: an int that the work gave, or how it ended.
    """
    with command(kind, argv, module) as this:
        args = this.checked()
        this.end.take((work or this.run)(args))
    return this.code


def run_part(parts: Mapping[str, tuple[type[Any], str]], argv: Sequence[str] | None, package: str) -> int:
    """Run the part of a command that the first word names, or else the first part.

    Args:
        parts: Options and module of each, as `run_command` takes them, by name.
        argv: The command line without the program's name; None takes the process's.
        package: The command's, such as `experiments.registration`.

    Returns:
        The exit code.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    name = words.pop(0) if words and words[0] in parts else next(iter(parts))
    kind, module = parts[name]
    program = f"{program_of(package)} {name}"
    args = read_options(kind, words, program=program, description=docstring_of(module), config=())
    with carrying_out(args, words, module) as this:
        checked = this.checked()  # before `run` is looked up, which imports it
        this.run(checked)
    return this.code


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
    """Command that runs a module of an experiment.

    Args:
        module: Its name.

    Returns:
        Such as `python -m experiments.train`.
    """
    return f"python -m {module.removesuffix('.run').removesuffix('.__main__')}"
