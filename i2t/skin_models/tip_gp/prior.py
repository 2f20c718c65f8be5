"""Population of kernels that comes with the package, made by `python -m experiments.calibrate --prior`."""

from dataclasses import dataclass
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

PRIOR_FILE = "prior.npz"  # file, in this package, with the population of kernels
PRIOR_KIND = "i2t kernel prior"  # kind of file in the header of the population of kernels


@dataclass(frozen=True)
class PlainMembers:
    """Options of the plain Gaussian processes that join the population of kernels, and their shares of the prior."""

    share: float = 0.25  # prior probability of all plain processes together
    fitted_part: float = 0.4  # part of the plain processes' share for the one that is fitted to the presses
    mean_part: float = 0.1  # part of the plain processes' share for the one that predicts the mean of the presses
    constant: float = 10.0  # variance of the constant, relative to the signal's
    min_fitted_presses: int = 4
    max_fitted_presses: int = 150


_PLAIN_MEMBERS = PlainMembers()  # plain Gaussian processes that join the population, and their shares of the prior


class KernelPrior(NamedTuple):
    """Kernels of a population of skins, and their log prior shares among skins pressed by travel and by force."""

    kernels: SkinKernels
    log_share: Float[np.ndarray, "kinds s"]  # log prior shares; the rows are travel and force


@cache
def load_prior() -> KernelPrior:
    """Load the population of kernels that comes with the package.

    Returns:
        Kernels and the logarithms of their shares.

    Raises:
        SerializationError: The package's file is damaged or missing.
    """
    with as_file(files("i2t.skin_models.tip_gp") / PRIOR_FILE) as path:
        prior, _ = serialization.load(path, PRIOR_KIND, KernelPrior)
    kernels = SkinKernels(*(np.asarray(values, np.float64) for values in prior.kernels))
    return KernelPrior(kernels, np.asarray(prior.log_share, np.float64))


def save_prior(path: Path | str, prior: KernelPrior, about: dict[str, Any]) -> None:
    """Write a population of kernels as one file, in single precision.

    Args:
        path: Path of the file.
        prior: Kernels and the logarithms of their shares.
        about: How the prior was made, in types that JSON can hold.

    Raises:
        SerializationError: The file cannot be written.
    """
    kernels = SkinKernels(*(np.asarray(values, np.float32) for values in prior.kernels))
    serialization.save(path, PRIOR_KIND, KernelPrior(kernels, np.asarray(prior.log_share, np.float32)), about)


def plain_kernels(position: Float[np.ndarray, "n 2"], load: Float[np.ndarray, " n"]) -> SkinKernels:
    """Make a grid of plain Gaussian processes, squared exponential over position and load, at the scales of presses.

    Args:
        position: `(n, 2)` positions of the presses (m).
        load: `(n,)` loads of the presses (typical loads).

    Returns:
        Kernels for each length, load width and noise; the last one predicts the mean of the presses.
    """
    spread = 2 * float(np.sqrt(np.mean(np.var(position, axis=0))))
    spread = spread if spread > 1e-7 else 2e-3  # m; presses at one place have no spread
    load_spread = max(float(np.std(load)), 1e-2)
    # Lengths and widths are multiples of the spreads of positions and loads.
    usual = product((0.15, 0.25, 0.4, 0.6, 0.9, 1.6, 3.0), (0.3, 0.7, 1.5, 4.0), (1e-3, 1e-2, 1e-1))
    # Wrong or uninformative labels call for much noise, or for nothing but the mean.
    noisy = product((0.25, 0.6, 1.6), (0.7, 4.0), (0.5, 2.0))
    grid = np.array([*usual, *noisy, (1.0, 1.0, 1e3)])
    constant = np.append(np.full(len(grid) - 1, _PLAIN_MEMBERS.constant), 1e5)
    return plain_kernel(spread * grid[:, 0], load_spread * grid[:, 1], grid[:, 2], constant)


def fitted_kernel(
    position: Float[np.ndarray, "n 2"], load: Float[np.ndarray, " n"], readings: Float[np.ndarray, "n c"]
) -> SkinKernels:
    """Fit the lengths and the noise of a plain Gaussian process to the presses.

    Args:
        position: `(n, 2)` positions of the presses (m).
        load: `(n,)` loads of the presses (typical loads).
        readings: `(n, c)` readings of the presses (uT).

    Returns:
        A stack of one kernel, or an empty stack if the presses are too few.
    """
    some = np.random.default_rng(0).permutation(len(load))[: _PLAIN_MEMBERS.max_fitted_presses]
    if len(some) < _PLAIN_MEMBERS.min_fitted_presses or not np.ptp(readings, axis=0).any():
        return plain_kernel(np.zeros(0), np.zeros(0), np.zeros(0), np.zeros(0))
    scales = fit_scales(position[some], load[some], readings[some])
    return plain_kernel(
        *(np.array([value]) for value in (scales.length, scales.width, scales.noise, _PLAIN_MEMBERS.constant))
    )


def add_plain_members(
    prior: KernelPrior,
    kind: str,
    position: Float[np.ndarray, "n 2"],
    load: Float[np.ndarray, " n"],
    readings: Float[np.ndarray, "n c"],
) -> tuple[SkinKernels, Float[np.ndarray, " k"]]:
    """Add plain Gaussian processes to the population of kernels for a kind of load.

    Args:
        prior: Prior of the population.
        kind: Kind of load, "travel" or "force".
        position: `(n, 2)` positions of the presses (m).
        load: `(n,)` loads of the presses (typical loads).
        readings: `(n, c)` readings of the presses (uT), to which one of the plain processes is fitted.

    Returns:
        A stack of k kernels, and the `(k,)` logarithms of their shares.
    """
    log_share = prior.log_share[("travel", "force").index(kind)]
    present = np.isfinite(log_share)
    plain, fitted = plain_kernels(position, load), fitted_kernel(position, load, readings)
    counts = len(plain.load_power) - 1, 1, len(fitted.load_power)
    parts = _PLAIN_MEMBERS.share * np.array(
        [
            1 - _PLAIN_MEMBERS.mean_part - _PLAIN_MEMBERS.fitted_part,
            _PLAIN_MEMBERS.mean_part,
            _PLAIN_MEMBERS.fitted_part,
        ]
    )
    share = np.log(1 - _PLAIN_MEMBERS.share) + log_share[present] - np.log(np.sum(np.exp(log_share[present])))
    plain_share = np.repeat(np.log(parts / np.maximum(counts, 1)), counts)
    return join(take(prior.kernels, present), plain, fitted), np.append(share, plain_share)
