"""The predictors that `experiments.train` compares, each fitted to the training touches of a data set."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from experiments.train.configs import TrainExperiment
from experiments.train.loads import ALIKE_FORCE_N, PressLoad
from experiments.train.splitting import Split
from i2t.dataset import Dataset
from i2t.prediction import baselines, checkpoint, gp, training
from i2t.prediction.gp import GP, ContactPressure
from i2t.prediction.model import Inputs, ModelConfig
from i2t.prediction.predictor import BaselineModel, Model, TouchBatch, TrainedNetwork, predict_pressures
from i2t.prediction.pressure import PressureModelConfig
from i2t.prediction.training import Batch
from i2t.progress import progress
from i2t.types import Touches

NOISY_CURVATURE_M = 20e-6  # median second difference of pixels that a surface without noise stays below
LARGE_WINDOW_M = 25e-3  # from here on the skin is taken to be as large as the window, and cells are coarser


def pressure_model_of(dataset: Dataset, load: PressLoad, cfg: TrainExperiment) -> PressureModelConfig | None:
    """How contact pressure is predicted on this set: from its load, and from views that are smoothed where they are
    noisy; None where nothing says how hard touches were pressed.
    """
    if load.control is None:
        return None
    patches = dataset.touches.patch
    curvature = patches[:, 2:] - 2 * patches[:, 1:-1] + patches[:, :-2]
    noisy = float(np.median(np.abs(curvature))) > NOISY_CURVATURE_M
    large = dataset.window > LARGE_WINDOW_M
    return PressureModelConfig(
        pitch=dataset.window / patches.shape[1],
        window=round(dataset.window * 500) / 500 if large else PressureModelConfig.window,
        smooth=noisy,
        tilt=cfg.hidden_tilt if noisy else 0.0,
        control=load.control,
        force_sign=load.force_sign,
        softness=cfg.softness,
        cell=1e-3 if large else PressureModelConfig.cell,
    )


def views_of(dataset: Dataset) -> np.ndarray:
    """Wide views (n, w, w) m where they were recorded, else patches."""
    wide = dataset.touches.wide
    centre = wide.shape[-1] // 2
    return dataset.touches.patch if np.isnan(wide[:, centre, centre]).any() else wide


def touch_batch(dataset: Dataset, rows: np.ndarray, pressure: ContactPressure | None) -> TouchBatch:
    """The touches in `rows` (a mask), whose contact pressures may have been predicted before, as predictors take
    them.
    """
    touches = dataset.touches
    which = np.flatnonzero(rows)
    return TouchBatch(
        patch=touches.patch[rows],
        view=views_of(dataset)[rows],
        pitch=dataset.window / touches.patch.shape[1],
        force=touches.force[rows],
        nearest=touches.nearest[rows],
        depth=touches.depth[rows],
        pressure=None if pressure is None else ContactPressure(pressure.pressure[which], pressure.load[which]),
    )


def median_conditions(touches: Touches, rows: np.ndarray) -> tuple[float, float]:
    """Median force (N) and depth (m) of the touches in `rows`, which stand in for what a user does not measure; 1 N and
    0.3 mm where they were not measured.
    """

    def median(values: np.ndarray, default: float) -> float:
        known = values[np.isfinite(values)]
        return float(np.median(known)) if len(known) else default

    return median(touches.force[rows], ALIKE_FORCE_N), median(touches.depth[rows], 0.3e-3)


def fit_baseline_models(dataset: Dataset, split: Split, measured: tuple[str, ...]) -> dict[str, Model]:
    """Mean reading, nearest patches and ridge regression of the training touches, without and with what was measured
    at all of them.
    """
    touches, rows = dataset.touches, split.train
    values = [getattr(touches, name)[rows] for name in measured]
    stacked = np.stack(values, -1) if values else np.zeros((int(rows.sum()), 0))
    fitted = baselines.fit_baselines(touches.patch[rows], stacked, touches.reading[rows], split.groups[rows])
    return {
        name: BaselineModel(baseline, measured if baselines.measured_count(baseline) else ())
        for name, baseline in fitted.items()
    }


def adapt_network(
    network: ModelConfig, dataset: Dataset, pressure: ContactPressure | None, measured: tuple[str, ...]
) -> tuple[ModelConfig, np.ndarray]:
    """The configuration of a network for this data set, and the images (n, p, p) that it sees of it."""
    conditions = tuple(name for name in network.conditions if name in measured)
    images = dataset.touches.patch if network.input != "image" or pressure is None else np.asarray(pressure.pressure)
    adapted = replace(
        network,
        pixels=images.shape[1],
        reach=dataset.reach,
        conditions=conditions,
        readings=dataset.touches.reading.shape[-1],
    )
    return adapted, images


def train_network(
    name: str,
    network: ModelConfig,
    cfg: training.TrainConfig,
    *,
    images: np.ndarray,
    touches: Touches,
    split: Split,
    folder: Path,
) -> tuple[TrainedNetwork, dict[str, np.ndarray]]:
    """Train with a bar, saving every chunk in `folder`; goes on from what an interrupted run saved. Returns the network
    and its errors over epochs.
    """
    train, validation = (_batch(network, images, touches, rows) for rows in (split.train, split.validation))
    training.check(train, network, "training")
    training.check(validation, network, "validation")
    norm = training.normalisation(train)
    prepared = jax.jit(training.prepare, static_argnums=0)
    ready, ready_validation = (prepared(network, norm, part) for part in (train, validation))
    state, history = jax.jit(partial(training.start, network, cfg, len(train.target)))(), []
    if checkpoint.exists(folder):  # an interrupted run got this far
        state, _, about = checkpoint.restore(folder)
        history = about.extra["history"]
    done = int(np.max(state.epoch))
    with progress(total=cfg.epochs, initial=done, desc=f"training {name}", unit="epoch") as bar:

        def log(epoch: int, info: training.EpochInfo) -> None:
            history.append([float(np.mean(info.train.squared)), float(np.mean(info.validation.squared))])
            bar.update()
            bar.set_postfix(validation=f"{history[-1][1]:.3f}")

        state = training.fit(
            state, network, cfg, ready, ready_validation, log=log,
            save=lambda state: checkpoint.save(
                folder, state, network, cfg, norm, touches=len(train.target), extra={"history": history}
            ),
        )  # fmt: skip
    norm = jax.jit(training.with_residual, static_argnums=1)(state.best_params, network, norm, ready_validation)
    values = np.array(history).reshape(-1, 2)
    return TrainedNetwork(state.best_params, network, norm), {
        f"{name}, training": values[:, 0],
        f"{name}, validation": values[:, 1],
    }


def _batch(network: ModelConfig, images: np.ndarray, touches: Touches, rows: np.ndarray) -> Batch:
    """The touches in `rows` as a network is trained on them."""
    values = [getattr(touches, condition)[rows] for condition in network.conditions]
    stacked = np.stack(values, -1) if values else np.zeros((int(rows.sum()), 0))
    return Batch(Inputs(jnp.asarray(images[rows]), jnp.float32(stacked)), jnp.asarray(touches.reading[rows]))


def fit_gp(pressure: ContactPressure, readings: np.ndarray, split: Split, seed: int) -> GP:
    """The Gaussian process on the training touches, hyperparameters from held-out groups of them."""
    rows = np.flatnonzero(split.train)
    train = ContactPressure(pressure.pressure[rows], pressure.load[rows])
    return gp.condition(train, readings[rows], split.groups[rows], seed=seed)


def ceiling(dataset: Dataset, pressure_model: PressureModelConfig, split: Split, seed: int) -> np.ndarray:
    """Readings (n, 3 chips) uT of the test touches by the same Gaussian process where the camera saw what the skin met
    and the force was known: what errors cost.
    """
    truth = dataset.touches.truth
    assert truth is not None
    exact = replace(pressure_model, smooth=False, tilt=0.0, pitch=dataset.window / dataset.touches.patch.shape[1])
    pressure = predict_pressures(exact, truth.wide, truth.force, truth.indentation)
    fitted = fit_gp(pressure, dataset.touches.reading, split, seed)
    rows = np.flatnonzero(split.test)
    return np.asarray(gp.predict(fitted, ContactPressure(pressure.pressure[rows], pressure.load[rows]))[0])
