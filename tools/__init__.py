"""Tools: what makes and checks the documents, the pictures and the models that come with the package."""

import experiments  # noqa: F401  # bounds the threads of BLAS before NumPy is loaded
