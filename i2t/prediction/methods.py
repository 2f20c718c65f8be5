"""Interface of all predictors: a method is fitted to touches and gives a predictor.

    class Mine(Method):
        title = "nearest of all"

        def fit(self, key, touches, split):
            rows = split.train
            model = MyModel(...)  # an i2t.prediction.touch_model.TouchModel
            return touches.predictor(model, split)

`python -m experiments.train --method my_package.module:Mine` fits it beside the others, on the same touches, and keeps
it if it is the best on validation touches. `METHODS` are those that come with i2t.
"""

import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module  # noqa: TID251  # of a user's class
from typing import Any, ClassVar, TypeVar

import numpy as np
from jaxtyping import Array, Key

from i2t.contact.pressure import ContactPressure, PressureModelConfig
from i2t.dataset import Dataset, Split
from i2t.paper.config import PaperOptions
from i2t.prediction.predictor import Predictor
from i2t.prediction.touch_model import TouchBatch, TouchModel, from_disk, to_disk
from i2t.skin.boards import board_as_lists
from i2t.training import TrainConfig

METHODS: Mapping[str, str] = {  # names of the command line; the first of equal ones is kept
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
ALIKE_FORCE_N = 1.0  # where nothing says how hard touches were pressed
USUAL_DEPTH_M = 0.3e-3  # past first contact, likewise

Made = TypeVar("Made")


@dataclass(frozen=True)
class TrainingTouches:
    """Input of every method.

    Attributes:
        dataset: All touches, those to validate and to test with included; `Split` says which may be fitted to.
        measured: Of force, nearest and depth, those that were measured at every touch.
        pressure_model: How contact pressure is predicted; None where nothing says how hard touches were pressed.
        pressure: Contact pressures of all touches, likewise.
        paper: Sizes and loss of the paper's network.
        training: How networks are trained.
        shared: What methods compute once for all (`once`).
    """

    dataset: Dataset
    measured: tuple[str, ...] = ()
    pressure_model: PressureModelConfig | None = None
    pressure: ContactPressure | None = None
    paper: PaperOptions = field(default_factory=PaperOptions)
    training: TrainConfig = field(default_factory=TrainConfig)
    shared: dict[tuple[str, bytes], Any] = field(default_factory=dict, repr=False)

    def once(self, name: str, rows: np.ndarray, make: Callable[[], Made]) -> Made:
        """Value that methods share, made by the first that asks.

        Args:
            name: Of what is made.
            rows: (n,) mask of the touches that it is made of.
            make: Makes it.

        Returns:
            What was made.
        """
        key = name, rows.tobytes()
        if key not in self.shared:
            self.shared[key] = make()
        made: Made = self.shared[key]
        return made

    def batch(self, rows: np.ndarray) -> TouchBatch:
        """Touches as predictors take them.

        Args:
            rows: (n,) mask of touches.

        Returns:
            What is known of them beside their readings.
        """
        touches = self.dataset.touches
        return TouchBatch(
            touches.patch,
            views_of(self.dataset),
            self.dataset.window / touches.patch.shape[1],
            force=touches.force,
            nearest=touches.nearest,
            depth=touches.depth,
            pressure=self.pressure,
            pressure_model=self.pressure_model,
        ).rows(np.flatnonzero(rows))

    def predictor(self, model: TouchModel, split: Split) -> Predictor:
        """Predictor around a fitted model.

        Args:
            model: Fitted.
            split: Whose training touches say what stands in for a force or depth that a user does not give.

        Returns:
            The predictor.

        Raises:
            ValueError: The model could not be kept on disk, which is better known now than at the end of a run.
        """
        try:
            arrays, about = to_disk(model)
            from_disk(arrays, json.loads(json.dumps(about)))
        except (LookupError, TypeError, AttributeError) as error:
            raise ValueError(f"a {type(model).__name__} could not be loaded again: {error}") from error
        pressed = self.dataset.touches
        force, depth = _usual_force(pressed.force[split.train]), _median(pressed.depth[split.train], USUAL_DEPTH_M)
        known = pressed.force[split.train]
        known = known[np.isfinite(known)]
        metadata: dict[str, Any] = {"board": board_as_lists(self.dataset.board)}
        if len(known):
            metadata["force_range"] = [float(known.min()), float(known.max())]
        return Predictor(model, self.dataset.window, self.dataset.reach, force, depth, metadata=metadata)


class Method(ABC):
    """Method that is fitted to touches and predicts.

    Attributes:
        title: Of its rows in tables.
        baseline: Whether it is one of those that every other has to beat.
    """

    title: ClassVar[str]
    baseline: ClassVar[bool] = False

    @abstractmethod
    def fit(self, key: Key[Array, ""], touches: TrainingTouches, split: Split) -> Predictor | None:
        """Fit to the training touches.

        Args:
            key: Random key.
            touches: All touches, and what is known of them.
            split: Which of them train, and which validate.

        Returns:
            The predictor; None where the touches lack what the method needs.
        """


def find_method(name: str) -> Method:
    """A method by its name.

    Args:
        name: One of `METHODS`, or the module and class of another, as "my_package.module:Mine".

    Returns:
        The method.

    Raises:
        ValueError: There is none of that name.
    """
    module, _, kind = METHODS.get(name, name).partition(":")
    if not kind:
        raise ValueError(f"there is no method {name}; choose of {', '.join(METHODS)}, or name one as module:Class")
    try:
        found = getattr(import_module(module), kind)
    except (ImportError, AttributeError) as error:
        raise ValueError(f"the method {name} cannot be had: {error}") from error
    if not (isinstance(found, type) and issubclass(found, Method) and hasattr(found, "title")):
        raise ValueError(f"{name} is no i2t.prediction.methods.Method with a title")
    try:
        return found()
    except TypeError as error:  # `fit` is missing, or it wants arguments
        raise ValueError(f"the method {name} cannot be made: {error}") from error


def find_methods(names: Sequence[str]) -> tuple[Method, ...]:
    """Methods by their names.

    Args:
        names: As of `find_method`; one that is named twice is found once.

    Returns:
        The methods, each with a title of its own.

    Raises:
        ValueError: There is none of a name, or two have one title.
    """
    found = {name: find_method(name) for name in names}
    titles = [method.title for method in found.values()]
    for name, method in found.items():
        if titles.count(method.title) > 1:
            raise ValueError(f"the method {name} has the title of another, {method.title!r}; give it its own")
    return tuple(found.values())


def views_of(dataset: Dataset) -> np.ndarray:
    """Wide views where they were recorded, else patches.

    Args:
        dataset: Of n touches.

    Returns:
        (n, w, w) m.
    """
    wide = dataset.touches.wide
    centre = wide.shape[-1] // 2
    return dataset.touches.patch if np.isnan(wide[:, centre, centre]).any() else wide


def _usual_force(force: np.ndarray) -> float:
    """The median of the forces (N); where most of them do not press, of those that do."""
    median = _median(force, ALIKE_FORCE_N)
    return median if median > 0 else _median(np.where(force > 0, force, np.nan), ALIKE_FORCE_N)


def _median(values: np.ndarray, default: float) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else default
