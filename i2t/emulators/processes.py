"""Emulators in processes of their own, which end with the block that started them and with this program."""

import os
import select
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TextIO, TypeAlias

Address: TypeAlias = tuple[str, int]  # and port, at which an emulated board listens

END_S = 5.0  # that an emulator may take to end


@contextmanager
def started(module: str, *options: str) -> Iterator[tuple[str, "subprocess.Popen[str]"]]:
    """Run an emulator next to this process.

    Args:
        module: Its name; it takes `--tethered`, and prints a line once it is ready.
        options: Of its command line.

    Yields:
        That line, and the process, from which further lines can be read.

    Raises:
        RuntimeError: It did not start.
    """
    command = [sys.executable, "-m", module, "--tethered", *options]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            line = process.stdout.readline().strip()
            if not line:
                raise RuntimeError(f"the emulator did not start: {module} {' '.join(options)}")
            yield line, process
        finally:
            process.terminate()
            try:
                process.wait(END_S)
            except subprocess.TimeoutExpired:  # it was stopped, or hangs
                process.kill()


def has_ended(stream: TextIO) -> bool:
    """Tell whether the other end of a stream was closed.

    Args:
        stream: Such as the standard input of a tethered emulator.

    Returns:
        True then; nobody is waited for.
    """
    ready, _, _ = select.select([stream], [], [], 0)
    return bool(ready) and not os.read(stream.fileno(), 1)
