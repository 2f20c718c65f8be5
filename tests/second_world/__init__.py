"""A world of other physics than i2t's, and the scores of predictors in it."""

import experiments  # noqa: F401  # bounds the threads of BLAS before NumPy is loaded
