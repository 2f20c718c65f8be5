"""Time for procedures and recorders: this machine's, or that of a simulation that need not wait."""

import time
from typing import Protocol, runtime_checkable


@runtime_checkable
class Clock(Protocol):
    """Interface of a clock: monotonic time, Unix time at the same rate, and waiting; devices share one."""

    def now(self) -> float:
        """Return the monotonic time (s) that dates the samples and states of devices."""

    def wall(self) -> float:
        """Return the Unix time (s) for files; a person or a time server may set it."""

    def sleep(self, seconds: float) -> None:
        """Wait for a time.

        Args:
            seconds: Time to wait in s; 0 or less does not wait.
        """


class MonotonicClock:
    """Clock of this machine: real time."""

    def now(self) -> float:
        """Return the machine's monotonic time (s), `time.monotonic()`."""
        return time.monotonic()

    def wall(self) -> float:
        """Return the machine's Unix time (s), `time.time()`."""
        return time.time()

    def sleep(self, seconds: float) -> None:
        """Wait for a time (s), as in `Clock.sleep`."""
        time.sleep(seconds)
