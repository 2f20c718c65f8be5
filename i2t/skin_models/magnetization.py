"""A pad from a few presses with a known tip: its magnetization map, and the few parameters of the layer under it.

For a known displacement the reading is linear in the magnetization (`i2t.skin.dipoles`), so that presses give a linear
system for the map, reading = Phi w + noise. The map is a series of cosines on the pad with the covariance of
`i2t.skin.pad.smooth_random`, of which a few hundred weights w are left, normal with variance 1; their posterior is that
of Bayesian linear regression (Bishop, "Pattern Recognition and Machine Learning", section 3.3).

The other parameters, `LayerParameters`, are not linear: thickness, gap from layer to chips, stiffness (presses
controlled by force) or the depth of first contact (by depth), the tip's offset in the plane, and strength and length of
the map and the noise. They are found with the map solved for at every step (variable projection; Golub and Pereyra,
SIAM J. Numer. Anal. 10, 1973): what is maximised is the log density of each press as predicted from all others
(Rasmussen and Williams, "Gaussian Processes for Machine Learning", section 5.4.2) plus that of the parameters' priors,
which are those of `i2t.skin.pad.sample_pad`. Gradients are exact: forward through the contact and the design matrices,
backwards through the regression. The coordinates are a `LayerParameters` of standard deviations from the prior's
median, which the optimiser sees as one vector (`ravel_pytree`).

Metres, newtons, pascals, microtesla. `c` is the number of channels, three for each chip of the board; `m` is the number
of cosines along an edge, `k` the number of weights.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Key
from scipy import optimize

from i2t.contact.pressure import ContactPressure
from i2t.errors import SerializationError
from i2t.files import serialization
from i2t.leave_one_out import leave_out_blocks
from i2t.runtime.batching import map_batches
from i2t.skin import elasticity as elastic
from i2t.skin.contact import MAX_HEIGHT_M, solve, solve_force
from i2t.skin.dipoles import CELL_NODES, MICROTESLA, MU0_OVER_4PI, cell_means, response, sheets, turn
from i2t.skin.elasticity import CELL_GRID, GRID, Grid
from i2t.skin.files import KIND as FILE_KIND
from i2t.skin.files import load_pad
from i2t.skin.pad import (
    CHIP_GAP_M,
    FRICTION_COEFFICIENT,
    MAGNETIZATION_A_PER_M,
    MAP_CELLS,
    MOUNT_COMPLIANCE_M_PER_N,
    POISSON_RATIO,
    THICKNESS_M,
    YOUNG_PA,
)
from i2t.skin_models.base import load_fitted
from i2t.types import Board, Pad, in_one_line
from i2t.validation import round_tip

MODES = 12  # cosines along each edge: waves of 3.6 mm, finer than any that can be distinguished 1.5 mm above a chip
DESIGN_BATCH = 8  # at a time, for the caches
MIN_FORCE_N = 1e-3
MAX_RADIUS_MM = 50.0  # of a tip
NOISE_PRIOR_UT = 2.0  # prior median of a reading's noise
MAGNETIZATION_STD = 0.7 * MAGNETIZATION_A_PER_M  # A/m, prior median: patches and the uniform part share the variance
# Parameters that change the design matrices; the others only scale what the matrices give.
DESIGN_PARAMETERS = ("thickness", "gap", "young", "contact_offset", "mount_compliance", "tip_offset")
# Parameters with a normal prior; the others cannot be negative and have a lognormal one.
NORMAL_PARAMETERS = ("contact_offset", "tip_offset")
LBFGS_STEPS = 25  # in each linearization
MAX_MOVE_STDS = 0.7  # how far each coordinate goes in one of them, in standard deviations of the prior
FAILED_OBJECTIVE = 1e9  # added to the objective at the start, where it cannot be computed
NO_PAD = "no pad explains these presses; check the tip, the unit of the loads and the board"

MAX_LAYER_PRESSES = 48  # that the layer's parameters are fitted to; they need no more, and the map takes all
LINEARIZATIONS = 3  # of the design matrices
GAIN_STD = 0.05  # of the chips' gains, as in `sample_pad`
GAIN_ROUNDS = 3


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


class LayerParameters(NamedTuple):
    """Parameters that readings are nonlinear in; also their coordinates in the prior."""

    thickness: Float[Array, ""]  # m
    gap: Float[Array, ""]  # m, from the layer's base to the chips
    young: Float[Array, ""]  # Pa; only the prior's where presses are controlled by depth
    contact_offset: Float[Array, ""]  # m, first contact later than believed; zero where controlled by force
    mount_compliance: Float[Array, ""]  # m/N, of an edge-clamped skin
    tip_offset: Float[Array, "2"]  # m, of the tip from where it was believed
    patch_strength: Float[Array, "3"]  # A/m, of the map's patches along each axis
    uniform_strength: Float[Array, ""]  # A/m, of the uniform part
    patch_length: Float[Array, ""]  # m
    noise_std: Float[Array, ""]  # uT, of a reading, with all that the model leaves out


class LayerPrior(NamedTuple):
    """Prior of `LayerParameters`: normal for NORMAL_PARAMETERS, lognormal for all others."""

    median: LayerParameters
    std: LayerParameters  # of the parameter where the prior is normal, of its logarithm where it is lognormal


def layer_prior() -> LayerPrior:
    """Prior that approximates `sample_pad`.

    A mounting compliance is lognormal although it is exactly 0 in bonded skins; one wide prior stands for both kinds.

    Returns:
        Medians and standard deviations.
    """
    median = LayerParameters(
        thickness=jnp.asarray(THICKNESS_M + 0.5e-3),
        gap=jnp.asarray(CHIP_GAP_M),
        young=jnp.asarray(YOUNG_PA),
        contact_offset=jnp.asarray(0.0),
        mount_compliance=jnp.asarray(0.3 * MOUNT_COMPLIANCE_M_PER_N),
        tip_offset=jnp.zeros(2),
        patch_strength=jnp.full(3, MAGNETIZATION_STD),
        uniform_strength=jnp.asarray(MAGNETIZATION_STD),
        patch_length=jnp.asarray(3e-3),
        noise_std=jnp.asarray(NOISE_PRIOR_UT),
    )
    std = LayerParameters(
        thickness=jnp.asarray(0.12),
        gap=jnp.asarray(0.17),
        young=jnp.asarray(0.15),
        contact_offset=jnp.asarray(1e-4),  # m
        mount_compliance=jnp.asarray(1.3),
        tip_offset=jnp.full(2, 3e-4),  # m
        patch_strength=jnp.full(3, 0.7),
        uniform_strength=jnp.asarray(0.7),
        patch_length=jnp.asarray(0.2),
        noise_std=jnp.asarray(1.0),
    )
    return LayerPrior(median, std)


def parameters_at(coordinates: LayerParameters, prior: LayerPrior) -> LayerParameters:
    """Parameters from their coordinates in the prior.

    Args:
        coordinates: Standard deviations from the median; their prior is normal with variance 1.
        prior: Medians and standard deviations.

    Returns:
        The parameters in their units.
    """

    def value(name: str) -> Array:
        median, std, at = (getattr(part, name) for part in (prior.median, prior.std, coordinates))
        return median + std * at if name in NORMAL_PARAMETERS else median * jnp.exp(std * at)

    return LayerParameters(**{name: value(name) for name in LayerParameters._fields})


def make_pad(layer: LayerParameters, board: Board, magnetization: Float[Array, "cells cells 3"] | None = None) -> Pad:
    """A pad of a layer over a board, whose chips keep their positions in the plane.

    Args:
        layer: Parameters of the layer.
        board: The sensor board, any number of chips.
        magnetization: Map (A/m); by default none.

    Returns:
        A pad with gains of 1.
    """
    chips = jnp.asarray(board.chips).at[:, 2].set(-(layer.thickness + layer.gap))
    empty = jnp.zeros((MAP_CELLS, MAP_CELLS, 3)) if magnetization is None else magnetization
    return Pad(
        thickness=jnp.asarray(layer.thickness),
        young=jnp.asarray(layer.young),
        poisson=jnp.asarray(POISSON_RATIO),
        magnetization=empty,
        gains=jnp.ones(3 * len(board.chips)),
        board=Board(chips, jnp.asarray(board.rotations)),
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
        position: Where, as believed (m).
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
    """Posterior of the map's weights."""

    weights: Float[Array, " k"]  # mean
    leave_one_out: Float[Array, "n c"]  # uT, each press as predicted from all others
    log_density: Float[Array, " n"]  # of each press as predicted from all others


def bayesian_linear_regression(
    features: Float[Array, "n c k"], readings: Float[Array, "n c"], noise_std: Float[Array, ""]
) -> LinearRegression:
    """Weights of prior variance 1, and predictions of left-out presses (all values), in closed form.

    Args:
        features: Readings of each weight.
        readings: Readings of the presses, in the features' unit.
        noise_std: Standard deviation of a reading's noise, in the same unit.

    Returns:
        The posterior, and each press as predicted from all others.
    """
    channels = features.shape[1]
    rows = features.reshape(-1, features.shape[-1]) / noise_std
    precision = jnp.matmul(rows.T, rows, precision="highest") + jnp.eye(features.shape[-1])
    cholesky = jnp.linalg.cholesky(precision)
    projected = jnp.matmul(rows.T, readings.reshape(-1) / noise_std, precision="highest")
    weights = jax.scipy.linalg.cho_solve((cholesky, True), projected)
    half = jax.scipy.linalg.solve_triangular(cholesky, rows.T, lower=True).T.reshape(features.shape)
    rest = jnp.eye(channels)[None] - jnp.einsum("nok,npk->nop", half, half, precision="highest")
    error = (readings - jnp.einsum("nok,k->no", features, weights, precision="highest")) / noise_std
    # In units of the noise the precision of a press's readings is I - H, H its part of the hat matrix.
    left_out = leave_out_blocks(rest + 1e-5 * jnp.eye(channels)[None], error[..., None])
    log_density = left_out.log_density[:, 0] - channels * jnp.log(noise_std)
    return LinearRegression(weights, readings - noise_std * left_out.error[..., 0], log_density)


@in_one_line
class PadFit(NamedTuple):
    """A fitted pad, and its errors on its own presses."""

    pad: Pad
    layer: LayerParameters
    left_out: Float[np.ndarray, "n c"]  # uT, measured minus predicted from all other presses

    def predict(self, contact: ContactPressure) -> tuple[Float[Array, "m c"], Float[np.ndarray, "m c"]]:
        """Simulate the readings of contacts.

        Args:
            contact: m contact pressures on cells of 1 mm, as this pad has them (`predict_pressures` with `pad`).

        Returns:
            Mean reading (uT), and the root mean square of each channel's errors on presses left out.
        """
        std = np.sqrt(np.mean(np.asarray(self.left_out, np.float64) ** 2, axis=0))
        return _simulate_readings(self.pad, contact), np.broadcast_to(std, (len(contact.load), len(std)))

    def save(self, path: Path | str, about: dict[str, Any] | None = None) -> None:
        """Write one file, which `i2t.load_pad` reads too.

        Args:
            path: Of the file; `.npz` by custom.
            about: Anything that JSON can hold (whose pad it is, how it was fitted).

        Raises:
            SerializationError: It cannot be written.
        """
        serialization.save(path, FILE_KIND, self.pad, about, beside=_FitRecord(self.layer, self.left_out))


class _FitRecord(NamedTuple):
    """Fields of a fitted pad's file that stand beside the pad's."""

    layer: LayerParameters | None  # neither where the pad was saved alone
    left_out: np.ndarray | None


def load_pad_fit(path: Path | str) -> PadFit:
    """Read a fitted pad with its errors from its file.

    Args:
        path: Of a file that `PadFit.save` wrote.

    Returns:
        The pad and what is known of its fit.

    Raises:
        SerializationError: The file is missing, damaged or something else, or a pad alone, which `i2t.load_pad` reads.
    """

    def build(path: Path | str, record: _FitRecord, about: dict[str, Any]) -> PadFit:
        if record.layer is None or record.left_out is None:
            raise SerializationError(f"{path}: holds a pad without its fit; read it by i2t.load_pad, or fit it again")
        pad = load_pad(path)
        shapes = {f"layer.{name}": np.shape(value) for name, value in layer_prior().median._asdict().items()}
        serialization.check_arrays(
            path, record, shapes | {"left_out": (len(record.left_out), len(pad.gains))}, "fit again"
        )
        return PadFit(pad, jax.tree.map(jnp.float32, record.layer), record.left_out)

    return load_fitted(path, FILE_KIND, _FitRecord, build)


@jax.jit
def _simulate_readings(pad: Pad, contact: ContactPressure) -> Float[Array, "m c"]:
    pascals = contact.pressure / CELL_GRID.spacing**2
    return map_batches(lambda pressure: response(pad, pressure, CELL_GRID), pascals, batch_size=DESIGN_BATCH)


class TipReadings(NamedTuple):
    """n presses of one tip with their readings, in random order."""

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
        max_layer_presses: The layer's parameters are fitted to at most so many presses, the first.
        linearizations: Of the design matrices; with 0 the layer stays at the median of its prior.
    """

    tip: RoundTip
    by_force: bool
    grid: Grid = GRID
    max_layer_presses: int = MAX_LAYER_PRESSES
    linearizations: int = LINEARIZATIONS

    def fit(self, key: Key[Array, ""] | None, data: TipReadings) -> PadFit:
        """Fit a pad to presses: first the layer, then the map and the chips' gains for that layer.

        Args:
            key: Not used, as the fit draws nothing.
            data: The presses.

        Returns:
            The pad, the layer's parameters, and the errors of presses left out. Presses whose derivatives are not
            finite are left out of the layer's fit with a warning.

        Raises:
            ValueError: A press is not finite, or what is fitted is not.
        """
        _check_finite(data)
        position, load, readings, board = data
        first = slice(self.max_layer_presses)
        some = TipReadings(position[first], load[first], readings[first], board)
        layer = _fit_layer(self, some, layer_prior())
        designs = design_matrices(layer, board, self.tip, position, load, by_force=self.by_force, grid=self.grid)
        features = weight_features(layer, designs, self.grid.window)
        gains, solved, pad = _map_and_gains(layer, features, readings, board, self.grid.window)
        left_out = np.asarray(readings, np.float64) - np.asarray(solved.leave_one_out, np.float64)
        fitted = PadFit(pad._replace(gains=gains), layer, left_out)
        if not all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(fitted)):
            raise ValueError(NO_PAD)
        return fitted


def _check_finite(pressed: TipReadings) -> None:
    """Raise ValueError where a position, load or reading is not finite."""
    for name in ("position", "load", "reading"):
        values = np.asarray(getattr(pressed, name))
        wrong = ~np.isfinite(values).reshape(len(values), -1).all(1)
        if wrong.any():
            first = np.argmax(wrong)
            raise ValueError(
                f"{wrong.sum()} presses have {name}s that are not finite, the first in row {first}; drop them"
            )


@partial(jax.jit, static_argnames=("window",))
def _map_and_gains(
    layer: LayerParameters, features: Array, readings: Array, board: Board, window: float
) -> tuple[Array, LinearRegression, Pad]:
    gains = jnp.ones(readings.shape[1])
    solved = bayesian_linear_regression(features, readings, layer.noise_std)
    for _ in range(GAIN_ROUNDS):
        # The presses measure a gain only as far as each is predicted from all others.
        own = jnp.sum(solved.leave_one_out**2, axis=0) / layer.noise_std**2
        seen = jnp.sum(solved.leave_one_out / gains[None] * readings, axis=0) / layer.noise_std**2
        own = own / gains**2
        gains = (1 / GAIN_STD**2 + seen) / (1 / GAIN_STD**2 + own)
        solved = bayesian_linear_regression(features * gains[None, :, None], readings, layer.noise_std)
    weights, level = solved.weights[:-3].reshape(3, MODES, MODES), solved.weights[-3:]
    r, waves = cosine_prior_factor(layer.patch_length, window), jnp.asarray(cosine_basis())
    edge = jnp.matmul(waves, r, precision="highest")
    patches = jnp.einsum("ia,jb,cab,c->ijc", edge, edge, weights, layer.patch_strength, precision="highest")
    return gains, solved, make_pad(layer, board, patches + layer.uniform_strength * level[None, None])


class _Linearization(NamedTuple):
    """Design matrices near some coordinates."""

    coordinates: LayerParameters
    value: Array  # (n, c, 3, m, m)
    changes: Array  # (d, n, c, 3, m, m), along each coordinate of DESIGN_PARAMETERS


Objective = Callable[[np.ndarray], tuple[float, np.ndarray]]  # coordinates -> value and gradient


def _fit_layer(model: MagnetizationModel, pressed: TipReadings, prior: LayerPrior) -> LayerParameters:
    """The most likely parameters of a layer; raises ValueError where the objective is not finite from the start."""
    flat, unravel = ravel_pytree(jax.tree.map(jnp.zeros_like, prior.median))
    at, options, linearizations = np.zeros(len(flat)), {"maxiter": LBFGS_STEPS}, model.linearizations
    for done in range(linearizations):
        objective = _linearized(at, model, pressed, prior, unravel)
        if not _is_finite(objective(at)):
            if done == 0:
                raise ValueError(NO_PAD)
            warnings.warn(
                f"the fit of the layer stopped after {done} of {linearizations} linearizations, because the objective "
                "is not finite at the parameters reached",
                stacklevel=3,
            )
            break
        bounds = [(x - MAX_MOVE_STDS, x + MAX_MOVE_STDS) for x in at]
        bounded = _finite_everywhere(objective, start=at)
        at = optimize.minimize(bounded, at, jac=True, method="L-BFGS-B", bounds=bounds, options=options).x
    if linearizations and not at.any():
        warnings.warn("the fit of the layer did not leave the medians of its prior", stacklevel=3)
    return parameters_at(unravel(jnp.asarray(at, jnp.float32)), prior)


def _is_finite(evaluated: tuple[float, np.ndarray]) -> bool:
    value, gradient = evaluated
    return bool(np.isfinite(value) and np.isfinite(gradient).all())


def _finite_everywhere(objective: Objective, *, start: np.ndarray) -> Objective:
    """The objective, with a large value where single precision cannot factor its matrices."""
    failed = FAILED_OBJECTIVE + abs(objective(start)[0])

    def bounded(x: np.ndarray) -> tuple[float, np.ndarray]:
        evaluated = objective(x)
        return evaluated if _is_finite(evaluated) else (failed, np.zeros(len(x)))

    return bounded


def _linearized(
    at: np.ndarray,
    model: MagnetizationModel,
    pressed: TipReadings,
    prior: LayerPrior,
    unravel: Callable[[Any], LayerParameters],
) -> Objective:
    """Value and gradient of the negative log posterior, with design matrices that are linear about `at`; of the presses
    whose designs are finite.
    """
    coordinates = unravel(jnp.asarray(at, jnp.float32))
    value, changes = _design_derivatives(
        coordinates,
        prior,
        pressed,
        tip=model.tip,
        by_force=model.by_force,
        grid=model.grid,
    )
    usable = _with_finite_designs(value, changes)
    linearization, readings = _Linearization(coordinates, value[usable], changes[:, usable]), pressed.reading[usable]

    def objective(x: np.ndarray) -> tuple[float, np.ndarray]:
        here = unravel(jnp.asarray(x, jnp.float32))
        value, gradient = _value_and_gradient(here, linearization, readings, prior, window=model.grid.window)
        return float(value), np.asarray(ravel_pytree(gradient)[0], np.float64)

    return objective


def _with_finite_designs(value: Array, changes: Array) -> np.ndarray:
    """Rows of the presses whose design matrices and their derivatives are finite; a warning counts the others."""
    finite = np.isfinite(np.asarray(value)).all((1, 2, 3, 4)) & np.isfinite(np.asarray(changes)).all((0, 2, 3, 4, 5))
    if not finite.any():
        raise ValueError(NO_PAD)
    if not finite.all():
        lost = np.flatnonzero(~finite)
        warnings.warn(
            f"{len(lost)} of {len(finite)} presses are left out of the fit of the layer, because the derivatives of "
            f"their readings are not finite (the first is in row {lost[0]})",
            stacklevel=5,
        )
    return np.flatnonzero(finite)


def _design_coordinates(coordinates: LayerParameters) -> tuple[Array, ...]:
    return tuple(getattr(coordinates, name) for name in DESIGN_PARAMETERS)


def _negative_log_posterior(
    coordinates: LayerParameters, linearization: _Linearization, readings: Array, prior: LayerPrior, window: float
) -> Array:
    layer = parameters_at(coordinates, prior)
    here, _ = ravel_pytree(_design_coordinates(coordinates))
    there, _ = ravel_pytree(_design_coordinates(linearization.coordinates))
    designs = linearization.value + jnp.tensordot(here - there, linearization.changes, 1, precision="highest")
    features = weight_features(layer, designs, window)
    solved = bayesian_linear_regression(features, readings, layer.noise_std)
    return 0.5 * jnp.sum(ravel_pytree(coordinates)[0] ** 2) - jnp.sum(solved.log_density)


_value_and_gradient = jax.jit(jax.value_and_grad(_negative_log_posterior), static_argnames=("window",))


@partial(jax.jit, static_argnames=("tip", "by_force", "grid"))
def _design_derivatives(
    coordinates: LayerParameters,
    prior: LayerPrior,
    pressed: TipReadings,
    *,
    tip: RoundTip,
    by_force: bool,
    grid: Grid,
) -> tuple[Array, Array]:
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
