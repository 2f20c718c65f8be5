"""A Gaussian process of one skin whose hyperparameters are marginalised over a population of skins.

`kernel` holds the covariance of readings over presses, `left_out` predicts each press from all others in closed form,
`prior` is the population of kernels that comes with the package, and `mixture` weighs its members by the presses at
hand and predicts.
"""

from i2t.calibration.population_gp.kernel import SkinKernels
from i2t.calibration.population_gp.mixture import (
    FitOptions,
    PopulationGP,
    PressTable,
    board_shares,
    condition,
    fit_population,
    interval_scaling,
    of_any_version,
    predict_population,
)
from i2t.calibration.population_gp.prior import KernelPrior, load_prior, save_prior

__all__ = [
    "FitOptions",
    "KernelPrior",
    "PopulationGP",
    "PressTable",
    "SkinKernels",
    "board_shares",
    "condition",
    "fit_population",
    "interval_scaling",
    "load_prior",
    "of_any_version",
    "predict_population",
    "save_prior",
]
