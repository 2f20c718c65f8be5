"""The compared methods: each predicts readings at rows of a recording from other rows, all alike from outside."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from experiments.calibrate.data import PressRecording
from i2t.calibration import (
    DEPTH_HYPERPARAMETERS,
    FORCE_HYPERPARAMETERS,
    StructuredGPHyperparameters,
    baseline_network,
    calibrate,
    lattice,
    plain_gp,
    structured_gp,
)
from i2t.calibration.baseline_network import PressFeatures
from i2t.calibration.structured_gp import StructuredGP
from i2t.prediction.metrics import nearest_neighbours, tuned

NEIGHBOURS, PLAIN = "k nearest presses", "plain Gaussian process"
STRUCTURED, HEIGHT = "structured GP", "structured GP + height"
SELECTED = "structured GP + height, scales by cross-validation"
PERIOD = "structured GP + height, period given"
SCRATCH, PRETRAINED = "network from scratch", "network pretrained on generated skins"
RESIDUAL = "pretrained network + structured GP"
MEAN, CALIBRATED = "mean of the presses", "i2t.calibrate"
PREVIOUS_MEAN, PREVIOUS_ALONE = "earlier half as the mean", "earlier half alone"

MAX_SELECTION_PRESSES = 300  # that hyperparameters are chosen on: the cost grows with the cube
FOLDS = 5  # of cross-validation
LEAST_UNIT_LOAD = 1e-6  # m or N, where all loads are nil
SCALES = {"map_length": (0.7, 1.0, 1.4), "bend_variance": (0.3, 1.0, 3.0), "noise_variance": (0.3, 1.0, 3.0)}
RESIDUAL_NOISE = {"noise_variance": (1.0, 10.0, 100.0, 1e4)}  # what a previous session leaves is mostly noise
PRETRAINING_PRESSES = 125  # of each generated skin

Predict: TypeAlias = Callable[[np.ndarray, np.ndarray], np.ndarray]  # (known rows, test rows) -> (n, c) uT

fit, predict = jax.jit(structured_gp.fit), jax.jit(structured_gp.predict)
interval_scaling = jax.jit(structured_gp.interval_scaling)
_select, _predict_network = jax.jit(structured_gp.select_hyperparameters), jax.jit(baseline_network.predict)


@dataclass(frozen=True)
class Predictors:
    """The methods on one recording."""

    recording: PressRecording
    lattice_period: float = 0.0  # m; 0: none is known
    scratch_steps: int = 500
    pretrained_features: np.ndarray | None = None  # (n, k) of all rows
    log_noise: float = 0.0  # of the pretrained network

    @property
    def hyperparameters(self) -> StructuredGPHyperparameters:
        """Hyperparameters of the structured GP."""
        return FORCE_HYPERPARAMETERS if self.recording.by_force else DEPTH_HYPERPARAMETERS

    def by_name(self) -> dict[str, Predict]:
        """All methods by name."""
        methods: dict[str, Predict] = {
            MEAN: self.mean,
            NEIGHBOURS: partial(neighbours, self.recording),
            PLAIN: self.plain,
            CALIBRATED: self.calibrated,
            SCRATCH: self.scratch,
            STRUCTURED: partial(self.structured, height_std=0.0),
            HEIGHT: self.structured,
            SELECTED: self.selected,
        }
        if self.lattice_period:
            methods[PERIOD] = partial(self.structured, lattice_period=self.lattice_period)
        if self.pretrained_features is not None:
            methods |= {PRETRAINED: self.pretrained, RESIDUAL: self.residual}
        return methods

    def gp(self, hyperparameters: StructuredGPHyperparameters, rows: np.ndarray, target: np.ndarray) -> StructuredGP:
        """A structured GP of the target (n, c) uT at rows."""
        return fit(hyperparameters, self.recording.presses(rows), jnp.float32(target), self.recording.chips)

    def gp_mean(
        self, hyperparameters: StructuredGPHyperparameters, rows: np.ndarray, target: np.ndarray, test: np.ndarray
    ) -> np.ndarray:
        """Predictions of a structured GP of the target at rows."""
        return np.asarray(predict(self.gp(hyperparameters, rows, target), self.recording.presses(test))[0], np.float64)

    def structured(self, rows: np.ndarray, test: np.ndarray, **changed: float) -> np.ndarray:
        """The structured GP with heights; `changed` are hyperparameters."""
        return self.gp_mean(self.hyperparameters._replace(**changed), rows, self.recording.readings[rows], test)

    def plain(self, rows: np.ndarray, test: np.ndarray) -> np.ndarray:
        """A Gaussian process over position and load, its scales fitted to the rows."""
        position, load = self.recording.position, self.recording.load
        known = position[rows], load[rows], self.recording.readings[rows]
        return plain_gp.predict_plain(plain_gp.fit_scales(*known), known, (position[test], load[test]))

    def mean(self, rows: np.ndarray, test: np.ndarray) -> np.ndarray:
        """The mean of the rows, wherever and however hard is pressed."""
        return np.tile(self.recording.readings[rows].mean(0), (len(test), 1))

    def calibrated(self, rows: np.ndarray, test: np.ndarray) -> np.ndarray:
        """Predictions of `i2t.calibrate`."""
        recording = self.recording
        known = recording.position[rows], recording.load[rows], recording.readings[rows]
        calibration = calibrate(*known, load_kind=recording.load_kind, board=recording.own_board)
        return calibration.predict(recording.position[test], recording.load[test])[0]

    def selected(self, rows: np.ndarray, test: np.ndarray) -> np.ndarray:
        """The structured GP, its scales by cross-validation."""
        readings = self.recording.readings[rows]
        candidates = structured_gp.hyperparameter_grid(self.hyperparameters, SCALES)
        return self.gp_mean(select(candidates, self.recording, rows, readings), rows, readings, test)

    def pretrained(self, rows: np.ndarray, test: np.ndarray) -> np.ndarray:
        """The pretrained network with a head fitted as by `fit_head`; NumPy, so that no number of rows compiles."""
        assert self.pretrained_features is not None
        phi, readings = self.pretrained_features[rows], self.recording.readings[rows]
        scale, noise = np.sqrt(np.mean(readings**2)) + 1e-6, np.exp(self.log_noise) + 1e-4
        weights = np.linalg.solve(phi.T @ phi / noise + np.eye(phi.shape[1]), phi.T @ readings / (noise * scale))
        return self.pretrained_features[test] @ weights * scale

    def residual(self, rows: np.ndarray, test: np.ndarray) -> np.ndarray:
        """The pretrained network, and a structured GP of what it leaves of rows that its head was not fitted to."""
        left = self.recording.readings[rows] - cross_predict(self.pretrained, rows)
        return self.pretrained(rows, test) + self.gp_mean(
            self.hyperparameters._replace(height_std=0.0), rows, left, test
        )

    def scratch(self, rows: np.ndarray, test: np.ndarray) -> np.ndarray:
        """The same network, trained on the rows alone."""
        network, head = baseline_network.train_from_scratch(
            jax.random.key(0),
            self.recording.presses(rows),
            jnp.float32(self.recording.readings[rows]),
            max_position=jnp.float32(np.abs(self.recording.position).max()),
            unit_load=jnp.float32(max(self.recording.load.max(), LEAST_UNIT_LOAD)),
            steps=self.scratch_steps,
        )
        return np.asarray(_predict_network(network, head, self.recording.presses(test))[0], np.float64)

    def with_network(self, network: PressFeatures) -> "Predictors":
        """These methods with a pretrained network."""
        rows = np.arange(len(self.recording.load))
        features = np.asarray(baseline_network.features(network, self.recording.presses(rows)), np.float64)
        return replace(self, pretrained_features=features, log_noise=float(network.log_noise))


def pretrain_network(recording: PressRecording, skins: int, steps: int) -> PressFeatures:
    """A network pretrained on generated skins of four magnets, over the positions and depths of a recording."""
    half_edge, max_depth = float(np.abs(recording.position).max()), float(recording.load.max())
    sample = jax.jit(
        lambda key: lattice.sample_skins(key, skins, PRETRAINING_PRESSES, half_edge=half_edge, max_depth=max_depth)
    )
    return baseline_network.pretrain(jax.random.key(1), *sample(jax.random.key(0)), steps=steps)[0]


def neighbours(recording: PressRecording, rows: np.ndarray, test: np.ndarray) -> np.ndarray:
    """k nearest presses in position and load, k by cross-validation."""

    def mean(x: np.ndarray, y: np.ndarray, at: np.ndarray, k: float) -> np.ndarray:
        return nearest_neighbours(x, y, at, int(k))

    x, at = recording.features(rows), recording.features(test)
    return tuned(mean, (1.0, 2.0, 3.0, 4.0, 6.0, 8.0), x, recording.readings[rows], np.arange(len(rows)), at=at)


def select(
    candidates: StructuredGPHyperparameters, recording: PressRecording, rows: np.ndarray, target: np.ndarray
) -> StructuredGPHyperparameters:
    """Hyperparameters by cross-validation on at most MAX_SELECTION_PRESSES of the rows, which come in random order."""
    some = slice(MAX_SELECTION_PRESSES)
    return _select(candidates, recording.presses(rows[some]), jnp.float32(target[some]), recording.chips)


def cross_predict(method: Predict, rows: np.ndarray) -> np.ndarray:
    """Readings (n, c) uT of rows, which come in random order, each fifth of them predicted from the others."""
    fold = np.arange(len(rows)) % min(FOLDS, len(rows))
    parts = {i: method(rows[fold != i], rows[fold == i]) for i in range(fold.max() + 1)}
    predicted = np.empty((len(rows), parts[0].shape[1]))
    for i, part in parts.items():
        predicted[fold == i] = part
    return predicted
