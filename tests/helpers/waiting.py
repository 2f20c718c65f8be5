"""Waiting for other processes and threads."""

import time

PATIENCE = 20.0  # s that a loaded machine may need for what takes a moment


def eventually(condition) -> None:
    """Ask again until the condition holds."""
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)
