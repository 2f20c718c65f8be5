"""Exit codes of commands, and output pipes whose reader has ended, as in `i2t place --help | head -1`."""

import os
import select
import sys
from enum import IntEnum
from typing import Any


class ExitCode(IntEnum):
    """Exit codes of commands that failed, were used wrongly, were interrupted, or lost the reader of their output."""

    FAILED = 1
    WRONG_USE = 2
    INTERRUPTED = 130  # as shells report it for programs that end by SIGINT
    OUTPUT_CLOSED = 141  # as shells report it for programs that end by SIGPIPE


def output_is_closed() -> bool:
    """Test whether the reader of stdout or stderr has ended; if so, further output to it is discarded.

    It distinguishes this case from a broken connection to a device, which raises the same error and must be reported.

    Returns:
        Whether stdout or stderr has lost its reader.
    """
    closed = [stream for stream in (sys.stdout, sys.stderr) if _has_no_reader(stream)]
    for stream in closed:  # otherwise Python would complain again when it writes its buffer at exit
        null_device = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null_device, stream.fileno())
        os.close(null_device)
    return bool(closed)


def _has_no_reader(stream: Any) -> bool:
    try:
        descriptor = stream.fileno()
    except (AttributeError, OSError, ValueError):  # missing, closed, or replaced by an object that is not a file
        return False
    if not hasattr(select, "poll"):  # Windows
        return False
    poll = select.poll()
    poll.register(descriptor, 0)  # errors are reported anyway
    return any(event & (select.POLLERR | select.POLLHUP) for _, event in poll.poll(0))
