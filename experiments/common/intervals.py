"""Number of clusters that an interval of a given width needs."""

import math

from scipy import stats


def clusters_needed(half: float, clusters: int, wanted: float) -> int | None:
    """Compute how many clusters, such as pads, make an interval of Student's t as narrow as wanted.

    Args:
        half: Half of the width of a 95 % interval over clusters.
        clusters: Number of these clusters. Their standard deviation is assumed to stay the same.
        wanted: Half of the wanted width.

    Returns:
        The minimum number of clusters, at least 3, or None if there is no interval.
    """
    if clusters < 3 or not math.isfinite(half):
        return None
    number = 3
    spread = half / stats.t.ppf(0.975, clusters - 1) * math.sqrt(clusters)
    while not stats.t.ppf(0.975, number - 1) * spread / math.sqrt(number) <= wanted:
        number += 1
    return number
