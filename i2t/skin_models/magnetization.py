"""A pad from a few presses with a known tip: its magnetization map, and the few parameters of the layer under it.

For a known displacement the reading is linear in the magnetization (`i2t.skin.dipoles`), so that presses give a linear
system for the map, reading = Phi w + noise. The map is a series of cosines on the pad with the covariance of
`i2t.skin.pad.smooth_random`, of which a few hundred weights w are left, normal with variance 1; their posterior is that
of Bayesian linear regression (Bishop, "Pattern Recognition and Machine Learning", section 3.3).

`i2t.skin_models.layer_fit` finds the other parameters, in which the reading is not linear, with the weights integrated
out; derivatives of the readings run forward through the contact and the design matrices.

A press leaves behind others at its own place when it is left out alone; how well a pad predicts where it was not
pressed, the errors at places left out say.

Metres, newtons, pascals, microtesla. `c` is the number of channels, three for each chip of the board; `m` is the number
of cosines along an edge, `k` the number of weights.
"""

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int, Key
from scipy import linalg

from i2t.contact.pressure import ContactPressure
from i2t.dataset import same_places
from i2t.errors import SerializationError
from i2t.files import serialization
from i2t.geometry import so3_exp
from i2t.leave_one_out import leave_out_blocks
from i2t.runtime.batching import map_batches
from i2t.skin import elasticity as elastic
from i2t.skin.contact import MAX_HEIGHT_M, solve, solve_force
from i2t.skin.dipoles import CELL_NODES, MICROTESLA, MU0_OVER_4PI, cell_means, response, sheets, turn
from i2t.skin.elasticity import CELL_GRID, GRID, Grid
from i2t.skin.files import KIND as FILE_KIND
from i2t.skin.files import load_pad
from i2t.skin.pad import FRICTION_COEFFICIENT, MAP_CELLS
from i2t.skin_models.base import load_fitted
from i2t.skin_models.layer_fit import (
    DESIGN_PARAMETERS,
    NO_PAD,
    LayerParameters,
    LayerPosterior,
    LayerPrior,
    fit_layer,
    layer_prior,
    parameters_at,
)
from i2t.types import Board, Pad, in_one_line
from i2t.validation import round_tip

MODES = 12  # cosines along each edge: waves of 3.6 mm, finer than any that can be distinguished 1.5 mm above a chip
DESIGN_BATCH = 8  # at a time, for the caches
MIN_FORCE_N = 1e-3
MAX_RADIUS_MM = 50.0  # of a tip
MAX_LAYER_PRESSES = 48  # that the layer's parameters are fitted to; they need no more, and the map takes all


@runtime_checkable
class Tip(Protocol):
    """Any tip whose surface over the skin is known."""

    def height(self, position: Float[Array, "2"], grid: Grid = GRID) -> Float[Array, "n n"]:
        """Distance of the tip's surface behind its lowest point over each cell.

        Args:
            position: (2,) m, of the tip's axis on the skin.
            grid: Cells of the pad.

        Returns:
            (n, n) m, row along tool y; `MAX_HEIGHT_M` where the tip is not over the cell.
        """
        ...


@dataclass(frozen=True)
class RoundTip:
    """A sphere or the flat end of an upright cylinder.

    Attributes:
        shape: Which of them.
        radius: In metres.
    """

    shape: Literal["sphere", "cylinder"]
    radius: float

    def height(self, position: Float[Array, "2"] | Float[np.ndarray, "2"], grid: Grid = GRID) -> Float[Array, "n n"]:
        """Distance of the tip's surface behind its lowest point over each cell.

        Args:
            position: Of the tip's axis on the skin (m).
            grid: Cells of the pad.

        Returns:
            Heights (m), row along tool y; `MAX_HEIGHT_M` where the tip is not over the cell.
        """
        y, x = np.meshgrid(grid.centres, grid.centres, indexing="ij")
        square = (x - position[0]) ** 2 + (y - position[1]) ** 2
        under = square < self.radius**2
        if self.shape == "cylinder":
            return jnp.where(under, 0.0, MAX_HEIGHT_M)
        return jnp.where(under, self.radius - jnp.sqrt(jnp.where(under, self.radius**2 - square, 1.0)), MAX_HEIGHT_M)


def parse_tip(text: str) -> RoundTip:
    """A tip from its name, as `python -m i2t.convert presses --indenter` writes it.

    Args:
        text: `sphere:RADIUS` or `cylinder:RADIUS`, the radius in mm.

    Returns:
        The tip.

    Raises:
        ValueError: It is neither.
    """
    try:
        shape, millimetres = round_tip(text, MAX_RADIUS_MM)
    except ValueError as error:
        forms = f"--tip sphere:RADIUS or cylinder:RADIUS takes one in mm, up to {MAX_RADIUS_MM:g}"
        raise ValueError(f'"{text}" is no tip that a pad can be fitted to ({forms}): {error}') from None
    return RoundTip("sphere" if shape == "sphere" else "cylinder", 1e-3 * millimetres)


def make_pad(layer: LayerParameters, board: Board, magnetization: Float[Array, "cells cells 3"] | None = None) -> Pad:
    """A pad of a layer over a board.

    Args:
        layer: Parameters of the layer.
        board: The sensor board, any number of chips, all in one plane.
        magnetization: Map (A/m); by default none.

    Returns:
        The pad.
    """
    turned = so3_exp(jnp.asarray(layer.board_rotation))
    chips = jnp.matmul(jnp.asarray(board.chips).at[:, 2].set(0.0), turned.T, precision="highest")
    shift = jnp.concatenate([layer.board_offset, -(layer.thickness + layer.gap)[None]])
    empty = jnp.zeros((MAP_CELLS, MAP_CELLS, 3)) if magnetization is None else magnetization
    return Pad(
        thickness=jnp.asarray(layer.thickness),
        young=jnp.asarray(layer.young),
        poisson=jnp.asarray(layer.poisson),
        magnetization=empty,
        gains=jnp.asarray(layer.gains),
        board=Board(chips + shift, jnp.matmul(turned, jnp.asarray(board.rotations), precision="highest")),
        friction=jnp.asarray(FRICTION_COEFFICIENT),
        mount_compliance=jnp.asarray(layer.mount_compliance),
    )


def cosine_basis() -> Float[np.ndarray, "cells m"]:
    """Orthonormal cosines on the map's cells along an edge (the discrete cosine transform's), the slowest first.

    Returns:
        A column for each cosine.
    """
    k, i = np.arange(MODES), np.arange(MAP_CELLS)
    waves = np.cos(np.pi * (i[:, None] + 0.5) * k / MAP_CELLS) * np.sqrt(2 / MAP_CELLS)
    return np.where(k == 0, waves / np.sqrt(2), waves).astype(np.float32)


def cosine_prior_factor(patch_length: Float[Array, ""], window: float) -> Float[Array, "m m"]:
    """Cholesky factor of the covariance of an edge's cosines: that of `smooth_random`, in their basis.

    Args:
        patch_length: Length of the patches (m).
        window: Edge of the pad (m).

    Returns:
        The lower factor.
    """
    at = (np.arange(MAP_CELLS) + 0.5) / MAP_CELLS * window
    scaled = (at[:, None] - at[None, :]) / patch_length
    waves = jnp.asarray(cosine_basis())
    covariance = waves.T @ (0.999 * jnp.exp(-0.5 * scaled**2) + 0.001 * jnp.eye(MAP_CELLS)) @ waves
    return jnp.linalg.cholesky(covariance + 1e-5 * jnp.eye(MODES))


def design_matrix(
    layer: LayerParameters,
    board: Board,
    tip: Tip,
    position: Float[Array, "2"],
    load: Float[Array, ""],
    *,
    by_force: bool,
    grid: Grid = GRID,
) -> Float[Array, "c 3 m m"]:
    """Reading of one press for each cosine of each component of the magnetization.

    Args:
        layer: Parameters of the layer.
        board: The sensor board.
        tip: What presses.
        position: Where, as believed (m).
        load: Force (N) or depth (m).
        by_force: Whether the load is a force.
        grid: Cells of the pad.

    Returns:
        Readings (uT) of 1 A/m: channels, components, cosines along y and along x.
    """
    pad = make_pad(layer, board)
    if isinstance(tip, RoundTip):
        tip = replace(tip, radius=tip.radius * layer.tip_scale)
    height = tip.height(position + layer.tip_offset, grid)
    if by_force:
        contact = solve_force(pad, height, jnp.maximum(load, MIN_FORCE_N), grid)
    else:
        contact = solve(pad, height, load - layer.contact_offset, grid)
    return pressure_design(pad, contact.pressure, grid)


def pressure_design(pad: Pad, pressure: Float[Array, "n n"], grid: Grid = GRID) -> Float[Array, "c 3 m m"]:
    """Reading under a pressure for each cosine of each component of the magnetization.

    Args:
        pad: A skin; its own magnetization is not asked for.
        pressure: Pa, on its cells.
        grid: Cells of the pad.

    Returns:
        Readings (uT) of 1 A/m: channels, components, cosines along y and along x.
    """
    loaded = elastic.load(pad, pressure, grid=grid)
    # Moments of magnetization 1 along one cosine in y and one in x are a product: the sheets' of each edge.
    share, depths = _edge_moments(grid), sheets(pad, grid)[0]
    thick = pad.thickness * np.polynomial.legendre.leggauss(CELL_NODES)[1] / 2
    y, x = np.meshgrid(grid.centres, grid.centres, indexing="ij")

    def sheet(at: tuple[Array, Array]) -> Array:
        depth, size = at
        displacement, rotation = elastic.interior(pad, loaded, depth, grid)
        rest = jnp.stack([jnp.asarray(x), jnp.asarray(y), jnp.broadcast_to(-depth, x.shape)])
        turned = jax.vmap(lambda one: turn(rotation, jnp.broadcast_to(one[:, None, None], rest.shape)))(jnp.eye(3))

        def chip(point: Array) -> Array:
            before, after = _dipole_tensor(point, rest), _dipole_tensor(point, rest + displacement)
            change = jnp.einsum("oqij,cqij->ocij", after, turned, precision="highest") - before
            return jnp.einsum("ocij,ia,jb->ocab", change, share, share, precision="highest")

        return size * jnp.stack([chip(point) for point in pad.board.chips])

    field = MICROTESLA * jnp.sum(jax.lax.map(sheet, (depths, thick)), axis=0)  # (chips, 3, 3, modes, modes), tool axes
    own = jnp.einsum("kqo,kqcab->kocab", pad.board.rotations, field, precision="highest")
    return own.reshape(3 * len(own), 3, *field.shape[-2:])


@partial(jax.jit, static_argnames=("tip", "by_force", "grid"))
def design_matrices(
    layer: LayerParameters,
    board: Board,
    tip: Tip,
    position: Float[Array, "n 2"],
    load: Float[Array, " n"],
    *,
    by_force: bool,
    grid: Grid = GRID,
) -> Float[Array, "n c 3 m m"]:
    """`design_matrix` of many presses.

    Args:
        layer: Parameters of the layer.
        board: The sensor board.
        tip: What presses; hashable.
        position: Positions (m), as believed.
        load: Forces (N) or depths (m).
        by_force: Whether the loads are forces.
        grid: Cells of the pad.

    Returns:
        Readings (uT) of 1 A/m for each press.
    """

    def one(press: tuple[Array, Array]) -> Array:
        return design_matrix(layer, board, tip, *press, by_force=by_force, grid=grid)

    return map_batches(one, (position, load), batch_size=DESIGN_BATCH)


def weight_features(layer: LayerParameters, designs: Float[Array, "n c 3 m m"], window: float) -> Float[Array, "n c k"]:
    """Readings of weights of prior variance 1.

    Args:
        layer: Strengths and length of the magnetization's patches.
        designs: Design matrices.
        window: Edge of the pad (m).

    Returns:
        Readings (uT) of each weight: those of the patches, then three of the uniform part.
    """
    r = cosine_prior_factor(layer.patch_length, window)
    patches = jnp.einsum("nocab,ax,by,c->nocxy", designs, r, r, layer.patch_strength, precision="highest")
    level = designs[:, :, :, 0, 0] * (MAP_CELLS * layer.uniform_strength)  # the first cosines are 1 / sqrt(MAP)
    return jnp.concatenate([patches.reshape(*designs.shape[:2], -1), level], axis=-1)


def _edge_moments(grid: Grid) -> Float[np.ndarray, "n m"]:
    """Weights of the map's cosines in each cell of the grid along an edge, times the cell's width (`sheets`)."""
    cell = (2 * np.arange(grid.cells) + 1) * MAP_CELLS // (2 * grid.cells)
    return (cell_means(grid.cells).T @ cosine_basis()[cell] * grid.spacing).astype(np.float32)


def _dipole_tensor(point: Array, at: Float[Array, "3 n n"]) -> Float[Array, "3 3 n n"]:
    """Field (T) at a point per moment (A m2) at each position."""
    d = point[:, None, None] - at
    inverse = jax.lax.rsqrt(jnp.sum(d**2, axis=0))
    along = d * inverse[None]
    return MU0_OVER_4PI * (3 * along[:, None] * along[None] - jnp.eye(3)[..., None, None]) * inverse[None, None] ** 3


class LinearRegression(NamedTuple):
    """Posterior of the map's weights, and the readings predicted without their own group of presses."""

    weights: Float[np.ndarray, " k"]  # mean
    left_out: Float[np.ndarray, "n c"]  # uT, each press as predicted from all other groups
    log_density: Float[np.ndarray, " groups"]  # of each group as predicted from all others


def bayesian_linear_regression(
    features: Float[Any, "n c k"],
    readings: Float[Any, "n c"],
    noise_std: float,
    *,
    group: Int[np.ndarray, " n"] | None = None,
) -> LinearRegression:
    """Regress readings on weights of prior variance 1, and leave out groups of presses, in closed form.

    Args:
        features: Readings of each weight.
        readings: Readings of the presses, in the features' unit.
        noise_std: Standard deviation of a reading's noise, in the same unit.
        group: Group of each press, counted from 0; by default each press is its own.

    Returns:
        The posterior, and each press as predicted from all other groups.
    """
    n, channels, k = features.shape
    rows = np.asarray(features, np.float64).reshape(-1, k) / noise_std
    values = np.asarray(readings, np.float64).reshape(-1) / noise_std
    factor = linalg.cholesky(rows.T @ rows + np.eye(k), lower=True)
    weights = linalg.cho_solve((factor, True), rows.T @ values)
    half = linalg.solve_triangular(factor, rows.T, lower=True).T.reshape(n, channels, k)
    error = (values - rows @ weights).reshape(n, channels)
    group = np.arange(n) if group is None else group
    sizes, left_out = np.bincount(group), np.empty((n, channels))
    log_density = np.empty(len(sizes))
    for size in np.unique(sizes):
        some = np.flatnonzero(sizes == size)
        presses = np.stack([np.flatnonzero(group == number) for number in some])
        # In units of the noise the precision of a group's readings is I - H, H its part of the hat matrix.
        part = half[presses].reshape(len(some), size * channels, k)
        precision = np.eye(size * channels) - part @ part.swapaxes(1, 2)
        blocks = leave_out_blocks(precision, error[presses].reshape(len(some), -1, 1))
        left_out[presses] = blocks.error.reshape(len(some), size, channels)
        log_density[some] = blocks.log_density[:, 0] - size * channels * np.log(noise_std)
    return LinearRegression(weights, np.asarray(readings, np.float64) - noise_std * left_out, log_density)


def magnetization_map(
    layer: LayerParameters, weights: Float[Any, " k"], window: float
) -> Float[Array, "cells cells 3"]:
    """Magnetization (A/m) of weights of prior variance 1.

    Args:
        layer: Strengths and length of the magnetization's patches.
        weights: As for `weight_features`.
        window: Edge of the pad (m).

    Returns:
        The map.
    """
    weights = jnp.float32(weights)
    patches, level = weights[:-3].reshape(3, MODES, MODES), weights[-3:]
    edge = jnp.matmul(cosine_basis(), cosine_prior_factor(layer.patch_length, window), precision="highest")
    patches = jnp.einsum("ia,jb,cab,c->ijc", edge, edge, patches, layer.patch_strength, precision="highest")
    return patches + layer.uniform_strength * level[None, None]


@in_one_line
class PadFit(NamedTuple):
    """A fitted pad, and its errors on its own presses."""

    pad: Pad
    posterior: LayerPosterior
    left_out: Float[np.ndarray, "n c"]  # uT, measured minus predicted from all other presses
    left_out_places: Float[np.ndarray, "n c"]  # uT, measured minus predicted from the presses at all other places

    def predict(self, contact: ContactPressure) -> tuple[Float[Array, "m c"], Float[np.ndarray, "m c"]]:
        """Simulate the readings of contacts.

        Args:
            contact: m contact pressures on cells of 1 mm, as this pad has them (`predict_pressures` with `pad`).

        Returns:
            Mean reading (uT), and the root mean square of each channel's errors at places left out.
        """
        std = np.sqrt(np.mean(np.asarray(self.left_out_places, np.float64) ** 2, axis=0))
        return _simulate_readings(self.pad, contact), np.broadcast_to(std, (len(contact.load), len(std)))

    def save(self, path: Path | str, about: dict[str, Any] | None = None) -> None:
        """Write one file, which `i2t.load_pad` reads too.

        Args:
            path: Of the file; `.npz` by custom.
            about: Anything that JSON can hold (whose pad it is, how it was fitted).

        Raises:
            SerializationError: It cannot be written.
        """
        serialization.save(path, FILE_KIND, self.pad, about, beside=_FitRecord(*self[1:]))


class _FitRecord(NamedTuple):
    """Fields of a fitted pad's file that stand beside the pad's; none of them where the pad was saved alone."""

    posterior: LayerPosterior | None
    left_out: np.ndarray | None
    left_out_places: np.ndarray | None


def load_pad_fit(path: Path | str) -> PadFit:
    """Read a fitted pad with its errors from its file.

    Args:
        path: Of a file that `PadFit.save` wrote.

    Returns:
        The pad and what is known of its fit.

    Raises:
        SerializationError: The file is missing, damaged or something else, a pad of an earlier version, or a pad alone,
            which `i2t.load_pad` reads.
    """

    def build(path: Path | str, record: _FitRecord, about: dict[str, Any]) -> PadFit:
        if record.posterior is None or record.left_out is None or record.left_out_places is None:
            raise SerializationError(f"{path}: holds a pad without its fit; read it by i2t.load_pad, or fit it again")
        pad = load_pad(path)
        shapes = {f"posterior.{end}.{name}": np.shape(value) for end in ("layer", "low", "high")
                  for name, value in layer_prior(len(pad.gains)).median._asdict().items()}  # fmt: skip
        errors = dict.fromkeys(("left_out", "left_out_places"), (len(record.left_out), len(pad.gains)))
        serialization.check_arrays(path, record, shapes | errors, "fit again")
        return PadFit(pad, jax.tree.map(jnp.float32, record.posterior), record.left_out, record.left_out_places)

    return load_fitted(path, FILE_KIND, _FitRecord, build)


@jax.jit
def _simulate_readings(pad: Pad, contact: ContactPressure) -> Float[Array, "m c"]:
    pascals = contact.pressure / CELL_GRID.spacing**2
    return map_batches(lambda pressure: response(pad, pressure, CELL_GRID), pascals, batch_size=DESIGN_BATCH)


class TipReadings(NamedTuple):
    """Presses of one tip with their readings."""

    position: Float[Array, "n 2"]  # m, tool frame
    load: Float[Array, " n"]  # depth in m, or normal force in N
    reading: Float[Array, "n c"]  # uT
    board: Board  # of any number of chips


@dataclass(frozen=True)
class MagnetizationModel:
    """A pad of an elastic layer with an unknown map of magnetization, pressed by a known tip.

    Attributes:
        tip: What pressed; hashable.
        by_force: Whether the loads are forces.
        grid: Cells of the pad.
        max_layer_presses: The layer's parameters are fitted to at most so many presses, the first ones; with 0 the
            layer stays at the median of its prior.
    """

    tip: RoundTip
    by_force: bool
    grid: Grid = GRID
    max_layer_presses: int = MAX_LAYER_PRESSES

    def fit(self, key: Key[Array, ""] | None, data: TipReadings) -> PadFit:
        """Fit a pad to presses: first the layer, then the map for that layer.

        Args:
            key: Not used, as the fit draws nothing.
            data: The presses, in random order.

        Returns:
            The pad, the layer's parameters with their ranges, and the errors of presses and of places left out.
            Presses whose derivatives are not finite are left out of the layer's fit with a warning, and another warning
            says if the fit did not converge.

        Raises:
            ValueError: A press is not finite, or what is fitted is not.
        """
        _check_finite(data)
        readings = np.asarray(data.reading, np.float64)
        posterior = self.fit_layer(data)
        layer = posterior.layer
        designs = design_matrices(layer, data.board, self.tip, data.position, data.load, by_force=self.by_force,
                                  grid=self.grid)  # fmt: skip
        features = np.asarray(weight_features(layer, designs, self.grid.window)) * np.asarray(layer.gains)[:, None]
        noise_std = float(layer.noise_std)
        places = same_places(np.asarray(data.position))
        solved, by_place = (
            bayesian_linear_regression(features, readings, noise_std, group=group) for group in (None, places)
        )
        pad = make_pad(layer, data.board, magnetization_map(layer, solved.weights, self.grid.window))
        fitted = PadFit(pad, posterior, *(readings - values.left_out for values in (solved, by_place)))
        if not all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(fitted)):
            raise ValueError(NO_PAD)
        return fitted

    def fit_layer(self, data: TipReadings) -> LayerPosterior:
        """Fit the parameters of the layer.

        Args:
            data: The presses, in random order.

        Returns:
            The most likely parameters and their ranges.

        Raises:
            ValueError: The search cannot begin.
        """
        prior, first = layer_prior(data.reading.shape[1]), min(self.max_layer_presses, len(data.load))
        if not first:
            return LayerPosterior(prior.median, *(parameters_at(ends, prior) for ends in _prior_ends(prior)), True)
        some = data._replace(
            **{name: getattr(data, name)[:first] for name in ("position", "load", "reading")},
        )
        options = {"tip": self.tip, "by_force": self.by_force, "grid": self.grid}
        return fit_layer(
            partial(_unit_features, prior=prior, pressed=some, **options),
            partial(_linearize, prior=prior, pressed=some, **options),
            np.asarray(some.reading),
            prior,
        )


def _prior_ends(prior: LayerPrior) -> tuple[LayerParameters, LayerParameters]:
    """Coordinates of the ends of the prior's 95 % ranges."""
    return tuple(jax.tree.map(lambda at, end=end: jnp.full_like(at, end), prior.median) for end in (-1.96, 1.96))


def _check_finite(data: TipReadings) -> None:
    """Raise ValueError where a position, load or reading is not finite."""
    for name, values in (("positions", data.position), ("loads", data.load), ("readings", data.reading)):
        wrong = ~np.isfinite(np.asarray(values)).reshape(len(values), -1).all(1)
        if wrong.any():
            raise ValueError(
                f"{wrong.sum()} presses have {name} that are not finite, the first in row {np.argmax(wrong)}; drop them"
            )


@partial(jax.jit, static_argnames=("tip", "by_force", "grid"))
def _unit_features(
    coordinates: LayerParameters, *, prior: LayerPrior, pressed: TipReadings, tip: RoundTip, by_force: bool, grid: Grid
) -> Float[Array, "n c k"]:
    """Readings of weights on a layer whose map has strength 1."""
    layer = _of_unit_strength(parameters_at(coordinates, prior))
    designs = design_matrices(layer, pressed.board, tip, pressed.position, pressed.load, by_force=by_force, grid=grid)
    return weight_features(layer, designs, grid.window)


@partial(jax.jit, static_argnames=("tip", "by_force", "grid"))
def _linearize(
    coordinates: LayerParameters, *, prior: LayerPrior, pressed: TipReadings, tip: RoundTip, by_force: bool, grid: Grid
) -> tuple[Float[Array, "n c k"], Float[Array, "e n c k"]]:
    """`_unit_features`, and their derivatives along each coordinate of SHAPE_PARAMETERS."""
    designs, changes = _design_changes(coordinates, prior, pressed, tip=tip, by_force=by_force, grid=grid)

    def features(designs: Array, patch_length: Array) -> Array:
        layer = _of_unit_strength(parameters_at(coordinates._replace(patch_length=patch_length), prior))
        return weight_features(layer, designs, grid.window)

    length = coordinates.patch_length
    value, by_length = jax.jvp(partial(features, designs), (length,), (jnp.ones_like(length),))
    by_design = jax.vmap(lambda change: features(change, length))(changes)
    return value, jnp.concatenate([by_design, by_length[None]])


def _of_unit_strength(layer: LayerParameters) -> LayerParameters:
    one = jnp.asarray(1.0)
    return layer._replace(patch_strength=jnp.ones(3), uniform_strength=one)


def _design_coordinates(coordinates: LayerParameters) -> tuple[Array, ...]:
    return tuple(getattr(coordinates, name) for name in DESIGN_PARAMETERS)


@partial(jax.jit, static_argnames=("tip", "by_force", "grid"))
def _design_changes(
    coordinates: LayerParameters, prior: LayerPrior, pressed: TipReadings, *, tip: RoundTip, by_force: bool, grid: Grid
) -> tuple[Float[Array, "n c 3 m m"], Float[Array, "e n c 3 m m"]]:
    """Design matrices of all presses, and their change along each coordinate of DESIGN_PARAMETERS."""
    start, unravel = ravel_pytree(_design_coordinates(coordinates))

    def one(press: tuple[Array, Array]) -> tuple[Array, Array]:
        def at(vector: Array) -> Array:
            moved = coordinates._replace(**dict(zip(DESIGN_PARAMETERS, unravel(vector), strict=True)))
            layer = parameters_at(moved, prior)
            return design_matrix(layer, pressed.board, tip, *press, by_force=by_force, grid=grid)

        def along(direction: Array) -> Array:
            return jax.jvp(at, (start,), (direction,))[1]

        return at(start), jax.lax.map(along, jnp.eye(len(start)))

    value, changes = jax.lax.map(one, (pressed.position, pressed.load))
    return value, jnp.swapaxes(changes, 0, 1)
