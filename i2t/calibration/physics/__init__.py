"""A pad from a few presses with a known tip: its magnetization map, and the few parameters of the layer under it.

For a known displacement the reading is linear in the magnetization (`i2t.skin.dipoles`), so that presses give a linear
system for the map, reading = Phi w + noise. The map is a series of cosines on the pad with the covariance of
`i2t.skin.pad.smooth_random`, of which a few hundred weights w are left, normal with variance 1; their posterior is that
of Bayesian linear regression (Bishop, "Pattern Recognition and Machine Learning", section 3.3).

The other parameters, `LayerParameters`, are not linear: thickness, gap from layer to chips, stiffness (presses
controlled by force) or the depth of first contact (by depth), the tip's offset in the plane, and strength and length of
the map and the noise. They are found with the map solved for at every step (variable projection; Golub and Pereyra,
SIAM J. Numer. Anal. 10, 1973): what is maximised is the log density of each press as predicted from all others
(Rasmussen and Williams, "Gaussian Processes for Machine Learning", section 5.4.2) plus that of the parameters' priors,
which are those of `i2t.skin.pad.sample_pad`. Gradients are exact: forward through the contact and the design matrices,
backwards through the regression. The curvature at the maximum gives the parameters' spread (Laplace's approximation).

Metres, newtons, pascals, microtesla. `c` is the number of channels, three for each chip of the board; `m` is the number
of cosines along an edge, `k` the number of weights.

`layer` has tips, parameters and prior; `design` what a press tells of the map; `regression` the map's posterior;
`layer_fit` the other parameters; `fit` puts them together.
"""

from i2t.calibration.physics.design import (
    DESIGN_BATCH,
    MODES,
    cosine_basis,
    cosine_prior_factor,
    design_matrices,
    design_matrix,
    weight_features,
)
from i2t.calibration.physics.fit import PadFit, fit_pad, predict_pad, solve_map
from i2t.calibration.physics.layer import (
    LayerParameters,
    LayerPrior,
    RoundTip,
    Tip,
    layer_prior,
    make_pad,
    parameters_at,
)
from i2t.calibration.physics.regression import LinearRegression, bayesian_linear_regression

__all__ = [
    "DESIGN_BATCH",
    "MODES",
    "LayerParameters",
    "LayerPrior",
    "LinearRegression",
    "PadFit",
    "RoundTip",
    "Tip",
    "bayesian_linear_regression",
    "cosine_basis",
    "cosine_prior_factor",
    "design_matrices",
    "design_matrix",
    "fit_pad",
    "layer_prior",
    "make_pad",
    "parameters_at",
    "predict_pad",
    "solve_map",
    "weight_features",
]
