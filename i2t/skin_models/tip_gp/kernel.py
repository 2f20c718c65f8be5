"""Covariance of readings over presses, for many candidate skins at once.

A press has a position x (m, tool frame) and a load d. The load is its travel or its normal force in units of the
recording's typical load (root mean square), so that one kernel serves both. A reading of a channel of chip p is

  y(x, d) = e_p(x) [f(d) g(x) + f(d) b(x, d) + g0(x)] + const + noise,
  f(d) = ((d + load_offset) / (1 + load_offset))^load_power,

with a map g that the load scales, a bend b whose shape changes with the load, a static part g0 that does not depend on
the load (skins that stay displaced), a constant, and noise with a part that grows with the signal. The amplitude e_p
falls with the distance of x from chip p. Map and bend together have the variance 1 at the typical load. All variances
are relative to the square of a channel's scale.

A plain Gaussian process is one of these kernels: no growth with the load, no map, a bend and a large constant.

The module uses NumPy, so that it compiles for no number of presses. Kernels are stacked along a leading axis s.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from i2t.types import in_one_line

UNIFORM_FAR_AMPLITUDE = 1.0  # amplitude, far from the chip, of a kernel that does not use chip positions


@in_one_line
class SkinKernels(NamedTuple):
    """Hyperparameters of s kernels, each a covariance of a skin's readings over position and load of the tip.

    Lengths are in m, loads in typical loads, and variances relative to the square of a channel's scale.
    """

    load_power: Float[np.ndarray, " s"]
    load_offset: Float[np.ndarray, " s"]  # offset of the load, in typical loads
    map_length: Float[np.ndarray, " s"]  # m, length scale of the map g
    bend_share: Float[np.ndarray, " s"]  # share of the bend b in the variance of g and b together
    bend_length: Float[np.ndarray, " s"]  # m, length scale of the bend b
    bend_load_width: Float[np.ndarray, " s"]  # width of the bend over the load, in typical loads
    static_variance: Float[np.ndarray, " s"]  # variance of the map g0
    static_length: Float[np.ndarray, " s"]  # m, length scale of the map g0
    constant_variance: Float[np.ndarray, " s"]
    noise_variance: Float[np.ndarray, " s"]
    gain_noise_variance: Float[np.ndarray, " s"]  # variance of the noise that grows with e f
    chip_reach: Float[np.ndarray, " s"]  # m, distance over which the amplitude e falls
    far_amplitude: Float[np.ndarray, " s"]  # amplitude e far from the chip; 1 if e does not fall


class PressGeometry(NamedTuple):
    """Positions (m), loads (typical loads) and squared distances from the chips (m^2) of n presses, for kernels."""

    position: Float[np.ndarray, "n 2"]  # m
    load: Float[np.ndarray, " n"]  # loads of the presses, in typical loads
    chip_square: Float[np.ndarray, "chips n"] | None  # m^2, squared distances from the chips


def take(kernels: SkinKernels, which: Int[np.ndarray, " k"] | Bool[np.ndarray, " s"] | slice) -> SkinKernels:
    """Select some kernels of a stack.

    Args:
        kernels: A stack of s kernels.
        which: Numbers of the selected kernels, a mask `(s,)` or a slice.

    Returns:
        A stack of the selected kernels.
    """
    return SkinKernels(*(values[which] for values in kernels))


def join(*parts: SkinKernels) -> SkinKernels:
    """Concatenate stacks of kernels.

    Args:
        parts: Stacks of kernels.

    Returns:
        One stack of all kernels in the given order.
    """
    return SkinKernels(*(np.concatenate(values) for values in zip(*parts, strict=True)))


def geometry(
    position: Float[np.ndarray, "n 2"],
    load: Float[np.ndarray, " n"],
    chip_positions: Float[np.ndarray, "chips 2"] | None,
) -> PressGeometry:
    """Prepare the geometry of presses for kernels.

    Args:
        position: `(n, 2)` positions of the presses (m).
        load: `(n,)` loads of the presses (typical loads).
        chip_positions: `(chips, 2)` chip positions (m), if they are known.

    Returns:
        Positions, loads and squared distances from the chips.
    """
    square = None if chip_positions is None else squared_distance(chip_positions, position)
    return PressGeometry(position, load, square)


def squared_distance(a: Float[np.ndarray, "a 2"], b: Float[np.ndarray, "b 2"]) -> Float[np.ndarray, "a b"]:
    """Compute the squared distances between points of the plane.

    Args:
        a: `(a, 2)` points (m).
        b: `(b, 2)` other points (m).

    Returns:
        `(a, b)` squared distances (m^2).
    """
    return (a[:, None, 0] - b[None, :, 0]) ** 2 + (a[:, None, 1] - b[None, :, 1]) ** 2


def responses(kernels: SkinKernels, load: Float[np.ndarray, " n"]) -> Float[np.ndarray, "s n"]:
    """Compute the factor f by which the signal grows with the load; it is 1 at the typical load.

    Args:
        kernels: A stack of s kernels.
        load: `(n,)` loads in units of the typical load.

    Returns:
        `(s, n)` values of f, one for each kernel and load.
    """
    offset = kernels.load_offset[:, None]
    base = np.maximum((load[None, :] + offset) / (1 + offset), 1e-3)  # loads may be negative
    return base ** kernels.load_power[:, None]


def amplitudes(kernels: SkinKernels, at: PressGeometry) -> Float[np.ndarray, "s groups n"]:
    """Compute the amplitude e of the signal of each group of channels, which falls with the distance from the chip.

    Args:
        kernels: A stack of s kernels.
        at: Geometry of n presses.

    Returns:
        `(s, groups, n)` amplitudes, dimensionless; one group for each chip, or a single one without chips.
    """
    if at.chip_square is None:
        return np.ones((len(kernels.load_power), 1, len(at.load)))
    far = kernels.far_amplitude[:, None, None]
    near = np.exp(-at.chip_square[None] / (2 * kernels.chip_reach[:, None, None] ** 2))
    return far + (1 - far) * near


def signal_covariances(kernels: SkinKernels, a: PressGeometry, b: PressGeometry) -> Float[np.ndarray, "s groups a b"]:
    """Compute the covariances of the readings of a and b presses, without noise.

    Args:
        kernels: A stack of s kernels.
        a: Presses, one for each row.
        b: Presses, one for each column.

    Returns:
        `(s, groups, a, b)` covariances relative to the square of a channel's scale, for each kernel and group of
        channels.
    """
    square = squared_distance(a.position, b.position)[None]
    load_square = ((a.load[:, None] - b.load[None, :]) ** 2)[None]
    k = SkinKernels(*(values[:, None, None] for values in kernels))
    smooth = np.exp(-square / (2 * k.map_length**2))
    bent = np.exp(-square / (2 * k.bend_length**2) - load_square / (2 * k.bend_load_width**2))
    grown = responses(kernels, a.load)[:, :, None] * responses(kernels, b.load)[:, None, :]
    inner = grown * (smooth + k.bend_share * (bent - smooth))
    inner += k.static_variance * np.exp(-square / (2 * k.static_length**2))
    if a.chip_square is None:
        return (inner + k.constant_variance)[:, None]
    e_a, e_b = amplitudes(kernels, a), amplitudes(kernels, b)
    return e_a[..., :, None] * e_b[..., None, :] * inner[:, None] + k.constant_variance[:, None]


def signal_variances(kernels: SkinKernels, at: PressGeometry) -> Float[np.ndarray, "s groups n"]:
    """Compute the diagonals of `signal_covariances` of presses with themselves.

    Args:
        kernels: A stack of s kernels.
        at: Geometry of n presses.

    Returns:
        `(s, groups, n)` variances of each kernel, group of channels and press, relative to the square of a channel's
        scale.
    """
    inner = responses(kernels, at.load) ** 2 + kernels.static_variance[:, None]
    return amplitudes(kernels, at) ** 2 * inner[:, None, :] + kernels.constant_variance[:, None, None]


def noise_variances(kernels: SkinKernels, at: PressGeometry) -> Float[np.ndarray, "s groups n"]:
    """Compute the variances of the readings' noise in each press.

    Args:
        kernels: A stack of s kernels.
        at: Geometry of n presses.

    Returns:
        `(s, groups, n)` variances of each kernel, group of channels and press, relative to the square of a channel's
        scale.
    """
    grown = (amplitudes(kernels, at) * responses(kernels, at.load)[:, None, :]) ** 2
    return kernels.noise_variance[:, None, None] + kernels.gain_noise_variance[:, None, None] * grown


def load_slopes(
    kernels: SkinKernels, a: PressGeometry, b: PressGeometry, *, step: float = 1e-3
) -> Float[np.ndarray, "s groups a b"]:
    """Compute the derivatives of `signal_covariances` by the load of the rows, by central differences.

    Args:
        kernels: A stack of s kernels.
        a: Presses, one for each row.
        b: Presses, one for each column.
        step: Half of the difference of the loads (typical loads).

    Returns:
        `(s, groups, a, b)` derivatives of the relative covariances per typical load.
    """
    high, low = (signal_covariances(kernels, a._replace(load=a.load + sign * step), b) for sign in (1, -1))
    return (high - low) / (2 * step)
