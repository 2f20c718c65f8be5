"""Posterior of the position and depth of a press by a skin's calibration tip, from one reading.

This is `i2t.reconstruction.local_shape` for a skin of which nothing is known but presses of one tip, as of most real
ones. The shapes of the library are that tip at many places and depths, and the forward model is the skin's own
calibration (`i2t.calibrate`), which says of each candidate what it would read and how far that may be wrong. With z the
differences of a reading y from candidate i in standard deviations s,

    log w_i = T [ -sum log s - (k + c)/2 log(1 + z'z / k) ],

Student's t with k degrees of freedom, tempered by T, because what a calibration errs is alike in all channels; a share
of the prior stays mixed in. What a head of the skin, which learned positions from readings, says of the position can be
pooled with them.

Metres, newtons, microtesla; positions are of the tip in the tool frame.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from i2t.calibration import Calibration
from i2t.reconstruction.local_shape import PatchLikelihood

CANDIDATES_AT_ONCE = 4096  # that a calibration predicts: its memory grows with them


class TipModel(NamedTuple):
    """Readings of a calibrated skin for its tip at every candidate: places, each at every load."""

    places: Float[Array, "p 2"]  # m
    loads: Float[Array, " l"]  # m or N, as those of the calibration
    mean: Float[Array, "p l c"]  # uT
    std: Float[Array, "p l c"]  # uT, noise included
    likelihood: PatchLikelihood = PatchLikelihood(dof=8.0, temperature=0.2)


class TipPosterior(NamedTuple):
    """Posterior of a tip's position and load."""

    weight: Float[Array, "p l"]  # of each place and load; sums to 1
    position: Float[Array, "2"]  # m, mean
    load: Float[Array, ""]  # m or N, mean
    bits: Float[Array, ""]  # by which the weights differ from those before the touch (Kullback-Leibler)


def imagine_tip(
    calibration: Calibration,
    positions: Float[np.ndarray, "n 2"],
    loads: Float[np.ndarray, " n"],
    *,
    spacing: float = 0.6e-3,
    load_levels: int = 10,
) -> TipModel:
    """Predict the reading of every candidate.

    Args:
        calibration: Of one skin, by positions and one kind of load.
        positions: Of the presses that it was made of (m); candidates fill their box, and a little more.
        loads: Of these presses (m or N).
        spacing: Of the places (m).
        load_levels: Candidates at each place, at even quantiles of the loads.

    Returns:
        Places, loads and what the skin would read there.

    Raises:
        ValueError: The calibration knows no position, or not one load.
    """
    if calibration.load_kind not in ("depth", "force"):
        raise ValueError(f"the calibration's loads are {calibration.load_kind}; it takes positions with depth or force")
    low, high = np.min(positions, axis=0) - spacing / 2, np.max(positions, axis=0) + spacing / 2
    along = [np.linspace(low[i], high[i], int(np.ceil((high[i] - low[i]) / spacing)) + 1) for i in range(2)]
    places = np.stack(np.meshgrid(*along, indexing="ij"), axis=-1).reshape(-1, 2)
    levels = np.quantile(loads, (np.arange(load_levels) + 0.5) / load_levels)
    every = np.repeat(places, load_levels, axis=0), np.tile(levels, len(places))
    parts = [
        calibration.predict(every[0][at : at + CANDIDATES_AT_ONCE], every[1][at : at + CANDIDATES_AT_ONCE])
        for at in range(0, len(every[1]), CANDIDATES_AT_ONCE)
    ]
    mean, std = (jnp.float32(np.concatenate(column)) for column in zip(*parts, strict=True))
    shape = len(places), load_levels, -1
    return TipModel(jnp.float32(places), jnp.float32(levels), mean.reshape(shape), std.reshape(shape))


def infer_tip(
    reading: Float[Array | np.ndarray, " c"],
    model: TipModel,
    *,
    head: tuple[Float[Array, "2"], Float[Array, "2"]] | None = None,
    head_weight: Float[Array, ""] | float = 0.25,
) -> TipPosterior:
    """Locate one press from its reading. Compile it at the edge: `jax.jit(jax.vmap(...))` for many.

    Args:
        reading: uT.
        model: What the skin reads at every candidate.
        head: What a head of the skin says of the position (`i2t.calibration.heads`): mean and standard deviation (m).
        head_weight: By which its logarithm counts next to the tempered likelihood. It comes from the same reading, so
            the two are pooled and not multiplied (logarithmic opinion pool; Genest and Zidek, Statistical Science 1,
            1986).

    Returns:
        The posterior; all candidates are as likely before.
    """
    likelihood = model.likelihood
    z = (jnp.asarray(reading)[None, None] - model.mean) / model.std
    spread = jnp.sum(jnp.log(model.std), axis=-1)
    explained = -spread - 0.5 * (likelihood.dof + z.shape[-1]) * jnp.log1p(jnp.sum(z * z, axis=-1) / likelihood.dof)
    logarithm = likelihood.temperature * explained
    if head is not None:
        mean, std = head
        logarithm -= 0.5 * head_weight * jnp.sum(((model.places - mean[None]) / std[None]) ** 2, axis=-1)[:, None]
    posterior = jax.nn.softmax(logarithm.ravel()).reshape(logarithm.shape)
    weight = (1 - likelihood.prior_share) * posterior + likelihood.prior_share / posterior.size
    bits = jnp.sum(jax.scipy.special.xlogy(weight, weight * weight.size)) / jnp.log(2.0)
    # The prior's share stands for touches that are not understood; the means are of those that are.
    return TipPosterior(
        weight, jnp.sum(posterior, axis=1) @ model.places, jnp.sum(posterior, axis=0) @ model.loads, bits
    )


def credible_level(
    posterior: TipPosterior, model: TipModel, position: Float[Array | np.ndarray, "2"]
) -> Float[Array, ""]:
    """Share of the posterior at places more probable than that of a position: at most 0.9 if the position is in the
    smallest region that holds 90 %.

    Args:
        posterior: Of one press.
        model: With the places.
        position: m.

    Returns:
        A share; half of the position's own place counts as more probable.
    """
    weight = jnp.sum(posterior.weight, axis=1)
    own = weight[jnp.argmin(jnp.sum((model.places - jnp.asarray(position)[None]) ** 2, axis=-1))]
    return jnp.sum(jnp.where(weight > own, weight, 0)) + own / 2
