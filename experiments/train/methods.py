"""The predictors that `experiments.train` compares, each fitted to the training touches of a data set."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from experiments.train.configs import TrainExperiment
from experiments.train.splitting import Split
from i2t.dataset import Dataset
from i2t.prediction import checkpoint, gp, training
from i2t.prediction import predictor as predicting
from i2t.prediction.model import Inputs, ModelConfig
from i2t.prediction.predictor import Network, Predictor, Reading
from i2t.prediction.pressure import Imagination
from i2t.prediction.training import Batch
from i2t.types import Touches


def imagination_of(dataset: Dataset, measured: tuple[str, ...], cfg: TrainExperiment) -> Imagination:
    """How touches of this set are imagined: by force where it was measured, else by depth; smoothed where views are
    noisy.
    """
    patches = dataset.touches.patch
    curvature = patches[:, 2:] - 2 * patches[:, 1:-1] + patches[:, :-2]
    noisy = float(np.median(np.abs(curvature))) > 20e-6  # a surface alone curves less than this over a pixel
    large = dataset.window > 25e-3
    return Imagination(
        pitch=dataset.window / patches.shape[1],
        window=round(dataset.window * 500) / 500 if large else Imagination.window,
        smooth=noisy,
        tilt=cfg.hidden_tilt if noisy else 0.0,
        control="force" if "force" in measured else "depth",
        cell=1e-3 if large else Imagination.cell,
    )


def views_of(dataset: Dataset) -> np.ndarray:
    """Wide views where they were recorded, else patches."""
    wide = dataset.touches.wide
    centre = wide.shape[-1] // 2
    return dataset.touches.patch if np.isnan(wide[:, centre, centre]).any() else wide


def fit_network_to(
    network: ModelConfig, dataset: Dataset, imagined: gp.Imagined, measured: tuple[str, ...]
) -> tuple[ModelConfig, np.ndarray]:
    """The configuration and images of a network on this data set."""
    conditions = tuple(name for name in network.conditions if name in measured)
    images = np.asarray(imagined.pressure) if network.input == "image" else dataset.touches.patch
    return replace(network, pixels=images.shape[1], reach=dataset.reach, conditions=conditions), images


def train_network(
    name: str,
    network: ModelConfig,
    cfg: training.TrainConfig,
    images: np.ndarray,
    touches: Touches,
    split: Split,
    folder: Path,
) -> tuple[Network, dict[str, np.ndarray]]:
    """Train with a bar, saving every chunk; goes on from what an interrupted run saved."""

    def batch(rows: np.ndarray) -> Batch:
        values = [getattr(touches, condition)[rows] for condition in network.conditions]
        stacked = np.stack(values, -1) if values else np.zeros((int(rows.sum()), 0))
        return Batch(Inputs(jnp.asarray(images[rows]), jnp.float32(stacked)), jnp.asarray(touches.reading[rows]))

    train, validation = batch(split.train), batch(split.validation)
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
    with tqdm(total=cfg.epochs, initial=done, desc=f"training {name}", unit="epoch") as bar:

        def log(epoch: int, info: training.EpochInfo) -> None:
            history.append([float(np.mean(info.train.squared)), float(np.mean(info.validation.squared))])
            bar.update()
            bar.set_postfix(validation=f"{history[-1][1]:.3f}")

        state = training.fit(
            state, network, cfg, ready, ready_validation, log=log,
            save=lambda state: checkpoint.save(
                folder, state, network, cfg, norm, len(train.target), {"history": history}
            ),
        )  # fmt: skip
    norm = jax.jit(training.with_residual, static_argnums=1)(state.best_params, network, norm, ready_validation)
    values = np.array(history).reshape(-1, 2)
    return Network(state.best_params, network, norm), {
        f"{name}, training": values[:, 0],
        f"{name}, validation": values[:, 1],
    }


def fit_process(imagined: gp.Imagined, readings: np.ndarray, split: Split, seed: int) -> gp.GP:
    """The Gaussian process on the training touches, hyperparameters from held-out groups of them."""
    rows = np.flatnonzero(split.train)
    train = gp.Imagined(imagined.pressure[rows], imagined.load[rows])
    return condition(train, readings[rows], split.groups[rows], seed)


def condition(imagined: gp.Imagined, readings: np.ndarray | jax.Array, groups: np.ndarray, seed: int) -> gp.GP:
    """A process told all of these touches, hyperparameters from held-out groups of them."""
    values = jnp.asarray(readings)
    hyper, _ = gp.choose(imagined, values, groups, seed=seed)
    return jax.jit(gp.fit)(hyper, imagined, values)


def ceiling(dataset: Dataset, imagination: Imagination, split: Split, seed: int) -> np.ndarray:
    """The same process where the camera saw what the skin met and the force was known: what the errors cost."""
    truth = dataset.touches.truth
    assert truth is not None
    exact = replace(imagination, smooth=False, tilt=0.0, pitch=dataset.window / dataset.touches.patch.shape[1])
    imagined = predicting.imagine_all(exact, truth.wide, truth.force, truth.indentation)
    process = fit_process(imagined, dataset.touches.reading, split, seed)
    rows = np.flatnonzero(split.test)
    return np.asarray(gp.predict(process, gp.Imagined(imagined.pressure[rows], imagined.load[rows]))[0])


def describe(predictor: Predictor, dataset: Dataset, split: Split) -> Predictor:
    """Fill in the middle of the training touches, which stands in for what a user does not measure."""
    touches = dataset.touches
    return replace(
        predictor,
        load=predicting.middle(touches.force[split.train], 1.0),
        depth=predicting.middle(touches.depth[split.train], 0.3e-3),
    )


def predict(predictor: Predictor, dataset: Dataset, rows: np.ndarray, imagined: gp.Imagined) -> Reading:
    """Predict rows of a data set whose touches were all imagined before."""
    touches = dataset.touches
    measured = {name: getattr(touches, name)[rows] for name in ("force", "nearest", "depth")}
    if predictor.imagination is None:
        return predictor.from_image(touches.patch[rows], measured)
    which = np.flatnonzero(rows)
    return predictor.from_imagined(gp.Imagined(imagined.pressure[which], imagined.load[which]), measured)
