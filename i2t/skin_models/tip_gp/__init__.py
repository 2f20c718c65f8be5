"""Gaussian process of one tip on one skin: `population` is the model, its covariance is in `kernel`, its members are in
`prior`, and what it weighs them by is in `left_out`. `structured` is one of its kernels by given hyperparameters,
`candidates` are boards that the skin's may be, and `plain` is the baseline.
"""
