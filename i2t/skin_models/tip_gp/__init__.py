"""Gaussian process of one tip on one skin.

`population` is the model, `kernel` its covariance, `prior` its members and `leave_one_out` the errors that weigh them.
`structured` is a single kernel with given hyperparameters, `candidates` lists boards that a skin may have, and `plain`
is the baseline.
"""
