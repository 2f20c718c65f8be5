"""The number of clusters that an interval of some width needs."""

import math

from scipy import stats


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
