"""Tasks that take no time, and failures of their workers."""

import os
import signal
from pathlib import Path


def write_number(path: Path, number: int) -> None:
    """The file of a task, and a word for its log."""
    print(f"number {number}")
    path.write_text(f"{number}\n")


def die_at_first(path: Path, number: int, deaths: int = 1) -> None:
    """Write a number as `write_number` does, but kill the worker the first times."""
    seen = path.with_suffix(".seen")
    seen.open("a").write("x")
    if len(seen.read_text()) <= deaths:
        os.kill(os.getpid(), signal.SIGKILL)
    write_number(path, number)


def refuse(path: Path) -> None:
    """Raise an error as a user's mistake does."""
    raise ValueError(f"{path.name} cannot be made")


def write_cores(path: Path) -> None:
    """Write the cores that a worker may use."""
    path.write_text(repr(sorted(os.sched_getaffinity(0))))
