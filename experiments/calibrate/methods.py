"""The compared methods: each predicts readings at rows of a recording from other rows, all alike from outside."""

from collections.abc import Callable, Mapping
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
    lattice,
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
RESIDUAL, BEST = "pretrained network + structured GP", "best method by cross-validation"
PREVIOUS_MEAN, PREVIOUS_ALONE = "earlier half as the mean", "earlier half alone"

MAX_SELECTION_PRESSES = 300  # that hyperparameters are chosen on: the cost grows with the cube
FOLDS = 5
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
        """Those of the structured GP."""
        return FORCE_HYPERPARAMETERS if self.recording.by_force else DEPTH_HYPERPARAMETERS

    def by_name(self) -> dict[str, Predict]:
        """All of them."""
        methods: dict[str, Predict] = {
            NEIGHBOURS: partial(neighbours, self.recording),
            PLAIN: self.plain,
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
        """What a structured GP of the target at rows predicts."""
        return np.asarray(predict(self.gp(hyperparameters, rows, target), self.recording.presses(test))[0], np.float64)

    def structured(self, rows: np.ndarray, test: np.ndarray, **changed: float) -> np.ndarray:
        """The structured GP with heights; `changed` are hyperparameters."""
        return self.gp_mean(self.hyperparameters._replace(**changed), rows, self.recording.readings[rows], test)

    def plain(self, rows: np.ndarray, test: np.ndarray) -> np.ndarray:
        """A Gaussian process over position and load, its scales by cross-validation."""
        readings = self.recording.readings[rows]
        bare = Predictors(replace(self.recording, chip_positions=None))
        centred = readings - readings.mean(0)
        hyperparameters = select(plain_candidates(self.recording), bare.recording, rows, centred)
        return readings.mean(0) + bare.gp_mean(hyperparameters, rows, centred, test)

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
            unit_load=jnp.float32(self.recording.load.max()),
            steps=self.scratch_steps,
        )
        return np.asarray(_predict_network(network, head, self.recording.presses(test))[0], np.float64)

    def with_network(self, network: PressFeatures) -> "Predictors":
        """The same with a pretrained network."""
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


def plain_candidates(recording: PressRecording) -> StructuredGPHyperparameters:
    """The plain process, squared exponential over position and load: nothing but the bent part, without growth."""
    load = float(recording.load.std())
    plain = StructuredGPHyperparameters(
        unit_load=load, load_offset=0.0, load_power=0.0, map_length=8e-3, map_variance=0.0, bend_variance=1.0,
        bend_length=8e-3, bend_load_width=2 * load, static_variance=0.0, constant_variance=0.0, noise_variance=1e-2,
        height_std=0.0, height_length=2e-3, chip_reach=1.0, far_amplitude=1.0,
    )  # fmt: skip
    return structured_gp.hyperparameter_grid(
        plain,
        {
            "bend_length": (0.5, 0.75, 1.0, 1.5),
            "bend_load_width": (0.5, 1.0, 2.0),
            "noise_variance": (0.1, 1.0),
        },
    )


def cross_predict(method: Predict, rows: np.ndarray) -> np.ndarray:
    """Readings (n, c) uT of rows, each fifth predicted from the others."""
    fold = np.arange(len(rows)) % min(FOLDS, len(rows))
    parts = {i: method(rows[fold != i], rows[fold == i]) for i in range(fold.max() + 1)}
    predicted = np.empty((len(rows), parts[0].shape[1]))
    for i, part in parts.items():
        predicted[fold == i] = part
    return predicted


def select_method(methods: Mapping[str, Predict], recording: PressRecording, rows: np.ndarray) -> str:
    """The method with the least error on fifths of at most MAX_SELECTION_PRESSES of the rows.

    It is the structured GP with heights unless another is better by one standard error over presses.
    """
    rows = rows[:MAX_SELECTION_PRESSES]
    errors = {
        name: ((recording.readings[rows] - cross_predict(methods[name], rows)) ** 2).sum(1)
        for name in (HEIGHT, PRETRAINED, RESIDUAL, PERIOD)
        if name in methods
    }
    gain = {name: errors[HEIGHT] - error for name, error in errors.items()}
    sure = {name: g.mean() for name, g in gain.items() if g.mean() > g.std() / np.sqrt(max(len(g) - 1, 1))}
    return max(sure, key=lambda name: sure[name]) if sure else HEIGHT
