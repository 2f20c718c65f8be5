"""Structured Gaussian process (GP) of one skin: readings of all presses, predicted from a few with one tip.

A press has a position x (m, tool frame) and a load d: its depth (m) or its normal force (N), one of them throughout. A
reading of channel c is

  y_c = e_c(x) [f(d) g_c(x) + f(d) b_c(x, d) + g0_c(x) + const_c] + noise,
  f(d) = ((d + load_offset) / (unit_load + load_offset))^load_power,

a Gaussian process of mean zero: one map g_c, stretched by the load, a little bend b_c of its shape with the load, and
for presses controlled by force a part g0_c that does not depend on it. The amplitude e_c falls with the distance of x
from the chip of channel c where chips are given. Channels share the covariance and differ in scale.

The surface is not flat: d is replaced by d + h(x), with one height h per position for all channels. The residuals of
all channels along their slopes measure the height at each press. They are taken from leave-one-out means (Rasmussen and
Williams, "Gaussian Processes for Machine Learning", equations 5.10 to 5.12), so that no press explains itself; a second
GP of short length smooths the heights, and the fit is repeated with them.

With few presses the hyperparameters cannot be fitted and are fixed: `DEPTH_HYPERPARAMETERS` and
`FORCE_HYPERPARAMETERS`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from i2t.types import in_one_line

JITTER = 1e-5  # of the signal's variance: float32 factors of 1000 presses stay real
HEIGHT_FITS = 3  # fits, each with the heights that the one before found; more change nothing
HEIGHT_ERROR_UNIT_LOADS = 5e-3  # standard deviation of what one press measures of its height, at least
STDS_WITHIN_90_PERCENT = 1.645  # standard deviations of a normal error that hold nine in ten
CONFORMAL_FOLDS = 10  # of cross-validation, up to MANY_PRESSES
CONFORMAL_FOLDS_OF_MANY = 3  # beyond
MANY_PRESSES = 300
DEFAULT_INTERVAL_SCALING = 1.2  # on the development presses of the recording that DEPTH_HYPERPARAMETERS was found on
DEFAULT_SCALING_PRESSES = 5.0  # presses' worth of belief in DEFAULT_INTERVAL_SCALING
SHARED_SCALING_PRESSES = 20.0  # presses' worth of belief that all channels have one interval scaling
SHARED_SCALE_PRESSES = 2.0  # presses' worth of belief that all channels have one scale


@in_one_line
class Presses(NamedTuple):
    """Positions and loads of presses."""

    position: Float[Array, "n 2"]  # m, tool frame
    load: Float[Array, " n"]  # depth in m, or normal force in N


@in_one_line
class StructuredGPHyperparameters(NamedTuple):
    """Hyperparameters, as Python numbers or scalars of JAX.

    Loads have the unit of the presses' (m or N); variances are relative to a channel's at the unit load.
    """

    unit_load: float | Float[Array, "..."]  # load at which f is 1
    load_offset: float | Float[Array, "..."]  # load below zero at which f vanishes
    load_power: float | Float[Array, "..."]
    map_length: float | Float[Array, "..."]  # m, of the maps g and g0
    map_variance: float | Float[Array, "..."]  # of g
    bend_variance: float | Float[Array, "..."]  # of b
    bend_length: float | Float[Array, "..."]  # m
    bend_load_width: float | Float[Array, "..."]  # load
    static_variance: float | Float[Array, "..."]  # of g0
    constant_variance: float | Float[Array, "..."]  # of const
    noise_variance: float | Float[Array, "..."]  # of noise and of what the model leaves out
    height_std: float | Float[Array, "..."]  # load, of h
    height_length: float | Float[Array, "..."]  # m
    chip_reach: float | Float[Array, "..."]  # m, over which e falls
    far_amplitude: float | Float[Array, "..."]  # e far from the chip
    lattice_period: float | Float[Array, "..."] = 0.0  # m, of heights that repeat along x and y; 0: none is known
    height_load_width: float | Float[Array, "..."] = 0.0  # load over which heights change; 0: they do not
    periodic_share: float | Float[Array, "..."] = 0.5  # of the heights' variance, where there is a period


# Found on the development presses of one eFlesh session (docs/calibration.md): the long length is in the order of the
# height of the magnets over the chips and of their spacing, the short one that of a lattice's struts.
DEPTH_HYPERPARAMETERS = StructuredGPHyperparameters(
    unit_load=2e-3, load_offset=2.7e-3, load_power=1.8, map_length=16.5e-3, map_variance=1.0, bend_variance=0.0145,
    bend_length=2e-3, bend_load_width=7e-3, static_variance=0.03, constant_variance=2e-3, noise_variance=4.5e-3,
    height_std=0.17e-3, height_length=1.8e-3, chip_reach=10e-3, far_amplitude=0.2, height_load_width=8e-3,
)  # fmt: skip
# Found on 24 simulated boards pressed with a spherical tip of 4 mm to 0.2 to 1 N, by a coordinate search on R2 of
# presses left out: a map of two lengths, that of the layer's thickness and twice as much, hardly bent by the load. What
# does not depend on the force is kept from a guess: simulated boards have none, real ones may.
FORCE_HYPERPARAMETERS = StructuredGPHyperparameters(
    unit_load=1.0, load_offset=0.24, load_power=1.4, map_length=2.1e-3, map_variance=1.0, bend_variance=5.2,
    bend_length=5e-3, bend_load_width=7.8, static_variance=0.3, constant_variance=0.1, noise_variance=1.7e-2,
    height_std=0.0, height_length=2e-3, chip_reach=5.8e-3, far_amplitude=0.013,
)  # fmt: skip


@in_one_line
class StructuredGP(NamedTuple):
    """The GP conditioned on the presses of one skin."""

    hyperparameters: StructuredGPHyperparameters
    presses: Presses
    corrected_presses: Presses  # loads with the heights found
    chip_positions: Float[Array, "chips 2"] | None  # m
    cholesky: Float[Array, "groups n n"]  # of the covariance; a group of channels for each chip, or one of all
    weights: Float[Array, "n c"]
    scale: Float[Array, " c"]  # uT
    height_cholesky: Float[Array, "n n"]
    height_weights: Float[Array, " n"]
    previous_session: "StructuredGP | None" = None  # only in files of an earlier version, which are refused


class LeaveOneOut(NamedTuple):
    """Each press as predicted from all others."""

    mean: Float[Array, "n c"]  # uT
    std: Float[Array, "n c"]  # uT, noise included
    slope: Float[Array, "n c"]  # uT per unit load
    scale: Float[Array, " c"]  # uT


def load_response(hyperparameters: StructuredGPHyperparameters, load: Float[Array, " n"]) -> Float[Array, " n"]:
    """Growth of the signal with the load: f, which is 1 at the unit load.

    Args:
        hyperparameters: Unit load, offset and power.
        load: Depths (m) or forces (N).

    Returns:
        f of each load.
    """
    whole = hyperparameters.unit_load + hyperparameters.load_offset
    return jnp.maximum((load + hyperparameters.load_offset) / whole, 1e-3) ** hyperparameters.load_power


def covariance(hyperparameters: StructuredGPHyperparameters, a: Presses, b: Presses) -> Float[Array, "a b"]:
    """Covariance of two readings of one channel, relative to its scale, before the amplitudes e.

    Args:
        hyperparameters: Of the GP.
        a: Presses, one for each row.
        b: Presses, one for each column.

    Returns:
        Covariances without noise.
    """
    h = hyperparameters
    square = _squared_distance(a.position, b.position)
    load_difference = a.load[:, None] - b.load[None, :]
    smooth = jnp.exp(-square / (2 * h.map_length**2))
    bent = jnp.exp(-square / (2 * h.bend_length**2) - load_difference**2 / (2 * h.bend_load_width**2))
    grown = load_response(h, a.load)[:, None] * load_response(h, b.load)[None, :]
    return grown * (h.map_variance * smooth + h.bend_variance * bent) + h.static_variance * smooth + h.constant_variance


def amplitude(
    hyperparameters: StructuredGPHyperparameters,
    position: Float[Array, "n 2"],
    chip_positions: Float[Array, "chips 2"] | None,
) -> Float[Array, "groups n"]:
    """Amplitude e of each chip's channels at each position.

    Args:
        hyperparameters: Reach of a chip and amplitude far from it.
        position: Positions of presses (m).
        chip_positions: Positions of the chips (m), or None for one group of all channels.

    Returns:
        A row for each chip, or a row of ones without chips.
    """
    if chip_positions is None:
        return jnp.ones((1, len(position)))
    near = jnp.exp(-_squared_distance(chip_positions, position) / (2 * hyperparameters.chip_reach**2))
    return hyperparameters.far_amplitude + (1 - hyperparameters.far_amplitude) * near


def fit(
    hyperparameters: StructuredGPHyperparameters,
    presses: Presses,
    readings: Float[Array, "n c"],
    chip_positions: Float[Array, "chips 2"] | None = None,
) -> StructuredGP:
    """Condition the GP on n presses and their readings.

    Args:
        hyperparameters: Of the GP.
        presses: Positions (m) and loads (m or N).
        readings: Their readings (uT); with chips three channels for each, in the chips' order.
        chip_positions: Positions of the chips (m), for amplitudes that fall with the distance from them.

    Returns:
        The conditioned GP.
    """
    unit_load, corrected = hyperparameters.unit_load, presses
    spread = _height_covariance(hyperparameters, presses, presses)
    for _ in range(HEIGHT_FITS):
        known = (corrected.load - presses.load) / unit_load
        seen, variance = _measured_heights(
            leave_one_out(hyperparameters, corrected, readings, chip_positions), readings
        )
        height_cholesky = jnp.linalg.cholesky(spread + jnp.diag(variance))
        height_weights = jax.scipy.linalg.cho_solve((height_cholesky, True), known + seen)
        height = jnp.matmul(spread, height_weights, precision="highest")
        corrected = Presses(presses.position, presses.load + unit_load * height)
    system = _system(hyperparameters, corrected, chip_positions)
    # Group by group: batched factors that run side by side may wait for ever for the threads that each other holds.
    cholesky = jax.lax.map(jnp.linalg.cholesky, system)
    weights = _ungrouped(jax.lax.map(lambda both: _solve(*both), (cholesky, _grouped(readings, len(system)))))
    return StructuredGP(
        hyperparameters=hyperparameters,
        presses=presses,
        corrected_presses=corrected,
        chip_positions=chip_positions,
        cholesky=cholesky,
        weights=weights,
        scale=_channel_scale(readings, weights),
        height_cholesky=height_cholesky,
        height_weights=height_weights,
    )


def predict(gp: StructuredGP, presses: Presses) -> tuple[Float[Array, "n c"], Float[Array, "n c"]]:
    """Predict the readings of n presses.

    Args:
        gp: The GP of one skin.
        presses: Positions (m) and loads (m or N).

    Returns:
        Mean and standard deviation (uT), noise and uncertain heights included.
    """
    h, chips = gp.hyperparameters, gp.chip_positions
    height, height_variance = _predicted_heights(gp, presses)
    corrected, known = Presses(presses.position, presses.load + h.unit_load * height), gp.corrected_presses
    e, e_known = (amplitude(h, p.position, chips) for p in (presses, known))
    weights = _grouped(gp.weights, len(e))

    def cross(load: Float[Array, " n"]) -> Float[Array, "groups n m"]:
        return e[:, :, None] * e_known[:, None, :] * covariance(h, Presses(presses.position, load), known)[None]

    k, change = jax.jvp(cross, (corrected.load,), (jnp.full_like(corrected.load, h.unit_load),))
    mean, slope = (_ungrouped(jnp.matmul(part, weights, precision="highest")) for part in (k, change))
    own = e**2 * _variance(h, corrected)[None]
    explained = jax.lax.map(
        lambda both: jax.scipy.linalg.solve_triangular(both[0], both[1].T, lower=True), (gp.cholesky, k)
    )
    variance = jnp.maximum(own - jnp.sum(explained**2, axis=1), 0) + h.noise_variance
    variance = jnp.repeat(variance, len(gp.scale) // len(e), axis=0).T * gp.scale[None] ** 2
    return mean, jnp.sqrt(variance + slope**2 * height_variance[:, None])


def leave_one_out(
    hyperparameters: StructuredGPHyperparameters,
    presses: Presses,
    readings: Float[Array, "n c"],
    chip_positions: Float[Array, "chips 2"] | None = None,
) -> LeaveOneOut:
    """Predict each press from all others, in closed form (Rasmussen and Williams, equations 5.10 to 5.12).

    Args:
        hyperparameters: Of the GP; heights take no part.
        presses: Positions (m) and loads (m or N).
        readings: Their readings (uT).
        chip_positions: Positions of the chips (m), as in `fit`.

    Returns:
        Means, standard deviations, slopes by the load, and the channels' scales.
    """
    system = _system(hyperparameters, presses, chip_positions)
    inverse = jax.lax.map(lambda K: _solve(jnp.linalg.cholesky(K), jnp.eye(len(K))), system)
    y = _grouped(readings, len(system))
    weights = jnp.matmul(inverse, y, precision="highest")
    own = jnp.diagonal(inverse, axis1=1, axis2=2)[..., None]
    e = amplitude(hyperparameters, presses.position, chip_positions)

    def rows(load: Float[Array, " n"]) -> Float[Array, "n n"]:
        return covariance(hyperparameters, Presses(presses.position, load), presses)

    change = jax.jvp(rows, (presses.load,), (jnp.full_like(presses.load, hyperparameters.unit_load),))[1]
    change = e[:, :, None] * e[:, None, :] * change[None]
    # Weights without press i are w - A_i w_i / A_ii, A the inverse: zero at i itself.
    mine = jnp.einsum("gij,gji->gi", change, inverse, precision="highest")[..., None]
    slope = jnp.matmul(change, weights, precision="highest") - mine * weights / own
    scale = _channel_scale(readings, _ungrouped(weights))
    std = _ungrouped(jnp.broadcast_to(jnp.sqrt(1 / own), y.shape)) * scale[None]
    return LeaveOneOut(_ungrouped(y - weights / own), std, _ungrouped(slope), scale)


def interval_scaling(
    hyperparameters: StructuredGPHyperparameters,
    presses: Presses,
    readings: Float[Array, "n c"],
    chip_positions: Float[Array, "chips 2"] | None = None,
) -> Float[Array, " c"]:
    """Factors on the standard deviations of `predict`, so that nine in ten readings lie within 1.645 of them.

    Each tenth of the presses is predicted from the others (cross-conformal prediction; Vovk, Annals of Mathematics and
    Artificial Intelligence 74, 2015). Because a few presses say little, each channel's factor is drawn to that of all
    channels by 20 presses' worth, and that one to DEFAULT_INTERVAL_SCALING by 5.

    Args:
        hyperparameters: Of the GP.
        presses: Positions (m) and loads (m or N), in random order.
        readings: Their readings (uT).
        chip_positions: Positions of the chips (m), as in `fit`.

    Returns:
        A factor for each channel.
    """
    n = len(readings)
    folds = min(CONFORMAL_FOLDS if n <= MANY_PRESSES else CONFORMAL_FOLDS_OF_MANY, n)
    if folds < 2:
        return jnp.ones(readings.shape[1])

    def ratio(fold: Array) -> Float[Array, "m c"]:
        # Folds of one size, strided through the presses; a remainder is always known.
        tested = fold + folds * jnp.arange(n // folds)
        rest = jnp.argsort(jnp.zeros(n).at[tested].set(1.0), stable=True)[: n - n // folds]
        known = Presses(presses.position[rest], presses.load[rest])
        gp = fit(hyperparameters, known, readings[rest], chip_positions)
        mean, std = predict(gp, Presses(presses.position[tested], presses.load[tested]))
        return jnp.abs(readings[tested] - mean) / std / STDS_WITHIN_90_PERCENT

    ratios = jax.lax.map(ratio, jnp.arange(folds)).reshape(-1, readings.shape[1])
    prior, shared = DEFAULT_SCALING_PRESSES, SHARED_SCALING_PRESSES
    together = (n * jnp.quantile(ratios, 0.9) + prior * DEFAULT_INTERVAL_SCALING) / (n + prior)
    return (n * jnp.quantile(ratios, 0.9, axis=0) + shared * together) / (n + shared)


def _squared_distance(a: Float[Array, "a 2"], b: Float[Array, "b 2"]) -> Float[Array, "a b"]:
    return jnp.sum((a[:, None, :] - b[None, :, :]) ** 2, axis=-1)


def _height_covariance(h: StructuredGPHyperparameters, a: Presses, b: Presses) -> Float[Array, "a b"]:
    """Covariance of heights, in unit loads squared."""
    near = jnp.exp(-_squared_distance(a.position, b.position) / (2 * h.height_length**2))
    period, known = jnp.where(h.lattice_period > 0, h.lattice_period, 1.0), h.lattice_period > 0
    # MacKay's periodic kernel, which near zero is the same as the other.
    phase = jnp.sin(jnp.pi / period * (a.position[:, None, :] - b.position[None, :, :])) * (period / jnp.pi)
    repeated = jnp.exp(-jnp.sum(phase**2, axis=-1) / (2 * h.height_length**2))
    share = jnp.where(known, h.periodic_share, 0.0)
    changing = h.height_load_width > 0
    load_distance = jnp.abs(a.load[:, None] - b.load[None, :]) / jnp.where(changing, h.height_load_width, 1.0)
    correlation = ((1 - share) * near + share * repeated) * jnp.where(changing, jnp.exp(-load_distance), 1.0)
    return (jnp.asarray(h.height_std) / h.unit_load) ** 2 * correlation


def _predicted_heights(gp: StructuredGP, presses: Presses) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Mean (unit loads) and variance of the heights at other presses."""
    h = gp.hyperparameters
    near = _height_covariance(h, presses, gp.presses)
    height = jnp.matmul(near, gp.height_weights, precision="highest")
    explained = jax.scipy.linalg.solve_triangular(gp.height_cholesky, near.T, lower=True)
    variance = (jnp.asarray(h.height_std) / h.unit_load) ** 2 - jnp.sum(explained**2, axis=0)
    return height, jnp.maximum(variance, 0)


def _variance(h: StructuredGPHyperparameters, presses: Presses) -> Float[Array, " n"]:
    """Diagonal of the covariance."""
    return (
        load_response(h, presses.load) ** 2 * (h.map_variance + h.bend_variance)
        + h.static_variance
        + h.constant_variance
    )


def _system(
    h: StructuredGPHyperparameters, presses: Presses, chip_positions: Float[Array, "chips 2"] | None
) -> Float[Array, "groups n n"]:
    """Covariance of the readings, noise included."""
    e = amplitude(h, presses.position, chip_positions)
    signal = e[:, :, None] * e[:, None, :] * covariance(h, presses, presses)[None]
    return signal + (h.noise_variance + JITTER) * jnp.eye(len(presses.load))[None]


def _measured_heights(
    found: LeaveOneOut, readings: Float[Array, "n c"]
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Height at each press (unit loads) by weighted least squares over its channels, and its variance."""
    precision = 1 / found.std**2
    total = jnp.maximum(jnp.sum(found.slope**2 * precision, axis=1), 1e-6)
    height = jnp.sum(found.slope * (readings - found.mean) * precision, axis=1) / total
    return height, 1 / total + HEIGHT_ERROR_UNIT_LOADS**2


def _channel_scale(target: Float[Array, "n c"], weights: Float[Array, "n c"]) -> Float[Array, " c"]:
    """Scale of each channel: its most likely value, drawn to that of all channels."""
    square, prior = jnp.sum(target * weights, axis=0), SHARED_SCALE_PRESSES
    return jnp.sqrt(jnp.maximum((square + prior * jnp.mean(square) / len(target)) / (len(target) + prior), 1e-6))


def _solve(cholesky: Float[Array, "n n"], values: Float[Array, "n m"]) -> Float[Array, "n m"]:
    return jax.scipy.linalg.cho_solve((cholesky, True), values)


def _grouped(values: Float[Array, "n c"], groups: int) -> Float[Array, "groups n each"]:
    """Channels that share a system, those of one chip or all, next to each other."""
    return jnp.swapaxes(values.reshape(len(values), groups, -1), 0, 1)


def _ungrouped(values: Float[Array, "groups n each"]) -> Float[Array, "n c"]:
    """The inverse of `_grouped`."""
    return jnp.swapaxes(values, 0, 1).reshape(values.shape[1], -1)
