"""The four verbs of every model of one skin: fit, predict, left_out, save and load.

    fitted = model.fit(key, data)            # data: touches of one skin
    mean, std = fitted.predict(contact)      # (m, c) uT each, noise included
    errors = fitted.left_out                 # (n, c) uT, of the same touches, each predicted from all others
    fitted.save(path)

A model is a value, a frozen dataclass of options; what `fit` returns is of one skin.

| model | data | contact | fitted |
| --- | --- | --- | --- |
| `calibration.TipModel` | presses of one tip | position and load of that tip | `Calibration` |
| `pressure_gp.PressureModel` | readings of contact pressures | `ContactPressure` | `GP` |
| `pad_fit.ContactModel` | touches of known objects | `ContactPressure` on its layer | `pad_model.KnownPad` |
| `magnetization.MagnetizationModel` | presses of one tip | `ContactPressure` | `PadFit` |

Files are of one format (`i2t.files.serialization`); their header says which model they hold, and
`i2t.skin_models.load` reads any of them.
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
    """Model of one skin."""

    @property
    def left_out(self) -> Float[np.ndarray, "n c"]:
        """Errors (uT) on the touches of the fit, measured minus predicted from all others."""
        ...

    def predict(self, *contact: Contact.args, **options: Contact.kwargs) -> tuple[Any, Any]:
        """Predict readings of contacts that were not measured.

        Args:
            contact: m contacts, as the model describes them.
            options: Of the model.

        Returns:
            Mean and standard deviation, (m, c) uT each, noise included.
        """
        ...

    def save(self, path: Path | str) -> None:
        """Write one file, which appears whole or not at all.

        Args:
            path: Of the file; `.npz` by custom.
        """
        ...


class SkinModel(Protocol[Data, Contact]):
    """Options of a model, which is fitted to touches of one skin."""

    def fit(self, key: Key[Array, ""] | None, data: Data) -> FittedSkinModel[Contact]:
        """Fit the model to touches.

        Args:
            key: Of what the fit draws; None where it draws nothing.
            data: n touches of one skin.

        Returns:
            The model of that skin.
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
    """Read a fitted model from its file.

    Args:
        path: Of the file, or the name of a ready model that has such a part.
        kind: Of file.
        form: Type of the NamedTuple that it holds.
        build: Makes the model of the path, that NamedTuple and what was kept with it.
        ready: Part of the ready models that `path` may name.

    Returns:
        The model.

    Raises:
        SerializationError: The file is missing, damaged, of another kind, or its parts do not fit each other.
    """
    hint = "" if ready is None else ready_hint(path, ready)
    path = path if ready is None else ready_path(path, ready)
    record, about = serialization.load(path, kind, form, missing=hint)
    with serialization.fitting(path):
        return build(path, record, about)
