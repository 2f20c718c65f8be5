"""Emulators in processes of their own, which end with the block that started them and with this program."""

import os
import select
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TextIO, TypeAlias

Address: TypeAlias = tuple[str, int]  # host and port of an emulated board


@contextmanager
def run_emulator(module: str, *options: str) -> Iterator[tuple[str, "subprocess.Popen[str]"]]:
    """Run an emulator as a child process while the block runs.

    Args:
        module: Name of the emulator's module, which takes `--tethered` and prints a line once it is ready.
        options: Options of the emulator's command line.

    Yields:
        The line that the emulator printed, and its process, from which further lines can be read.

    Raises:
        RuntimeError: If the emulator did not start.
    """
    command = [sys.executable, "-m", module, "--tethered", *options]
    with subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,  # Ctrl-C must not reach a device; desktop Linux shares the processor by sessions
    ) as process:
        try:
            assert process.stdout is not None
            line = process.stdout.readline().strip()
            if not line:
                raise RuntimeError(f"the emulator did not start: {module} {' '.join(options)}")
            yield line, process
        finally:
            process.terminate()
            try:
                process.wait(5.0)
            except subprocess.TimeoutExpired:  # the emulator was stopped, or hangs
                process.kill()


def has_ended(stream: TextIO) -> bool:
    """Test whether the other end of a stream was closed, without waiting; discard a byte if one has arrived.

    Args:
        stream: A stream, such as the standard input of a tethered emulator.

    Returns:
        True if it was closed.
    """
    ready, _, _ = select.select([stream], [], [], 0)
    return bool(ready) and not os.read(stream.fileno(), 1)
