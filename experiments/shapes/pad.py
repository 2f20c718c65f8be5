"""Fit of a skin to labelled presses of stamps, and prediction of each stamp's reading at measured poses.

For a known stamp, position, rotation and force, the pressure depends only on the layer, and the reading is linear in
the skin's magnetization. The map is fitted by Bayesian linear regression as in `i2t.skin_models.magnetization`. Of the
nonlinear parameters, only thickness and mount compliance are fitted, by the leave-one-out density of presses on a grid
of layers. The covariance of the residuals accounts for noise, tilt of the stamp and errors of the layer model. The
hysteresis of a chip comes from a regression of a session's residuals on the previous readings.
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
from i2t.skin.boards import AXES_OF_CHIP
from i2t.skin.contact import MAX_HEIGHT_M
from i2t.skin.elasticity import GRID, Grid
from i2t.skin_models import magnetic_layer as physics
from i2t.skin_models.magnetic_layer import LayerParameters
from i2t.skin_models.magnetization import LinearRegression, bayesian_linear_regression
from i2t.types import Board

# Thickness (m) and mount compliance (m/N) of the layers on the grid.
LAYERS = [(thickness, compliance) for compliance in (1e-6, 0.25e-3) for thickness in (2.0e-3, 2.5e-3, 3.0e-3)]


@dataclass(frozen=True)
class StampTip:
    """A stamp at its final position.

    Attributes:
        surface: Distance behind its nearest point at the cells of the pad, `(n, n)`, m.
    """

    surface: Array

    def height(self, position: Float[Array, "2"], grid: Grid = GRID) -> Float[Array, "n n"]:
        """Return the heights at the cells, which do not depend on the position."""
        return self.surface


class StampPoses(NamedTuple):
    """Measured poses and forces of n presses."""

    position: Float[np.ndarray, "n 2"]  # m, centre of the face on the skin
    rotation: Float[np.ndarray, " n"]  # rad, about the skin's normal
    force: Float[np.ndarray, " n"]  # N


class FittedSkin(NamedTuple):
    """A fitted skin."""

    layer: int  # index in `LAYERS`
    weights: Float[np.ndarray, " k"]
    covariance: Float[np.ndarray, "c c"]  # uT^2, of the residuals
    residuals: Float[np.ndarray, "n c"]  # uT, leave-one-out residuals of the training presses


def layer_of(thickness: float, mount_compliance: float, channels: int) -> LayerParameters:
    """Take the prior's median for a board, with a given thickness (m) and mount compliance (m/N)."""
    median = physics.layer_prior(channels).median
    layer = median._replace(thickness=jnp.float32(thickness), mount_compliance=jnp.float32(mount_compliance))
    return jax.tree.map(jnp.float32, layer)


@partial(jax.jit, static_argnames=("grid",))
def stamp_features(
    layer: LayerParameters, board: Board, drawn: Stamp, which: Int[Array, " n"], poses: StampPoses, *, grid: Grid = GRID
) -> Float[Array, "n c k"]:
    """Compute the reading (uT) per weight of the map, of prior variance 1, for a press of each stamp `which`."""

    def press(args: tuple) -> Array:
        index, position, rotation, force = args
        stamp = jax.tree.map(lambda leaf: leaf[index], drawn)
        face = heights(stamp, pose(position, rotation, stamp), PAD_WINDOW, grid.cells)[0]
        tip = StampTip(jnp.minimum(face - jnp.min(face), MAX_HEIGHT_M))
        force = jnp.maximum(force, 0.05)  # a noisy wrench sensor may measure less
        design = physics.design_matrix(layer, board, tip, jnp.zeros(2), force, by_force=True, grid=grid)
        return physics.weight_features(layer, design[None], PAD_WINDOW)[0]

    return map_batches(press, (which, *poses), batch_size=physics.DESIGN_BATCH)


@dataclass(frozen=True)
class StampFeatures:
    """Features of one skin's presses, computed at first use and cached."""

    board: Board
    names: Sequence[str]  # names of the stamps
    poses: StampPoses
    shape: Int[np.ndarray, " n"]  # index in `names`
    layers: int  # number of `LAYERS` that are tried
    grid: Grid = GRID
    _pressed: dict[tuple[int, int], np.ndarray] = field(default_factory=dict)
    _hypotheses: dict[int, np.ndarray] = field(default_factory=dict)

    @cached_property
    def _drawn(self) -> Stamp:
        return stamps(self.names)

    def pressed(self, layer: int, rows: np.ndarray) -> Float[np.ndarray, "n c k"]:
        """Compute the features of the pressed stamps, for a layer of `LAYERS`."""
        missing = [row for row in rows if (layer, row) not in self._pressed]
        if missing:
            new = self._features(layer, self.shape[missing], StampPoses(*(leaf[missing] for leaf in self.poses)))
            self._pressed.update({(layer, row): features for row, features in zip(missing, new, strict=True)})
        return np.stack([self._pressed[layer, row] for row in rows])

    def hypotheses(self, layer: int) -> Float[np.ndarray, "n classes c k"]:
        """Compute the features of every stamp at every pose."""
        if layer not in self._hypotheses:
            n = len(self.poses.force)
            classes = len(self.names)
            poses = StampPoses(*(np.repeat(leaf, classes, axis=0) for leaf in self.poses))
            features = self._features(layer, np.tile(np.arange(classes), n), poses)
            self._hypotheses[layer] = features.reshape(n, classes, *features.shape[1:])
        return self._hypotheses[layer]

    def _features(self, layer: int, which: np.ndarray, poses: StampPoses, chunk: int = 64) -> np.ndarray:
        parameters, parts = layer_of(*LAYERS[layer], self.board.num_readings), []
        for start in range(0, len(which), chunk):  # chunks of one size are compiled once
            rows = np.minimum(np.arange(start, start + chunk), len(which) - 1)
            own = StampPoses(*(jnp.float32(leaf[rows]) for leaf in poses))
            stamp = jnp.int32(which[rows])
            parts.append(np.asarray(stamp_features(parameters, self.board, self._drawn, stamp, own, grid=self.grid)))
        return np.concatenate(parts)[: len(which)]

    def fit(
        self, rows: np.ndarray, readings: Float[np.ndarray, "n c"], *, layer_presses: int = 48, min_std: float = 1.0
    ) -> FittedSkin:
        """Fit a skin to labelled presses `rows` and their readings (uT): the layer with the best leave-one-out
        predictions of at most `layer_presses` presses, and its map. `min_std` (uT) is added to the residuals.
        """
        # The order is mostly the same in all folds.
        some = np.argsort(_PRIORITY[rows % len(_PRIORITY)], kind="stable")[:layer_presses]
        scores = [_best_regression(self.pressed(layer, rows[some]), readings[some])[1] for layer in range(self.layers)]
        best = int(np.argmax(scores))
        features = self.hypotheses(best)[rows, self.shape[rows]]
        solved, _ = _best_regression(features, readings)
        left = np.asarray(readings - solved.leave_group_out, np.float64)
        # Shrinkage towards the diagonal has the weight of as many presses as there are channels.
        raw, channels = left.T @ left, readings.shape[1]
        covariance = (raw + channels * np.diag(np.diag(raw)) / len(left)) / (len(left) + channels)
        return FittedSkin(best, solved.weights, covariance + min_std**2 * np.eye(channels), left)


def _best_regression(
    features: np.ndarray, readings: np.ndarray, noise_levels: Sequence[float] = (3.0, 5.0)
) -> tuple[LinearRegression, float]:
    """Choose the noise level (uT) with the best leave-one-out density. Returns the regression and the density."""
    regressions = [bayesian_linear_regression(features, readings, noise) for noise in noise_levels]
    densities = [float(np.mean(regression.log_density)) for regression in regressions]
    best = int(np.argmax(densities))
    return regressions[best], densities[best]


_PRIORITY = np.random.default_rng(0).permutation(100_003)


def fit_hysteresis(
    residuals: Float[np.ndarray, "n c"],
    before: Float[np.ndarray, "n c"],
    session: Int[np.ndarray, " n"],
    sessions: Int[np.ndarray, " m"],
    *,
    prior_presses: float = 8.0,
) -> Float[np.ndarray, "m c"]:
    """Estimate the share of the previous press that remains in each chip in each session.

    Args:
        residuals: Residuals of the presses, uT.
        before: Readings of the previous presses, uT.
        session: Session of each press.
        sessions: Sessions to report. A session without presses has a share of 0.
        prior_presses: Weight of the prior of no hysteresis, in presses.

    Returns:
        Shares `(m, c)` by ridge regression of the residuals on the previous readings.
    """
    chips = before.shape[1] // AXES_OF_CHIP
    kept = np.zeros((len(sessions), chips))
    power = np.maximum((before**2).reshape(-1, chips, AXES_OF_CHIP).sum(2).mean(0), 1e-9)
    for i, number in enumerate(sessions):
        x, y = (values[session == number].reshape(-1, chips, AXES_OF_CHIP) for values in (before, residuals))
        kept[i] = (x * y).sum((0, 2)) / ((x**2).sum((0, 2)) + prior_presses * power)
    return np.repeat(kept, AXES_OF_CHIP, axis=1)


def predict_reading(skin: FittedSkin, features: Float[np.ndarray, "*n c k"]) -> Float[np.ndarray, "*n c"]:
    """Predict the readings (uT) of a skin."""
    return np.asarray(features @ np.asarray(skin.weights))


def log_likelihood(
    skin: FittedSkin, features: Float[np.ndarray, "n classes c k"], readings: Float[np.ndarray, "n c"]
) -> Float[np.ndarray, "n classes"]:
    """Compute the log likelihood of the readings for each stamp, up to a constant."""
    error = readings[:, None] - predict_reading(skin, features)
    return -0.5 * np.einsum("nco,op,ncp->nc", error, np.linalg.inv(skin.covariance), error)
