"""A skin fitted to labelled presses of stamps, and what each stamp would read on it where the arm says it presses.

For a known stamp, position, rotation and force the pressure is known up to the layer, and the reading is linear in the
skin's magnetization: the map is fitted by Bayesian linear regression as in `i2t.skin_models.magnetization`. Of the
parameters that are not linear only thickness and mount compliance are distinguished, by the density of each press as
predicted from all others (leave-one-out) on a grid of layers. What one press leaves unexplained, the noise, the tilt of
the stamp and what the layer cannot say, is a covariance of the residuals; the hysteresis of a chip is found by
regressing the residuals of a session on the readings before.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from experiments.shapes.world import Stamp, heights, pose, stamps
from i2t.patches.dimensions import PAD_WINDOW
from i2t.runtime.batching import map_batches
from i2t.skin.contact import MAX_HEIGHT_M
from i2t.skin.elasticity import GRID, Grid
from i2t.skin_models import magnetic_layer as physics
from i2t.skin_models.magnetic_layer import LayerParameters
from i2t.skin_models.magnetization import LinearRegression, bayesian_linear_regression
from i2t.types import Board

# Thickness (m) and mount compliance (m/N).
LAYERS = [(thickness, compliance) for compliance in (1e-6, 0.25e-3) for thickness in (2.0e-3, 2.5e-3, 3.0e-3)]
LAYER_PRESSES = 48  # from which the layer is chosen
NOISE_LEVELS_UT = (3.0, 5.0)  # of a reading, with what the layer cannot say
MIN_RESIDUAL_STD_UT = 1.0
MIN_MEASURED_FORCE_N = 0.05  # where a noisy wrench sensor says less
HYSTERESIS_PRIOR_PRESSES = 8.0  # presses' worth of belief that a chip has none
CHUNK_PRESSES = 64
AXES_PER_CHIP = 3  # of a chip


@dataclass(frozen=True)
class StampTip:
    """A stamp that is already where it presses.

    Attributes:
        surface: (n, n) m behind its nearest point, over the cells of the pad.
    """

    surface: Array

    def height(self, position: Float[Array, "2"], grid: Grid = GRID) -> Float[Array, "n n"]:
        """Heights over the cells, whatever the position."""
        return self.surface


class StampPoses(NamedTuple):
    """Poses of n presses, as the arm knows them."""

    position: Float[np.ndarray, "n 2"]  # m, of the face's middle on the skin
    rotation: Float[np.ndarray, " n"]  # rad, about the skin's normal
    force: Float[np.ndarray, " n"]  # N


class FittedSkin(NamedTuple):
    """A fitted skin."""

    layer: int  # in `LAYERS`
    weights: Float[np.ndarray, " k"]
    covariance: Float[np.ndarray, "c c"]  # uT^2, of what is left of a reading
    residuals: Float[np.ndarray, "n c"]  # uT, of the presses it was fitted to, each as predicted from all others


def layer_of(thickness: float, mount_compliance: float, channels: int) -> LayerParameters:
    """The prior's median with a given thickness (m) and mount compliance (m/N), for a board of some channels."""
    median = physics.layer_prior(channels).median
    layer = median._replace(thickness=jnp.float32(thickness), mount_compliance=jnp.float32(mount_compliance))
    return jax.tree.map(jnp.float32, layer)


@partial(jax.jit, static_argnames=("grid",))
def stamp_features(
    layer: LayerParameters, board: Board, drawn: Stamp, which: Int[Array, " n"], poses: StampPoses, *, grid: Grid = GRID
) -> Float[Array, "n c k"]:
    """Readings (uT) of a press of each stamp `which` for each weight of the map, of prior variance 1."""

    def one(args: tuple) -> Array:
        index, position, rotation, force = args
        stamp = jax.tree.map(lambda leaf: leaf[index], drawn)
        face = heights(stamp, pose(position, rotation, stamp), PAD_WINDOW, grid.cells)[0]
        tip = StampTip(jnp.minimum(face - jnp.min(face), MAX_HEIGHT_M))
        force = jnp.maximum(force, MIN_MEASURED_FORCE_N)
        design = physics.design_matrix(layer, board, tip, jnp.zeros(2), force, by_force=True, grid=grid)
        return physics.weight_features(layer, design[None], PAD_WINDOW)[0]

    return map_batches(one, (which, *poses), batch_size=physics.DESIGN_BATCH)


@dataclass(frozen=True)
class StampFeatures:
    """Features of one skin's presses, each worked out when it is first asked for and kept."""

    board: Board
    names: Sequence[str]  # of the stamps
    poses: StampPoses
    shape: Int[np.ndarray, " n"]  # in `names`
    layers: int  # how many of `LAYERS` are tried
    grid: Grid = GRID
    _pressed: dict[tuple[int, int], np.ndarray] = field(default_factory=dict)
    _hypotheses: dict[int, np.ndarray] = field(default_factory=dict)

    @cached_property
    def _drawn(self) -> Stamp:
        return stamps(self.names)

    def pressed(self, layer: int, rows: np.ndarray) -> Float[np.ndarray, "n c k"]:
        """Features of what was pressed, on a layer of `LAYERS`."""
        missing = [row for row in rows if (layer, row) not in self._pressed]
        if missing:
            made = self._features(layer, self.shape[missing], StampPoses(*(leaf[missing] for leaf in self.poses)))
            self._pressed.update({(layer, row): features for row, features in zip(missing, made, strict=True)})
        return np.stack([self._pressed[layer, row] for row in rows])

    def hypotheses(self, layer: int) -> Float[np.ndarray, "n classes c k"]:
        """Features of every stamp in turn at every pose."""
        if layer not in self._hypotheses:
            n = len(self.poses.force)
            classes = len(self.names)
            each = StampPoses(*(np.repeat(leaf, classes, axis=0) for leaf in self.poses))
            made = self._features(layer, np.tile(np.arange(classes), n), each)
            self._hypotheses[layer] = made.reshape(n, classes, *made.shape[1:])
        return self._hypotheses[layer]

    def _features(self, layer: int, which: np.ndarray, poses: StampPoses) -> np.ndarray:
        parameters, parts = layer_of(*LAYERS[layer], self.board.num_readings), []
        for start in range(0, len(which), CHUNK_PRESSES):  # of one size, and so compiled once
            rows = np.minimum(np.arange(start, start + CHUNK_PRESSES), len(which) - 1)
            some = StampPoses(*(jnp.float32(leaf[rows]) for leaf in poses))
            made = stamp_features(parameters, self.board, self._drawn, jnp.int32(which[rows]), some, grid=self.grid)
            parts.append(np.asarray(made))
        return np.concatenate(parts)[: len(which)]

    def fit(self, rows: np.ndarray, readings: Float[np.ndarray, "n c"]) -> FittedSkin:
        """The skin from labelled presses `rows` and their readings (uT): the layer that best predicts each of (at most
        LAYER_PRESSES of) them from the others, and its map.
        """
        some = np.argsort(_PRIORITY[rows % len(_PRIORITY)], kind="stable")[
            :LAYER_PRESSES
        ]  # mostly the same in all folds
        scores = [_best_regression(self.pressed(layer, rows[some]), readings[some])[1] for layer in range(self.layers)]
        best = int(np.argmax(scores))
        features = self.hypotheses(best)[rows, self.shape[rows]]
        solved, _ = _best_regression(features, readings)
        left = np.asarray(readings - solved.leave_group_out, np.float64)
        # Shrunk towards its diagonal as by as many presses as there are values.
        raw, channels = left.T @ left, readings.shape[1]
        covariance = (raw + channels * np.diag(np.diag(raw)) / len(left)) / (len(left) + channels)
        return FittedSkin(best, solved.weights, covariance + MIN_RESIDUAL_STD_UT**2 * np.eye(channels), left)


def _best_regression(features: np.ndarray, readings: np.ndarray) -> tuple[LinearRegression, float]:
    """The regression of the noise level under which presses are most probable as predicted from all others."""
    tried = [bayesian_linear_regression(features, readings, noise) for noise in NOISE_LEVELS_UT]
    densities = [float(np.mean(one.log_density)) for one in tried]
    best = int(np.argmax(densities))
    return tried[best], densities[best]


_PRIORITY = np.random.default_rng(0).permutation(100_003)


def fit_hysteresis(
    residuals: Float[np.ndarray, "n c"],
    before: Float[np.ndarray, "n c"],
    session: Int[np.ndarray, " n"],
    sessions: Int[np.ndarray, " m"],
) -> Float[np.ndarray, "m c"]:
    """Share of the press before that each chip keeps in each session.

    Args:
        residuals: Of presses (uT).
        before: Readings of the presses before them (uT).
        session: In which each was.
        sessions: Sessions to report; one without presses has none.

    Returns:
        Shares by ridge regression of the residuals on the readings before.
    """
    chips = before.shape[1] // AXES_PER_CHIP
    kept = np.zeros((len(sessions), chips))
    power = np.maximum((before**2).reshape(-1, chips, AXES_PER_CHIP).sum(2).mean(0), 1e-9)
    for i, one in enumerate(sessions):
        x, y = (values[session == one].reshape(-1, chips, AXES_PER_CHIP) for values in (before, residuals))
        kept[i] = (x * y).sum((0, 2)) / ((x**2).sum((0, 2)) + HYSTERESIS_PRIOR_PRESSES * power)
    return np.repeat(kept, AXES_PER_CHIP, axis=1)


def predict_reading(skin: FittedSkin, features: Float[np.ndarray, "*n c k"]) -> Float[np.ndarray, "*n c"]:
    """The readings (uT) that a skin is expected to give."""
    return np.asarray(features @ np.asarray(skin.weights))


def log_likelihood(
    skin: FittedSkin, features: Float[np.ndarray, "n classes c k"], readings: Float[np.ndarray, "n c"]
) -> Float[np.ndarray, "n classes"]:
    """Log likelihood of the readings if each of the stamps had been pressed there, up to a constant."""
    error = readings[:, None] - predict_reading(skin, features)
    return -0.5 * np.einsum("nco,op,ncp->nc", error, np.linalg.inv(skin.covariance), error)
