"""Calibration of one skin: from a few presses with one tip, what all other presses will read, with uncertainty.

A reading of channel c at place x (m, tool frame) and load d (depth in m or force in N, one of them throughout) is

  y_c = e_c(x) [f(d) g_c(x) + f(d) b_c(x, d) + g0_c(x) + const_c] + noise,
  f(d) = ((d + offset) / (unit + offset))^power,

a structured Gaussian process of mean zero: one map g_c, stretched by the load, a little bend b_c of its shape with the
load, and for presses controlled by force a part g0_c that does not depend on it. The amplitude e_c falls with the
distance of x from the chip of channel c where chips are given. Channels share the covariance and differ in scale.

The surface is not flat: d is replaced by d + h(x), with one height h per place for all channels. Each press tells its
height by the residuals of all channels along their slopes, taken from leave-one-out means (Rasmussen and Williams,
"Gaussian Processes for Machine Learning", equations 5.10 to 5.12), so that no press explains itself; a second process
of short length smooths the heights, and the fit is repeated with them.

With few presses the hyperparameters cannot be fitted and are fixed: `DEPTH` and `FORCE`. `choose` may scale them by
cross-validation on the presses, never by evidence, which misleads where the prior is wrong in detail.
"""

from collections.abc import Mapping, Sequence
from itertools import product
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

JITTER = 1e-5  # of the signal's variance: float32 factors of 1000 presses stay real
ROUNDS = 3  # fits, each with the heights that the one before found; more change nothing
HEIGHT_ERROR = 5e-3  # of the unit load: what a press tells of its height is never better than this
WITHIN = 1.645  # standard deviations of a normal error that hold nine in ten
FOLDS = 10  # up to MANY presses, and three beyond
MANY = 300
USUAL = 1.2  # widening on the development presses of the recording that DEPTH was found on
FEW = 2.0  # presses' worth of belief that all channels have one scale


class Presses(NamedTuple):
    """Where and how hard a skin was pressed."""

    place: Float[Array, "n 2"]  # m, tool frame
    load: Float[Array, " n"]  # m of depth, or N of force


class Hyper(NamedTuple):
    """Hyperparameters; the load's unit is that of the presses, variances are relative to a channel's at the unit load.

    Python numbers or scalars of JAX.
    """

    unit: float | Float[Array, "..."]  # load at which f is 1
    offset: float | Float[Array, "..."]  # load below zero at which f vanishes
    power: float | Float[Array, "..."]
    length: float | Float[Array, "..."]  # m, of the maps g and g0
    steady: float | Float[Array, "..."]  # variance of g
    bend: float | Float[Array, "..."]  # variance of b
    bend_length: float | Float[Array, "..."]  # m
    bend_width: float | Float[Array, "..."]  # load
    standing: float | Float[Array, "..."]  # variance of g0
    constant: float | Float[Array, "..."]  # variance of const
    noise: float | Float[Array, "..."]  # variance of noise and of what the model leaves out
    height: float | Float[Array, "..."]  # standard deviation of h, load
    height_length: float | Float[Array, "..."]  # m
    reach: float | Float[Array, "..."]  # m, over which e falls
    floor: float | Float[Array, "..."]  # e far from the chip
    period: float | Float[Array, "..."] = 0.0  # m, of a lattice along x and y whose heights repeat; 0: none is known
    height_width: float | Float[Array, "..."] = 0.0  # load over which heights change; 0: they do not
    repeating: float | Float[Array, "..."] = 0.5  # share of the heights' variance that repeats, where there is a period


# Found on the development presses of one eFlesh session (docs/calibration.md): the long length is in the order of the
# height of the magnets over the chips and of their spacing, the short one that of a lattice's struts.
DEPTH = Hyper(
    unit=2e-3, offset=2.7e-3, power=1.8, length=16.5e-3, steady=1.0, bend=0.0145, bend_length=2e-3, bend_width=7e-3,
    standing=0.03, constant=2e-3, noise=4.5e-3, height=0.17e-3, height_length=1.8e-3, reach=10e-3, floor=0.2,
    height_width=8e-3,
)  # fmt: skip
# Found on 24 simulated boards pressed with a spherical tip of 4 mm to 0.2 to 1 N (`experiments.calibrate_pads
# --population`): a map of two lengths, that of the layer's thickness and twice as much, hardly bent by the load. What
# does not depend on the force is kept from a guess: simulated boards have none, real ones may.
FORCE = Hyper(
    unit=1.0, offset=0.24, power=1.4, length=2.1e-3, steady=1.0, bend=5.2, bend_length=5e-3, bend_width=7.8,
    standing=0.3, constant=0.1, noise=1.7e-2, height=0.0, height_length=2e-3, reach=5.8e-3, floor=0.013,
)  # fmt: skip


class Process(NamedTuple):
    """A fitted skin."""

    hyper: Hyper
    presses: Presses
    raised: Presses  # their loads with the heights found
    chips: Float[Array, "chips 2"] | None
    cholesky: Float[Array, "groups n n"]
    weights: Float[Array, "n channels"]
    scale: Float[Array, " channels"]  # uT
    height_cholesky: Float[Array, "n n"]
    height_weights: Float[Array, " n"]
    earlier: "Process | None"


class LeftOut(NamedTuple):
    """What all other presses say of each."""

    mean: Float[Array, "n channels"]  # uT
    std: Float[Array, "n channels"]  # uT, noise included
    slope: Float[Array, "n channels"]  # uT per unit load (hyper.unit)
    scale: Float[Array, " channels"]  # uT


def growth(hyper: Hyper, load: Float[Array, " n"]) -> Float[Array, " n"]:
    """How a signal grows with the load, f."""
    whole = hyper.unit + hyper.offset
    return jnp.maximum((load + hyper.offset) / whole, 1e-3) ** hyper.power


def covariance(hyper: Hyper, a: Presses, b: Presses) -> Float[Array, "a b"]:
    """Covariance of two readings of one channel, relative to its scale, before the amplitudes e."""
    square = _square(a.place, b.place)
    apart = a.load[:, None] - b.load[None, :]
    smooth = jnp.exp(-square / (2 * hyper.length**2))
    bent = jnp.exp(-square / (2 * hyper.bend_length**2) - apart**2 / (2 * hyper.bend_width**2))
    grown = growth(hyper, a.load)[:, None] * growth(hyper, b.load)[None, :]
    return grown * (hyper.steady * smooth + hyper.bend * bent) + hyper.standing * smooth + hyper.constant


def amplitude(
    hyper: Hyper, place: Float[Array, "n 2"], chips: Float[Array, "chips 2"] | None
) -> Float[Array, "groups n"]:
    """Amplitude e of each chip's channels at each place; one group of all channels without chips."""
    if chips is None:
        return jnp.ones((1, len(place)))
    near = jnp.exp(-_square(chips, place) / (2 * hyper.reach**2))
    return hyper.floor + (1 - hyper.floor) * near


def fit(
    hyper: Hyper,
    presses: Presses,
    readings: Float[Array, "n channels"],
    chips: Float[Array, "chips 2"] | None = None,
    earlier: Process | None = None,
) -> Process:
    """Condition on n presses and their readings (uT); `chips` are their places (m) for an amplitude that falls.

    With an `earlier` process its predictions are the mean and the residuals are what is learnt; heights were learnt by
    the earlier one, so give hyperparameters with `height` zero.
    """
    target = readings if earlier is None else readings - predict(earlier, presses)[0]
    raised = presses
    spread = (jnp.asarray(hyper.height) / hyper.unit) ** 2 * _near(presses, presses, hyper)
    for _ in range(ROUNDS):
        known = (raised.load - presses.load) / hyper.unit
        seen, variance = _heights(left_out(hyper, raised, target, chips), target)
        height_cholesky = jnp.linalg.cholesky(spread + jnp.diag(variance))
        height_weights = jax.scipy.linalg.cho_solve((height_cholesky, True), known + seen)
        height = jnp.matmul(spread, height_weights, precision="highest")
        raised = Presses(presses.place, presses.load + hyper.unit * height)
    system = _system(hyper, raised, chips)
    # Group by group: batched factors that run side by side may wait for ever for the threads that each other holds.
    cholesky = jax.lax.map(jnp.linalg.cholesky, system)
    weights = jax.lax.map(lambda both: _solve(*both), (cholesky, _grouped(target, len(system))))
    return Process(
        hyper, presses, raised, chips, cholesky, _flat(weights), _scale(target, _flat(weights)),
        height_cholesky, height_weights, earlier,
    )  # fmt: skip


def predict(process: Process, presses: Presses) -> tuple[Float[Array, "n channels"], Float[Array, "n channels"]]:
    """Mean and standard deviation (uT) of the readings of n presses, noise and uncertain heights included."""
    hyper, known = process.hyper, process.presses
    near = (jnp.asarray(hyper.height) / hyper.unit) ** 2 * _near(presses, known, hyper)
    height = jnp.matmul(near, process.height_weights, precision="highest")
    told = jax.scipy.linalg.solve_triangular(process.height_cholesky, near.T, lower=True)
    unsure = jnp.maximum((jnp.asarray(hyper.height) / hyper.unit) ** 2 - jnp.sum(told**2, axis=0), 0)
    raised = Presses(presses.place, presses.load + hyper.unit * height)
    e, e_known = (amplitude(hyper, p.place, process.chips) for p in (presses, known))
    known = process.raised
    weights = _grouped(process.weights, len(e))

    def cross(load: Float[Array, " n"]) -> Float[Array, "groups n m"]:
        return e[:, :, None] * e_known[:, None, :] * covariance(hyper, Presses(presses.place, load), known)[None]

    k, change = jax.jvp(cross, (raised.load,), (jnp.full_like(raised.load, hyper.unit),))
    mean, slope = (_flat(jnp.matmul(part, weights, precision="highest")) for part in (k, change))
    own = e**2 * _own(hyper, raised)[None]
    explained = jax.lax.map(
        lambda both: jax.scipy.linalg.solve_triangular(both[0], both[1].T, lower=True), (process.cholesky, k)
    )
    variance = jnp.maximum(own - jnp.sum(explained**2, axis=1), 0) + hyper.noise
    variance = jnp.repeat(variance, len(process.scale) // len(e), axis=0).T * process.scale[None] ** 2
    if process.earlier is not None:
        mean = mean + predict(process.earlier, presses)[0]
    return mean, jnp.sqrt(variance + slope**2 * unsure[:, None])


def left_out(
    hyper: Hyper, presses: Presses, readings: Float[Array, "n channels"], chips: Float[Array, "chips 2"] | None = None
) -> LeftOut:
    """Each press as all others predict it, in closed form."""
    system = _system(hyper, presses, chips)
    inverse = jax.lax.map(lambda K: _solve(jnp.linalg.cholesky(K), jnp.eye(len(K))), system)
    y = _grouped(readings, len(system))
    weights = jnp.matmul(inverse, y, precision="highest")
    own = jnp.diagonal(inverse, axis1=1, axis2=2)[..., None]
    e = amplitude(hyper, presses.place, chips)

    def rows(load: Float[Array, " n"]) -> Float[Array, "n n"]:
        return covariance(hyper, Presses(presses.place, load), presses)

    change = jax.jvp(rows, (presses.load,), (jnp.full_like(presses.load, hyper.unit),))[1]
    change = e[:, :, None] * e[:, None, :] * change[None]
    # Weights without press i are w - A_i w_i / A_ii, A the inverse: zero at i itself.
    mine = jnp.einsum("gij,gji->gi", change, inverse, precision="highest")[..., None]
    slope = jnp.matmul(change, weights, precision="highest") - mine * weights / own
    scale = _scale(readings, _flat(weights))
    std = _flat(jnp.broadcast_to(jnp.sqrt(1 / own), y.shape)) * scale[None]
    return LeftOut(_flat(y - weights / own), std, _flat(slope), scale)


def errors(
    hyper: Hyper, presses: Presses, readings: Float[Array, "n channels"], chips: Float[Array, "chips 2"] | None = None
) -> Float[Array, " n"]:
    """Squared error of each press as all others predict it, heights from all others included.

    In units of the readings' variance: one minus the mean is R2.
    """
    found = left_out(hyper, presses, readings, chips)
    seen, variance = _heights(found, readings)
    spread = (jnp.asarray(hyper.height) / hyper.unit) ** 2 * _near(presses, presses, hyper)
    inverse = _solve(jnp.linalg.cholesky(spread + jnp.diag(variance)), jnp.eye(len(seen)))
    height = seen - jnp.matmul(inverse, seen, precision="highest") / jnp.diagonal(inverse)
    error = readings - found.mean - found.slope * height[:, None]
    total = jnp.sum((readings - jnp.mean(readings, axis=0, keepdims=True)) ** 2) / len(readings)
    return jnp.sum(error**2, axis=1) / total


def widening(
    hyper: Hyper, presses: Presses, readings: Float[Array, "n channels"], chips: Float[Array, "chips 2"] | None = None
) -> Float[Array, " channels"]:
    """Factors on the standard deviations of `predict`, by which nine in ten readings lie within 1.645 of them when a
    tenth of the presses is predicted by the others, each tenth in turn (cross-conformal prediction; Vovk, Annals of
    Mathematics and Artificial Intelligence 74, 2015).

    A few presses say little: each channel is drawn to all by 20 presses' worth, and all to USUAL by 5.
    """
    n = len(readings)
    folds = min(FOLDS if n <= MANY else 3, n)
    if folds < 2:
        return jnp.ones(readings.shape[1])

    def ratio(fold: Array) -> Float[Array, "m channels"]:
        # Folds of one size, strided through the presses; a remainder is always known.
        tested = fold + folds * jnp.arange(n // folds)
        rest = jnp.argsort(jnp.zeros(n).at[tested].set(1.0), stable=True)[: n - n // folds]
        told = fit(hyper, Presses(presses.place[rest], presses.load[rest]), readings[rest], chips)
        mean, std = predict(told, Presses(presses.place[tested], presses.load[tested]))
        return jnp.abs(readings[tested] - mean) / std / WITHIN

    ratios = jax.lax.map(ratio, jnp.arange(folds)).reshape(-1, readings.shape[1])
    together = (n * jnp.quantile(ratios, 0.9) + 5 * USUAL) / (n + 5)
    return (n * jnp.quantile(ratios, 0.9, axis=0) + 20 * together) / (n + 20)


def options(hyper: Hyper, factors: Mapping[str, Sequence[float]]) -> Hyper:
    """All products of the given factors on the named hyperparameters, stacked; `hyper` itself comes first."""
    scaled = [
        hyper._replace(**{name: value * factor for (name, value), factor in zip(kept.items(), chosen, strict=True)})
        for kept in [{name: getattr(hyper, name) for name in factors}]
        for chosen in product(*factors.values())
    ]
    return Hyper(*(jnp.asarray(values, jnp.float32) for values in zip(hyper, *scaled, strict=True)))


def choose(
    stacked: Hyper,
    presses: Presses,
    readings: Float[Array, "n channels"],
    chips: Float[Array, "chips 2"] | None = None,
) -> Hyper:
    """The option with the least leave-one-out error, or the first where none is better by one standard error.

    The standard error is that of the paired difference over presses (Breiman et al. 1984, section 3.4.3): few presses
    do not move the defaults by chance.
    """
    all_errors = jax.lax.map(lambda hyper: errors(hyper, presses, readings, chips), stacked)
    difference = all_errors - all_errors[:1]
    mean = jnp.mean(difference, axis=1)
    sure = mean + jnp.std(difference, axis=1) / jnp.sqrt(len(readings) - 1.0 + 1e-6) < 0
    best = jnp.argmin(jnp.where(sure & jnp.isfinite(mean), mean, 0.0).at[0].set(0.0))
    return jax.tree.map(lambda values: values[best], stacked)


def _square(a: Float[Array, "a 2"], b: Float[Array, "b 2"]) -> Float[Array, "a b"]:
    return jnp.sum((a[:, None, :] - b[None, :, :]) ** 2, axis=-1)


def _near(a: Presses, b: Presses, hyper: Hyper) -> Float[Array, "a b"]:
    """Correlation of heights."""
    near = jnp.exp(-_square(a.place, b.place) / (2 * hyper.height_length**2))
    period, known = jnp.where(hyper.period > 0, hyper.period, 1.0), hyper.period > 0
    # MacKay's periodic kernel, which near zero is the same as the other.
    phase = jnp.sin(jnp.pi / period * (a.place[:, None, :] - b.place[None, :, :])) * (period / jnp.pi)
    repeated = jnp.exp(-jnp.sum(phase**2, axis=-1) / (2 * hyper.height_length**2))
    share = jnp.where(known, hyper.repeating, 0.0)
    changing = hyper.height_width > 0
    apart = jnp.abs(a.load[:, None] - b.load[None, :]) / jnp.where(changing, hyper.height_width, 1.0)
    return ((1 - share) * near + share * repeated) * jnp.where(changing, jnp.exp(-apart), 1.0)


def _own(hyper: Hyper, presses: Presses) -> Float[Array, " n"]:
    """Diagonal of the covariance."""
    return growth(hyper, presses.load) ** 2 * (hyper.steady + hyper.bend) + hyper.standing + hyper.constant


def _system(hyper: Hyper, presses: Presses, chips: Float[Array, "chips 2"] | None) -> Float[Array, "groups n n"]:
    e = amplitude(hyper, presses.place, chips)
    signal = e[:, :, None] * e[:, None, :] * covariance(hyper, presses, presses)[None]
    return signal + (hyper.noise + JITTER) * jnp.eye(len(presses.load))[None]


def _heights(found: LeftOut, readings: Float[Array, "n channels"]) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """What each press tells of its height, in unit loads, and its variance."""
    precise = 1 / found.std**2
    known = jnp.maximum(jnp.sum(found.slope**2 * precise, axis=1), 1e-6)
    return jnp.sum(found.slope * (readings - found.mean) * precise, axis=1) / known, 1 / known + HEIGHT_ERROR**2


def _scale(target: Float[Array, "n channels"], weights: Float[Array, "n channels"]) -> Float[Array, " channels"]:
    """Scale of each channel: its most likely value, drawn to that of all channels by FEW presses."""
    square = jnp.sum(target * weights, axis=0)
    return jnp.sqrt(jnp.maximum((square + FEW * jnp.mean(square) / len(target)) / (len(target) + FEW), 1e-6))


def _solve(cholesky: Float[Array, "n n"], values: Float[Array, "n m"]) -> Float[Array, "n m"]:
    return jax.scipy.linalg.cho_solve((cholesky, True), values)


def _grouped(values: Float[Array, "n channels"], groups: int) -> Float[Array, "groups n each"]:
    """Channels that share a system, those of one chip or all, side by side."""
    return jnp.swapaxes(values.reshape(len(values), groups, -1), 0, 1)


def _flat(values: Float[Array, "groups n each"]) -> Float[Array, "n channels"]:
    """The inverse of `_grouped`."""
    return jnp.swapaxes(values, 0, 1).reshape(values.shape[1], -1)
