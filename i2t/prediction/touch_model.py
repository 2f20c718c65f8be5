"""Models that predict readings, and their form on disk: a model consists of its fields.

    @dataclass(frozen=True)
    class Mine(TouchModel):
        weights: np.ndarray  # (2304, c) uT / m
        mean: np.ndarray  # (c,) uT

        @property
        def channels(self):
            return len(self.mean)

        def predict_batch(self, touches):
            flat = touches.patch.reshape(len(touches.patch), -1)
            return Reading(flat @ self.weights + self.mean, np.ones((len(flat), self.channels)))

Fields are arrays, trees of arrays (dicts and named tuples), frozen dataclasses without arrays, texts, numbers, and
tuples of these. Arrays hold 32-bit numbers on disk. A field `pressure` is a `PressureModelConfig` and marks a model on
predicted contact pressure.
A model of another package can be loaded once that package is imported. A file never causes an import, except of modules
of i2t itself.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import asdict, fields, is_dataclass, replace
from importlib import import_module  # noqa: TID251  # for i2t's own models
from typing import Any, ClassVar, NamedTuple, TypeVar, get_args, get_type_hints

import jax.numpy as jnp
import numpy as np

from i2t.contact.pressure import ContactPressure, PressureModelConfig, predict_pressures
from i2t.dataset import Dataset
from i2t.errors import CheckpointError
from i2t.runtime.batching import select_rows
from i2t.types import Touches, in_one_line

Config = TypeVar("Config")


@in_one_line
class Reading(NamedTuple):
    """Mean and standard deviation (uT) of a predicted reading in the board's order and axes: one touch, or n on axis 0.

    Example:
        predictor = i2t.load_predictor("nominal")
        mean, std = predictor.predict(patch, force=1.0)  # (3 chips,) uT each
    """

    mean: np.ndarray  # (3 chips,) or (n, 3 chips) uT
    std: np.ndarray  # as mean: standard deviation of the sensor's reading about the mean, including noise


@in_one_line
class TouchBatch(NamedTuple):
    """Inputs for predicting n readings: patches and views (m), and force (N), nearest and travel (m); NaN if unknown.

    Contact pressures are included if they were predicted before.
    """

    patch: np.ndarray  # (n, p, p) m, behind the nearest surface point
    view: np.ndarray  # (n, w, w) m, the view, or the patch if there is none
    pitch: float  # m, edge of a pixel of both
    force: np.ndarray  # (n,) N, along tool z
    nearest: np.ndarray  # (n,) m, signed distance of the nearest surface point from the tool origin
    travel: np.ndarray  # (n,) m, of the tool past first contact
    pressure: ContactPressure | None = None  # if it was predicted before
    pressure_model: PressureModelConfig | None = None  # configuration of that prediction

    def rows(self, which: np.ndarray) -> "TouchBatch":
        """Select some of the batch's touches.

        Args:
            which: (n,) mask, or indices of touches.

        Returns:
            Batch of the selected touches.
        """
        names = ("patch", "view", "force", "nearest", "travel", "pressure")
        return self._replace(**{name: select_rows(getattr(self, name), which) for name in names})

    def pressures(self, cfg: PressureModelConfig) -> ContactPressure:
        """Return the touches' contact pressures, predicting them if they are missing or have another configuration.

        Args:
            cfg: Configuration of the predicted contact pressure.

        Returns:
            Contact pressures of the n touches.
        """
        if self.pressure is not None and self.pressure_model == cfg:
            return self.pressure
        return predict_pressures(replace(cfg, pitch=self.pitch), self.view, self.force, self.travel)

    def conditions(self, names: Sequence[str]) -> np.ndarray:
        """Stack values measured at contact, which every touch must have.

        Args:
            names: Names of the k values, each of "force", "nearest" and "travel".

        Returns:
            `(n, k)` values in the order of the names: force in N, nearest and travel in m.

        Raises:
            ValueError: A touch lacks one of them.
        """
        missing = [name for name in names if not np.isfinite(getattr(self, name)).all()]
        if missing:
            raise ValueError(f"this model needs {', '.join(missing)} of every touch; pass it to predict")
        return stacked(self, names)


def stacked(touches: Touches | TouchBatch, names: Sequence[str]) -> np.ndarray:
    """Stack values measured at contact, NaN where one is unknown.

    Args:
        touches: n touches.
        names: Names of the k values, each of "force", "nearest" and "travel".

    Returns:
        `(n, k)` values in the order of the names: force in N, nearest and travel in m.
    """
    values = [getattr(touches, name) for name in names]
    return np.stack(values, -1) if values else np.zeros((len(touches.patch), 0))


def views_of(dataset: Dataset) -> np.ndarray:
    """Return a data set's views (patches with their surroundings) if every touch has one, otherwise its patches.

    Args:
        dataset: Data set of n touches.

    Returns:
        `(n, w, w)` views (m), w pixels along an edge.
    """
    view = dataset.touches.view
    centre = view.shape[-1] // 2
    return dataset.touches.patch if np.isnan(view[:, centre, centre]).any() else view


def recorded_batch(dataset: Dataset) -> TouchBatch:
    """Convert a data set to the form that predictors take.

    Args:
        dataset: Data set of n touches.

    Returns:
        Patches, views and conditions of the touches, without their readings.
    """
    touches = dataset.touches
    return TouchBatch(
        touches.patch, views_of(dataset), dataset.window / touches.patch.shape[1],
        force=touches.force, nearest=touches.nearest, travel=touches.travel,
    )  # fmt: skip


class TouchModel(ABC):
    """Model that predicts the readings of touches. A subclass is a frozen dataclass.

    Example:
        @dataclass(frozen=True)
        class ZeroModel(i2t.TouchModel):
            channels = 15

            def predict_batch(self, touches):
                zero = np.zeros((len(touches.patch), self.channels), np.float32)
                return i2t.Reading(zero, zero + 50)  # uT
    """

    registered: ClassVar[dict[str, type["TouchModel"]]] = {}  # by module and name
    pressure: ClassVar[PressureModelConfig | None] = None  # a field of models on predicted contact pressure

    def __init_subclass__(cls) -> None:
        """Register the class for loading from disk."""
        TouchModel.registered[f"{cls.__module__}:{cls.__qualname__}"] = cls

    @property
    @abstractmethod
    def channels(self) -> int:
        """Number of values in a reading."""

    @abstractmethod
    def predict_batch(self, touches: TouchBatch) -> Reading:
        """Predict the readings of touches.

        Args:
            touches: n touches.

        Returns:
            `(n, c)` means and standard deviations (uT).

        Raises:
            ValueError: Patches or conditions do not fit the model.
        """


def to_disk(model: TouchModel) -> tuple[dict[str, Any], dict[str, Any]]:
    """Convert a model to arrays and JSON values, for saving to disk.

    Args:
        model: The model to save.

    Returns:
        Arrays by field (32 bits, or booleans), and a dict of the class and all other fields.

    Raises:
        ValueError: A field of the model is neither an array nor convertible to JSON.
    """
    arrays, settings = {}, {}
    for field in fields(model):  # type: ignore[arg-type]
        value = getattr(model, field.name)
        if is_dataclass(value) and not isinstance(value, type):
            settings[field.name] = {"config": type(value).__name__, "values": asdict(value)}
        elif isinstance(value, str | int | float | bool | None) or _are_plain(value):
            settings[field.name] = value
        else:
            try:
                arrays[field.name] = _plain(value)
            except (TypeError, ValueError, OverflowError) as error:
                raise ValueError(
                    f"{type(model).__name__}.{field.name} cannot be kept on disk ({error}); a field of a TouchModel is "
                    "an array, a dict or named tuple of arrays, a frozen dataclass, a text or a number"
                ) from error
    return arrays, {"class": f"{type(model).__module__}:{type(model).__qualname__}", "settings": settings}


def from_disk(arrays: dict[str, Any], about: dict[str, Any]) -> TouchModel:
    """Restore the model that `to_disk` converted.

    Args:
        arrays: Arrays by field.
        about: The class and all other fields.

    Returns:
        Model equal to the converted one.

    Raises:
        CheckpointError: The model's class is not registered.
        ValueError: Fields do not fit the class. LookupError, TypeError and AttributeError mean the same.
    """
    name = about["class"]
    if name not in TouchModel.registered and name.startswith("i2t.prediction."):
        import_module(name.partition(":")[0])
    if name not in TouchModel.registered:
        module = name.partition(":")[0]
        raise CheckpointError(
            f"the predictor is a {name}, which is not registered here; call "
            f'importlib.import_module("{module}") before you load it'
        )
    kind = TouchModel.registered[name]
    hints = get_type_hints(kind)
    given = {key: _array_tree(hints[key], value) for key, value in arrays.items()}
    given |= {key: _setting(hints[key], value) for key, value in about["settings"].items()}
    return kind(**given)


def config_from(kind: type[Config], values: dict[str, Any]) -> Config:
    """Restore a configuration from its JSON form, in which tuples became lists.

    Args:
        kind: Dataclass of the configuration.
        values: Fields by name; missing fields keep their defaults.

    Returns:
        Configuration of this class.

    Raises:
        ValueError: A field is unknown, or a value is refused.
    """
    hints = get_type_hints(kind)
    unknown = sorted(set(values) - set(hints))
    if unknown:
        raise ValueError(f"unknown {', '.join(unknown)}")

    def convert(name: str) -> Any:
        if is_dataclass(hints[name]):
            return config_from(hints[name], values[name])
        if isinstance(values[name], list) and len(values[name]) > 100:  # many more than layers of a network
            raise ValueError(f"{len(values[name])} values of {name}")
        return tuple(values[name]) if isinstance(values[name], list) else values[name]

    return kind(**{name: convert(name) for name in values})


def _are_plain(values: Any) -> bool:
    """Test for a tuple of texts and numbers without arrays."""
    return type(values) is tuple and all(isinstance(value, str | int | float | bool) for value in values)


def _plain(node: Any) -> Any:
    """Convert named tuples to dicts at all levels, so that files name their fields, and numbers to JAX's 32 bits."""
    if isinstance(node, tuple) and hasattr(node, "_asdict"):
        node = node._asdict()
    if isinstance(node, dict):
        return {name: _plain(value) for name, value in node.items()}
    values = np.asarray(node)
    if values.dtype.kind in "iu":
        largest = np.iinfo(np.int32).max
        if values.size and not -largest <= int(values.min()) <= int(values.max()) <= largest:
            raise OverflowError(f"whole numbers beyond {largest}")
        return jnp.asarray(values, jnp.int32)
    if values.dtype.kind not in "fb":
        raise TypeError(f"values of type {values.dtype}")
    return jnp.asarray(values, bool if values.dtype.kind == "b" else jnp.float32)


def _array_tree(kind: Any, value: Any) -> Any:
    """Restore the arrays of a field of this type: named tuples, and NumPy's arrays if the type asks for them."""
    if value is None:
        value = jnp.zeros(0)
    if hasattr(kind, "_fields"):
        hints = get_type_hints(kind)
        return kind(**{name: _array_tree(hints[name], leaf) for name, leaf in value.items()})
    if isinstance(value, dict):
        return value
    types = [getattr(hint, "array_type", hint) for hint in get_args(kind) or (kind,)]
    return np.asarray(value) if np.ndarray in types else value


def _setting(kind: Any, value: Any) -> Any:
    """Restore a value, or a configuration of this class or of a subclass."""
    if isinstance(value, dict):
        name, allowed = value["config"], [hint for hint in (get_args(kind) or (kind,)) if isinstance(hint, type)]
        classes = [cls for base in allowed for cls in (base, *base.__subclasses__()) if cls.__name__ == name]
        if not classes:
            raise ValueError(f"{name} is not a {kind}")
        return config_from(classes[0], value["values"])
    return tuple(value) if isinstance(value, list) else value
