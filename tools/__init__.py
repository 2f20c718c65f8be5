"""Tools that make and check the documents, the figures and the models of the package."""

import experiments  # noqa: F401  # bounds the threads of BLAS before NumPy is loaded
