"""Models of any class on disk: their fields are restored, and fields that no file can hold are refused at once."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pytest

from i2t.prediction.predictor import Predictor, load_predictor
from i2t.prediction.touch_model import Reading, TouchBatch, TouchModel, to_disk


class Pair(NamedTuple):
    first: np.ndarray
    second: np.ndarray


@dataclass(frozen=True)
class Sizes:
    width: int = 3
    names: tuple[str, ...] = ("x",)


@dataclass(frozen=True)
class Anything(TouchModel):
    rows: np.ndarray
    flags: np.ndarray
    empty: np.ndarray
    tree: dict[str, Any]
    pair: Pair
    sizes: Sizes | None
    other: Sizes | None
    number: float
    extra: Any = None

    @property
    def channels(self) -> int:
        return 3

    def predict_batch(self, touches: TouchBatch) -> Reading:
        return Reading(np.zeros((len(touches.patch), 3)), np.ones((len(touches.patch), 3)))


def anything(extra: Any = None) -> Anything:
    tree = {"a": np.ones(3), "b": {"c": np.arange(2)}}
    pair = Pair(np.ones(2), np.zeros((2, 2)))
    return Anything(
        np.arange(5), np.array([True, False]), np.zeros((0, 5)), tree, pair, Sizes(7, ("y", "z")), None, 2.5, extra
    )


def test_all_fields_of_a_model_are_restored(tmp_path):
    original = anything()
    Predictor(original, 17e-3, 4e-3, 1.0, 3e-4).save(tmp_path / "p")
    back: Any = load_predictor(tmp_path / "p").model
    assert type(back) is Anything
    assert (back.sizes, back.other, back.number) == (original.sizes, None, 2.5)
    assert (back.rows.dtype, back.flags.dtype, back.tree["b"]["c"].dtype) == (np.int32, bool, np.int32)
    for name in ("rows", "flags", "empty"):
        np.testing.assert_array_equal(getattr(back, name), getattr(original, name))
    np.testing.assert_array_equal(back.pair.second, original.pair.second)
    np.testing.assert_array_equal(back.tree["b"]["c"], original.tree["b"]["c"])


@pytest.mark.parametrize("extra", [[np.ones(2), np.ones(3)], {"a": "text"}, print, np.array(["a"]), np.array([2**40])])
def test_fields_that_cannot_be_saved_are_refused_in_one_sentence(extra):
    with pytest.raises(ValueError, match=r"Anything\.extra cannot be kept on disk") as error:
        to_disk(anything(extra))
    assert "\n" not in str(error.value)
