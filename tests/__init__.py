"""Tests of i2t, the faults that `python -m tests.faults` counts, and the world of `python -m tests.second_world`."""
