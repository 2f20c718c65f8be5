"""Recorded touches as episodes: each session is one, judged by a pad model of the skin that recorded it."""

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import numpy as np

from experiments.common.runs import begin
from experiments.recognize import pad_sources
from experiments.recognize import report as reporting
from experiments.recognize.arguments import SimulateArgs
from experiments.recognize.config import Recognition
from experiments.recognize.trained_run import load_meshes, meshes_by_name
from i2t import dataset as data
from i2t.dataset import Dataset, source_words
from i2t.dataset.sets import times_of
from i2t.errors import DataError
from i2t.geometry import inverse
from i2t.hardware.rig import Rig
from i2t.objects import Mesh, catalogue
from i2t.prediction.predictor import Predictor
from i2t.recognition import belief, metrics
from i2t.recognition.belief import Particles
from i2t.recognition.episodes import BeliefModel, believe, episodes_from_dataset, usable_touches
from i2t.recognition.paper_rules import paper_rules
from i2t.recognition.site_pool import prepare_surfaces
from i2t.recordings.samples import first_samples, mean_samples
from i2t.recordings.sets import corrected_dataset
from i2t.skin_models.pad_model import KnownPad, require_skin, save_pad_model

SAME_PLACE_M, SAME_TURN, SAME_PRESS_S = 2e-4, 4e-3, 1.0  # m, rad and s within which touches are of one contact
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


def run(args: SimulateArgs, cfg: Recognition) -> dict[str, Any]:
    """Recognise the objects of recorded sessions, and write down how often and how sure."""
    assert args.dataset is not None
    loaded, corrections = corrected_dataset(data.load_dataset(args.dataset, skin=args.skin_name))
    recorded = merge_samples(loaded)
    meshes = candidate_meshes(args, recorded)
    sessions = choose_sessions(recorded, cfg.touches, args.max_touches)
    rig = None if args.rig is None else Rig.read(args.rig)
    source = pad_sources.find_pad_source(pad=args.pad, run=args.trained_run, cfg=cfg, meshes=meshes, rig=rig)
    used = recorded.select(np.isin(recorded.touches.session, [recorded.sessions.index(n) for n in sessions.names]))
    pads = [recorded.pads[i] for i in np.unique(used.touches.pad)]
    warning = require_skin(source.skin, pads, recorded.board, str(args.dataset), other_skin=args.other_skin)
    if warning:
        print(warning)
    begin(args.out, args, cfg, args.resume, args.overwrite)
    known = source.make(jax.random.key(args.seed))
    print(pad_sources.describe(known))
    for correction in corrections:
        print(f"note: {correction}")
    print(f"{args.dataset} ({source_words(recorded.source)}): {sessions.describe()}")
    if len(recorded) < len(loaded):
        print(
            f"{len(loaded)} recorded touches are samples of {len(recorded)}: those within {SAME_PRESS_S:g} s at one "
            "place are of one contact, and count as one touch with their mean reading"
        )
    save_pad_model(args.out / "pad_model.npz", known)
    particles = belief.sample_particles((rig or Rig()).object_covariance, cfg.num_particles, args.seed)
    results = recognise(
        used, meshes, sessions, known=known, predictor=source.predictor, particles=particles, cfg=cfg
    )  # fmt: skip
    parts, temperatures = reporting.calibrate([{"recorded": results}])
    trained_on = sorted(set(known.origin.objects) & {results.names[i] for i in results.truth})
    summary = reporting.summarise(
        parts, args.out, recorded.source, "sessions",
        temperatures=metrics.to_json(temperatures), dataset=str(args.dataset),
        pad_model=pad_sources.to_json(known) | {"other_skin": warning}, touched_with=pads,
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


def candidate_meshes(args: SimulateArgs, recorded: Dataset) -> dict[str, Mesh]:
    """The objects to tell apart: those of --objects, or those of the data set."""
    if args.objects:
        return load_meshes(args.objects, args.unit)
    missing = [name for name in recorded.objects if name not in catalogue.NAMES]
    if missing:
        raise DataError(
            f"{args.dataset} has touches of {', '.join(missing)}, of which there is no mesh; name all objects to tell "
            f"apart, with a mesh of that name among them, for instance --objects star {missing[0]}.stl --unit mm"
        )
    if len(recorded.objects) < 2:
        raise DataError(
            f"{args.dataset} has touches of {recorded.objects[0]} only; name the objects to tell apart: --objects"
        )
    return meshes_by_name(recorded.objects)


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


def merge_samples(recorded: Dataset) -> Dataset:
    """Make one touch of samples of one contact: usable touches of a session that follow each other within a second with
    the tool where it was, which no arm lifts and presses again in. They share the contact's errors, so that they are no
    independent touches.

    Args:
        recorded: Touches in order of time.

    Returns:
        The same touches, or fewer; readings, forces and depths of those that were merged are means.
    """
    touches, time = recorded.touches, times_of(recorded)
    usable = np.isin(np.arange(len(recorded)), np.concatenate(list(usable_touches(touches).values())))
    moved = inverse(touches.T_w_t[:-1]) @ touches.T_w_t[1:]
    turned = np.arccos(np.clip((np.trace(moved[:, :3, :3], axis1=1, axis2=2) - 1) / 2, -1, 1))
    follows = (np.linalg.norm(moved[:, :3, 3], axis=1) < SAME_PLACE_M) & (turned < SAME_TURN)
    follows &= usable[1:] & usable[:-1]
    for same in (touches.session, touches.code):
        follows &= same[1:] == same[:-1]
    with np.errstate(invalid="ignore"):
        follows &= (np.diff(time) >= 0) & (np.diff(time) < SAME_PRESS_S)  # false where a time is unknown
    starts = first_samples(follows)
    if len(starts) == len(recorded):
        return recorded
    merged = recorded.select(starts)
    means: dict[str, Any] = {
        name: mean_samples(np.asarray(getattr(touches, name), np.float64), starts).astype(np.float32)
        for name in ("reading", "force", "depth")
    }
    return replace(merged, touches=merged.touches._replace(**means))


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
