"""Times of the watch of a UR arm, without its client library."""

STATE_TIMEOUT_S = 0.1  # without a state, after which the arm is taken for lost
WATCHDOG_RATE_HZ = 10.0  # how often the controller must hear from us
STATE_TIMEOUT_RANGE_S = (0.02, 5.0)
WATCHDOG_RATE_RANGE_HZ = (0.25, 50.0)  # from 4 s, in which an arm at 40 mm/s goes 0.16 m, to 20 ms


def check_watch(state_timeout: float | None, watchdog_rate: float | None) -> None:
    """Refuse times that protect nobody, or that no controller can keep to.

    Args:
        state_timeout: s without a state after which the arm is taken for lost; None is not checked.
        watchdog_rate: Hz, how often the controller must hear from us; None is not checked.

    Raises:
        ValueError: One of them is out of range.
    """
    for name, value, (least, most), unit in (
        ("state timeout", state_timeout, STATE_TIMEOUT_RANGE_S, "s"),
        ("watchdog rate", watchdog_rate, WATCHDOG_RATE_RANGE_HZ, "Hz"),
    ):
        if value is not None and not least <= value <= most:
            raise ValueError(f"The {name} {value:g} {unit} is outside {least:g} to {most:g} {unit}.")
