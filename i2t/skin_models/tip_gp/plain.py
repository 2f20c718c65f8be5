"""Plain Gaussian process, the baseline of every method: squared exponential over position and load.

It has two lengths (over position and over load) and a noise, shared by all channels, which differ in scale:

  y_c = mean_c + s_c g_c(x, d) + noise,   cov(g, g') = exp(-|x - x'|^2 / 2 l^2 - (d - d')^2 / 2 w^2)

The hyperparameters l, w and noise maximise the marginal likelihood with the best scales (Rasmussen and Williams,
"Gaussian Processes for Machine Learning", section 5.4). Wide log-normal priors prevent nonsense from five presses. The
module uses NumPy, so that it compiles for no number of presses.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize

from i2t.skin_models.tip_gp import kernel
from i2t.skin_models.tip_gp.kernel import UNIFORM_FAR_AMPLITUDE, SkinKernels
from i2t.skin_models.tip_gp.leave_one_out import Observed, condition_all


@dataclass(frozen=True)
class ScaleFit:
    """Options for fitting a plain Gaussian process: log-normal priors of length, width and noise, and search limits."""

    max_presses: int = 300  # largest number of presses, because the cost grows with its cube
    length_median: float = 0.8  # prior median of the length l, as a multiple of the spread of positions
    width_median: float = 1.5  # prior median of the width w, as a multiple of the spread of loads
    noise_median: float = 0.01  # prior median of the noise, relative to a channel's variance
    # prior standard deviations of the logarithms of l, w and noise
    prior_stds: tuple[float, float, float] = (0.7, 0.7, 2.0)
    # Starts and bounds of the same logarithms, relative to the medians.
    starts: tuple[tuple[float, float, float], ...] = ((0.0, 0.0, 0.0), (-0.7, 0.0, 1.5))
    bounds: tuple[tuple[float, float], ...] = ((-4.0, 4.0), (-4.0, 4.0), (-7.0, 5.0))
    min_noise: float = 1e-6
    failed_loss: float = 1e30  # loss if the covariance cannot be factored


_SCALE_FIT = ScaleFit()  # priors of the plain process's hyperparameters, and the optimizer's limits


class PlainScales(NamedTuple):
    """Length over position (m), width over load (m or N) and relative noise variance of a plain Gaussian process."""

    length: float  # m, length scale over positions
    width: float  # m or N, length scale over loads
    noise: float  # variance of the noise, relative to the signal's


def fit_scales(position: np.ndarray, load: np.ndarray, readings: np.ndarray) -> PlainScales:
    """Fit the hyperparameters of a plain Gaussian process over position and load to presses.

    Args:
        position: `(n, 2)` positions of the presses (m).
        load: `(n,)` loads of the presses (m or N).
        readings: `(n, c)` readings of the presses (uT).

    Returns:
        The most probable length scales over positions (m) and loads (m or N), and noise.

    Raises:
        ValueError: A press is not finite, or no covariance of the presses can be factored.
    """
    some = slice(_SCALE_FIT.max_presses)
    position, load, readings = position[some], load[some], readings[some]
    medians = np.array([
        _SCALE_FIT.length_median * max(float(position.std(0).mean()) * 2, 1e-9),
        _SCALE_FIT.width_median * max(float(load.std()), 1e-9),
        _SCALE_FIT.noise_median,
    ])  # fmt: skip
    square = ((position[:, None] - position) ** 2).sum(-1), (load[:, None] - load) ** 2
    centred = readings - readings.mean(0)
    results = [
        minimize(_loss, at, (medians, square, centred), jac=True, method="L-BFGS-B", bounds=_SCALE_FIT.bounds)
        for at in map(np.array, _SCALE_FIT.starts)
    ]
    best = min(results, key=lambda result: float(result.fun) if np.isfinite(result.fun) else np.inf)
    if not best.fun < _SCALE_FIT.failed_loss:
        raise ValueError(
            f"no plain Gaussian process fits these {len(load)} presses; check for positions, loads or readings that "
            "are not finite or far too large"
        )
    length, width, noise = medians * np.exp(best.x)
    return PlainScales(float(length), float(width), max(float(noise), _SCALE_FIT.min_noise))


def predict_plain(
    scales: PlainScales,
    pressed: tuple[np.ndarray, np.ndarray, np.ndarray],
    at: tuple[np.ndarray, np.ndarray],
) -> np.ndarray:
    """Predict the readings of presses by a plain Gaussian process over position and load.

    Args:
        scales: Hyperparameters.
        pressed: Positions `(n, 2)`, loads `(n,)` and readings `(n, c)` of the presses that were made.
        at: Positions `(m, 2)` and loads `(m,)` of the presses to predict.

    Returns:
        `(m, c)` predicted readings (uT).
    """
    position, load, readings = pressed
    mean = readings.mean(0)
    kernels = plain_kernel(
        *np.array([[scales.length], [scales.width], [max(scales.noise, _SCALE_FIT.min_noise)], [0.0]])
    )
    inputs = kernel.geometry(position, load, None)
    [given] = condition_all(kernels, inputs, Observed(readings - mean, np.zeros((len(load), 1))))
    return mean + kernel.signal_covariances(kernels, kernel.geometry(*at, None), inputs)[0, 0] @ given.weights


def plain_kernel(length: np.ndarray, width: np.ndarray, noise: np.ndarray, constant: np.ndarray) -> SkinKernels:
    """Write plain processes as kernels of skins: squared exponential over position and load, without growth.

    Args:
        length: `(s,)` lengths over positions (m).
        width: `(s,)` widths over loads, in the loads' unit.
        noise: `(s,)` noise variances, relative to the signal's.
        constant: `(s,)` variances of a constant, relative to the signal's.

    Returns:
        A stack of s kernels.
    """
    ones, zeros = np.ones(len(length)), np.zeros(len(length))
    return SkinKernels(
        load_power=zeros, load_offset=ones, map_length=length, bend_share=ones, bend_length=length,
        bend_load_width=width, static_variance=zeros, static_length=length, constant_variance=constant,
        noise_variance=noise, gain_noise_variance=zeros, chip_reach=ones, far_amplitude=UNIFORM_FAR_AMPLITUDE * ones,
    )  # fmt: skip


def _loss(
    free: np.ndarray, medians: np.ndarray, square: tuple[np.ndarray, np.ndarray], centred: np.ndarray
) -> tuple[float, np.ndarray]:
    """Compute minus the log posterior, up to a constant, and its gradient by the logarithms of the hyperparameters."""
    n, c = centred.shape
    length, width, noise = medians * np.exp(free)
    near = np.exp(-(square[0] / length**2 + square[1] / width**2) / 2)
    try:
        factor = cho_factor(near + (noise + _SCALE_FIT.min_noise) * np.eye(n), lower=True)
    except np.linalg.LinAlgError:
        return _SCALE_FIT.failed_loss, np.zeros(3)
    inverse = cho_solve(factor, np.eye(n))
    weights = inverse @ centred
    scale = np.maximum((centred * weights).sum(0) / n, 1e-12)  # best scale of each channel
    loss = 0.5 * n * np.log(scale).sum() + c * np.log(np.diagonal(factor[0])).sum()
    outer = (weights / scale) @ weights.T
    change = (near * square[0] / length**2, near * square[1] / width**2, noise * np.eye(n))
    slope = np.array([0.5 * ((c * inverse - outer) * part).sum() for part in change])
    stds = np.array(_SCALE_FIT.prior_stds)
    return float(loss + 0.5 * ((free / stds) ** 2).sum()), slope + free / stds**2
