"""Models of one skin, fitted to its touches, with one interface (`base`): fit, predict, leave_one_out, save and load.

`calibration` models one tip by the Gaussian process of `tip_gp`. Two models serve any contact: `pressure_gp`, a
Gaussian process over contact pressure, and `pad_model`, which `pad_fit` fits to touches of known objects and which
combines a `reading_model` of the pressure on a `layer` with the `likelihood` of its errors. `magnetization` fits a
`Pad` to simulate with. `check_presses` reports recorded presses that contradict any sound skin.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from i2t.errors import SerializationError
from i2t.files import serialization
from i2t.recordings.diagnose import check_presses
from i2t.skin_models.base import FittedSkinModel, SkinModel
from i2t.skin_models.calibration import Calibration, LoadKind, TipModel, TipPresses, calibrate, load_calibration
from i2t.skin_models.tip_gp.structured import (
    FORCE_HYPERPARAMETERS,
    TRAVEL_HYPERPARAMETERS,
    StructuredGPHyperparameters,
)

__all__ = [
    "FORCE_HYPERPARAMETERS", "TRAVEL_HYPERPARAMETERS", "Calibration", "FittedSkinModel", "LoadKind",
    "SkinModel", "StructuredGPHyperparameters", "TipModel", "TipPresses", "calibrate", "check_presses", "load",
    "load_calibration",
]  # fmt: skip


def load(path: Path | str) -> FittedSkinModel[Any]:
    """Read a fitted model of a skin, of any kind.

    Args:
        path: Path of a file that the `save` of a fitted model wrote.

    Returns:
        The fitted model; its class depends on the kind of file.

    Raises:
        SerializationError: The file is missing, damaged or holds no model of a skin.
    """
    from i2t.skin_models import calibration, magnetization, pad_model, pressure_gp

    readers: dict[str, Callable[[Path | str], FittedSkinModel[Any]]] = {
        calibration.FILE_KIND: load_calibration,
        magnetization.FILE_KIND: magnetization.load_pad_fit,
        pad_model.PAD_MODEL_KIND: pad_model.load_pad_model,
        pressure_gp.FILE_KIND: pressure_gp.load_pressure_gp,
    }
    if (kind := serialization.file_kind(path)) not in readers:
        raise SerializationError(
            f"{path}: holds a {kind}, which is not a model of a skin; name a file that `save` wrote"
        )
    return readers[kind](path)
