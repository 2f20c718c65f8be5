"""Each press as predicted from all others, in closed form (`i2t.leave_one_out`) and for many kernels at once."""

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

CHUNK_VALUES = 3_000_000  # of matrices that are held at once
ONE_THREAD_PRESSES = 400  # most presses for which BLAS gets one thread
SHARED_SCALE_PRESSES = 2.0  # presses' worth of belief that all channels have one scale
MIN_SCALE_UT = 1e-3
CURVE_CELLS = 64  # of a curve that fills the plane, along an edge; a power of two


class Observed(NamedTuple):
    """Readings that kernels explain."""

    target: Float[np.ndarray, "n c"]  # uT
    extra_noise: Float[np.ndarray, "n groups"]  # relative variance of presses that are no good


class LeftOutPresses(NamedTuple):
    """n presses predicted from each other by s kernels."""

    error: Float[np.ndarray, "s n c"]  # uT, reading minus mean
    variance: Float[np.ndarray, "s n c"]  # uT^2, noise included
    scale: Float[np.ndarray, "s c"]  # uT
    part_error: Float[np.ndarray, "s n c"]  # uT, with all presses of a part left out together
    part_variance: Float[np.ndarray, "s n c"]  # uT^2


class Conditioned(NamedTuple):
    """One kernel given n presses; groups of channels have systems of their own."""

    inverse: Float[np.ndarray, "groups n n"]
    weights: Float[np.ndarray, "n c"]
    scale: Float[np.ndarray, " c"]  # uT


def one_thread_for_few(presses: int) -> contextlib.AbstractContextManager[Any]:
    """Give BLAS one thread while matrices of few presses are computed, because threads that wait for each other cost
    many times what such a matrix does.

    Args:
        presses: Number of presses, the edge of the matrices.

    Returns:
        A context in which BLAS has one thread, or as many as before if there are many presses.
    """
    return _blas().limit(limits=1 if presses <= ONE_THREAD_PRESSES else None, user_api="blas")


@cache
def _blas() -> ThreadpoolController:
    return ThreadpoolController()


def left_out(
    kernels: SkinKernels, at: PressGeometry, observed: Observed, part: Int[np.ndarray, " n"] | None = None
) -> LeftOutPresses:
    """Predict each press from all others with each kernel, and from all that are not of its part.

    Args:
        kernels: s of them.
        at: The presses.
        observed: Their readings.
        part: Number of the part in which each press lies; by default each is a part of its own.

    Returns:
        Errors, variances and scales.
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
    return LeftOutPresses(error, variance, scale, part_error, part_variance)


def parts_that_lie_together(position: Float[np.ndarray, "n 2"], parts: int) -> Int[np.ndarray, " n"]:
    """Cut positions along a curve that fills the plane (Morton's) into parts of equally many presses.

    Args:
        position: Of the presses (m).
        parts: How many.

    Returns:
        Number of the part of each press, from 0.
    """
    n, extent = len(position), max(float(np.ptp(position, axis=0).max()), 1e-9)
    cell = ((CURVE_CELLS - 1) * (position - position.min(0)) / extent).astype(int)
    bits = range(CURVE_CELLS.bit_length() - 1)
    along = sum(((cell[:, axis] >> bit) & 1) << (2 * bit + axis) for bit in bits for axis in (0, 1))
    part = np.empty(n, int)
    part[np.argsort(along, kind="stable")] = np.sort(np.arange(n) % min(parts, n))
    return part


def left_out_slopes(kernels: SkinKernels, at: PressGeometry, observed: Observed) -> Float[np.ndarray, "s n c"]:
    """Slopes by the load of the means of presses left out.

    Args:
        kernels: s of them.
        at: The presses.
        observed: Their readings.

    Returns:
        uT for one typical load.
    """
    slopes = []
    for i, given in enumerate(condition_all(kernels, at, observed)):
        change = kernel.load_slopes(kernel.take(kernels, slice(i, i + 1)), at, at)[0]
        groups = len(given.inverse)
        change = np.broadcast_to(change, (groups, *change.shape[1:]))
        weights = grouped(given.weights, groups)
        # Weights without press i are w - A_i w_i / A_ii, A the inverse: zero at i itself.
        own = np.einsum("gij,gji->gi", change, given.inverse)[..., None]
        lost = leave_out_rows(np.diagonal(given.inverse, axis1=1, axis2=2), own * weights).error
        slopes.append(ungrouped(change @ weights - lost))
    return np.stack(slopes)


def condition_all(kernels: SkinKernels, at: PressGeometry, observed: Observed) -> Iterator[Conditioned]:
    """Condition kernels on the presses, one after the other.

    Args:
        kernels: s of them.
        at: The presses.
        observed: Their readings.

    Yields:
        Each kernel given the presses.
    """
    n, groups = observed.extra_noise.shape
    for part in _chunks(len(kernels.load_power), groups * n * n):
        some = kernel.take(kernels, part)
        signal, noise = kernel.signal_covariances(some, at, at), kernel.noise_variances(some, at)
        for one, own_noise in zip(signal, noise, strict=True):
            many = max(len(one), groups)
            noise_of = np.broadcast_to(own_noise, (many, n)) + observed.extra_noise.T
            system = np.array(np.broadcast_to(one, (many, n, n)))
            system[:, np.arange(n), np.arange(n)] += noise_of
            yield _condition(system, observed)


def grouped(values: Float[np.ndarray, "n c"], groups: int) -> Float[np.ndarray, "groups n each"]:
    """Channels that share a system, those of one chip or all, next to each other.

    Args:
        values: Of all channels.
        groups: Their number.

    Returns:
        The same values.
    """
    return np.swapaxes(values.reshape(len(values), groups, -1), 0, 1)


def ungrouped(values: Float[np.ndarray, "groups n each"]) -> Float[np.ndarray, "n c"]:
    """The inverse of `grouped`.

    Args:
        values: Of groups of channels.

    Returns:
        The same values.
    """
    return np.swapaxes(values, 0, 1).reshape(values.shape[1], -1)


def _condition(system: np.ndarray, observed: Observed) -> Conditioned:
    """One kernel, from the covariances (groups, n, n) of the readings."""
    inverse = inverses(system, failed=1 / UNINFORMED_VARIANCE)
    weights = ungrouped(inverse @ grouped(observed.target, len(inverse)))
    return Conditioned(inverse, weights, _channel_scale(observed.target, weights))


def _channel_scale(target: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Scale of each channel: its most likely value, drawn to that of all channels."""
    n, square = len(target), np.sum(target * weights, axis=0)
    shrunk = (square + SHARED_SCALE_PRESSES * np.mean(square) / n) / (n + SHARED_SCALE_PRESSES)
    return np.sqrt(np.maximum(shrunk, MIN_SCALE_UT**2))


def _chunks(count: int, values: int) -> Iterator[slice]:
    size = max(1, CHUNK_VALUES // max(values, 1))
    for start in range(0, count, size):
        yield slice(start, min(start + size, count))
