"""Run a command and end it with an exit code and, after an error, one sentence.

0    success
1    failure: a device, the disk, or a missed goal
2    wrong use: options, files or folders must change
129  a closed terminal (SIGHUP)
130  Ctrl-C
141  the reader of the output has ended, as `head` does; the command ends silently
143  SIGTERM
"""

import errno
import logging
import signal
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from i2t.cli.options import check_options, read_options, refuse_renamed
from i2t.cli.pipes import ExitCode, output_is_closed
from i2t.cli.signals import interrupted_by_signals
from i2t.errors import WRONG_PATH_ERRORS, DeviceError, FullDiskError, printable
from i2t.runtime.compile_cache import use_compile_cache

# Advice that ends the message of an operating system's error about a path, by the class of the error.
OS_ERROR_REMEDIES: dict[type[OSError], str] = {
    FileNotFoundError: "check the name",
    FileExistsError: "give another name",
    NotADirectoryError: "name a folder",
    IsADirectoryError: "name a file",
    PermissionError: "choose one that you may read and write",
}


def exit_code_of(work: Callable[[], Any], interrupted: str | Callable[[], str] = "interrupted") -> int:
    """Do a command's work and return its exit code. Print errors that the user can correct as one sentence.

    Args:
        work: The work of the command. If it returns an int, that is the exit code.
        interrupted: The sentence to print after Ctrl-C, SIGTERM or SIGHUP, or a function that returns it.

    Returns:
        0 after success; 2 if the work cannot be done as requested (a ValueError, or a file or folder that does not fit
        the command line); 1 if a device or the disk failed; 130 after Ctrl-C, 143 after SIGTERM and 129 after SIGHUP;
        141 if the reader of the output has ended.
    """
    show_warning, warnings.showwarning = warnings.showwarning, _show_warning
    try:
        with _shown_log():
            use_compile_cache()
            with interrupted_by_signals():
                result = work()
        if sys.stdout is not None and not sys.stdout.closed:
            sys.stdout.flush()  # here, where a failure can be reported
        return result if isinstance(result, int) else 0
    except (DeviceError, ValueError, OSError) as error:  # DataError is a ValueError
        if isinstance(error, BrokenPipeError) and output_is_closed():
            return ExitCode.OUTPUT_CLOSED
        print(f"error: {printable(_sentence(error))}", file=sys.stderr)
        wrong_use = isinstance(error, (ValueError, *WRONG_PATH_ERRORS)) and not isinstance(error, FullDiskError)
        return ExitCode.WRONG_USE if wrong_use else ExitCode.FAILED
    except KeyboardInterrupt as interrupt:
        with suppress(OSError):  # the terminal may be closed
            print(f"\n{interrupted() if callable(interrupted) else interrupted}", file=sys.stderr)
        return 128 + int(getattr(interrupt, "number", signal.SIGINT))
    except MemoryError:
        print("error: this machine is out of memory; process less at a time", file=sys.stderr)
        return ExitCode.FAILED
    finally:
        warnings.showwarning = show_warning


@dataclass(frozen=True)
class CommandLine:
    """A command line, which reads options, checks their numbers and does its work when it is called.

    Args:
        kind: The dataclass of options, or a union of those of the sub-commands.
        work: Function that takes the options. If it returns an int, that is the exit code.
        program: The command as a user types it, unless the call or the installed script names it.
        description: Text of the help, as in `read_options`.
        interrupted: The sentence to print after a signal, or a function that takes the options and returns it.
    """

    kind: Any
    work: Callable[[Any], Any]
    program: str
    description: str
    interrupted: str | Callable[[Any], str]

    def __call__(self, words: Sequence[str] | None = None, *, program: str = "") -> int:
        """Run the command line.

        Args:
            words: The words after the program's name; by default, those of `sys.argv`.
            program: The command as the user typed it; by default, the installed script that runs, such as
                `i2t-collect`, or else `self.program`.

        Returns:
            The exit code.
        """
        program = program or _installed_script() or self.program
        options: list[Any] = []  # none until the command line is read

        def read_and_work() -> Any:
            refuse_renamed(self.kind, words)
            options.append(read_options(self.kind, words, program=program, description=self.description))
            check_options(options[0])
            return self.work(options[0])

        def interrupted() -> str:
            if isinstance(self.interrupted, str):
                return self.interrupted
            return self.interrupted(options[0]) if options else "interrupted"

        return exit_code_of(read_and_work, interrupted)


def command(
    kind: Any,
    work: Callable[[Any], Any],
    *,
    program: str,
    description: str | None = "",
    interrupted: str | Callable[[Any], str] = "interrupted",
) -> CommandLine:
    """Make the `main` function of a command.

    Args:
        kind: A dataclass of options, or a union of those of the sub-commands. Its `FORMER_NAMES`, if it has them, are
            refused as in `refuse_renamed`.
        work: Function that takes the options. If it returns an int, that is the exit code.
        program: The command as a user types it, unless a call names it.
        description: Text of the help, as in `read_options`.
        interrupted: The sentence to print after a signal, or a function that takes the options and returns it.

    Returns:
        A callable that takes the words after the program's name, by default those of `sys.argv`, and returns the exit
        code.
    """
    return CommandLine(kind, work, program, description or "", interrupted)


def _installed_script() -> str:
    """Return the name of the installed script that runs, such as i2t-collect; empty if another program runs."""
    name = Path(sys.argv[0]).name.removesuffix(".exe")
    return name if name.startswith("i2t-") else ""


def _sentence(error: Exception) -> str:
    """Write the message of an error; for the system's own errors, with the file and the remedy."""
    no_room = (errno.ENOSPC, errno.EFBIG, errno.EIO, getattr(errno, "EDQUOT", errno.ENOSPC))
    if isinstance(error, OSError) and error.filename is None and error.errno in no_room:
        return f"a file cannot be written ({error.strerror}); make room on its disk, or name another (--out)"
    if not isinstance(error, OSError) or error.filename is None or error.strerror is None:
        return str(error)
    remedy = next((f"; {advice}" for kind, advice in OS_ERROR_REMEDIES.items() if isinstance(error, kind)), "")
    return f"{error.filename}: {error.strerror[:1].lower()}{error.strerror[1:]}{remedy}"


class _PlainLines(logging.Handler):
    """Handler that prints messages to stderr without level and name."""

    def emit(self, record: logging.LogRecord) -> None:
        """Print the message of a record."""
        try:
            if "tqdm" in sys.modules:  # a bar is drawn again below the line
                sys.modules["tqdm"].tqdm.write(self.format(record), file=sys.stderr)
            else:
                print(self.format(record), file=sys.stderr, flush=True)
        except (OSError, ValueError):  # stderr is closed
            self.handleError(record)


@contextmanager
def _shown_log() -> Iterator[None]:
    """Show what the library logs, from INFO on, while a command runs. If the program has configured logging, its
    handlers and levels apply instead.
    """
    log = logging.getLogger("i2t")
    if log.hasHandlers():  # also those of a command around this one
        yield
        return
    handler, level, propagates = _PlainLines(), log.level, log.propagate
    log.addHandler(handler)
    log.setLevel(level or logging.INFO)
    log.propagate = False  # libraries that are imported meanwhile, such as absl, add handlers to the root
    try:
        yield
    finally:
        log.removeHandler(handler)
        log.setLevel(level)
        log.propagate = propagates


def _show_warning(message: Warning | str, category: type[Warning], *where: Any, **_: Any) -> None:
    """Print a warning in one line; warnings of other libraries keep their origin."""
    if issubclass(category, UserWarning):
        print(f"warning: {printable(message)}", file=sys.stderr)
    else:
        print(warnings.formatwarning(message, category, *where[:2]), end="", file=sys.stderr)
