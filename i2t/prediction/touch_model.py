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
tuples of these. Numbers of arrays have 32 bits on disk. A field `pressure` is a `PressureModelConfig`, and says that
the model is one on predicted contact pressure.
A model of another package is known once that package is imported: a file never says what is to be imported, but for
modules of i2t itself.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import asdict, fields, is_dataclass, replace
from importlib import import_module  # noqa: TID251  # of a user's class
from typing import Any, ClassVar, NamedTuple, TypeVar, get_args, get_type_hints

import jax.numpy as jnp
import numpy as np

from i2t.contact.pressure import ContactPressure, PressureModelConfig, predict_pressures
from i2t.errors import CheckpointError
from i2t.runtime.batching import select_rows
from i2t.types import Touches, in_one_line

MAX_INTEGER = 2**31 - 1
MAX_LIST = 100  # values of a list in a configuration, such as layers
Config = TypeVar("Config")


@in_one_line
class Reading(NamedTuple):
    """A predicted touch, in the board's order and axes; unpacks as (mean, std). One touch, or n on axis 0.

    Example:
        predictor = i2t.load_predictor("nominal")
        mean, std = predictor.predict(patch, force=1.0)  # (3 chips,) uT each
    """

    mean: np.ndarray  # (3 chips,) or (n, 3 chips) uT
    std: np.ndarray  # as mean: standard deviation of the sensor's reading about the mean, its noise included


@in_one_line
class TouchBatch(NamedTuple):
    """What is known of n touches beside their readings; NaN where a value is unknown."""

    patch: np.ndarray  # (n, p, p) m, behind the nearest surface point
    view: np.ndarray  # (n, w, w) m, the patch, or the same view with its surroundings
    pitch: float  # m, edge of a pixel of both
    force: np.ndarray  # (n,) N, along tool z
    nearest: np.ndarray  # (n,) m, signed distance of the nearest surface point from the tool origin
    depth: np.ndarray  # (n,) m, travel past first contact
    pressure: ContactPressure | None = None  # where it was predicted before
    pressure_model: PressureModelConfig | None = None  # by which it was

    def rows(self, which: np.ndarray) -> "TouchBatch":
        """Some of the touches.

        Args:
            which: (n,) mask, or numbers of touches.

        Returns:
            Those.
        """
        names = ("patch", "view", "force", "nearest", "depth", "pressure")
        return self._replace(**{name: select_rows(getattr(self, name), which) for name in names})

    def pressures(self, cfg: PressureModelConfig) -> ContactPressure:
        """The contact pressures, predicted where they were not before, or otherwise.

        Args:
            cfg: How.

        Returns:
            n of them.
        """
        if self.pressure is not None and self.pressure_model == cfg:
            return self.pressure
        return predict_pressures(replace(cfg, pitch=self.pitch), self.view, self.force, self.depth)

    def conditions(self, names: Sequence[str]) -> np.ndarray:
        """Values measured at contact, which must be known of every touch.

        Args:
            names: Of force, nearest and depth, those that are wanted.

        Returns:
            (n, k), in that order.

        Raises:
            ValueError: One is unknown of a touch.
        """
        missing = [name for name in names if not np.isfinite(getattr(self, name)).all()]
        if missing:
            raise ValueError(f"this model needs {', '.join(missing)} of every touch; pass it to predict")
        return stacked(self, names)


def stacked(touches: Touches | TouchBatch, names: Sequence[str]) -> np.ndarray:
    """Values measured at contact, side by side.

    Args:
        touches: n touches.
        names: Of force, nearest and depth, those that are wanted.

    Returns:
        (n, k), in that order.
    """
    values = [getattr(touches, name) for name in names]
    return np.stack(values, -1) if values else np.zeros((len(touches.patch), 0))


class TouchModel(ABC):
    """Model of the readings of touches. A subclass is a frozen dataclass."""

    known: ClassVar[dict[str, type["TouchModel"]]] = {}  # by module and name
    pressure: ClassVar[PressureModelConfig | None] = None  # a field of models on predicted contact pressure

    def __init_subclass__(cls) -> None:
        """Make the class known to those who read it from disk."""
        TouchModel.known[f"{cls.__module__}:{cls.__qualname__}"] = cls

    @property
    @abstractmethod
    def channels(self) -> int:
        """Values of a reading."""

    @abstractmethod
    def predict_batch(self, touches: TouchBatch) -> Reading:
        """Readings of touches that are seen or simulated.

        Args:
            touches: n touches.

        Returns:
            Mean and standard deviation (n, c) uT.

        Raises:
            ValueError: Patches or conditions do not fit the model.
        """


def to_disk(model: TouchModel) -> tuple[dict[str, Any], dict[str, Any]]:
    """A model as trees of arrays and as JSON values.

    Args:
        model: What is to be kept.

    Returns:
        Arrays by field (of 32 bits, or booleans), and the class with all other fields.

    Raises:
        ValueError: A field is neither.
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
    """The model that `to_disk` was given.

    Args:
        arrays: By field.
        about: Its class, and its other fields.

    Returns:
        The model.

    Raises:
        CheckpointError: Its class is not known here.
        ValueError: Fields do not fit the class, as LookupError, TypeError and AttributeError do.
    """
    name = about["class"]
    if name not in TouchModel.known and name.startswith("i2t.prediction."):
        import_module(name.partition(":")[0])
    if name not in TouchModel.known:
        module = name.partition(":")[0]
        raise CheckpointError(
            f'the predictor is a {name}, which is not known here; importlib.import_module("{module}") before it is '
            "loaded makes it known"
        )
    kind = TouchModel.known[name]
    hints = get_type_hints(kind)
    given = {key: _array_tree(hints[key], value) for key, value in arrays.items()}
    given |= {key: _setting(hints[key], value) for key, value in about["settings"].items()}
    return kind(**given)


def config_from(kind: type[Config], values: dict[str, Any]) -> Config:
    """A configuration from its JSON form, in which tuples became lists.

    Args:
        kind: Its dataclass.
        values: Fields by name; those left out keep their defaults.

    Returns:
        The configuration.

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
        if isinstance(values[name], list) and len(values[name]) > MAX_LIST:
            raise ValueError(f"{len(values[name])} values of {name}")
        return tuple(values[name]) if isinstance(values[name], list) else values[name]

    return kind(**{name: convert(name) for name in values})


def _are_plain(values: Any) -> bool:
    """Test for a few texts or numbers, and no arrays."""
    return type(values) is tuple and all(isinstance(value, str | int | float | bool) for value in values)


def _plain(node: Any) -> Any:
    """Named tuples as dicts, all the way down, so that files name their fields; numbers of 32 bits, as JAX has them."""
    if isinstance(node, tuple) and hasattr(node, "_asdict"):
        node = node._asdict()
    if isinstance(node, dict):
        return {name: _plain(value) for name, value in node.items()}
    values = np.asarray(node)
    if values.dtype.kind in "iu":
        if values.size and not -MAX_INTEGER <= int(values.min()) <= int(values.max()) <= MAX_INTEGER:
            raise OverflowError(f"whole numbers beyond {MAX_INTEGER}")
        return jnp.asarray(values, jnp.int32)
    if values.dtype.kind not in "fb":
        raise TypeError(f"values of type {values.dtype}")
    return jnp.asarray(values, bool if values.dtype.kind == "b" else jnp.float32)


def _array_tree(kind: Any, value: Any) -> Any:
    """Arrays as a field of this type has them: named tuples again, NumPy's own where they are asked for."""
    if value is None:
        value = jnp.zeros(0)
    if hasattr(kind, "_fields"):
        hints = get_type_hints(kind)
        return kind(**{name: _array_tree(hints[name], each) for name, each in value.items()})
    if isinstance(value, dict):
        return value
    asked = [getattr(each, "array_type", each) for each in get_args(kind) or (kind,)]
    return np.asarray(value) if np.ndarray in asked else value


def _setting(kind: Any, value: Any) -> Any:
    """A configuration of this class or of one that extends it, or a value."""
    if isinstance(value, dict):
        name, allowed = value["config"], [each for each in (get_args(kind) or (kind,)) if isinstance(each, type)]
        found = [each for one in allowed for each in (one, *one.__subclasses__()) if each.__name__ == name]
        if not found:
            raise ValueError(f"{name} is no {kind}")
        return config_from(found[0], value["values"])
    return tuple(value) if isinstance(value, list) else value
