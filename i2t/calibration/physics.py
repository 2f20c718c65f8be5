"""A pad from a few presses with a known tip: its magnetisation map, and the few numbers that say what lies under it.

For a known displacement the reading is linear in the magnetisation (`i2t.skin.dipoles`), so that presses give a linear
system for the map, reading = Phi w + noise. The map is a series of cosines on the pad with the covariance of
`i2t.skin.pad.smooth_random`, of which a few hundred weights w are left, normal with variance 1; their posterior is that
of Bayesian linear regression (Bishop, "Pattern Recognition and Machine Learning", section 3.3).

What is left is not linear: thickness, gap from layer to chips, stiffness (presses controlled by force) or the depth of
first touch (by depth), the tip's offset in the plane, and strength and length of the map and the noise. They are found
with the map solved for at every step (variable projection; Golub and Pereyra, SIAM J. Numer. Anal. 10, 1973): what is
climbed is the logarithm of the density that all other presses give to each (Rasmussen and Williams, "Gaussian Processes
for Machine Learning", section 5.4.2) plus that of their priors, which are those of `i2t.skin.pad.sample_pad`. Gradients
are exact: forward through the contact and the design, backwards through the regression. The curvature at the top gives
their spread (Laplace).
"""

from dataclasses import dataclass
from functools import partial
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy import optimize

from i2t.calibration.structured_gp import Presses
from i2t.skin import elasticity as elastic
from i2t.skin.contact import FAR, solve, solve_force
from i2t.skin.dipoles import MICROTESLA, MU0_OVER_4PI, NODES, cell_means, sheets, turn
from i2t.skin.elasticity import GRID, Grid
from i2t.skin.pad import FRICTION, GAP, GIVE, MAP, POISSON, STRENGTH, THICKNESS, YOUNG
from i2t.types import READINGS, Board, Pad

MODES = 12  # cosines along each edge: waves of 3.6 mm, finer than any that 1.5 mm above a chip can be told apart
LIMIT = 48  # presses that the numbers which are not linear are found from; they take no more, and the map takes all
ROUNDS = 3  # linearisations of the design
STEPS = 25  # of the climb in each
REACH = 0.7  # how far each goes, in standard deviations of the prior
MOVES = 7  # coordinates that change the design
COORDINATES = 13
IMPOSSIBLE = 1e9  # what is descended, where it cannot be computed
BATCH = 8  # presses at a time, for the caches
GAIN_SPREAD = 0.05  # of the chips' gains, as in `sample_pad`


@dataclass(frozen=True)
class Tip:
    """What presses: a sphere or the flat end of an upright cylinder."""

    shape: Literal["sphere", "cylinder"]
    radius: float  # m

    def height(self, place: Float[Array, "2"], grid: Grid = GRID) -> Float[Array, "n n"]:
        """Distance (m) of the tip's surface behind its lowest point over each cell, its axis at `place` (m)."""
        y, x = np.meshgrid(grid.centres, grid.centres, indexing="ij")
        square = (x - place[0]) ** 2 + (y - place[1]) ** 2
        under = square < self.radius**2
        if self.shape == "cylinder":
            return jnp.where(under, 0.0, FAR)
        return jnp.where(under, self.radius - jnp.sqrt(jnp.where(under, self.radius**2 - square, 1.0)), FAR)


class Layer(NamedTuple):
    """What is not linear; also its spread (one standard deviation) in the same units."""

    thickness: Float[Array, ""]  # m
    gap: Float[Array, ""]  # m
    young: Float[Array, ""]  # Pa; only the prior's where presses are controlled by depth
    zero: Float[Array, ""]  # m by which the skin was met later than believed; zero where controlled by force
    give: Float[Array, ""]  # m/N, of a skin held at its edge
    offset: Float[Array, "2"]  # m by which the tip stood off from where it was believed
    strength: Float[Array, "3"]  # A/m, of the map's patches along each axis
    common: Float[Array, ""]  # A/m, of the uniform part
    length: Float[Array, ""]  # m, of the patches
    noise: Float[Array, ""]  # uT, of a reading, with all that the model leaves out


class Prior(NamedTuple):
    """Middle and standard deviation of each of `Layer`; a factor exp(normal) for those that cannot be negative."""

    middle: Layer
    spread: Layer


def prior(thickness: float = THICKNESS + 0.5e-3, gap: float = GAP, length: float = 3e-3) -> Prior:
    """Much as `sample_pad` draws pads, with 0.1 mm of first touch, 0.3 mm of offset, 2 uT of noise within a factor e.
    One wide lognormal stands for a give that is nothing in most skins.
    """
    part = 0.7 * STRENGTH  # patches and the uniform part share the variance
    middle = Layer(thickness, gap, YOUNG, 0.0, 0.3 * GIVE, jnp.zeros(2), jnp.full(3, part), part, length, 2.0)  # type: ignore[arg-type]
    spread = Layer(0.12, 0.17, 0.15, 1e-4, 1.3, jnp.full(2, 3e-4), jnp.full(3, 0.7), 0.7, 0.2, 1.0)  # type: ignore[arg-type]
    return Prior(middle, spread)


class PadFit(NamedTuple):
    """A fitted pad, and how sure it is."""

    pad: Pad
    layer: Layer
    spread: Layer  # of `layer`
    weights: Float[Array, " k"]
    cholesky: Float[Array, "k k"]  # of the weights' precision
    left_out: Float[Array, "n 15"]  # uT, what all other presses say of each
    score: Float[Array, ""]  # mean log density of a reading of a press as all others predict it


def layer_of(free: Float[Array, " free"], given: Prior) -> Layer:
    """From coordinates whose prior is normal with variance 1."""
    m, d = given

    def factor(name: str, at: Array) -> Array:
        return getattr(m, name) * jnp.exp(getattr(d, name) * at)

    return Layer(
        factor("thickness", free[0]), factor("gap", free[1]), factor("young", free[2]), m.zero + d.zero * free[3],
        factor("give", free[4]), m.offset + d.offset * free[5:7], factor("strength", free[7:10]),
        factor("common", free[10]), factor("length", free[11]), factor("noise", free[12]),
    )  # fmt: skip


def make_pad(layer: Layer, board: Board, magnetisation: Float[Array, "m m 3"] | None = None) -> Pad:
    """The layer over a board, whose chips keep their places in the plane."""
    chips = jnp.asarray(board.chips).at[:, 2].set(-(layer.thickness + layer.gap))
    empty = jnp.zeros((MAP, MAP, 3)) if magnetisation is None else magnetisation
    return Pad(
        jnp.asarray(layer.thickness), jnp.asarray(layer.young), jnp.asarray(POISSON), empty, jnp.ones(READINGS),
        Board(chips, jnp.asarray(board.rotations)), friction=jnp.asarray(FRICTION), give=jnp.asarray(layer.give),
    )  # fmt: skip


def cosines(cells: int = MAP) -> Float[np.ndarray, "cells modes"]:
    """Orthonormal cosines on the cells of an edge (the discrete cosine transform's), the slowest first."""
    k, i = np.arange(min(MODES, cells)), np.arange(cells)
    waves = np.cos(np.pi * (i[:, None] + 0.5) * k / cells) * np.sqrt(2 / cells)
    return np.where(k == 0, waves / np.sqrt(2), waves).astype(np.float32)


def root(length: Float[Array, ""], window: float, cells: int = MAP) -> Float[Array, "modes modes"]:
    """Factor of the covariance of an edge's cosines: that of `smooth_random`, seen by them."""
    at = (np.arange(cells) + 0.5) / cells * window
    apart = (at[:, None] - at[None, :]) / length
    waves = jnp.asarray(cosines(cells))
    covariance = waves.T @ (0.999 * jnp.exp(-0.5 * apart**2) + 0.001 * jnp.eye(cells)) @ waves
    return jnp.linalg.cholesky(covariance + 1e-5 * jnp.eye(len(covariance)))


def design(
    layer: Layer, board: Board, tip: Tip, place: Float[Array, "2"], load: Float[Array, ""], by_force: bool,
    grid: Grid = GRID,
) -> Float[Array, "15 3 m m"]:  # fmt: skip
    """The reading (uT) of one press for each cosine (y, x) of 1 A/m of each component of the magnetisation."""
    pad = make_pad(layer, board)
    height = tip.height(place + layer.offset, grid)
    if by_force:
        contact = solve_force(pad, height, jnp.maximum(load, 1e-3), grid)
    else:
        contact = solve(pad, height, load - layer.zero, grid)
    loaded = elastic.load(pad, contact.pressure, grid=grid)
    # Moments of magnetisation 1 along one cosine in y and one in x are a product: the sheets' of each edge.
    share, depths = _edge(grid), sheets(pad, grid)[0]
    thick = pad.thickness * np.polynomial.legendre.leggauss(NODES)[1] / 2
    y, x = np.meshgrid(grid.centres, grid.centres, indexing="ij")

    def sheet(at: tuple[Array, Array]) -> Array:
        depth, size = at
        displacement, rotation = elastic.interior(pad, loaded, depth, grid)
        rest = jnp.stack([jnp.asarray(x), jnp.asarray(y), jnp.broadcast_to(-depth, x.shape)])
        turned = jax.vmap(lambda one: turn(rotation, jnp.broadcast_to(one[:, None, None], rest.shape)))(jnp.eye(3))

        def chip(point: Array) -> Array:
            before, after = _tensor(point, rest), _tensor(point, rest + displacement)
            change = jnp.einsum("oqij,cqij->ocij", after, turned, precision="highest") - before
            return jnp.einsum("ocij,ia,jb->ocab", change, share, share, precision="highest")

        return size * jnp.stack([chip(point) for point in pad.board.chips])

    field = MICROTESLA * jnp.sum(jax.lax.map(sheet, (depths, thick)), axis=0)  # (chips, 3, 3, modes, modes), tool axes
    own = jnp.einsum("kqo,kqcab->kocab", pad.board.rotations, field, precision="highest")
    return own.reshape(READINGS, 3, *field.shape[-2:])


def _edge(grid: Grid) -> Float[np.ndarray, "n m"]:
    """What a cosine of the map gives to each cell of the grid along an edge, times the cell's width (`sheets`)."""
    cell = (2 * np.arange(grid.cells) + 1) * MAP // (2 * grid.cells)
    return (cell_means(grid.cells).T @ cosines()[cell] * grid.spacing).astype(np.float32)


def _tensor(point: Array, at: Float[Array, "3 n n"]) -> Float[Array, "3 3 n n"]:
    """Field (T) at a point per moment (A m2) at each place."""
    d = point[:, None, None] - at
    inverse = jax.lax.rsqrt(jnp.sum(d**2, axis=0))
    along = d * inverse[None]
    return MU0_OVER_4PI * (3 * along[:, None] * along[None] - jnp.eye(3)[..., None, None]) * inverse[None, None] ** 3


@partial(jax.jit, static_argnums=(2, 4, 5))
def designs(
    layer: Layer, board: Board, tip: Tip, presses: Presses, by_force: bool, grid: Grid = GRID
) -> Float[Array, "n 15 3 m m"]:
    """`design` of many presses."""
    return jax.lax.map(
        lambda at: design(layer, board, tip, at[0], at[1], by_force, grid), tuple(presses), batch_size=BATCH
    )


def features(layer: Layer, designed: Float[Array, "n 15 3 m m"], window: float) -> Float[Array, "n 15 k"]:
    """The readings of weights of variance 1."""
    r = root(layer.length, window)
    patches = jnp.einsum("nocab,ax,by,c->nocxy", designed, r, r, layer.strength, precision="highest")
    level = designed[:, :, :, 0, 0] * (MAP * layer.common)  # the first cosines are 1 / sqrt(MAP)
    return jnp.concatenate([patches.reshape(*designed.shape[:2], -1), level], axis=-1)


class Solved(NamedTuple):
    """A linear fit of the map."""

    weights: Float[Array, " k"]
    cholesky: Float[Array, "k k"]
    mean: Float[Array, "n 15"]  # uT, of each press as all others predict it
    density: Float[Array, " n"]  # log density of each press as all others predict it


def regress(phi: Float[Array, "n 15 k"], readings: Float[Array, "n 15"], noise: Float[Array, ""]) -> Solved:
    """Weights of prior variance 1, and what leaving out each press (all its 15 values) gives, in closed form."""
    rows = phi.reshape(-1, phi.shape[-1]) / noise
    precision = jnp.matmul(rows.T, rows, precision="highest") + jnp.eye(phi.shape[-1])
    cholesky = jnp.linalg.cholesky(precision)
    weights = jax.scipy.linalg.cho_solve(
        (cholesky, True), jnp.matmul(rows.T, readings.reshape(-1) / noise, precision="highest")
    )
    half = jax.scipy.linalg.solve_triangular(cholesky, rows.T, lower=True).T.reshape(phi.shape)
    rest = jnp.eye(READINGS)[None] - jnp.einsum("nok,npk->nop", half, half, precision="highest")
    error = (readings - jnp.einsum("nok,k->no", phi, weights, precision="highest")) / noise
    factor = jnp.linalg.cholesky(rest + 1e-5 * jnp.eye(READINGS)[None])
    lone = jax.vmap(lambda L, e: jax.scipy.linalg.cho_solve((L, True), e))(factor, error)
    # The error without the press is (I - H)^-1 e, its covariance (I - H)^-1.
    log_rest = 2 * jnp.sum(jnp.log(jnp.diagonal(factor, axis1=1, axis2=2)), axis=1)
    density = -0.5 * (jnp.sum(error * lone, axis=1) - log_rest) - READINGS * jnp.log(noise * np.sqrt(2 * np.pi))
    return Solved(weights, cholesky, readings - noise * lone, density)


def fit_pad(
    presses: Presses,
    readings: Float[Array, "n 15"],
    tip: Tip,
    board: Board,
    by_force: bool,
    given: Prior | None = None,
    grid: Grid = GRID,
    limit: int = LIMIT,
    rounds: int = ROUNDS,
) -> PadFit:
    """A pad from n presses and their readings (uT); at most `limit` of them, the first, find what is not linear.

    Presses are expected in random order. With `rounds` 0 the layer stays at the middle of its prior.
    """
    given = prior() if given is None else given
    first = min(limit, len(presses.load))
    some, told = jax.tree.map(lambda part: part[:first], presses), readings[:first]
    free = np.zeros(COORDINATES)
    curvature = np.eye(COORDINATES)
    for _ in range(rounds):
        here = jnp.asarray(free, jnp.float32)
        designed = _moved(here, given, board, tip, some, by_force, grid)

        def climb(x: np.ndarray, here: Array = here, designed: Array = designed) -> tuple[float, np.ndarray]:
            value, slope = _slopes(jnp.asarray(x, jnp.float32), here, designed, told, given, grid.window)
            if not np.isfinite(value) or not np.isfinite(slope).all():  # beyond what single precision can factor
                return IMPOSSIBLE, np.zeros(COORDINATES)
            return float(value), np.asarray(slope, np.float64)

        bounds = [(at - REACH, at + REACH) for at in free]
        found = optimize.minimize(climb, free, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": STEPS})
        free = found.x
        step = 0.05
        curvature = np.array(
            [(climb(free + step * e)[1] - climb(free - step * e)[1]) / (2 * step) for e in np.eye(len(free))]
        )
    values, vectors = np.linalg.eigh((curvature + curvature.T) / 2)
    # The prior alone curves by 1: less is rounding, or a top that was not reached.
    spread = np.sqrt(np.sum(vectors**2 / np.maximum(values, 1.0), axis=1))
    layer = layer_of(jnp.asarray(free, jnp.float32), given)
    return solve_map(layer, _spread(layer, spread, given), presses, readings, tip, board, by_force, grid)


def solve_map(
    layer: Layer,
    spread: Layer,
    presses: Presses,
    readings: Float[Array, "n 15"],
    tip: Tip,
    board: Board,
    by_force: bool,
    grid: Grid = GRID,
) -> PadFit:
    """The map and the chips' gains for a known layer."""
    phi = features(layer, designs(layer, board, tip, presses, by_force, grid), grid.window)
    return _finish(layer, spread, phi, readings, board, grid.window)


@partial(jax.jit, static_argnames=("window",))
def _finish(layer: Layer, spread: Layer, phi: Array, readings: Array, board: Board, window: float) -> PadFit:
    gains = jnp.ones(READINGS)
    solved = regress(phi, readings, layer.noise)
    for _ in range(3):
        # A gain is told by the presses only as far as all other presses predict it.
        own = jnp.sum(solved.mean**2, axis=0) / layer.noise**2
        seen = jnp.sum(solved.mean / gains[None] * readings, axis=0) / layer.noise**2
        own = own / gains**2
        gains = (1 / GAIN_SPREAD**2 + seen) / (1 / GAIN_SPREAD**2 + own)
        solved = regress(phi * gains[None, :, None], readings, layer.noise)
    weights, level = solved.weights[:-3].reshape(3, MODES, MODES), solved.weights[-3:]
    r, waves = root(layer.length, window), jnp.asarray(cosines())
    edge = jnp.matmul(waves, r, precision="highest")
    patches = jnp.einsum("ia,jb,cab,c->ijc", edge, edge, weights, layer.strength, precision="highest")
    magnetisation = patches + layer.common * level[None, None]
    pad = make_pad(layer, board, magnetisation)._replace(gains=gains)
    return PadFit(pad, layer, spread, solved.weights, solved.cholesky, solved.mean, jnp.mean(solved.density) / READINGS)


def predict_pad(
    fitted: PadFit, presses: Presses, tip: Tip, by_force: bool, grid: Grid = GRID
) -> tuple[Float[Array, "n 15"], Float[Array, "n 15"]]:
    """Mean and standard deviation (uT) of the readings of other presses; the layer is taken as known."""
    phi = features(fitted.layer, designs(fitted.layer, fitted.pad.board, tip, presses, by_force, grid), grid.window)
    return _told(fitted, phi)


@jax.jit
def _told(fitted: PadFit, phi: Array) -> tuple[Array, Array]:
    phi = phi * fitted.pad.gains[None, :, None]
    mean = jnp.einsum("nok,k->no", phi, fitted.weights, precision="highest")
    half = jax.scipy.linalg.solve_triangular(fitted.cholesky, phi.reshape(-1, phi.shape[-1]).T, lower=True)
    return mean, jnp.sqrt(jnp.sum(half**2, axis=0).reshape(mean.shape) + fitted.layer.noise**2)


def _spread(layer: Layer, free: np.ndarray, given: Prior) -> Layer:
    """Spread of the layer from that of its coordinates, to first order."""
    d = given.spread
    return Layer(
        layer.thickness * d.thickness * free[0], layer.gap * d.gap * free[1], layer.young * d.young * free[2],
        jnp.asarray(d.zero * free[3]), layer.give * d.give * free[4], d.offset * jnp.asarray(free[5:7]),
        layer.strength * d.strength * jnp.asarray(free[7:10]), layer.common * d.common * free[10],
        layer.length * d.length * free[11], layer.noise * d.noise * free[12],
    )  # fmt: skip


def _climbed(free: Array, here: Array, designed: Array, readings: Array, given: Prior, window: float) -> Array:
    """What is descended near `here`, where the design is linear in its coordinates."""
    layer = layer_of(free, given)
    moved = designed[0] + jnp.tensordot(free[:MOVES] - here[:MOVES], designed[1:], 1, precision="highest")
    solved = regress(features(layer, moved, window), readings, layer.noise)
    return 0.5 * jnp.sum(free**2) - jnp.sum(solved.density)


_slopes = jax.jit(jax.value_and_grad(_climbed), static_argnames=("window",))


@partial(jax.jit, static_argnums=(3, 5, 6))
def _moved(free: Array, given: Prior, board: Board, tip: Tip, presses: Presses, by_force: bool, grid: Grid) -> Array:
    """The design and its change along each of the first coordinates, (1 + MOVES, n, 15, 3, m, m)."""

    def one(press: tuple[Array, Array]) -> Array:
        def at(first: Array) -> Array:
            return design(layer_of(free.at[:MOVES].set(first), given), board, tip, press[0], press[1], by_force, grid)

        def along(direction: Array) -> Array:
            return jax.jvp(at, (free[:MOVES],), (direction,))[1]

        return jnp.concatenate([at(free[:MOVES])[None], jax.lax.map(along, jnp.eye(MOVES))])

    return jnp.swapaxes(jax.lax.map(one, tuple(presses)), 0, 1)
