"""Question: which objects were touched in recorded sessions?

    python -m experiments.recognize --dataset DIR                      on the pad model of runs/train
    python -m experiments.recognize --dataset DIR --pad-model runs/skin --rig lab.toml --objects a.stl b.stl --unit mm

Each session is an episode. Its object is recognised with a pad model of the skin that recorded it, as in
`experiments.recognize.run`. The paper's rules use the predictor of the pad model's run. Results go to --out:
metrics.json (95 % intervals over sessions), config.json and figures.
"""

from typing import Any

import numpy as np

from experiments.common.presets import choose_preset
from experiments.common.runs import begin
from experiments.recognize import report as reporting
from experiments.recognize.arguments import DatasetArgs
from experiments.recognize.config import PRESETS
from i2t import dataset as data
from i2t.dataset import source_phrase
from i2t.hardware.rig import Rig
from i2t.models.finished import find_pad_model
from i2t.objects.named import meshes_of_dataset, read_meshes
from i2t.prediction.predictor import load_predictor
from i2t.recognition import metrics
from i2t.recognition.paper_rules import paper_rules
from i2t.recognition.recognizer import RecognizerConfig
from i2t.recognition.recorded import describe
from i2t.recognition.recorded import to_json as pad_model_to_json
from i2t.recognition.sessions import recognize_sessions, require_objects_touched, session_touches
from i2t.recognition.site_pool import prepare_surfaces
from i2t.skin_models.pad_model import load_pad_model


def run(args: DatasetArgs) -> dict[str, Any]:
    """Recognise the objects of recorded sessions, and report the scores."""
    cfg = choose_preset(PRESETS, args.preset, num_particles=args.num_particles)
    dataset = data.load_dataset(args.dataset, skin=args.skin_name)
    require_objects_touched(dataset, str(args.dataset))
    meshes = read_meshes(args.objects, args.unit) or meshes_of_dataset(dataset.objects, str(args.dataset))
    rig = None if args.rig is None else Rig.read(args.rig)
    file, trained = find_pad_model(args.pad_model)
    fitted = load_pad_model(file)
    used = session_touches(
        dataset, fitted, enough=cfg.touches, touches=args.max_touches, other_skin=args.other_skin,
        whose=str(args.dataset),
    )  # fmt: skip
    if used.warning:
        print(used.warning)
    begin(args, cfg)
    print(describe(fitted))
    for correction in used.notes:
        print(f"note: {correction}")
    print(f"{args.dataset} ({source_phrase(dataset.source)}): {used.sessions.describe()}")
    if used.samples:
        print(
            f"{len(dataset)} recorded touches are samples of {len(dataset) - used.samples}: those within 1 s at one "
            "place belong to one contact, and are averaged"
        )
    config = RecognizerConfig(
        num_particles=cfg.num_particles, max_touches=cfg.touches, overtravel=cfg.limits.overtravel, seed=args.seed
    )
    recognized = recognize_sessions(meshes, used, fitted, covariance=(rig or Rig()).object_covariance, config=config)
    beliefs = dict(recognized.beliefs)
    if trained is not None:
        predictors = {"the paper's rules, the run's predictor": load_predictor(trained.folder)}
        surfaces = prepare_surfaces(list(meshes.values()))
        beliefs |= paper_rules(predictors, fitted.model.reading_std, surfaces, recognized.episodes)
    results = reporting.EpisodeResults(
        recognized.names, recognized.episodes.truth, beliefs, recognized.episodes, fitted.origin.pad,
        np.array(recognized.sessions),
    )  # fmt: skip
    parts, temperatures = reporting.calibrate([{"recorded": results}])
    trained_on = sorted(set(fitted.origin.objects) & {results.names[i] for i in results.truth})
    in_fit = None if used.in_fit is None else sum(used.in_fit)
    summary = reporting.summarise(
        parts, args.out, dataset.source, "sessions",
        temperatures=metrics.to_json(temperatures), dataset=str(args.dataset),
        pad_model=pad_model_to_json(fitted) | {"other_skin": used.warning}, touched_with=list(used.pads),
        sessions=used.sessions._asdict(), samples_merged=used.samples, objects_also_trained_on=trained_on,
        sessions_used_in_fit=in_fit,
    )  # fmt: skip
    results = parts[0]["recorded"]
    reporting.report_hardest_episode(results, list(meshes.values()), args.out / "story", dataset.source, dataset.board)
    reporting.print_tables(summary)
    if used.warning:
        print(used.warning)
    if in_fit:
        print(f"{in_fit} of the {len(used.sessions.names)} sessions were USED IN THE FIT of the pad model: not a test")
    if trained_on:
        print(f"the pad model was also fitted to touches of {', '.join(trained_on)}")
    return summary
