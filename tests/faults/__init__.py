"""Faults, injected by the hundred and counted: `python -m tests.faults`."""

import experiments  # noqa: F401  # bounds the threads of BLAS before NumPy is loaded
