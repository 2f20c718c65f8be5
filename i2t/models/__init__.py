"""Ready models, which are part of the package: a predictor of touches and a pad model for a start within seconds.

    predictor = i2t.load_predictor("nominal")
    pad_model = i2t.load_pad_model("nominal")
    dataset = i2t.load_dataset("nominal")
    calibration = i2t.load_calibration("eflesh")

"nominal" is one simulated pad, number 0 of `i2t.skin.pad.pad_from_seed`: a layer drawn about the nominal one, with its
own uneven magnetisation. It was not fitted to a real skin and does not match one; real touches need a model of your own
skin. "eflesh" is the calibration of one real skin of another kind, a printed lattice with four magnets, pressed by a
spherical tip. docs/model_card.md lists figures and limits, which `python -m tools.ready_models` computes.
"""

import os
from pathlib import Path
from typing import Any, Literal

from i2t.errors import closest, did_you_mean
from i2t.files.reading import read_json
from i2t.files.writing import as_path
from i2t.installation import training_commands

Part = Literal["predictor", "pad_model.npz", "touches.h5", "calibration.npz", "metrics.json"]
# Files of each model that comes with the package.
READY_MODELS: dict[str, tuple[Part, ...]] = {
    "nominal": ("predictor", "pad_model.npz", "touches.h5", "metrics.json"),
    "eflesh": ("calibration.npz", "metrics.json"),
}


def ready_path(name: str | os.PathLike[str], part: Part) -> Path:
    """Resolve the name of a ready model to the path of one of its parts; keep any other path.

    Args:
        name: Name of a ready model, or a path. An existing file or folder takes precedence over a model of that name.
        part: Part of the model.

    Returns:
        The path of the part, or `name` as a path.

    Raises:
        TypeError: The name is neither text nor a path.
        ValueError: The name is empty.
    """
    path = as_path("path", name)
    if isinstance(name, str) and part in READY_MODELS.get(name, ()) and not path.exists():
        return Path(__file__).parent / name / part
    return path


def ready_hint(name: str | os.PathLike[str], part: Part, *, list_all: bool = True) -> str:
    """Word the remedy for a path that does not exist, by naming the ready model that may be meant.

    Args:
        name: The name or path that the user gave.
        part: Part of the model.
        list_all: Whether all ready models are named if the name resembles none of them.

    Returns:
        The end of a sentence: "; did you mean nominal?", or ", or a ready model, nominal", or nothing.
    """
    names = [model for model, parts in READY_MODELS.items() if part in parts]
    close = closest(as_path("path", name).name, names)
    others = f", or a ready model, {' or '.join(names)}" if list_all else ""
    return f"; did you mean {close}?" if close else others


def explain_no_predictor(name: str | os.PathLike[str]) -> str:
    """Explain why a path holds no predictor, with a remedy.

    Args:
        name: The name or path that the user gave.

    Returns:
        The rest of a sentence that begins with the path.
    """
    path = as_path("path", name)
    writers = f"name the folder that {training_commands()} wrote"
    if path.exists():
        return f"holds no predictor of this i2t; {writers}{ready_hint(name, 'predictor')}"
    near = path.parent.is_dir() and closest(
        path.name, [other.name for other in path.parent.iterdir() if other.is_dir()]
    )
    hint = ready_hint(name, "predictor", list_all=False) or (near and f"; did you mean {path.with_name(near)}?")
    return f"there is no such folder{hint or f'; {writers}' + ready_hint(name, 'predictor')}"


def model_card(name: str) -> dict[str, Any]:
    """Read the data and scores of a ready model.

    Args:
        name: Name of the model.

    Returns:
        The model's source, data and scores, as docs/model_card.md lists them.

    Raises:
        ValueError: There is no ready model of this name.
    """
    if name not in READY_MODELS:
        raise ValueError(f"{name} is not a ready model; {did_you_mean(name, READY_MODELS)}")
    return read_json(Path(__file__).parent / name / "metrics.json", 2**16)
