"""Time as the procedure and the recorder see it: of this machine, or of a simulation that need not wait."""

import time
from typing import Protocol, runtime_checkable


@runtime_checkable
class Clock(Protocol):
    """Two times that pass at one speed, and waiting."""

    def now(self) -> float:
        """Seconds that never jump, as in the samples and states of devices."""

    def wall(self) -> float:
        """Unix time (s), as in files; a person or a time server may set it."""

    def sleep(self, seconds: float) -> None:
        """Wait.

        Args:
            seconds: s; nothing is waited for where it is 0 or less.
        """


class MonotonicClock:
    """The clocks of this machine."""

    def now(self) -> float:
        """`time.monotonic()`."""
        return time.monotonic()

    def wall(self) -> float:
        """`time.time()`."""
        return time.time()

    def sleep(self, seconds: float) -> None:
        """Wait that long, as in `Clock.sleep`."""
        time.sleep(seconds)
