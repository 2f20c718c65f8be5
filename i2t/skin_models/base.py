"""Interface of all models of one skin: fit, predict, leave_one_out, save and load.

    fitted = model.fit(key, data)            # data: touches of one skin
    mean, std = fitted.predict(contact)      # (m, c) uT each, noise included
    errors = fitted.leave_one_out            # (n, c) uT, of the same touches, each predicted from all others
    fitted.save(path)

A model is a frozen dataclass of options; `fit` returns the model of one skin.

| model | data | contact | fitted |
| --- | --- | --- | --- |
| `calibration.TipModel` | presses of one tip | position and load of that tip | `Calibration` |
| `pressure_gp.PressureModel` | readings of contact pressures | `ContactPressure` | `GP` |
| `pad_fit.ContactModel` | touches of known objects | `ContactPressure` on its layer | `pad_model.KnownPad` |
| `magnetization.MagnetizationModel` | presses of one tip | `ContactPressure` | `PadFit` |

All files have one format (`i2t.files.serialization`), whose header names the model; `i2t.skin_models.load` reads any of
them.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any, ParamSpec, Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Array, Float, Key

from i2t.files import serialization
from i2t.models import Part, ready_hint, ready_path

Contact = ParamSpec("Contact")
Data = TypeVar("Data", contravariant=True)
Record, Fitted = TypeVar("Record"), TypeVar("Fitted")


@runtime_checkable
class FittedSkinModel(Protocol[Contact]):
    """Interface of a fitted model of one skin: it predicts readings of contacts."""

    @property
    def leave_one_out(self) -> Float[np.ndarray, "n c"]:
        """Errors (uT) on the touches of the fit, measured minus predicted from all other touches."""
        ...

    def predict(self, *contact: Contact.args, **options: Contact.kwargs) -> tuple[Any, Any]:
        """Predict readings of contacts that were not measured.

        Args:
            contact: m contacts in the form that the model takes, such as contact pressures, or positions and loads.
            options: Options of the model.

        Returns:
            `(m, c)` means and standard deviations of the readings (uT), noise included.
        """
        ...

    def save(self, path: Path | str) -> None:
        """Write the model to one file, which appears whole or not at all.

        Args:
            path: Path of the file; `.npz` by convention.
        """
        ...


class SkinModel(Protocol[Data, Contact]):
    """Interface of the options of a skin model, whose `fit` fits the model to touches of one skin."""

    def fit(self, key: Key[Array, ""] | None, data: Data) -> FittedSkinModel[Contact]:
        """Fit the model to touches.

        Args:
            key: Random key of the fit; None if it draws nothing.
            data: n touches of one skin.

        Returns:
            The fitted model of that skin.
        """
        ...


def load_fitted(
    path: Path | str,
    kind: str,
    form: type[Record],
    build: Callable[[Path | str, Record, dict[str, Any]], Fitted],
    *,
    ready: Part | None = None,
) -> Fitted:
    """Read a fitted skin model of one kind from its file.

    Args:
        path: Path of the file, or the name of a ready model that has this part.
        kind: Kind of file, as stored in it.
        form: Type of the NamedTuple that the file holds.
        build: Function that builds the model from the path, the NamedTuple and the metadata.
        ready: Part of the ready models that `path` may name.

    Returns:
        The fitted model that `build` returns.

    Raises:
        SerializationError: The file is missing, damaged, of another kind, or its parts do not fit each other.
    """
    hint = "" if ready is None else ready_hint(path, ready)
    path = path if ready is None else ready_path(path, ready)
    record, about = serialization.load(path, kind, form, missing=hint)
    with serialization.fitting(path):
        return build(path, record, about)
