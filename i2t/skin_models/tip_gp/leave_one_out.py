"""Leave-one-out predictions of presses in closed form (`i2t.leave_one_out`), for many kernels at once."""

import contextlib
from collections.abc import Iterator
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from threadpoolctl import ThreadpoolController

from i2t.leave_one_out import UNINFORMED_VARIANCE, inverses, leave_out_parts, leave_out_rows
from i2t.skin_models.tip_gp import kernel
from i2t.skin_models.tip_gp.kernel import PressGeometry, SkinKernels


class Observed(NamedTuple):
    """Readings (uT) of n presses to which kernels are conditioned, and additional noise variance of outlying presses.

    The variance is one for each group of channels (chip), relative to the square of a channel's scale.
    """

    target: Float[np.ndarray, "n c"]  # uT
    extra_noise: Float[np.ndarray, "n groups"]  # additional relative variance of outlying presses


class LeaveOneOutPresses(NamedTuple):
    """Errors (uT) and variances (uT^2) of n presses by each of s kernels, without the press or its whole part."""

    error: Float[np.ndarray, "s n c"]  # uT, reading minus predicted mean
    variance: Float[np.ndarray, "s n c"]  # uT^2, predicted variance, noise included
    scale: Float[np.ndarray, "s c"]  # uT
    part_error: Float[np.ndarray, "s n c"]  # uT, error if all presses of a part are left out together
    part_variance: Float[np.ndarray, "s n c"]  # uT^2, variance if all presses of a part are left out together


class Conditioned(NamedTuple):
    """One kernel conditioned on n presses: inverse covariance of each group of channels, weights and scales (uT)."""

    inverse: Float[np.ndarray, "groups n n"]
    weights: Float[np.ndarray, "n c"]
    scale: Float[np.ndarray, " c"]  # uT


def limit_blas_threads(presses: int, *, limit: int = 400) -> contextlib.AbstractContextManager[Any]:
    """Limit BLAS to one thread for the matrices of few presses, for which several threads would be slower.

    Args:
        presses: Number of presses, which is the size of the matrices.
        limit: Maximum number of presses with one thread.

    Returns:
        A context in which BLAS has one thread, or as many as before if there are more presses than the limit.
    """
    return _blas().limit(limits=1 if presses <= limit else None, user_api="blas")


@cache
def _blas() -> ThreadpoolController:
    return ThreadpoolController()


def leave_one_out(
    kernels: SkinKernels, at: PressGeometry, observed: Observed, part: Int[np.ndarray, " n"] | None = None
) -> LeaveOneOutPresses:
    """Predict each press from all others with each kernel, and from all presses that are not of its part.

    Args:
        kernels: A stack of s kernels.
        at: Geometry of the n presses.
        observed: Readings of the presses.
        part: `(n,)` number of each press's part; by default each press is a part of its own.

    Returns:
        Errors (uT, reading minus prediction), variances (uT^2) and scales (uT) of the predictions.
    """
    n, c = observed.target.shape
    s = len(kernels.load_power)
    error, variance, scale = np.empty((s, n, c)), np.empty((s, n, c)), np.empty((s, c))
    part_error, part_variance = (error, variance) if part is None else (np.empty((s, n, c)), np.empty((s, n, c)))
    for i, given in enumerate(condition_all(kernels, at, observed)):
        groups, diagonal = len(given.inverse), np.diagonal(given.inverse, axis1=1, axis2=2)
        weights, own_scale = grouped(given.weights, groups), grouped(given.scale[None], groups)
        alone = leave_out_rows(np.maximum(diagonal, 1 / UNINFORMED_VARIANCE), weights, own_scale)
        error[i], variance[i], scale[i] = *map(ungrouped, alone), given.scale
        if part is not None:
            part_error[i], part_variance[i] = map(ungrouped, leave_out_parts(given.inverse, weights, part, own_scale))
    return LeaveOneOutPresses(error, variance, scale, part_error, part_variance)


def spatial_parts(position: Float[np.ndarray, "n 2"], parts: int, *, curve_bits: int = 6) -> Int[np.ndarray, " n"]:
    """Divide presses into parts of equal size by position, along a space-filling curve (Morton's).

    Args:
        position: `(n, 2)` positions of the presses (m).
        parts: Number of parts.
        curve_bits: Bits of the curve's resolution along each axis.

    Returns:
        `(n,)` number of each press's part, from 0.
    """
    n, extent = len(position), max(float(np.ptp(position, axis=0).max()), 1e-9)
    cell = ((2**curve_bits - 1) * (position - position.min(0)) / extent).astype(int)
    along = sum(((cell[:, axis] >> bit) & 1) << (2 * bit + axis) for bit in range(curve_bits) for axis in (0, 1))
    part = np.empty(n, int)
    part[np.argsort(along, kind="stable")] = np.sort(np.arange(n) % min(parts, n))
    return part


def leave_one_out_slopes(kernels: SkinKernels, at: PressGeometry, observed: Observed) -> Float[np.ndarray, "s n c"]:
    """Compute the derivatives, by the load, of the leave-one-out predictions of presses.

    Args:
        kernels: A stack of s kernels.
        at: Geometry of the n presses.
        observed: Readings of the presses.

    Returns:
        `(s, n, c)` slopes (uT per typical load).
    """
    slopes = []
    for i, given in enumerate(condition_all(kernels, at, observed)):
        change = kernel.load_slopes(kernel.take(kernels, slice(i, i + 1)), at, at)[0]
        groups = len(given.inverse)
        change = np.broadcast_to(change, (groups, *change.shape[1:]))
        weights = grouped(given.weights, groups)
        # The weights without press i are w - A_i w_i / A_ii, where A is the inverse; they vanish at i itself.
        own = np.einsum("gij,gji->gi", change, given.inverse)[..., None]
        lost = leave_out_rows(np.diagonal(given.inverse, axis1=1, axis2=2), own * weights).error
        slopes.append(ungrouped(change @ weights - lost))
    return np.stack(slopes)


def condition_all(kernels: SkinKernels, at: PressGeometry, observed: Observed) -> Iterator[Conditioned]:
    """Condition kernels on the presses, one after the other.

    Args:
        kernels: A stack of s kernels.
        at: Geometry of the n presses.
        observed: Readings of the presses.

    Yields:
        Each kernel conditioned on the presses.
    """
    n, groups = observed.extra_noise.shape
    for part in _chunks(len(kernels.load_power), groups * n * n):
        some = kernel.take(kernels, part)
        signal, noise = kernel.signal_covariances(some, at, at), kernel.noise_variances(some, at)
        for covariance, own_noise in zip(signal, noise, strict=True):
            many = max(len(covariance), groups)
            noise_of = np.broadcast_to(own_noise, (many, n)) + observed.extra_noise.T
            system = np.array(np.broadcast_to(covariance, (many, n, n)))
            system[:, np.arange(n), np.arange(n)] += noise_of
            yield _condition(system, observed)


def grouped(values: Float[np.ndarray, "n c"], groups: int) -> Float[np.ndarray, "groups n each"]:
    """Group the channels that share a system: those of one chip, or all channels.

    Args:
        values: `(n, c)` values of all channels.
        groups: Number of groups.

    Returns:
        `(groups, n, c / groups)` values of each group.
    """
    return np.swapaxes(values.reshape(len(values), groups, -1), 0, 1)


def ungrouped(values: Float[np.ndarray, "groups n each"]) -> Float[np.ndarray, "n c"]:
    """Join the channels of all groups; the inverse of `grouped`.

    Args:
        values: `(groups, n, c / groups)` values of each group.

    Returns:
        `(n, c)` values of all channels.
    """
    return np.swapaxes(values, 0, 1).reshape(values.shape[1], -1)


def _condition(system: np.ndarray, observed: Observed) -> Conditioned:
    """Condition one kernel, given the covariances (groups, n, n) of the readings."""
    inverse = inverses(system, failed=1 / UNINFORMED_VARIANCE)
    weights = ungrouped(inverse @ grouped(observed.target, len(inverse)))
    return Conditioned(inverse, weights, _channel_scale(observed.target, weights))


def _channel_scale(
    target: np.ndarray, weights: np.ndarray, *, shared_presses: float = 2.0, min_scale: float = 1e-3
) -> np.ndarray:
    """Estimate the scale (uT) of each channel: its most likely value, shrunk towards that of all channels."""
    n, square = len(target), np.sum(target * weights, axis=0)
    shrunk = (square + shared_presses * np.mean(square) / n) / (n + shared_presses)
    return np.sqrt(np.maximum(shrunk, min_scale**2))


def _chunks(count: int, values: int, *, max_values: int = 3_000_000) -> Iterator[slice]:
    """Cut a stack of matrices into chunks, so that memory holds at most this number of values at once."""
    size = max(1, max_values // max(values, 1))
    for start in range(0, count, size):
        yield slice(start, min(start + size, count))
