"""Ready models, which come with the package: a predictor of touches and a pad model, to start from in seconds.

    predictor = i2t.load_predictor("nominal")
    known = i2t.load_pad_model("nominal")
    calibration = i2t.load_calibration("eflesh")

"nominal" is one simulated pad, number 0 of `i2t.skin.pad.numbered_pad`: a layer drawn about the nominal one, with an
uneven magnetisation of its own. No real skin was touched for it, and no real skin reads as it does: take a model of
your own skin for real touches. "eflesh" is the calibration of one real skin of another kind, a printed lattice with
four magnets, pressed by a spherical tip. Figures and limits are in docs/model_card.md, made by
`python -m tools.ready_models`.
"""

import os
from pathlib import Path
from typing import Any, Literal

from i2t.errors import closest, did_you_mean
from i2t.files.reading import read_json
from i2t.files.writing import as_path

MAX_CARD_BYTES = 2**16
Part = Literal["predictor", "pad_model.npz", "calibration.npz", "metrics.json"]
READY_MODELS: dict[str, tuple[Part, ...]] = {
    "nominal": ("predictor", "pad_model.npz", "metrics.json"),
    "eflesh": ("calibration.npz", "metrics.json"),
}  # and their parts


def ready_path(name: str | os.PathLike[str], part: Part) -> Path:
    """Path of a part of a ready model, or the given path otherwise.

    Args:
        name: Of a ready model, or a path; where a file or folder of that name is at hand, it is meant.
        part: Of the model.

    Returns:
        The part's path, or `name` as a path.

    Raises:
        TypeError: The name is neither text nor a path.
        ValueError: It is empty.
    """
    path = as_path("path", name)
    if isinstance(name, str) and part in READY_MODELS.get(name, ()) and not path.exists():
        return Path(__file__).parent / name / part
    return path


def ready_hint(name: str | os.PathLike[str], part: Part) -> str:
    """The remedy where nothing is found under a name: the ready model that may be meant.

    Args:
        name: As given.
        part: Of the model.

    Returns:
        The end of a sentence: "; did you mean nominal?", or ", or a ready model, nominal".
    """
    names = [model for model, parts in READY_MODELS.items() if part in parts]
    close = closest(as_path("path", name).name, names)
    return f"; did you mean {close}?" if close else f", or a ready model, {' or '.join(names)}"


def model_card(name: str) -> dict[str, Any]:
    """Data and scores of a ready model.

    Args:
        name: Of the model.

    Returns:
        Its source, data and figures, as docs/model_card.md gives them.

    Raises:
        ValueError: There is no model of this name.
    """
    if name not in READY_MODELS:
        raise ValueError(f"{name} is no ready model; {did_you_mean(name, READY_MODELS)}")
    return read_json(Path(__file__).parent / name / "metrics.json", MAX_CARD_BYTES)
