"""How a number and its interval are printed."""

import math

import pytest

from experiments.common.intervals import with_interval


@pytest.mark.parametrize(
    ("numbers", "options", "said"),
    [
        ((0.81, 0.79, 0.83), {}, "0.810 [0.790, 0.830]"),
        ((0.81, None, None), {}, "0.810"),
        ((0.81, math.nan, 0.9), {"digits": 2}, "0.81"),
        ((None, 0.1, 0.2), {}, "-"),
        ((0.5, -0.1, 0.2), {"sign": "+", "ends": 1}, "+0.500 [-0.1, +0.2]"),
        ((0.0, -1e-9, 0.0881), {}, "0.000 [0.000, 0.088]"),  # zero has no sign
    ],
)
def test_an_interval_is_printed_where_there_is_one(numbers, options, said):
    assert with_interval(*numbers, **options) == said
