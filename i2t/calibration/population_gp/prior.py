"""The population of kernels that comes with the package, as `python -m experiments.calibrate_pads --prior` made it."""

from functools import cache
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from i2t import serialization
from i2t.calibration.population_gp.kernel import UNIFORM_FAR_AMPLITUDE, SkinKernels, join, take

PRIOR_FILE = "prior.npz"
PRIOR_KIND = "i2t kernel prior"
PLAIN_LENGTH_FACTORS = (0.15, 0.25, 0.4, 0.6, 0.9)  # of the standard deviation of positions times two
PLAIN_WIDTHS = (0.3, 0.7, 1.5, 4.0)  # standard deviations of the loads
PLAIN_NOISE = (1e-3, 1e-2, 1e-1)
PLAIN_CONSTANT = 10.0
PLAIN_SHARE = 0.05  # of the prior, of plain Gaussian processes


class KernelPrior(NamedTuple):
    """Kernels of a population of skins, and how common each is among skins pressed by depth and by force."""

    kernels: SkinKernels
    log_share: Float[np.ndarray, "kinds s"]  # rows: depth, force


LOAD_KINDS = ("depth", "force")  # rows of `KernelPrior.log_share`


@cache
def _packaged() -> tuple[KernelPrior, dict[str, Any]]:
    with as_file(files("i2t.calibration.population_gp") / PRIOR_FILE) as path:
        return serialization.load(path, PRIOR_KIND, KernelPrior)


def load_prior() -> KernelPrior:
    """The prior that comes with the package.

    Returns:
        Kernels and their shares.

    Raises:
        SerializationError: The package's file is damaged or missing.
    """
    prior, _ = _packaged()
    kernels = SkinKernels(*(np.asarray(values, np.float64) for values in prior.kernels))
    return KernelPrior(kernels, np.asarray(prior.log_share, np.float64))


def prior_about() -> dict[str, Any]:
    """How the prior that comes with the package was made.

    Returns:
        Seeds, kinds of skins and the command.
    """
    return _packaged()[1]


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
        A grid over length, load width and noise.
    """
    spread = 2 * max(float(np.sqrt(np.mean(np.var(position, axis=0)))), 1e-3)
    load_spread = max(float(np.std(load)), 1e-2)
    grid = np.array([(a, b, v) for a in PLAIN_LENGTH_FACTORS for b in PLAIN_WIDTHS for v in PLAIN_NOISE])
    one, none = np.ones(len(grid)), np.zeros(len(grid))
    length = spread * grid[:, 0]
    return SkinKernels(
        load_power=none, load_offset=one, map_length=length, bend_share=one, bend_length=length,
        bend_load_width=load_spread * grid[:, 1], static_variance=none, static_length=length,
        constant_variance=PLAIN_CONSTANT * one, noise_variance=grid[:, 2], gain_noise_variance=none, chip_reach=one,
        far_amplitude=UNIFORM_FAR_AMPLITUDE * one,
    )  # fmt: skip


def with_plain(
    prior: KernelPrior, kind: str, position: Float[np.ndarray, "n 2"], load: Float[np.ndarray, " n"]
) -> tuple[SkinKernels, Float[np.ndarray, " k"]]:
    """The prior of a kind of load, joined by plain Gaussian processes.

    Args:
        prior: Of the population.
        kind: Of load, one of `LOAD_KINDS`.
        position: Of the presses (m).
        load: Of the presses (typical loads).

    Returns:
        Kernels and the logarithms of their shares.
    """
    log_share = prior.log_share[LOAD_KINDS.index(kind)]
    known = np.isfinite(log_share)
    plain = plain_kernels(position, load)
    count = len(plain.load_power)
    share = np.log(1 - PLAIN_SHARE) + log_share[known] - np.log(np.sum(np.exp(log_share[known])))
    return join(take(prior.kernels, known), plain), np.append(share, np.full(count, np.log(PLAIN_SHARE / count)))
