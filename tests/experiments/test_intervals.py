"""How a number and its interval are printed, and how many clusters a narrower one needs."""

import math

import numpy as np
import pytest

from experiments.common.intervals import clusters_needed
from experiments.common.tables import cell
from i2t.intervals import student_interval


@pytest.mark.parametrize(
    ("numbers", "options", "said"),
    [
        ((0.81, 0.79, 0.83), {}, "0.810 [0.790, 0.830]"),
        ((0.81, None, None), {}, "0.810"),
        ((0.81, math.nan, 0.9), {"digits": 2}, "0.81"),
        (0.81, {"digits": 2}, "0.81"),
        ({"mean": 0.81, "low": 0.79, "high": 0.83}, {"digits": 2}, "0.81 [0.79, 0.83]"),
        (None, {}, "-"),
        ((None, 0.1, 0.2), {}, "-"),
        ((0.5, -0.1, 0.2), {"signed": True, "ends": 1}, "+0.500 [-0.1, +0.2]"),
        ((0.0, -1e-9, 0.0881), {}, "0.000 [0.000, 0.088]"),  # zero has no sign
    ],
)
def test_an_interval_is_printed_where_there_is_one(numbers, options, said):
    assert cell(numbers, **options) == said


def test_the_stated_number_of_clusters_is_the_smallest_that_narrows_the_interval():
    """The clusters have unit variance; at first there are six."""

    def half(number):
        values = np.resize([-1.0, 1.0], number)
        found = student_interval(values / values.std(ddof=1))
        return float(found.high - found.mean)

    needed = clusters_needed(half(6), 6, 0.3)
    assert half(needed) <= 0.3 < half(needed - 1)
    assert clusters_needed(half(needed), needed, half(needed)) == needed
    assert clusters_needed(math.nan, 6, 0.3) is clusters_needed(1.0, 2, 0.3) is None
