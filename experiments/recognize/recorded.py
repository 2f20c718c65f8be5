"""Recorded touches as episodes: each session is one, judged by a pad model of the skin that recorded it."""

from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from experiments.common.intervals import with_interval
from experiments.common.runs import begin, write_json
from experiments.recognize import figures, pad_sources
from experiments.recognize import report as reporting
from experiments.recognize.arguments import SimulateArgs
from experiments.recognize.config import Recognition
from experiments.recognize.trained_run import load_meshes, meshes_by_name
from i2t import dataset as data
from i2t import viz
from i2t.dataset import Dataset
from i2t.errors import DataError
from i2t.hardware.rig import Rig
from i2t.objects import Mesh, catalogue
from i2t.prediction.predictor import Predictor
from i2t.recognition import belief, metrics
from i2t.recognition.belief import Particles
from i2t.recognition.episodes import episodes_from_dataset, run_belief
from i2t.recognition.intervals import wilson_interval
from i2t.recognition.pad_model import PadModel
from i2t.recognition.pad_model_files import require_skin, save_pad_model
from i2t.recognition.paper_rules import paper_rules
from i2t.recognition.site_pool import precompute_outcomes, prepare_surfaces
from i2t.types import ReturnCode

MIN_INTERVAL_EPISODES = 5  # fewer say nothing about others: no interval is given
KEPT_PREDICTOR = "the paper's rules, the run's predictor"  # whose readings the paper's rules are given
TOO_FEW = "too few episodes for an interval"


class Sessions(NamedTuple):
    """Sessions that count, and numbers of their touches."""

    names: tuple[str, ...]  # in the order of the episodes
    touches: int  # of each, the first
    usable: tuple[int, ...]  # of each
    left_out: tuple[str, ...]  # with fewer

    def describe(self) -> str:
        """Describe the sessions in one line."""
        fewest, most = min(self.usable), max(self.usable)
        said = f"{len(self.names)} sessions of {fewest if fewest == most else f'{fewest} to {most}'} usable touches"
        if most > self.touches:
            said += f", the first {self.touches} of each count (--max-touches N for more from the longer ones)"
        if self.left_out:
            said += f"; left out, with fewer: {', '.join(self.left_out)}"
        return said


def run(args: SimulateArgs, cfg: Recognition) -> dict[str, Any]:
    """Recognise the objects of recorded sessions, and write down how often and how sure."""
    assert args.dataset is not None
    recorded = data.load_dataset(args.dataset, skin=args.skin_name)
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
    print(f"{args.dataset} ({recorded.source}): {sessions.describe()}")
    save_pad_model(args.out / "pad_model.npz", known)
    particles = belief.sample_particles((rig or Rig()).object_covariance, cfg.num_particles, args.seed)
    results = recognise(
        used, meshes, sessions.touches, model=known.model, predictor=source.predictor, particles=particles, cfg=cfg
    )
    (scaled,), temperatures = reporting.calibrate([{"recorded": results}])
    found = scaled["recorded"]
    trained_on = sorted(set(known.origin.objects) & {found.names[i] for i in found.truth})
    summary = {
        "source": recorded.source,
        "dataset": str(args.dataset),
        "pad_model": pad_sources.to_json(known) | {"other_skin": warning},
        "touched_with": pads,
        "sessions": sessions._asdict(),
        "objects_also_trained_on": trained_on,
        "temperatures": {method: metrics.to_json(one) for method, one in temperatures.items()},
        "sets": {"recorded": score(found)},
    }
    write_figures(found, args.out, recorded.source != "real")
    reporting.report_hardest_episode(found, list(meshes.values()), args.out / "story", recorded.source, recorded.board)
    write_json(args.out / "metrics.json", summary)
    print_table(summary, warning)
    return summary


def candidate_meshes(args: SimulateArgs, recorded: Dataset) -> dict[str, Mesh]:
    """The objects to tell apart: those of --objects, or those of the data set."""
    if args.objects:
        return load_meshes(args.objects, args.unit)
    missing = [name for name in recorded.objects if name not in catalogue.NAMES]
    if missing:
        raise DataError(
            f"{args.dataset} has touches of {', '.join(missing)}, of which there is no mesh; name all objects to tell "
            "apart, for instance --objects star mug.stl --unit mm"
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
    made = recorded.touches
    usable = (made.code != ReturnCode.FAILED) & np.isfinite(made.force)
    counts = {recorded.sessions[i]: int((usable & (made.session == i)).sum()) for i in np.unique(made.session)}
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
    )


def recognise(
    recorded: Dataset,
    meshes: dict[str, Mesh],
    touches: int,
    *,
    model: PadModel,
    predictor: Predictor | None,
    particles: Particles,
    cfg: Recognition,
) -> reporting.EpisodeResults:
    """Beliefs of every method along recorded sessions."""
    surfaces = prepare_surfaces(list(meshes.values()))
    sites, episodes = episodes_from_dataset(recorded, list(meshes), touches, overtravel=cfg.limits.overtravel)
    (table,) = precompute_outcomes(
        surfaces, particles.twist, sites.T_w_t, [model.reading_model],
        overtravel=cfg.limits.overtravel, label="recorded",
    )  # fmt: skip
    believed = run_belief(table, episodes, model.likelihood, particles)
    if predictor is not None:
        believed |= paper_rules({KEPT_PREDICTOR: predictor}, model.reading_std, surfaces, episodes)
    return reporting.EpisodeResults(tuple(meshes), episodes.truth, believed, episodes)


def score(results: reporting.EpisodeResults) -> dict[str, Any]:
    """Accuracy of every method after each touch; sessions are independent trials, each with a placement of its own."""
    assert results.episodes is not None
    truth = results.truth
    methods = {}
    for method, beliefs in results.beliefs.items():
        p = beliefs.astype(np.float64)
        hit = metrics.hits(p, truth)
        methods[method] = {
            "accuracy": _estimate(hit),
            "mean": _estimate(hit.mean(1)),
            "log_loss": metrics.log_loss(p, truth).mean(0).tolist(),
            "confusion": metrics.confusion(p[:, -1], truth).tolist(),
        }
    return {
        "objects": list(results.names),
        "episodes": len(truth),
        "episodes_of": {name: int((truth == i).sum()) for i, name in enumerate(results.names)},
        "air": float(1 - np.mean(results.episodes.observations.contact)),
        "methods": methods,
    }


def _estimate(hit: np.ndarray) -> dict[str, Any]:
    """Mean over episodes with Wilson's interval, which few episodes do not get."""
    found = wilson_interval(hit)
    if len(hit) < MIN_INTERVAL_EPISODES:
        return {"mean": metrics.to_json(found.mean), "low": None, "high": None}
    return metrics.to_json(found)


def print_table(summary: dict[str, Any], warning: str | None) -> None:
    """Accuracy of every method, with intervals where there are enough episodes."""
    entry = summary["sets"]["recorded"]
    touches = summary["sessions"]["touches"]
    columns = sorted({1, min(3, touches), min(5, touches), touches})
    few = entry["episodes"] < MIN_INTERVAL_EPISODES
    print(
        f"\nrecorded ({summary['source']}): {', '.join(entry['objects'])}; {entry['episodes']} episodes, "
        f"{100 * entry['air']:.0f} % of touches in air" + (f"; {TOO_FEW}" if few else "")
    )
    if warning:
        print(warning)
    if summary["objects_also_trained_on"]:
        print(f"the pad model was fitted to touches of {', '.join(summary['objects_also_trained_on'])} too")
    print(f"{'':48}" + "".join(f"{f'after {t}':>20}" for t in columns) + f"{'mean of all':>20}{'NLL':>7}")
    for method, values in entry["methods"].items():
        cells = [_cell({key: value and value[t - 1] for key, value in values["accuracy"].items()}) for t in columns]
        print(
            f"{method:48}" + "".join(f"{cell:>20}" for cell in (*cells, _cell(values["mean"])))
            + f"{np.mean(values['log_loss']):7.3f}"
        )  # fmt: skip


def _cell(estimate: dict[str, float | None]) -> str:
    return with_interval(estimate["mean"], estimate["low"], estimate["high"], ends=2)


def write_figures(results: reporting.EpisodeResults, out: Path, simulated: bool) -> None:
    """Accuracy and confusion."""
    if len(results.truth) >= MIN_INTERVAL_EPISODES:
        curves = {
            method: wilson_interval(metrics.hits(p.astype(np.float64), results.truth))
            for method, p in results.beliefs.items()
            if "average" not in method
        }
        viz.save_figure(figures.accuracy(curves, "Accuracy, recorded", simulated), out / "accuracy_recorded.png")
    counts = metrics.confusion(results.beliefs["fused"][:, -1].astype(np.float64), results.truth)
    figure = figures.confusion(counts, results.names, "Confusion, recorded", simulated)
    viz.save_figure(figure, out / "confusion_recorded.png")
