"""Start and end of a command: its exit code, and the sentence that goes with it.

0    it did what was asked
1    it began and failed: a device, the disk, or a goal that was missed
2    it was used wrongly: options, files or folders with which it cannot do what was asked
130  Ctrl-C
141  whoever read what it prints has gone, as `head` does: it ends without a word
"""

import errno
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import Any

from i2t.cli.options import check_options, read_options
from i2t.cli.pipes import NOBODY_READS, nobody_reads
from i2t.errors import NAMED_WRONGLY, DeviceError, FullDiskError, printable
from i2t.runtime.compile_cache import use_compile_cache

FAILED, WRONG_USE, INTERRUPTED_BY_USER = 1, 2, 130  # exit codes
SENT_AGAIN_S = 0.05
NO_ROOM = {errno.ENOSPC, errno.EFBIG, errno.EIO, getattr(errno, "EDQUOT", errno.ENOSPC)}  # errors of a disk
REMEDIES: dict[type[OSError], str] = {  # of the system's errors that name a file
    FileNotFoundError: "check the name",
    FileExistsError: "give another name",
    NotADirectoryError: "name a folder",
    IsADirectoryError: "name a file",
    PermissionError: "choose what you may read and write",
}


def exit_code_of(work: Callable[[], Any], interrupted: str | Callable[[], str] = "interrupted") -> int:
    """Do a command's work and return its exit code; errors for its user become one sentence, Ctrl-C a report of the
    state.

    Args:
        work: Of the command; an int that it returns is the exit code.
        interrupted: The sentence after Ctrl-C, or what makes it then.

    Returns:
        0 if it did what was asked; 2 if that cannot be done (a ValueError, or a file or folder that is not as the
        command line has it), 1 if a device or the disk failed, 130 after Ctrl-C, 141 without a word if nobody reads its
        output any more.
    """
    use_compile_cache()
    shown, warnings.showwarning = warnings.showwarning, _show_warning
    try:
        with _interrupts_in_good_time():
            result = work()
        if sys.stdout is not None and not sys.stdout.closed:
            sys.stdout.flush()  # here, where it is known what to say if that fails
        return result if isinstance(result, int) else 0
    except (DeviceError, ValueError, OSError) as error:  # DataError is a ValueError
        if isinstance(error, BrokenPipeError) and nobody_reads():
            return NOBODY_READS
        print(f"error: {printable(_sentence(error))}", file=sys.stderr)
        mendable = isinstance(error, (ValueError, *NAMED_WRONGLY)) and not isinstance(error, FullDiskError)
        return WRONG_USE if mendable else FAILED
    except KeyboardInterrupt:
        print(f"\n{interrupted() if callable(interrupted) else interrupted}", file=sys.stderr)
        return INTERRUPTED_BY_USER
    except MemoryError:
        print("error: the memory of this machine is used up; ask for less at a time", file=sys.stderr)
        return FAILED
    finally:
        warnings.showwarning = shown


def command(
    kind: Any,
    work: Callable[[Any], Any],
    *,
    program: str,
    description: str | None = "",
    interrupted: str = "interrupted",
) -> Callable[..., int]:
    """Make the `main` of a command that reads options, checks their numbers and does its work.

    Args:
        kind: A dataclass, or a union of those of sub-commands.
        work: Takes the options; an int that it returns is the exit code.
        program: What a user types to run the command.
        description: For the help, as in `read_options`.
        interrupted: The sentence after Ctrl-C.

    Returns:
        A function that takes the words without the program's name, by default those of this process, and returns the
        exit code.
    """

    def main(arguments: Sequence[str] | None = None) -> int:
        """Run the command line."""
        asked = read_options(kind, arguments, program=program, description=description or "")

        def checked() -> Any:
            check_options(asked)
            return work(asked)

        return exit_code_of(checked, interrupted)

    return main


def _sentence(error: Exception) -> str:
    """Message of an error; for the system's own errors, the file and the remedy."""
    if isinstance(error, OSError) and error.filename is None and error.errno in NO_ROOM:
        return f"a file cannot be written ({error.strerror}); make room on its disk, or name another (--out)"
    if not isinstance(error, OSError) or error.filename is None or error.strerror is None:
        return str(error)
    remedy = next((f"; {said}" for kind, said in REMEDIES.items() if isinstance(error, kind)), "")
    return f"{error.filename}: {error.strerror[:1].lower()}{error.strerror[1:]}{remedy}"


@contextmanager
def _interrupts_in_good_time() -> Iterator[None]:
    """Delay Ctrl-C a little where it would be lost or do harm.

    Python drops what is raised in a callback of its garbage collector, and JAX has one. A compiled module that is
    interrupted while it is imported may take the whole process down, and jaxlib does.
    """
    raised, unraisable_hook = signal.getsignal(signal.SIGINT), sys.unraisablehook

    def handler(number: int, frame: FrameType | None) -> None:
        if _importing():
            _send_again()
        else:
            signal.default_int_handler(number, frame)

    def hook(unraisable: "sys.UnraisableHookArgs") -> None:
        if issubclass(unraisable.exc_type, KeyboardInterrupt):
            _send_again()
        else:
            unraisable_hook(unraisable)

    ours = raised is signal.default_int_handler and threading.current_thread() is threading.main_thread()
    sys.unraisablehook = hook
    if ours:
        signal.signal(signal.SIGINT, handler)
    try:
        yield
    finally:
        sys.unraisablehook = unraisable_hook
        if ours:
            signal.signal(signal.SIGINT, raised)


def _importing() -> bool:
    """Test whether a module is being imported now."""
    specs = (getattr(module, "__dict__", {}).get("__spec__") for module in list(sys.modules.values()))
    return any(getattr(spec, "_initializing", False) for spec in specs)


def _send_again() -> None:
    if hasattr(signal, "pthread_kill"):  # which ends the main thread's waiting too
        timer = threading.Timer(SENT_AGAIN_S, signal.pthread_kill, (threading.main_thread().ident, signal.SIGINT))
    else:
        timer = threading.Timer(SENT_AGAIN_S, signal.raise_signal, (signal.SIGINT,))
    timer.daemon = True
    timer.start()


def _show_warning(message: Warning | str, category: type[Warning], *where: Any, **_: Any) -> None:
    """Show a warning in one line; warnings of other libraries keep their origin."""
    if issubclass(category, UserWarning):
        print(f"warning: {printable(message)}", file=sys.stderr)
    else:
        print(warnings.formatwarning(message, category, *where[:2]), end="", file=sys.stderr)
