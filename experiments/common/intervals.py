"""Numbers and their 95 % intervals, in one way for all experiments: how they are printed, and how many clusters a
narrower one needs.
"""

import math
from typing import SupportsFloat

from scipy import stats


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


def clusters_needed(half: float, clusters: int, wanted: float) -> int | None:
    """Number of clusters, such as pads, at which an interval of Student's t is as narrow as wanted.

    Args:
        half: Half of the width of a 95 % interval over clusters.
        clusters: Number of these; their standard deviation is taken to stay.
        wanted: Half of the width that is asked for.

    Returns:
        The least number, at least 3; None where there is no interval.
    """
    if clusters < 3 or not math.isfinite(half):
        return None
    number = 3
    spread = half / stats.t.ppf(0.975, clusters - 1) * math.sqrt(clusters)
    while not stats.t.ppf(0.975, number - 1) * spread / math.sqrt(number) <= wanted:
        number += 1
    return number
