"""The population of kernels that comes with the package, as `python -m experiments.calibrate --prior` makes it."""

from functools import cache
from importlib.resources import as_file, files
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from i2t.files import serialization
from i2t.skin_models.tip_gp.kernel import SkinKernels, join, take
from i2t.skin_models.tip_gp.plain import fit_scales, plain_kernel

PRIOR_FILE = "prior.npz"
PRIOR_KIND = "i2t kernel prior"
PLAIN_LENGTH_FACTORS = (0.15, 0.25, 0.4, 0.6, 0.9, 1.6, 3.0)  # of the standard deviation of positions times two
PLAIN_WIDTHS = (0.3, 0.7, 1.5, 4.0)  # standard deviations of the loads
PLAIN_NOISE = (1e-3, 1e-2, 1e-1)
# Presses whose labels say little, because these are wrong or little is known: much noise, and nothing but the mean.
NOISY_LENGTH_FACTORS, NOISY_WIDTHS, NOISY_NOISE = (0.25, 0.6, 1.6), (0.7, 4.0), (0.5, 2.0)
MEAN_NOISE, MEAN_CONSTANT = 1e3, 1e5
PLAIN_CONSTANT = 10.0
PLAIN_SHARE = 0.25  # of the prior, of plain Gaussian processes
FITTED_PART = 0.4  # of these, of the one that is fitted to the presses
MEAN_PART = 0.1  # of these, of the one that predicts their mean
MIN_FITTED_TO, MAX_FITTED_TO = 4, 150  # presses
LEAST_SPREAD_M = 1e-7  # of positions: less is one place


class KernelPrior(NamedTuple):
    """Kernels of a population of skins, and how common each is among skins pressed by depth and by force."""

    kernels: SkinKernels
    log_share: Float[np.ndarray, "kinds s"]  # rows: depth, force


LOAD_KINDS = ("depth", "force")  # rows of `KernelPrior.log_share`


@cache
def load_prior() -> KernelPrior:
    """The prior that comes with the package.

    Returns:
        Kernels and their shares.

    Raises:
        SerializationError: The package's file is damaged or missing.
    """
    with as_file(files("i2t.skin_models.tip_gp") / PRIOR_FILE) as path:
        prior, _ = serialization.load(path, PRIOR_KIND, KernelPrior)
    kernels = SkinKernels(*(np.asarray(values, np.float64) for values in prior.kernels))
    return KernelPrior(kernels, np.asarray(prior.log_share, np.float64))


def save_prior(path: Path | str, prior: KernelPrior, about: dict[str, Any]) -> None:
    """Write a prior as one file, in single precision.

    Args:
        path: Of the file.
        prior: Kernels and their shares.
        about: How it was made, as JSON can hold it.

    Raises:
        SerializationError: It cannot be written.
    """
    kernels = SkinKernels(*(np.asarray(values, np.float32) for values in prior.kernels))
    serialization.save(path, PRIOR_KIND, KernelPrior(kernels, np.asarray(prior.log_share, np.float32)), about)


def plain_kernels(position: Float[np.ndarray, "n 2"], load: Float[np.ndarray, " n"]) -> SkinKernels:
    """Plain Gaussian processes, squared exponential over position and load, at scales of the presses at hand.

    Args:
        position: Of the presses (m).
        load: Of the presses (typical loads).

    Returns:
        A grid over length, load width and noise; the last one predicts the mean of the presses.
    """
    spread = 2 * float(np.sqrt(np.mean(np.var(position, axis=0))))
    spread = spread if spread > LEAST_SPREAD_M else 2e-3
    load_spread = max(float(np.std(load)), 1e-2)
    usual = product(PLAIN_LENGTH_FACTORS, PLAIN_WIDTHS, PLAIN_NOISE)
    noisy = product(NOISY_LENGTH_FACTORS, NOISY_WIDTHS, NOISY_NOISE)
    grid = np.array([*usual, *noisy, (1.0, 1.0, MEAN_NOISE)])
    constant = np.append(np.full(len(grid) - 1, PLAIN_CONSTANT), MEAN_CONSTANT)
    return plain_kernel(spread * grid[:, 0], load_spread * grid[:, 1], grid[:, 2], constant)


def fitted_kernel(
    position: Float[np.ndarray, "n 2"], load: Float[np.ndarray, " n"], readings: Float[np.ndarray, "n c"]
) -> SkinKernels:
    """The plain Gaussian process whose lengths and noise are the most likely for the presses.

    Args:
        position: Of the presses (m).
        load: Of the presses (typical loads).
        readings: Of the presses (uT).

    Returns:
        One kernel, or none where the presses are too few to fit it to.
    """
    some = np.random.default_rng(0).permutation(len(load))[:MAX_FITTED_TO]
    if len(some) < MIN_FITTED_TO or not np.ptp(readings, axis=0).any():
        return plain_kernel(np.zeros(0), np.zeros(0), np.zeros(0), np.zeros(0))
    scales = fit_scales(position[some], load[some], readings[some])
    return plain_kernel(*(np.array([value]) for value in (scales.length, scales.width, scales.noise, PLAIN_CONSTANT)))


def with_plain(
    prior: KernelPrior,
    kind: str,
    position: Float[np.ndarray, "n 2"],
    load: Float[np.ndarray, " n"],
    readings: Float[np.ndarray, "n c"],
) -> tuple[SkinKernels, Float[np.ndarray, " k"]]:
    """The prior of a kind of load, joined by plain Gaussian processes.

    Args:
        prior: Of the population.
        kind: Of load, one of `LOAD_KINDS`.
        position: Of the presses (m).
        load: Of the presses (typical loads).
        readings: Of the presses (uT), to which one of the plain processes is fitted.

    Returns:
        Kernels and the logarithms of their shares.
    """
    log_share = prior.log_share[LOAD_KINDS.index(kind)]
    known = np.isfinite(log_share)
    plain, fitted = plain_kernels(position, load), fitted_kernel(position, load, readings)
    counts = len(plain.load_power) - 1, 1, len(fitted.load_power)
    parts = PLAIN_SHARE * np.array([1 - MEAN_PART - FITTED_PART, MEAN_PART, FITTED_PART])
    share = np.log(1 - PLAIN_SHARE) + log_share[known] - np.log(np.sum(np.exp(log_share[known])))
    of_plain = np.repeat(np.log(parts / np.maximum(counts, 1)), counts)
    return join(take(prior.kernels, known), plain, fitted), np.append(share, of_plain)
