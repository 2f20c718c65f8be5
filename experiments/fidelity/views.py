"""Several objects seen by a camera and touched: how well readings are predicted from views, objects held out."""

import numpy as np

from experiments.fidelity.config import FidelityPreset
from experiments.fidelity.forward import explained_share
from experiments.fidelity.sections import CannotTellError, Section, cell
from i2t.calibration.heads import SkinRecording
from i2t.prediction.baselines import fit_baselines, measured_count, predict

MIN_OBJECTS = 3
MAX_VIEWS = 1500


def view_section(recording: SkinRecording, preset: FidelityPreset, seed: int, section: Section) -> None:
    """R2 of every baseline on objects that it has not seen."""
    labels = recording.labels
    if recording.patches is None or labels is None:
        raise CannotTellError("The recording has no views of what was touched.")
    names = np.unique(labels)
    if len(names) < MIN_OBJECTS:
        many = "1 object is" if len(names) == 1 else f"{len(names)} objects are"
        raise CannotTellError(
            f"{many} seen; {MIN_OBJECTS} are needed to hold some out. A predictor from views is "
            "trained by experiments.train."
        )
    rng = np.random.default_rng(seed)
    held = np.isin(labels, rng.permutation(names)[: max(round(len(names) / 3), 1)])
    train, test = (rng.permutation(np.flatnonzero(rows))[:MAX_VIEWS] for rows in (~held, held))
    conditions = _measured(recording)
    views = recording.patches.astype(np.float64)
    fitted = fit_baselines(views[train], conditions[train], recording.readings[train], labels[train])
    predicted = {
        name: predict(one, views[test], conditions[test][:, : measured_count(one)])[0] for name, one in fitted.items()
    }
    scores = {name: explained_share(recording.readings[test], values) for name, values in predicted.items()}
    section.numbers |= {"objects": len(names), "held_out_touches": len(test), "r2": scores}
    section.tables[f"R2 on {len(test)} touches of objects not seen"] = [
        ["method", "R2"],
        *([name, cell(score)] for name, score in scores.items()),
    ]
    section.sentences.append(
        "These are the baselines that a predictor has to beat; python -m experiments.train --dataset DIR trains one."
    )


def _measured(recording: SkinRecording) -> np.ndarray:
    """(n, k): force and depth where they are known throughout."""
    known = [recording.targets[name] for name in ("force", "depth") if recording.known(name).all()]
    return np.concatenate(known, axis=1) if known else np.zeros((len(recording), 0))
