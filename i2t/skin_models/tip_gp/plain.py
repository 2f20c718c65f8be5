"""The plain Gaussian process that every method has to beat: squared exponential over position and load, its
hyperparameters fitted to the presses at hand.

Two lengths (over position and over load), a noise and nothing else, shared by all channels, which differ in scale:

  y_c = mean_c + s_c g_c(x, d) + noise,   cov(g, g') = exp(-|x - x'|^2 / 2 l^2 - (d - d')^2 / 2 w^2)

Marginal likelihood (Rasmussen and Williams, "Gaussian Processes for Machine Learning", section 5.4) is maximised over
l, w and the noise, the scales being at their best, with wide log-normal priors that keep five presses from choosing
nonsense. NumPy, so that no number of presses compiles.
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize

from i2t.skin_models.tip_gp import kernel
from i2t.skin_models.tip_gp.kernel import UNIFORM_FAR_AMPLITUDE, SkinKernels
from i2t.skin_models.tip_gp.left_out import Observed, condition_all

MAX_FITTED_PRESSES = 300  # that hyperparameters are fitted to: the cost grows with the cube
PRIOR_STDS = (0.7, 0.7, 2.0)  # of the logarithms of l, w and the noise
PRIOR_LENGTH = 0.8  # of the spread of positions, median of l; likewise of loads and w
PRIOR_WIDTH = 1.5
PRIOR_NOISE = 0.01  # of a channel's variance
STARTS = ((0.0, 0.0, 0.0), (-0.7, 0.0, 1.5))  # in logarithms, from the priors' medians
BOUNDS = ((-4.0, 4.0), (-4.0, 4.0), (-7.0, 5.0))  # likewise
LEAST_NOISE = 1e-6
FAILED_LOSS = 1e30  # where the covariance cannot be factored
SPREAD_FLOOR = 1e-9  # m, N


class PlainScales(NamedTuple):
    """Hyperparameters."""

    length: float  # m
    width: float  # of the load
    noise: float  # variance, relative to the signal's


def fit_scales(position: np.ndarray, load: np.ndarray, readings: np.ndarray) -> PlainScales:
    """Hyperparameters of the most likely plain process.

    Args:
        position: (n, 2) m.
        load: (n,) m or N.
        readings: (n, c) uT.

    Returns:
        Lengths and noise.

    Raises:
        ValueError: A press is not finite, or no covariance of the presses can be factored.
    """
    some = slice(MAX_FITTED_PRESSES)
    position, load, readings = position[some], load[some], readings[some]
    medians = np.array([
        PRIOR_LENGTH * max(float(position.std(0).mean()) * 2, SPREAD_FLOOR),
        PRIOR_WIDTH * max(float(load.std()), SPREAD_FLOOR),
        PRIOR_NOISE,
    ])  # fmt: skip
    square = ((position[:, None] - position) ** 2).sum(-1), (load[:, None] - load) ** 2
    centred = readings - readings.mean(0)
    start = [
        minimize(_loss, at, (medians, square, centred), jac=True, method="L-BFGS-B", bounds=BOUNDS)
        for at in map(np.array, STARTS)
    ]
    best = min(start, key=lambda found: float(found.fun) if np.isfinite(found.fun) else np.inf)
    if not best.fun < FAILED_LOSS:
        raise ValueError(
            f"no plain Gaussian process fits these {len(load)} presses; look for positions, loads or readings that are "
            "not finite or far too large"
        )
    length, width, noise = medians * np.exp(best.x)
    return PlainScales(float(length), float(width), max(float(noise), LEAST_NOISE))


def predict_plain(
    scales: PlainScales,
    known: tuple[np.ndarray, np.ndarray, np.ndarray],
    at: tuple[np.ndarray, np.ndarray],
) -> np.ndarray:
    """Readings of presses.

    Args:
        scales: Hyperparameters.
        known: Positions (n, 2), loads (n,) and readings (n, c) of the presses that are known.
        at: Positions (m, 2) and loads (m,) of those to predict.

    Returns:
        (m, c) uT.
    """
    position, load, readings = known
    mean = readings.mean(0)
    kernels = plain_kernel(*np.array([[scales.length], [scales.width], [max(scales.noise, LEAST_NOISE)], [0.0]]))
    pressed = kernel.geometry(position, load, None)
    [given] = condition_all(kernels, pressed, Observed(readings - mean, np.zeros((len(load), 1))))
    return mean + kernel.signal_covariances(kernels, kernel.geometry(*at, None), pressed)[0, 0] @ given.weights


def plain_kernel(length: np.ndarray, width: np.ndarray, noise: np.ndarray, constant: np.ndarray) -> SkinKernels:
    """Plain processes among the kernels of skins: squared exponential over position and load, without growth.

    Args:
        length: (s,) over positions (m).
        width: (s,) over loads.
        noise: (s,) variances, relative to the signal's.
        constant: (s,) variances of a constant, relative to the signal's.

    Returns:
        The kernels.
    """
    one, none = np.ones(len(length)), np.zeros(len(length))
    return SkinKernels(
        load_power=none, load_offset=one, map_length=length, bend_share=one, bend_length=length, bend_load_width=width,
        static_variance=none, static_length=length, constant_variance=constant, noise_variance=noise,
        gain_noise_variance=none, chip_reach=one, far_amplitude=UNIFORM_FAR_AMPLITUDE * one,
    )  # fmt: skip


def _loss(
    free: np.ndarray, medians: np.ndarray, square: tuple[np.ndarray, np.ndarray], centred: np.ndarray
) -> tuple[float, np.ndarray]:
    """Minus the log posterior, up to a constant, and its gradient by the logarithms of the hyperparameters."""
    n, c = centred.shape
    length, width, noise = medians * np.exp(free)
    near = np.exp(-(square[0] / length**2 + square[1] / width**2) / 2)
    try:
        factor = cho_factor(near + (noise + LEAST_NOISE) * np.eye(n), lower=True)
    except np.linalg.LinAlgError:
        return FAILED_LOSS, np.zeros(3)
    inverse = cho_solve(factor, np.eye(n))
    weights = inverse @ centred
    scale = np.maximum((centred * weights).sum(0) / n, 1e-12)  # of each channel, at its best
    loss = 0.5 * n * np.log(scale).sum() + c * np.log(np.diagonal(factor[0])).sum()
    outer = (weights / scale) @ weights.T
    change = (near * square[0] / length**2, near * square[1] / width**2, noise * np.eye(n))
    slope = np.array([0.5 * ((c * inverse - outer) * part).sum() for part in change])
    stds = np.array(PRIOR_STDS)
    return float(loss + 0.5 * ((free / stds) ** 2).sum()), slope + free / stds**2
