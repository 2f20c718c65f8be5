"""Signals that end a command: Ctrl-C (SIGINT), SIGTERM, and SIGHUP, which a closed terminal sends.

Each raises a `KeyboardInterrupt`, so that every `finally` runs and what was acknowledged is kept. An exception that a
signal raises anywhere may be lost or do harm, in these ways:

- A module that is interrupted during its import stays half-initialised, and a compiled one may crash the process. The
  exception therefore waits for the end of the import.
- Python discards exceptions in callbacks of its garbage collector, of which JAX has one, and so do some functions
  written in C. An exception that is deleted before it ends the command is raised again.
- Compiled code replaces the exception, as when JAX compares pytrees and raises a ValueError. An error that ends the
  command after a signal, and is not raised during the handling of its exception, counts as the interruption.
"""

import _thread  # which takes no lock of `threading`, which the interrupted code may hold
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

# Signals that end a command. Windows has no SIGHUP.
ENDING_SIGNALS = [signal.Signals[name] for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
RESEND_DELAY_S = 0.05  # s until a signal is sent again whose exception was delayed or lost


class SignalInterrupt(KeyboardInterrupt):
    """A signal that ends the command.

    Args:
        number: Number of the signal.
        on_deleted: Function that is called when the exception is deleted.
    """

    def __init__(self, number: int, on_deleted: Callable[["SignalInterrupt"], None]) -> None:
        super().__init__()
        self.number, self.accepted, self._on_deleted = number, False, on_deleted

    def __del__(self) -> None:
        self._on_deleted(self)


@contextmanager
def interrupted_by_signals() -> Iterator[None]:
    """Within the block, raise a `SignalInterrupt` in the main thread when a signal arrives that ends a command.

    Signals that the program ignores or handles otherwise keep their effect, and so do all in other threads.

    Raises:
        SignalInterrupt: The signal that ended the block, also if compiled code replaced its exception by an error.
    """
    is_main = threading.current_thread() is threading.main_thread()
    before = {number: signal.getsignal(number) for number in ENDING_SIGNALS if is_main}
    replaced = [number for number in before if before[number] in (signal.SIG_DFL, signal.default_int_handler)]
    interrupts, unraisable_hook = _Interrupts(), sys.unraisablehook

    def hook(unraisable: "sys.UnraisableHookArgs") -> None:
        if not issubclass(unraisable.exc_type, SignalInterrupt):  # which is raised again
            unraisable_hook(unraisable)

    sys.unraisablehook = hook
    for number in replaced:
        signal.signal(number, interrupts.handle)
    try:
        yield
    except Exception as error:
        if interrupts.received and not _was_raised_in_handling(error):
            raise SignalInterrupt(interrupts.received, lambda _: None) from error
        raise
    finally:
        interrupts.active = False
        sys.unraisablehook = unraisable_hook
        for number in replaced:
            signal.signal(number, before[number])


@contextmanager
def ended_by_ctrl_c() -> Iterator[None]:
    """Let Ctrl-C end the block, after which the program goes on as usual."""
    try:
        yield
    except KeyboardInterrupt as interrupt:
        if isinstance(interrupt, SignalInterrupt):
            if interrupt.number != signal.SIGINT:
                raise
            interrupt.accepted = True


class _Interrupts:
    """Handler of the signals that end a command."""

    def __init__(self) -> None:
        self.active = True  # whether a lost signal is sent again
        self.received = 0  # number of the last signal, unless its exception was accepted
        self._flying = 0  # number of exceptions that are neither deleted nor accepted
        self._sent_again = False
        self._importing_before = _modules_in_import()  # such as a script that is imported and runs the command

    def handle(self, number: int, frame: FrameType | None) -> None:
        """Raise the exception of a signal, or send the signal again if now is a bad time."""
        sent_again, self._sent_again = self._sent_again, False
        if sent_again and self._flying:  # a second Ctrl-C, whose exception ends the command
            return
        self.received = number
        # An error that replaced the exception may run `finally` clauses, which must end. JAX compiles while it handles
        # a KeyError of its caches, which does not count.
        error = sys.exc_info()[1]
        is_handling = sent_again and error is not None and not isinstance(error, KeyError)
        if is_handling or _modules_in_import() - self._importing_before:
            self._send_again(number)
        else:
            self._flying += 1
            raise SignalInterrupt(number, self._on_deleted)

    def _on_deleted(self, interrupt: SignalInterrupt) -> None:
        self._flying -= 1
        if interrupt.accepted:
            self.received = 0
        elif self.active and not self._flying:
            self._send_again(interrupt.number)

    def _send_again(self, number: int) -> None:
        _thread.start_new_thread(self._send_later, (number,))

    def _send_later(self, number: int) -> None:
        time.sleep(RESEND_DELAY_S)
        if not self.active:
            return
        self._sent_again = True
        if hasattr(signal, "pthread_kill"):  # wakes up a waiting main thread as well
            signal.pthread_kill(threading.main_thread().ident or 0, number)
        else:
            signal.raise_signal(number)


def _modules_in_import() -> set[str]:
    """Find the modules that are being imported."""
    modules = sys.modules.copy()  # at once, as another thread may import meanwhile
    specs = {name: getattr(module, "__dict__", {}).get("__spec__") for name, module in modules.items()}
    return {name for name, spec in specs.items() if getattr(spec, "_initializing", False)}


def _was_raised_in_handling(error: BaseException) -> bool:
    """Test whether an error was raised while the exception of a signal was handled."""
    context: BaseException | None = error
    while context is not None:
        if isinstance(context, SignalInterrupt):
            return True
        context = context.__context__
    return False
