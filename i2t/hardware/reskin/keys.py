"""Single keys on a terminal, without Enter and without waiting."""

import contextlib
import os
import sys
from collections.abc import Iterator


@contextlib.contextmanager
def pressed_keys() -> Iterator["Keys"]:
    """Hear single keys while the block lasts; the terminal is as before afterwards.

    Yields:
        What hears them; nothing is heard where standard input is no terminal.
    """
    if not sys.stdin.isatty():
        yield Keys()
    elif os.name == "nt":
        yield _WindowsKeys()
    else:
        import termios
        import tty

        descriptor = sys.stdin.fileno()
        before = termios.tcgetattr(descriptor)
        tty.setcbreak(descriptor)
        try:
            yield _PosixKeys(descriptor)
        finally:
            termios.tcsetattr(descriptor, termios.TCSADRAIN, before)


class Keys:
    """Keys where there is no terminal: none is ever pressed."""

    def newest(self) -> str:
        """The keys pressed since the last call, in order; "" where none was."""
        return ""


class _PosixKeys(Keys):
    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor

    def newest(self) -> str:
        import select

        if not select.select([self._descriptor], [], [], 0)[0]:
            return ""
        return os.read(self._descriptor, 64).decode(errors="ignore")


class _WindowsKeys(Keys):
    def newest(self) -> str:
        import msvcrt

        heard = ""
        while msvcrt.kbhit():  # type: ignore[attr-defined, unused-ignore]
            heard += msvcrt.getwch()  # type: ignore[attr-defined, unused-ignore]
        return heard
