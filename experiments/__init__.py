"""Experiments: each is run with `python -m`, and composes pure functions of i2t."""
