"""Tests of i2t, and the faults that `python -m tests.faults` counts."""
