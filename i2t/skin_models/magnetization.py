"""Pad fitted to a few presses with a known tip: its magnetization map, and the few parameters of the layer.

For a known displacement the reading is linear in the magnetization (`i2t.skin.dipoles`), so presses give a linear
system for the map, reading = Phi w + noise. The map is a series of cosines on the pad with the covariance of
`i2t.skin.pad.smooth_random`. It has a few hundred weights w, normal with variance 1, whose posterior is that of
Bayesian linear regression (Bishop, "Pattern Recognition and Machine Learning", section 3.3).

`i2t.skin_models.layer_fit` fits the other parameters, in which the reading is nonlinear, with the weights integrated
out. Derivatives of the readings run forward through the contact and the design matrices.

If a press is left out alone, other presses at its place stay. The errors at places left out therefore measure how well
a pad predicts where it was not pressed.

Metres, newtons, pascals, microtesla. `c` is the number of channels, three for each chip of the board; `m` is the number
of cosines along an edge, `k` the number of weights.
"""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

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
from i2t.leave_one_out import leave_out_blocks
from i2t.runtime.batching import map_batches
from i2t.skin.dipoles import response
from i2t.skin.elasticity import CELL_GRID, GRID, Grid
from i2t.skin.files import KIND as FILE_KIND
from i2t.skin.files import load_pad
from i2t.skin_models.base import load_fitted
from i2t.skin_models.layer_fit import NO_PAD, LayerPosterior, fit_layer, ranges
from i2t.skin_models.magnetic_layer import (
    DESIGN_BATCH,
    LayerParameters,
    LayerPrior,
    RoundTip,
    design_matrices,
    layer_prior,
    magnetization_map,
    make_pad,
    parameters_at,
    weight_features,
)
from i2t.types import Board, Pad, in_one_line


class LinearRegression(NamedTuple):
    """Posterior mean of a map's weights, and readings and log densities of presses, predicted from all other groups."""

    weights: Float[np.ndarray, " k"]  # posterior mean of the weights
    leave_group_out: Float[np.ndarray, "n c"]  # uT, prediction of each press from all other groups
    log_density: Float[np.ndarray, " groups"]  # log density of each group, predicted from all other groups


def bayesian_linear_regression(
    features: Float[Any, "n c k"],
    readings: Float[Any, "n c"],
    noise_std: float,
    *,
    group: Int[np.ndarray, " n"] | None = None,
) -> LinearRegression:
    """Regress readings on weights of prior variance 1, and leave out groups of presses, in closed form.

    Args:
        features: `(n, c, k)` readings of n presses for each of k weights.
        readings: `(n, c)` readings of the presses, in the features' unit.
        noise_std: Standard deviation of a reading's noise, in the same unit.
        group: `(n,)` number of each press's group, from 0; by default each press is a group of its own.

    Returns:
        Posterior mean of the weights, and the reading of each press (in the features' unit) and the log density of each
        group as predicted from all other groups.
    """
    n, channels, k = features.shape
    rows = np.asarray(features, np.float64).reshape(-1, k) / noise_std
    values = np.asarray(readings, np.float64).reshape(-1) / noise_std
    factor = linalg.cholesky(rows.T @ rows + np.eye(k), lower=True)
    weights = linalg.cho_solve((factor, True), rows.T @ values)
    half = linalg.solve_triangular(factor, rows.T, lower=True).T.reshape(n, channels, k)
    error = (values - rows @ weights).reshape(n, channels)
    group = np.arange(n) if group is None else group
    sizes, errors = np.bincount(group), np.empty((n, channels))
    log_density = np.empty(len(sizes))
    for size in np.unique(sizes):
        some = np.flatnonzero(sizes == size)
        presses = np.stack([np.flatnonzero(group == number) for number in some])
        # In units of the noise the precision of a group's readings is I - H, where H is its part of the hat matrix.
        part = half[presses].reshape(len(some), size * channels, k)
        precision = np.eye(size * channels) - part @ part.swapaxes(1, 2)
        blocks = leave_out_blocks(precision, error[presses].reshape(len(some), -1, 1))
        errors[presses] = blocks.error.reshape(len(some), size, channels)
        log_density[some] = blocks.log_density[:, 0] - size * channels * np.log(noise_std)
    return LinearRegression(weights, np.asarray(readings, np.float64) - noise_std * errors, log_density)


@in_one_line
class PadFit(NamedTuple):
    """Pad fitted to presses, with the 95 % ranges of its parameters and its leave-one-out errors."""

    pad: Pad
    posterior: LayerPosterior
    leave_one_out: Float[np.ndarray, "n c"]  # uT, measured minus predicted from all other presses
    leave_one_place_out: Float[np.ndarray, "n c"]  # uT, measured minus predicted from the presses at all other places

    def predict(self, contact: ContactPressure) -> tuple[Float[Array, "m c"], Float[np.ndarray, "m c"]]:
        """Predict the readings of contacts by simulating the fitted pad.

        Args:
            contact: m contact pressures of this pad on cells of 1 mm (`predict_pressures` with `pad`).

        Returns:
            `(m, c)` readings (uT), and `(m, c)` root mean square errors (uT) of each channel at left-out places.
        """
        std = np.sqrt(np.mean(np.asarray(self.leave_one_place_out, np.float64) ** 2, axis=0))
        return _simulate_readings(self.pad, contact), np.broadcast_to(std, (len(contact.load), len(std)))

    def save(self, path: Path | str, about: dict[str, Any] | None = None) -> None:
        """Write the fitted pad to one file, which `i2t.load_pad` reads as well.

        Args:
            path: Path of the file; `.npz` by convention.
            about: Data to be saved with the pad, such as its skin and its fit, in types that JSON can hold.

        Raises:
            SerializationError: The file cannot be written.
        """
        serialization.save(path, FILE_KIND, self.pad, about, extra=_FitRecord(*self[1:]))


class _FitRecord(NamedTuple):
    """Fields of a fitted pad's file besides the pad's, by their names there; all are None for a pad saved alone."""

    posterior: LayerPosterior | None
    left_out: np.ndarray | None
    left_out_places: np.ndarray | None


def load_pad_fit(path: Path | str) -> PadFit:
    """Read a fitted pad with its errors from its file.

    Args:
        path: Path of a file that `PadFit.save` wrote.

    Returns:
        The pad, the ranges of its parameters and its errors.

    Raises:
        SerializationError: The file is missing, damaged, of another kind or of an earlier version, or holds a pad
            alone, which `i2t.load_pad` reads.
    """

    def build(path: Path | str, record: _FitRecord, about: dict[str, Any]) -> PadFit:
        if record.posterior is None or record.left_out is None or record.left_out_places is None:
            raise SerializationError(f"{path}: holds a pad without its fit; read it with i2t.load_pad, or fit it again")
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
    """n presses of one tip in random order: positions (m), loads (m of travel or N), readings (uT), and the board."""

    position: Float[Array, "n 2"]  # m, position of each press in the tool frame
    load: Float[Array, " n"]  # load of each press: travel in m, or normal force in N
    reading: Float[Array, "n c"]  # uT
    board: Board


@dataclass(frozen=True)
class MagnetizationModel:
    """Options for fitting a pad, its elastic layer and magnetization map, to presses with a known tip.

    Attributes:
        tip: The pressing tip; hashable.
        by_force: Whether the loads are forces.
        grid: Cells of the pad.
        max_layer_presses: Maximum number of presses, the first ones, to which the layer's parameters are fitted; they
            need no more, and the map uses all. With 0 the layer stays at the median of its prior.
    """

    tip: RoundTip
    by_force: bool
    grid: Grid = GRID
    max_layer_presses: int = 48

    def fit(self, key: Key[Array, ""] | None, data: TipReadings) -> PadFit:
        """Fit a pad to presses: first the layer, then the map for that layer.

        Args:
            key: Ignored, because the fit draws nothing.
            data: The presses, in random order.

        Returns:
            The pad, the layer's parameters with their ranges, and the errors of presses and of places left out.
            Warnings report presses whose derivatives are not finite, which the layer's fit ignores, and a fit that did
            not converge.

        Raises:
            ValueError: A press or the result of the fit is not finite.
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
        fitted = PadFit(pad, posterior, *(readings - values.leave_group_out for values in (solved, by_place)))
        if not all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(fitted)):
            raise ValueError(NO_PAD)
        return fitted

    def fit_layer(self, data: TipReadings) -> LayerPosterior:
        """Fit the parameters of the pad's elastic layer.

        Args:
            data: The presses, in random order.

        Returns:
            The most probable parameters and their ranges.

        Raises:
            ValueError: The search cannot begin.
        """
        prior = layer_prior(data.reading.shape[1])
        first = min(self.max_layer_presses, len(data.load))
        if not first:
            zero = np.zeros(len(ravel_pytree(prior.median)[0]))
            return LayerPosterior(prior.median, *ranges(zero, np.ones(len(zero)), prior), converged=True)
        some = TipReadings(data.position[:first], data.load[:first], data.reading[:first], data.board)
        options = {"tip": self.tip, "by_force": self.by_force, "grid": self.grid}
        return fit_layer(
            partial(_unit_features, prior=prior, pressed=some, **options),
            np.asarray(some.reading),
            prior,
        )


def _check_finite(pressed: TipReadings) -> None:
    """Raise ValueError if a position, load or reading is not finite."""
    for name in ("position", "load", "reading"):
        values = np.asarray(getattr(pressed, name))
        wrong = ~np.isfinite(values).reshape(len(values), -1).all(1)
        if wrong.any():
            first = np.argmax(wrong)
            raise ValueError(
                f"{wrong.sum()} presses have {name}s that are not finite, the first in row {first}; drop them"
            )


@partial(jax.jit, static_argnames=("tip", "by_force", "grid"))
def _unit_features(
    coordinates: LayerParameters, *, prior: LayerPrior, pressed: TipReadings, tip: RoundTip, by_force: bool, grid: Grid
) -> Float[Array, "n c k"]:
    """Compute the readings of weights on a layer whose map has strength 1."""
    layer = _of_unit_strength(parameters_at(coordinates, prior))
    designs = design_matrices(layer, pressed.board, tip, pressed.position, pressed.load, by_force=by_force, grid=grid)
    return weight_features(layer, designs, grid.window)


def _of_unit_strength(layer: LayerParameters) -> LayerParameters:
    return layer._replace(patch_strength=jnp.ones(3), uniform_strength=jnp.asarray(1.0))
