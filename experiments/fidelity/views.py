"""Several objects seen by a camera and touched: how well readings are predicted from views, objects held out."""

import numpy as np

from experiments.fidelity.config import FidelityPreset
from experiments.fidelity.forward import explained_share
from experiments.fidelity.sections import CannotTellError, Section, cell
from i2t.calibration.heads import SkinRecording
from i2t.prediction.baselines import Nearest, NearestMeasured, Ridge, RidgeMeasured, mean_of, patch_features
from i2t.prediction.touch_model import TouchBatch

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
    readings, views = recording.readings, recording.patches.astype(np.float64)
    load = {name: recording.targets[name][:, 0] for name in ("force", "depth") if recording.known(name).all()}
    unknown = np.full(len(recording), np.nan)
    asked = TouchBatch(views, views, np.nan, load.get("force", unknown), unknown, load.get("depth", unknown))
    asked = asked._replace(**{name: getattr(asked, name)[test] for name in ("patch", "view", "force", "depth")})
    features = patch_features(views[train])
    models = {"mean reading": mean_of(readings[train])}
    for method in (Nearest(), Ridge(), *((NearestMeasured(), RidgeMeasured()) if load else ())):
        conditions = tuple(load) if method.measured else ()
        measured = np.reshape([load[name][train] for name in conditions], (len(conditions), len(train))).T
        models[method.title] = method.model(
            features, conditions, views[train], measured, readings[train], labels[train]
        )
    predicted = {name: model.predict_batch(asked).mean for name, model in models.items()}
    scores = {name: explained_share(readings[test], values) for name, values in predicted.items()}
    section.numbers |= {"objects": len(names), "held_out_touches": len(test), "r2": scores}
    section.tables[f"R2 on {len(test)} touches of objects not seen"] = [
        ["method", "R2"],
        *([name, cell(score)] for name, score in scores.items()),
    ]
    section.sentences.append(
        "These are the baselines that a predictor has to beat; python -m experiments.train --dataset DIR trains one."
    )
