"""Output that nobody reads any more, as in `python -m i2t.place --help | head -1`."""

import os
import select
import sys
from typing import Any

NOBODY_READS = 141  # exit code; as shells give it for programs that end by SIGPIPE


def nobody_reads() -> bool:
    """Test for an output pipe without a reader; further output to it is then dropped.

    A connection to a device breaks with the same error, and is no reason to say nothing.

    Returns:
        Whether stdout or stderr has lost its reader.
    """
    gone = [stream for stream in (sys.stdout, sys.stderr) if _has_no_reader(stream)]
    for stream in gone:  # Python would complain again when it writes what is left at its end
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)
    return bool(gone)


def _has_no_reader(stream: Any) -> bool:
    try:
        descriptor = stream.fileno()
    except (AttributeError, OSError, ValueError):  # none, replaced by what is no file, or closed
        return False
    if not hasattr(select, "poll"):  # Windows
        return False
    poll = select.poll()
    poll.register(descriptor, 0)  # errors are reported anyway
    return any(what & (select.POLLERR | select.POLLHUP) for _, what in poll.poll(0))
