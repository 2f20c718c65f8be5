"""Time for procedures and recorders: this machine's, or that of a simulation that need not wait."""

import time
from typing import Protocol, runtime_checkable


@runtime_checkable
class Clock(Protocol):
    """Two times that advance at the same rate, and a way to wait."""

    def now(self) -> float:
        """Return the monotonic time (s) that dates the samples and states of devices."""

    def wall(self) -> float:
        """Return the Unix time (s) for files; a person or a time server may set it."""

    def sleep(self, seconds: float) -> None:
        """Wait.

        Args:
            seconds: Time to wait in s; 0 or less does not wait.
        """


class MonotonicClock:
    """The clocks of this machine."""

    def now(self) -> float:
        """Return `time.monotonic()`."""
        return time.monotonic()

    def wall(self) -> float:
        """Return `time.time()`."""
        return time.time()

    def sleep(self, seconds: float) -> None:
        """Wait, as in `Clock.sleep`."""
        time.sleep(seconds)
