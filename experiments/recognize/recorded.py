"""Question: which objects were touched in recorded sessions?

    python -m experiments.recognize --dataset DIR                      on the pad model of runs/train
    python -m experiments.recognize --dataset DIR --pad-model runs/skin --rig lab.toml --objects a.stl b.stl --unit mm

Each session is an episode. Its object is recognised with a pad model of the skin that recorded it, as in
`experiments.recognize.run`. The paper's rules use the predictor of the pad model's run. Results go to --out:
metrics.json (95 % intervals over sessions), config.json and figures.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from experiments.common.presets import choose_preset
from experiments.common.runs import begin
from experiments.recognize import report as reporting
from experiments.recognize.arguments import DatasetArgs
from experiments.recognize.config import PRESETS, Recognition
from experiments.recognize.plans import load_meshes, meshes_by_name
from i2t import dataset as data
from i2t.dataset import Dataset, source_phrase
from i2t.errors import DataError
from i2t.hardware.rig import Rig
from i2t.models.finished import find_pad_model
from i2t.objects import Mesh, catalogue
from i2t.prediction.predictor import Predictor, load_predictor
from i2t.recognition import belief, metrics
from i2t.recognition.belief import Particles
from i2t.recognition.episodes import BeliefModel, believe, episodes_from_dataset, usable_touches
from i2t.recognition.paper_rules import paper_rules
from i2t.recognition.recorded import describe, merge_samples
from i2t.recognition.recorded import to_json as pad_model_to_json
from i2t.recognition.site_pool import prepare_surfaces
from i2t.recordings.sets import corrected_dataset
from i2t.skin_models.pad_model import KnownPad, load_pad_model, require_skin


class Sessions(NamedTuple):
    """The sessions that are used, and the numbers of their touches."""

    names: tuple[str, ...]  # in the order of the episodes
    touches: int  # number of touches that are used of each session, the first ones
    usable: tuple[int, ...]  # number of usable touches of each session
    left_out: tuple[str, ...]  # sessions with too few touches
    asked: int = 0  # touches of each session that the options or the preset ask for

    def describe(self) -> str:
        """Describe the sessions in one line."""
        fewest, most = min(self.usable), max(self.usable)
        sentence = f"{len(self.names)} sessions of {fewest if fewest == most else f'{fewest} to {most}'} usable touches"
        if most > self.touches:
            sentence += f", of which the first {self.touches} are used (--max-touches N for more from longer sessions)"
        if self.touches < self.asked:
            sentence += f"; no session has the {self.asked} that were asked for"
        if self.left_out:
            sentence += f"; left out, with too few: {', '.join(self.left_out)}"
        return sentence


def run(args: DatasetArgs) -> dict[str, Any]:
    """Recognise the objects of recorded sessions, and report the scores."""
    cfg = choose_preset(PRESETS, args.preset, num_particles=args.num_particles)
    loaded, corrections = corrected_dataset(data.load_dataset(args.dataset, skin=args.skin_name))
    recorded = merge_samples(loaded)
    meshes = load_meshes(args.objects, args.unit) or meshes_of(recorded.objects, args.dataset)
    sessions = choose_sessions(recorded, cfg.touches, args.max_touches)
    rig = None if args.rig is None else Rig.read(args.rig)
    file, trained = find_pad_model(args.pad_model)
    fitted = load_pad_model(file)
    used = recorded.select(np.isin(recorded.touches.session, [recorded.sessions.index(n) for n in sessions.names]))
    pads = [recorded.pads[i] for i in np.unique(used.touches.pad)]
    warning = require_skin(fitted, pads, recorded.board, str(args.dataset), other_skin=args.other_skin)
    if warning:
        print(warning)
    begin(args, cfg)
    print(describe(fitted))
    for correction in corrections:
        print(f"note: {correction}")
    print(f"{args.dataset} ({source_phrase(recorded.source)}): {sessions.describe()}")
    if len(recorded) < len(loaded):
        print(
            f"{len(loaded)} recorded touches are samples of {len(recorded)}: those within 1 s at one "
            "place belong to one contact, and are averaged"
        )
    particles = belief.sample_particles((rig or Rig()).object_covariance, cfg.num_particles, args.seed)
    predictor = None if trained is None else load_predictor(trained.folder)
    results = recognise(used, meshes, sessions, fitted=fitted, predictor=predictor, particles=particles, cfg=cfg)
    parts, temperatures = reporting.calibrate([{"recorded": results}])
    trained_on = sorted(set(fitted.origin.objects) & {results.names[i] for i in results.truth})
    summary = reporting.summarise(
        parts, args.out, recorded.source, "sessions",
        temperatures=metrics.to_json(temperatures), dataset=str(args.dataset),
        pad_model=pad_model_to_json(fitted) | {"other_skin": warning}, touched_with=pads,
        sessions=sessions._asdict(), samples_merged=len(loaded) - len(recorded), objects_also_trained_on=trained_on,
    )  # fmt: skip
    results = parts[0]["recorded"]
    reporting.report_hardest_episode(
        results, list(meshes.values()), args.out / "story", recorded.source, recorded.board
    )
    reporting.print_tables(summary)
    if warning:
        print(warning)
    if trained_on:
        print(f"the pad model was also fitted to touches of {', '.join(trained_on)}")
    return summary


def meshes_of(names: Sequence[str], dataset: Path) -> dict[str, Mesh]:
    """Load the meshes of a data set's objects (DataError: the catalogue lacks one, or there is only one object)."""
    missing = [name for name in names if name not in catalogue.NAMES]
    if missing:
        raise DataError(
            f"{dataset} has touches of {', '.join(missing)}, of which there is no mesh; name all objects to "
            f"distinguish, with a mesh of that name, for instance --objects star {missing[0]}.stl --unit mm"
        )
    if len(names) < 2:
        raise DataError(f"{dataset} has touches of {names[0]} only; name the objects to distinguish: --objects")
    return meshes_by_name(names)


def choose_sessions(recorded: Dataset, enough: int, max_touches: int | None) -> Sessions:
    """Choose the sessions that are long enough, and the number of touches to use of each.

    Args:
        recorded: The data set.
        enough: Minimum number of touches of a session, if `max_touches` is None.
        max_touches: Number of touches to use of each session; by default the number in the shortest chosen session.

    Returns:
        The sessions with the number of touches.

    Raises:
        DataError: No session has a usable touch, or `max_touches` of them.
    """
    counts = {recorded.sessions[i]: len(rows) for i, rows in usable_touches(recorded.touches).items()}
    longest = max(counts.values(), default=0)
    if not longest or (max_touches or 0) > longest:
        raise DataError(
            f"no session has {max_touches or 'any'} touches with a measured force; the longest has {longest}"
        )
    least = max_touches or min(enough, longest)
    kept = {name: count for name, count in counts.items() if count >= least}
    return Sessions(
        names=tuple(kept),
        touches=max_touches or min(kept.values()),
        usable=tuple(kept.values()),
        left_out=tuple(f"{name} ({count})" for name, count in counts.items() if name not in kept),
        asked=max_touches or enough,
    )


def recognise(
    recorded: Dataset,
    meshes: dict[str, Mesh],
    sessions: Sessions,
    *,
    fitted: KnownPad,
    predictor: Predictor | None,
    particles: Particles,
    cfg: Recognition,
) -> reporting.EpisodeResults:
    """Compute the beliefs of every method in recorded sessions, which are independent trials."""
    surfaces = prepare_surfaces(list(meshes.values()))
    model, overtravel = fitted.model, cfg.limits.overtravel
    sites, episodes = episodes_from_dataset(recorded, list(meshes), sessions.touches, overtravel=overtravel)
    models = {"": BeliefModel(model.reading_model, model.likelihood)}
    beliefs = believe(surfaces, sites, episodes, particles, models, overtravel=overtravel, label="recorded")
    if predictor is not None:
        predictors = {"the paper's rules, the run's predictor": predictor}
        beliefs |= paper_rules(predictors, model.reading_std, surfaces, episodes)
    return reporting.EpisodeResults(
        tuple(meshes), episodes.truth, beliefs, episodes, fitted.origin.pad, np.array(sessions.names)
    )  # fmt: skip
