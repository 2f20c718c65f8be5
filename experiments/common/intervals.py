"""Printing of a number and its 95 % interval, in one way for all experiments."""

import math
from typing import SupportsFloat


def with_interval(
    mean: SupportsFloat | None,
    low: SupportsFloat | None,
    high: SupportsFloat | None,
    *,
    digits: int = 3,
    ends: int | None = None,
    sign: str = "",
) -> str:
    """A number with its interval in brackets; without brackets where there is no interval, as of too few clusters.

    Args:
        mean: The number; None or NaN where there is none.
        low: Lower end, likewise.
        high: Upper end, likewise.
        digits: Decimals.
        ends: Decimals of the interval, if others.
        sign: "+" to print the sign of positive numbers too.

    Returns:
        Such as `0.81 [0.79, 0.83]`, `0.81`, or `-`.
    """
    number, *limits = (math.nan if value is None else float(value) for value in (mean, low, high))
    if not math.isfinite(number):
        return "-"
    said = f"{number:{sign}z.{digits}f}"
    if not all(map(math.isfinite, limits)):
        return said
    return f"{said} [{', '.join(f'{limit:{sign}z.{digits if ends is None else ends}f}' for limit in limits)}]"
