"""Experiments: each is run with `python -m`, and composes pure functions of i2t."""

import os

# Before NumPy is imported. Factors of a few hundred rows are too small to share: waiting threads of BLAS cost more than
# they give, and two processes on two cores take three times as long.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
