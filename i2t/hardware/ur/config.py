"""How a UR arm is reached and watched, without its client library."""

from dataclasses import dataclass


@dataclass(frozen=True)
class UrConfig:
    """A UR arm; see `i2t.hardware.ur.driver`."""

    host: str  # address of the controller
    state_timeout: float = 0.1  # s without a state after which the arm is taken for lost
    watchdog_rate: float = 10.0  # Hz, how often the controller must hear from us
