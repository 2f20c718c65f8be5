"""Interface of all predictors: a method is fitted to touches and gives a predictor.

    class Mine(Method):
        title = "nearest of all"

        def fit(self, key, touches, split):
            rows = split.train
            model = MyModel(...)  # an i2t.prediction.touch_model.TouchModel
            return touches.predictor(model, split)

`python -m experiments.train --method my_package.module:Mine` fits it next to the others, on the same touches, and keeps
it if it is the best on validation touches. `METHODS` are those that come with i2t.
"""

import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module  # noqa: TID251  # for the class of a user
from typing import Any, ClassVar, TypeVar

import numpy as np
from jaxtyping import Array, Key

from i2t.contact.pressure import ContactPressure, PressureModelConfig
from i2t.dataset import Dataset, Split
from i2t.dataset.digests import touch_digests
from i2t.paper.config import PaperOptions
from i2t.prediction.loads import ASSUMED_FORCE_N, usual_load
from i2t.prediction.predictor import Predictor
from i2t.prediction.touch_model import TouchBatch, TouchModel, from_disk, recorded_batch, to_disk
from i2t.skin.boards import board_as_lists
from i2t.training import TrainConfig

# Prediction methods, by the name on the command line; of equally good methods the first one is kept.
METHODS: Mapping[str, str] = {
    "mean": "i2t.prediction.baselines:Mean",
    "nearest": "i2t.prediction.baselines:Nearest",
    "nearest-measured": "i2t.prediction.baselines:NearestMeasured",
    "ridge": "i2t.prediction.baselines:Ridge",
    "ridge-measured": "i2t.prediction.baselines:RidgeMeasured",
    "nearest-pressure": "i2t.prediction.baselines:NearestPressure",
    "nearest-pressure-measured": "i2t.prediction.baselines:NearestPressureMeasured",
    "ridge-pressure": "i2t.prediction.baselines:RidgePressure",
    "ridge-pressure-measured": "i2t.prediction.baselines:RidgePressureMeasured",
    "paper-mask": "i2t.prediction.networks:PaperMask",
    "paper-depth": "i2t.prediction.networks:PaperDepth",
    "paper-mask-force": "i2t.prediction.networks:PaperMaskForce",
    "paper-depth-force": "i2t.prediction.networks:PaperDepthForce",
    "pressure-network": "i2t.prediction.networks:OnPressure",
    "gp": "i2t.prediction.gp_method:GaussianProcess",
}

Shared = TypeVar("Shared")


@dataclass(frozen=True)
class TrainingTouches:
    """Touches and options to which every method of predicting readings is fitted.

    Attributes:
        dataset: All touches, including those for validation and test; `Split` separates them.
        measured: Names of the measurements (force, nearest, travel) that every touch has.
        pressure_model: Configuration of the predicted contact pressure; None if neither force nor travel is recorded.
        pressure: Contact pressures of all touches; None without a pressure model.
        paper: Sizes and loss of the paper's network.
        training: Configuration of the training of networks.
        shared: Values that methods compute once and share (`cached`).
    """

    dataset: Dataset
    measured: tuple[str, ...] = ()
    pressure_model: PressureModelConfig | None = None
    pressure: ContactPressure | None = None
    paper: PaperOptions = field(default_factory=PaperOptions)
    training: TrainConfig = field(default_factory=TrainConfig)
    shared: dict[tuple[str, bytes], Any] = field(default_factory=dict, repr=False)

    def cached(self, name: str, rows: np.ndarray, make: Callable[[], Shared]) -> Shared:
        """Return a value that methods share, which the first of them computes.

        Args:
            name: Name of the value.
            rows: (n,) mask of the touches from which it is computed.
            make: Function that computes the value.

        Returns:
            Value of this name for these touches.
        """
        key = name, rows.tobytes()
        if key not in self.shared:
            self.shared[key] = make()
        value: Shared = self.shared[key]
        return value

    def batch(self, rows: np.ndarray) -> TouchBatch:
        """Select some of the data set's touches in the form that predictors take.

        Args:
            rows: (n,) mask of touches.

        Returns:
            Patches, views and conditions of these touches, without their readings.
        """
        batch = recorded_batch(self.dataset)._replace(pressure=self.pressure, pressure_model=self.pressure_model)
        return batch.rows(np.flatnonzero(rows))

    def predictor(self, model: TouchModel, split: Split) -> Predictor:
        """Wrap a fitted model in a predictor.

        Args:
            model: The fitted model.
            split: Split whose training touches give the default force and travel.

        Returns:
            Predictor of readings for this data set's patches and board.

        Raises:
            ValueError: The model cannot be saved to disk. This check fails before a run starts rather than at its end.
        """
        try:
            arrays, about = to_disk(model)
            from_disk(arrays, json.loads(json.dumps(about)))
        except (LookupError, TypeError, AttributeError) as error:
            raise ValueError(f"a {type(model).__name__} could not be loaded again: {error}") from error
        pressed = self.dataset.touches
        force, travel = _usual_force(pressed.force[split.train]), usual_load(pressed.travel[split.train], 0.3e-3)
        used = self.dataset.select(split.train | split.validation)
        metadata: dict[str, Any] = {
            "board": board_as_lists(self.dataset.board),
            "trained_on": _describe_training(self.dataset, split),
            "used_touches": touch_digests(used),
            "largest_reading": float(np.abs(pressed.reading[split.train]).max(initial=0.0)),
        }
        depth = pressed.patch[split.train].mean((1, 2))
        for name, values in (
            ("force_range", pressed.force[split.train]),
            ("travel_range", pressed.travel[split.train]),
            ("mean_depth_range", depth),
        ):
            if np.isfinite(values).any():
                metadata[name] = [float(np.nanmin(values)), float(np.nanmax(values))]
        return Predictor(model, self.dataset.window, self.dataset.reach, force, travel, metadata=metadata)


def _describe_training(dataset: Dataset, split: Split) -> dict[str, Any]:
    """Describe the touches of a fit: numbers for training and validation, the objects of each, and what is held out."""
    parts = {"training": split.train, "validation": split.validation}
    objects = {part: np.unique(dataset.touches.object[rows]) for part, rows in parts.items()}
    return {
        **{part: int(rows.sum()) for part, rows in parts.items()},
        **{f"{part}_objects": [dataset.objects[i] for i in numbers] for part, numbers in objects.items()},
        "split": split.description,
    }


class Method(ABC):
    """Method that is fitted to touches and predicts readings.

    Attributes:
        title: Name of the method in tables of results.
        baseline: Whether it is a baseline that all other methods have to beat.

    Example:
        class Nothing(i2t.Method):
            title = "always zero"

            def fit(self, key, touches, split):
                return touches.predictor(ZeroModel(), split)  # an i2t.TouchModel
    """

    title: ClassVar[str]
    baseline: ClassVar[bool] = False

    @abstractmethod
    def fit(self, key: Key[Array, ""], touches: TrainingTouches, split: Split) -> Predictor | None:
        """Fit the method to the training touches.

        Args:
            key: Random key.
            touches: All touches with their measured conditions.
            split: Split into training and validation touches.

        Returns:
            Fitted predictor, or None if the touches lack an input of the method.
        """


def find_method(name: str) -> Method:
    """Find a method of predicting readings by its name.

    Args:
        name: A key of `METHODS`, or the module and class of another method, such as "my_package.module:Mine".

    Returns:
        Instance of the method.

    Raises:
        ValueError: No method has this name.
    """
    module, _, kind = METHODS.get(name, name).partition(":")
    if not kind:
        raise ValueError(f"there is no method {name}; choose {', '.join(METHODS)}, or give module:Class")
    try:
        method = getattr(import_module(module), kind)
    except (ImportError, AttributeError) as error:
        raise ValueError(f"the method {name} cannot be imported: {error}") from error
    if not (isinstance(method, type) and issubclass(method, Method) and hasattr(method, "title")):
        raise ValueError(f"{name} is not an i2t.prediction.methods.Method with a title")
    try:
        return method()
    except TypeError as error:  # `fit` is missing, or the constructor needs arguments
        raise ValueError(f"the method {name} cannot be constructed: {error}") from error


def find_methods(names: Sequence[str]) -> tuple[Method, ...]:
    """Find methods of predicting readings by their names.

    Args:
        names: Names as for `find_method`; a repeated name counts once.

    Returns:
        Instances of the methods, whose titles differ.

    Raises:
        ValueError: No method has one of the names, or two methods have the same title.
    """
    methods = {name: find_method(name) for name in names}
    titles = [method.title for method in methods.values()]
    for name, method in methods.items():
        if titles.count(method.title) > 1:
            raise ValueError(
                f"the method {name} has the same title as another method, {method.title!r}; give it another title"
            )
    return tuple(methods.values())


def _usual_force(force: np.ndarray) -> float:
    """Compute the median force (N); if it does not press, that of the pressing touches."""
    median = usual_load(force, ASSUMED_FORCE_N)
    return median if median > 0 else usual_load(np.where(force > 0, force, np.nan), ASSUMED_FORCE_N)
