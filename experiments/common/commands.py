"""Commands of the experiments: options are read and checked before anything large is imported.

An experiment is a folder with `arguments.py`, a dataclass of its options that imports neither JAX nor NumPy, and
`run.py`, whose docstring is the command's help and whose `run` does the work. So `--help` is there at once, and so is
the answer to a wrong name or number. Its `__main__.py` names the two:

    main = command(TrainArgs, "experiments.train.run")
"""

import importlib
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeAlias

from experiments.common.runs import METRICS, check_folder, check_out, exit_code_of_run, folder_of, pictures_in
from i2t.cli.options import check_options, docstring_of, read_options

Main: TypeAlias = Callable[..., int]  # takes the command line, by default the process's, and gives the exit code


def command(kind: type[Any], module: str) -> Main:
    """A command.

    Args:
        kind: The dataclass of its options; it may have a method `check` that refuses what does not go together.
        module: Name of the module whose docstring is the help, and whose `run` takes the options.

    Returns:
        Its `main`.
    """
    program = f"python -m {module.removesuffix('.run').removesuffix('.__main__')}"

    def main(argv: Sequence[str] | None = None) -> int:
        return _carry_out(kind, module, _words(argv), program)

    return main


def command_of_parts(
    package: str, parts: Mapping[str, tuple[type[Any], str]], by_option: Mapping[str, str] = MappingProxyType({})
) -> Main:
    """A command whose first word names one of its parts; without such a word it is the first part.

    Args:
        package: The command's, such as `experiments.registration`.
        parts: Options and module of each, as `command` takes them, by name.
        by_option: Parts that an option names in place of the first, by the option.

    Returns:
        Its `main`.
    """
    first = next(iter(parts))

    def main(argv: Sequence[str] | None = None) -> int:
        words = _words(argv)
        name = words.pop(0) if words and words[0] in parts else first
        if name == first:
            name = next((by_option[flag] for word in words if (flag := word.partition("=")[0]) in by_option), first)
        about = f"\n\nParts of this command, each with its own --help: {', '.join(parts)}."
        return _carry_out(*parts[name], words, f"python -m {package} {name}", about)

    return main


def _words(argv: Sequence[str] | None) -> list[str]:
    return list(sys.argv[1:] if argv is None else argv)


def _carry_out(kind: type[Any], module: str, words: Sequence[str], program: str, about: str = "") -> int:
    """Read options, check them, and only then import what does the work; the exit code."""
    renamed = partial(refuse_renamed, getattr(kind, "FORMER_NAMES", {}), words)
    if code := exit_code_of_run(renamed):
        return code
    args = read_options(kind, words, program=program, description=docstring_of(module) + about, config=())
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
        say_where(out, getattr(args, "next_command", ""))
        return result

    return exit_code_of_run(work, out if hasattr(args, "resume") else None)


def refuse_renamed(former_names: Mapping[str, str], words: Sequence[str]) -> None:
    """Refuse options by their former names.

    Args:
        former_names: Of options, and their names now.
        words: The command line.

    Raises:
        ValueError: One is among them; the message tells its name now.
    """
    for word in words:
        flag = word.partition("=")[0].replace("_", "-")
        if flag in former_names:
            raise ValueError(f"{flag} is called {former_names[flag]} now; pass that, as --help explains it")


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
