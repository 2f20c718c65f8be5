"""The default data set of `experiments.train`, simulated touches of a preset's objects with one pad, and predictions
without errors of camera and arm.
"""

from dataclasses import replace
from pathlib import Path

import jax
import numpy as np

from experiments.train.configs import Simulation
from i2t import dataset as data
from i2t.contact.pressure import ContactPressure, PressureModelConfig, predict_pressures
from i2t.dataset import Dataset, Split
from i2t.objects import catalogue
from i2t.prediction.gp_method import fit_gp
from i2t.rendering.render import prepare_surface
from i2t.runtime.batching import select_rows
from i2t.runtime.progress import progress
from i2t.simulation import touches as simulation
from i2t.types import Pad


def simulated_dataset(cfg: Simulation, pad: Pad, path: Path, *, seed: int, name: str, camera: int = 0) -> Dataset:
    """Load the data set in `path`, or simulate it if the file does not exist, so that resumed runs use the same
    touches.

    Args:
        cfg: Objects, counts and errors.
        pad: The pad.
        path: HDF5 file of the data set.
        seed: Seed of sites and errors.
        name: Name of the pad in the data set.
        camera: Number of the camera, if the configuration has the same camera in all sessions.

    Returns:
        The data set, marked as simulated.
    """
    if path.exists():
        return data.load_dataset(path)
    print(f"simulating {sum(cfg.counts())} touches of {len(cfg.objects)} objects", flush=True)
    surfaces = [prepare_surface(catalogue.make_object(name).mesh) for name in cfg.objects]
    key, T_t_camera = jax.random.key(seed), None
    if cfg.same_camera:
        key_camera = jax.random.fold_in(key, 1_000_000 + camera)  # above the numbers of all sessions
        T_t_camera = simulation.sample_session_errors(key_camera, cfg.errors).T_t_camera
    with progress(total=sum(cfg.counts()), desc="simulating touches", unit="touches") as bar:
        touches = simulation.simulate_touches(
            jax.random.clone(key), surfaces, pad, cfg.errors, cfg.counts(), limits=cfg.limits,
            touches_per_session=cfg.touches_per_session, T_t_camera=T_t_camera, progress=bar.update,
        )  # fmt: skip
    meta = {"made by": f"experiments.train, seed {seed}"}
    dataset = Dataset.simulated(touches, cfg.objects, pad, pad_name=name, session="run", meta=meta)
    data.save_dataset(path, dataset)
    return dataset


def ceiling(dataset: Dataset, pressure_model: PressureModelConfig, split: Split, seed: int) -> np.ndarray:
    """Predict the readings (n, 3 chips) uT of the test touches with the same Gaussian process on exact views and
    forces, which shows the cost of errors.
    """
    truth = dataset.touches.truth
    assert truth is not None
    exact = replace(pressure_model, smooth=False, tilt=0.0, pitch=dataset.window / dataset.touches.patch.shape[1])
    pressure = predict_pressures(exact, truth.view, truth.force, truth.indentation)
    return predicted_by_gp(pressure, dataset.touches.reading, split, seed)


def predicted_by_gp(pressure: ContactPressure, readings: np.ndarray, split: Split, seed: int) -> np.ndarray:
    """Predict the readings (n, 3 chips) uT of the test touches with a Gaussian process on contact pressures."""
    fitted = fit_gp(jax.random.key(seed), pressure, readings, split)
    held_out = split.validation | split.test  # the same number as in the evaluation, so that nothing is compiled again
    mean, _ = fitted.predict(select_rows(pressure, np.flatnonzero(held_out)))
    return np.asarray(mean)[split.test[held_out]]
