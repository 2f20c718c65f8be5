"""Fit of one predictor to a data set: corrections, split, measured conditions and predicted contact pressures.

    predictor = i2t.fit_predictor(dataset)
    print(predictor.score(dataset))  # on the touches that were held out
    predictor.save("runs/mine")

`python -m experiments.train` fits and compares all methods on touches that the same functions prepare.
"""

import logging
import math
from dataclasses import replace
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Key

from i2t.contact.pressure import PressureModelConfig, predict_pressures
from i2t.dataset import Dataset, Split
from i2t.paper.config import PaperOptions
from i2t.prediction.loads import ASSUMED_FORCE_N, PressLoad, press_load, rows_with_load, several_skins
from i2t.prediction.methods import Method, TrainingTouches, find_method
from i2t.prediction.predictor import Predictor, std_scale
from i2t.prediction.splitting import choose_split
from i2t.prediction.touch_model import views_of
from i2t.recordings.sets import corrected_dataset
from i2t.training import TrainConfig
from i2t.validation import random_key

log = logging.getLogger(__name__)


class CorrectedTouches(NamedTuple):
    """Touches with corrected signs and heights, without the few whose load is not known."""

    dataset: Dataset
    rows: np.ndarray  # (n,) mask of the original touches that are kept
    notes: tuple[str, ...]  # sentences about problems of the recording


class PreparedTouches(NamedTuple):
    """Touches in the form that methods are fitted to, with their split."""

    touches: TrainingTouches
    split: Split
    notes: tuple[str, ...]  # sentences about problems of the recording
    selection: np.ndarray | None = None  # (n,) mask of further touches for choosing the method

    @property
    def selection_rows(self) -> np.ndarray:
        """Mask (n,) of all touches by which the method is chosen."""
        return self.split.validation if self.selection is None else self.split.validation | self.selection


def correct_touches(dataset: Dataset) -> CorrectedTouches:
    """Correct the signs and heights of a data set, and leave out touches whose load is not known, if they are few.

    Args:
        dataset: n recorded or simulated touches.

    Returns:
        The touches that are kept, with sentences about corrections.
    """
    dataset, corrections = corrected_dataset(dataset)
    rows, left_out = rows_with_load(dataset)
    return CorrectedTouches(dataset if rows.all() else dataset.select(rows), rows, (*corrections, *left_out))


def prepare_touches(
    corrected: CorrectedTouches,
    split: Split,
    *,
    pressure: bool = True,
    softness: float = 1.0,
    rendered: bool = False,
    hidden_tilt: float = math.radians(0.4),
) -> PreparedTouches:
    """List the conditions that were measured at every touch, and predict the contact pressures.

    Args:
        corrected: The corrected touches.
        split: Split of these touches.
        pressure: Whether contact pressures are predicted.
        softness: Softness of the skin, relative to the nominal skin.
        rendered: Whether the views were rendered, so that they have no noise but do not show the tilt either.
        hidden_tilt: Uncertainty (rad) of the tilt in a noisy or rendered view.

    Returns:
        The input of the methods, with notes for the user. There are no contact pressures if no load is known, or if
        nearly all of them would be zero.
    """
    dataset = corrected.dataset
    used = split.train | split.validation | split.test
    load = press_load(dataset.select(used).touches)
    notes = (*corrected.notes, *several_skins(dataset), *load.notes)
    measured = (
        name for name in ("force", "nearest", "travel") if np.isfinite(getattr(dataset.touches, name)[used]).all()
    )
    prepared = PreparedTouches(TrainingTouches(dataset, tuple(measured)), split, notes)
    if not pressure or load.control is None:
        return prepared
    noisy = _is_noisy(dataset.touches.patch)
    large = dataset.window > 25e-3  # then the skin is assumed to be as large as the window, and cells are coarser
    model = PressureModelConfig(
        pitch=dataset.window / dataset.touches.patch.shape[1],
        window=round(dataset.window * 500) / 500 if large else PressureModelConfig.window,
        smooth=noisy,
        tilt=hidden_tilt if noisy or rendered else 0.0,
        control=load.control,
        softness=softness,
        cell=1e-3 if large else PressureModelConfig.cell,
    )
    return _with_pressure(prepared, model, load)


def _is_noisy(patches: np.ndarray, curvature: float = 20e-6) -> bool:
    """Test whether the median second difference (m) of pixels exceeds a limit, so that views must be smoothed."""
    differences = patches[:, 2:] - 2 * patches[:, 1:-1] + patches[:, :-2]
    return float(np.median(np.abs(differences))) > curvature


def _with_pressure(
    prepared: PreparedTouches, model: PressureModelConfig, load: PressLoad, *, min_share: float = 0.1
) -> PreparedTouches:
    """Add the predicted contact pressures, unless less than a share of those for training are positive."""
    split, dataset, notes = prepared.split, prepared.touches.dataset, prepared.notes
    log.info("predicting contact pressures")
    force = np.full(len(dataset), ASSUMED_FORCE_N, np.float32) if load.constant else dataset.touches.force
    pressure = predict_pressures(model, views_of(dataset), force, dataset.touches.travel)
    total = np.asarray(pressure.pressure)[split.train].sum((1, 2))
    pressed = float(np.mean(total > model.floor / 10))
    if np.isfinite(total).all() and pressed >= min_share:
        return prepared._replace(touches=replace(prepared.touches, pressure_model=model, pressure=pressure))
    share = f"{100 * (1 - pressed):.0f} % of the predicted contact pressures are zero or not finite"
    return prepared._replace(notes=(*notes, f"{share}: methods on them are left out"))


def fit_predictor(
    dataset: Dataset,
    split: Split | None = None,
    *,
    method: str | Method = "gp",
    key: Key[Array, ""] | None = None,
    paper: PaperOptions | None = None,
    training: TrainConfig | None = None,
) -> Predictor:
    """Fit a predictor of readings to the touches of a data set.

    Forces and travels are corrected as `python -m experiments.train` does. Contact pressures are predicted if the
    method needs them, and the predicted standard deviations are scaled on the validation touches.

    Args:
        dataset: Data set of n touches.
        split: Touches to fit to, and those on which a network chooses its epoch and on which standard deviations are
            scaled. By default, `i2t.prediction.choose_split` chooses it, with touches held out for `Predictor.score`.
        method: The method, or its name as for `i2t.prediction.find_method`; by default the Gaussian process on
            predicted contact pressure.
        key: Random key of initial weights and minibatches; `jax.random.key(0)` by default.
        paper: Sizes and loss of the paper's network.
        training: Options of the training of networks.

    Returns:
        The fitted predictor. It knows the touches that it was fitted to (`Predictor.score`).

    Raises:
        TypeError: `dataset` is no data set, `split` no split, `key` no random key, or `method` is neither a method nor
            a name.
        ValueError: There is no method of this name, the touches lack an input of the method, the split is of another
            data set, or there are too few touches to choose a split.

    Example:
        predictor = i2t.fit_predictor(dataset)
        print(predictor.score(dataset))  # on the touches that were held out
    """
    if not isinstance(dataset, Dataset):
        raise TypeError(
            f"dataset: is a {type(dataset).__name__}; give the data set first and the random key by name, "
            "fit_predictor(dataset, split, key=key)"
        )
    if not isinstance(split, Split | None):
        raise TypeError(f"split: is a {type(split).__name__}; give an i2t.Split of the data set, or leave it out")
    chosen = find_method(method) if isinstance(method, str) else method
    if not isinstance(chosen, Method):
        raise TypeError(f"method: is {chosen!r}; give the name of a method, or an instance of a subclass of Method")
    key = jax.random.key(0) if key is None else key
    random_key("key", key)
    if split is not None and len(split.groups) != len(dataset):
        raise ValueError(
            f"split: has {len(split.groups)} touches, but the data set {len(dataset)}; split this data set"
        )
    corrected = correct_touches(dataset)
    split = (split or choose_split(dataset, rows=corrected.rows)).select(corrected.rows)
    for pressure in (False, True):  # a method that needs no contact pressures does not wait for them
        prepared = prepare_touches(corrected, split, pressure=pressure)
        touches = replace(prepared.touches, paper=paper or PaperOptions(), training=training or TrainConfig())
        if fitted := chosen.fit(jax.random.clone(key), touches, split):
            break
    else:
        reasons = "; ".join(prepared.notes)
        raise ValueError(
            f"method: {chosen.title} needs an input that the touches lack{f' ({reasons})' if reasons else ''}; choose "
            "another method"
        )
    for note in prepared.notes:
        log.info("note: %s", note)
    if split.validation.any():
        readings = touches.dataset.touches.reading[split.validation]
        predicted = fitted.predict_batch(touches.batch(split.validation))
        fitted = replace(fitted, std_scale=std_scale(readings, predicted._replace(std=np.maximum(predicted.std, 1e-6))))
    about = {"method": chosen.title, "source": dataset.source, "notes": list(prepared.notes)}
    return replace(fitted, metadata={**(fitted.metadata or {}), **about})
