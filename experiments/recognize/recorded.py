"""Question: which objects were touched in recorded sessions?

    python -m experiments.recognize --dataset DIR                      on the pad model of runs/train
    python -m experiments.recognize --dataset DIR --pad-model runs/skin --rig lab.toml --objects a.stl b.stl --unit mm

Each session is an episode, judged by a pad model of the very skin that recorded it, as in `experiments.recognize.run`;
the paper's rules are applied to the predictor that the run of the pad model kept. Results go to --out: metrics.json
(95 % intervals over sessions), config.json and figures.
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
from experiments.train.finished import find_pad_model
from i2t import dataset as data
from i2t.dataset import Dataset, source_phrase
from i2t.errors import DataError
from i2t.hardware.rig import Rig
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

KEPT_PREDICTOR = "the paper's rules, the run's predictor"  # whose readings the paper's rules are given


class Sessions(NamedTuple):
    """Sessions that count, and numbers of their touches."""

    names: tuple[str, ...]  # in the order of the episodes
    touches: int  # of each, the first
    usable: tuple[int, ...]  # of each
    left_out: tuple[str, ...]  # with fewer
    asked: int = 0  # touches of each that the options or the preset ask for

    def describe(self) -> str:
        """Describe the sessions in one line."""
        fewest, most = min(self.usable), max(self.usable)
        sentence = f"{len(self.names)} sessions of {fewest if fewest == most else f'{fewest} to {most}'} usable touches"
        if most > self.touches:
            sentence += f", the first {self.touches} of each count (--max-touches N for more from the longer ones)"
        if self.touches < self.asked:
            sentence += f", and not the {self.asked} that were asked for, which no session has"
        if self.left_out:
            sentence += f"; left out, with fewer: {', '.join(self.left_out)}"
        return sentence


def run(args: DatasetArgs) -> dict[str, Any]:
    """Recognise the objects of recorded sessions, and write down how often and how sure."""
    cfg = choose_preset(PRESETS, args.preset, num_particles=args.num_particles)
    loaded, corrections = corrected_dataset(data.load_dataset(args.dataset, skin=args.skin_name))
    recorded = merge_samples(loaded)
    meshes = load_meshes(args.objects, args.unit) or meshes_of(recorded.objects, args.dataset)
    sessions = choose_sessions(recorded, cfg.touches, args.max_touches)
    rig = None if args.rig is None else Rig.read(args.rig)
    file, trained = find_pad_model(args.pad_model)
    known = load_pad_model(file)
    used = recorded.select(np.isin(recorded.touches.session, [recorded.sessions.index(n) for n in sessions.names]))
    pads = [recorded.pads[i] for i in np.unique(used.touches.pad)]
    warning = require_skin(known, pads, recorded.board, str(args.dataset), other_skin=args.other_skin)
    if warning:
        print(warning)
    begin(args, cfg)
    print(describe(known))
    for correction in corrections:
        print(f"note: {correction}")
    print(f"{args.dataset} ({source_phrase(recorded.source)}): {sessions.describe()}")
    if len(recorded) < len(loaded):
        print(
            f"{len(loaded)} recorded touches are samples of {len(recorded)}: those within 1 s at one "
            "place are of one contact, and count as one touch with their mean reading"
        )
    particles = belief.sample_particles((rig or Rig()).object_covariance, cfg.num_particles, args.seed)
    predictor = None if trained is None else load_predictor(trained.folder)
    results = recognise(used, meshes, sessions, known=known, predictor=predictor, particles=particles, cfg=cfg)
    parts, temperatures = reporting.calibrate([{"recorded": results}])
    trained_on = sorted(set(known.origin.objects) & {results.names[i] for i in results.truth})
    summary = reporting.summarise(
        parts, args.out, recorded.source, "sessions",
        temperatures=metrics.to_json(temperatures), dataset=str(args.dataset),
        pad_model=pad_model_to_json(known) | {"other_skin": warning}, touched_with=pads,
        sessions=sessions._asdict(), samples_merged=len(loaded) - len(recorded), objects_also_trained_on=trained_on,
    )  # fmt: skip
    found = parts[0]["recorded"]
    reporting.report_hardest_episode(found, list(meshes.values()), args.out / "story", recorded.source, recorded.board)
    reporting.print_tables(summary)
    if warning:
        print(warning)
    if trained_on:
        print(f"the pad model was fitted to touches of {', '.join(trained_on)} too")
    return summary


def meshes_of(names: Sequence[str], dataset: Path) -> dict[str, Mesh]:
    """Meshes of the objects of a data set; DataError where the catalogue lacks one, or where there is only one."""
    missing = [name for name in names if name not in catalogue.NAMES]
    if missing:
        raise DataError(
            f"{dataset} has touches of {', '.join(missing)}, of which there is no mesh; name all objects to tell "
            f"apart, with a mesh of that name among them, for instance --objects star {missing[0]}.stl --unit mm"
        )
    if len(names) < 2:
        raise DataError(f"{dataset} has touches of {names[0]} only; name the objects to tell apart: --objects")
    return meshes_by_name(names)


def choose_sessions(recorded: Dataset, enough: int, max_touches: int | None) -> Sessions:
    """Sessions that are long enough, and how many touches of each count.

    Args:
        recorded: The data set.
        enough: Touches that a session has to have, where the user does not say.
        max_touches: How many the user wants of each session.

    Returns:
        As many touches as the shortest of these sessions has, or as the user wants.

    Raises:
        DataError: No session has a usable touch, or as many as the user wants.
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
    known: KnownPad,
    predictor: Predictor | None,
    particles: Particles,
    cfg: Recognition,
) -> reporting.EpisodeResults:
    """Beliefs of every method along recorded sessions, each an independent trial with a placement of its own."""
    surfaces = prepare_surfaces(list(meshes.values()))
    model, overtravel = known.model, cfg.limits.overtravel
    sites, episodes = episodes_from_dataset(recorded, list(meshes), sessions.touches, overtravel=overtravel)
    models = {"": BeliefModel(model.reading_model, model.likelihood)}
    believed = believe(surfaces, sites, episodes, particles, models, overtravel=overtravel, label="recorded")
    if predictor is not None:
        believed |= paper_rules({KEPT_PREDICTOR: predictor}, model.reading_std, surfaces, episodes)
    return reporting.EpisodeResults(
        tuple(meshes), episodes.truth, believed, episodes, known.origin.pad, np.array(sessions.names)
    )  # fmt: skip
