"""What a touch would be like on a possible object: where the skin would meet it, how far it would sink, what it reads.

An object that may lie anywhere near where it is believed is met by the flat skin at some travel along the approach
(`i2t.simulation.sites.press_along`); there its heights over the skin are pressed with a few loads into a layer of
nominal stiffness (`i2t.skin.contact`), and a process that has learnt one pad's touches turns pressures into readings.
For one load F the process of `i2t.prediction.gp` is linear in the pressure p,

    mean = p . M_F,    variance = p' V_F p   (in units of each channel's signal),

so M_F and the root of V_F are worked out once (`skin_map`), and a reading costs a product. Between loads, readings per
newton are interpolated in the logarithm of the load.

`meet` is geometry and mechanics, `read` one pad. Neither depends on what is measured, so outcomes can be tabulated for
sites, objects and places once and used for any number of touches. The travel comes with its slope along the six
coordinates of the object's placement, so that places between those imagined are told apart too
(`i2t.recognition.belief`).

Pure functions on one example; metres, newtons, microtesla; frames as in `i2t.types`.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from i2t.geometry import full_precision, invert
from i2t.prediction import gp
from i2t.prediction.gp import GP
from i2t.prediction.pressure import TOLERANCE, Imagination
from i2t.registration.patch import motion
from i2t.rendering.render import render_heights
from i2t.simulation import sites
from i2t.skin.contact import Grid, solve_force
from i2t.skin.pad import nominal_pad
from i2t.types import TWIST_LEVER_M, PAD_WINDOW, STANDOFF, Pad, Surface

CELLS = Grid(cells=20, modes=32, window=PAD_WINDOW)  # 1 mm, as the process sees pressures
LOADS = (0.3, 0.9, 2.7)  # N; most presses to 25 uT end between the outer ones
SMALLEST = Imagination.floor  # N, least load, where a noisy wrench sensor says less
ROUNDING = 1e-5  # of the largest eigenvalue of a variance: below it, nothing is left but rounding


class SkinMap(NamedTuple):
    """A pad as its process sees it at a few loads."""

    loads: Float[Array, " l"]  # N
    mean: Float[Array, "l cells channels"]  # uT per N on each cell of 1 mm
    root: Float[Array, "l cells rank"]  # of the variance, relative to the square of a channel's signal
    scale: Float[Array, " channels"]  # uT, root mean square of each channel's signal
    softness: Float[Array, ""]  # depth of a press over that on the nominal layer


class Met(NamedTuple):
    """How the skin would meet an object; the same for every pad."""

    hit: Bool[Array, ""]  # whether the skin meets anything within its travel
    travel: Float[Array, ""]  # m from the site to first contact, along the approach; its longest where nothing is met
    slope: Float[
        Array, "6"
    ]  # of the travel along the twist of the object's placement (`i2t.registration.patch.motion`)
    sunk: Float[Array, " l"]  # m past first contact at each load, on the nominal layer
    newtons: Float[Array, "l cells"]  # on each cell of 1 mm


class Outcome(NamedTuple):
    """A touch that was only imagined; loads (l) are those of the `SkinMap`."""

    hit: Bool[Array, ""]
    travel: Float[Array, ""]  # m, as in `Met`
    slope: Float[Array, "6"]
    sunk: Float[Array, " l"]  # m past first contact
    reading: Float[Array, "l 15"]  # uT
    variance: Float[Array, " l"]  # of the reading, relative to the square of a channel's signal


def skin_map(process: GP, softness: float = 1.0, loads: tuple[float, ...] = LOADS) -> SkinMap:
    """The maps of a fitted process; for the host, in double precision, as a variance is a small difference."""
    weights = np.asarray(process.hyper.weights / process.unit, np.float64)
    root = gp.roots(process.touches.pressure.shape[-1]).astype(np.float64)
    axis = np.einsum("lij,ljk->lik", root, root)  # C_l of one axis
    told = np.asarray(process.touches.pressure, np.float64)
    seen = np.einsum("lij,njk,lmk->lnim", axis, told, axis).reshape(len(axis), len(told), -1)
    cells = seen.shape[-1]
    prior = sum(w * np.kron(a, a) for w, a in zip(weights, axis, strict=True))
    cholesky, solved = np.asarray(process.cholesky, np.float64), np.asarray(process.weights, np.float64)
    means, roots = [], []
    for at in np.asarray(gp.bending(process.hyper, jnp.float32(loads), process.touches.load), np.float64):
        cross = np.einsum("l,lnx->nx", weights, seen) * at[:, None]
        means.append(cross.T @ solved * np.asarray(process.scale))
        half = np.linalg.solve(cholesky, cross)
        values, vectors = np.linalg.eigh(prior - half.T @ half)
        kept = np.maximum(values, 0) * (values > ROUNDING * values[-1])
        roots.append(vectors * np.sqrt(kept))
    rank = max(int((np.abs(r).max(0) > 0).sum()) for r in roots)
    return SkinMap(
        jnp.float32(loads), jnp.float32(np.stack(means)), jnp.float32(np.stack([r[:, cells - rank :] for r in roots])),
        process.scale, jnp.float32(softness),
    )  # fmt: skip


def meet(
    surface: Surface,
    T_w_o: Float[Array, "4 4"],
    twist: Float[Array, "6"],
    T_w_site: Float[Array, "4 4"],
    loads: Float[Array, " l"],
    past: float,
    prepare: float = STANDOFF,
) -> Met:
    """A touch at a site if the object lay a `twist` off `T_w_o`, approached from `prepare` (m) before the site up to
    `past` (m) beyond it, and pressed with each of `loads` (N).
    """
    (travel, (T_o_t, hit)), slope = jax.value_and_grad(_travel, argnums=2, has_aux=True)(
        surface, T_w_o, twist, T_w_site, past, prepare
    )
    sunk, newtons = pressures(surface, jax.lax.stop_gradient(T_o_t), loads)
    hit = hit & jnp.isfinite(sunk[0])
    smooth = hit & jnp.all(jnp.isfinite(slope))
    return Met(hit, travel, jnp.where(smooth, slope, 0.0), jnp.where(hit, sunk, 0.0), jnp.where(hit, newtons, 0.0))


def read(met: Met, skin: SkinMap) -> Outcome:
    """What a pad reads of it."""
    reading = jnp.einsum("lx,lxc->lc", met.newtons, skin.mean, precision="highest")
    variance = jnp.sum(jnp.einsum("lx,lxr->lr", met.newtons, skin.root, precision="highest") ** 2, axis=-1)
    return Outcome(met.hit, met.travel, met.slope, skin.softness * met.sunk, reading, variance)


@full_precision
def _travel(
    surface: Surface, T_w_o: Array, twist: Array, T_w_site: Array, past: float, prepare: float
) -> tuple[Array, tuple[Array, Array]]:
    T_o_w = invert(T_w_o @ motion(twist))
    start = T_o_w @ T_w_site @ jnp.eye(4).at[2, 3].set(-prepare)
    T_o_t, hit = sites.press_along(surface, start, start[:3, 2], travel=prepare + past)
    return jnp.dot(T_o_t[:3, 3] - start[:3, 3], start[:3, 2]) - prepare, (T_o_t, hit)


def pressures(
    surface: Surface, T_o_t: Float[Array, "4 4"], loads: Float[Array, " l"], pad: Pad | None = None
) -> tuple[Float[Array, " l"], Float[Array, "l cells"]]:
    """The skin at first contact T_o_t pressed with each load: how far it sinks (m, nominal layer) and the newtons on
    each cell. Infinite and zero where nothing lies before the skin.
    """
    pad = nominal_pad() if pad is None else pad
    heights = render_heights(surface, invert(T_o_t), PAD_WINDOW, CELLS.cells)
    nearest = jnp.min(heights)
    met = jnp.isfinite(nearest)
    behind = jnp.where(met, heights - jnp.where(met, nearest, 0.0), 0.0)

    def press(load: Float[Array, ""]) -> tuple[Array, Array]:
        load = jnp.maximum(load, SMALLEST)
        contact = solve_force(pad, behind, load, CELLS, tolerance=TOLERANCE, max_steps=Imagination.iterations)
        newtons = contact.pressure.reshape(-1) * CELLS.spacing**2
        return contact.indentation, newtons * load / jnp.maximum(jnp.sum(newtons), 1e-9)

    sunk, newtons = jax.vmap(press)(loads)
    return jnp.where(met, nearest + sunk, jnp.inf), jnp.where(met, newtons, 0.0)


def at_load(
    outcome: Outcome, loads: Float[Array, " l"], force: Float[Array, ""]
) -> tuple[Float[Array, ""], Float[Array, "15"], Float[Array, ""]]:
    """How far the skin sinks (m), the reading (uT) and its variance at a load (N) between those imagined, or beyond."""
    at = jnp.log(jnp.maximum(force, SMALLEST))
    knots = jnp.log(loads)
    i = jnp.clip(jnp.searchsorted(knots, at) - 1, 0, len(loads) - 2)
    part = jnp.clip((at - knots[i]) / (knots[i + 1] - knots[i]), -1.0, 2.0)
    between = partial(_between, i, part)
    newtons = jnp.exp(at)
    # A contact sinks as a power of its load; a reading grows about in proportion to it.
    sunk = jnp.exp(between(jnp.log(jnp.maximum(outcome.sunk, 1e-7))))
    variance = jnp.exp(between(jnp.log(jnp.maximum(outcome.variance / loads**2, 1e-12)))) * newtons**2
    reading = between(outcome.reading / loads[:, None]) * newtons
    return jnp.where(outcome.hit, sunk, 0.0), reading, jnp.where(outcome.hit, variance, 0.0)


def _between(i: Array, part: Array, values: Array) -> Array:
    low, high = (
        jax.lax.dynamic_index_in_dim(values, i, keepdims=False),
        jax.lax.dynamic_index_in_dim(values, i + 1, keepdims=False),
    )
    return low + part * (high - low)


def prior_spread(distance: float, angle: float) -> Float[np.ndarray, "6"]:
    """Standard deviations (m) of the twist of a placement unsure by `distance` (m) and `angle` (rad) on each axis."""
    return np.repeat([distance, TWIST_LEVER_M * angle], 3).astype(np.float32)
