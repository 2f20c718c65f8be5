"""Numbers of a run with intervals over objects and pads, the table that the documents show, and figures."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.reconstruct.arguments import CONDITIONS, ORACLE, POSES_BESIDE, RANDOM, READING
from experiments.reconstruct.episodes import SCORES, START, Episode
from i2t import viz
from i2t.intervals import Estimate, bootstrap_clusters, mean_interval
from i2t.objects.solids import Mesh
from i2t.reconstruction.evidence import SurfaceEvidence, Sweep
from i2t.reconstruction.signed_distances import interpolate
from i2t.reconstruction.surface import SurfaceEstimate
from i2t.types import Array
from i2t.viz.style import COLOURS, Colour, Picture, titled

COMPARED_POLICIES = (CONDITIONS[READING], CONDITIONS["uncertainty"])  # with random sites and the oracle
Episodes = dict[str, dict[int, Episode]]  # by condition, and by the number of the object


def summarize(episodes: Episodes, pads: int) -> dict[str, Any]:
    """Scores of every condition after some touches, and what conditions that share their objects say of each other."""
    numbers = next(iter(episodes.values()))
    courses = {name: _course(found) for name, found in episodes.items()}
    return {
        "episodes_of_each_condition": len(numbers),
        "test_objects": len(numbers),
        "pads": pads,
        "conditions": {name: _condition(found, pads) for name, found in episodes.items()},
        "less_than_pose": {
            name: _compared(lambda own, *poses: 1 - own / min(poses), (courses[name], *poses), pads)
            for name in courses
            if (poses := [courses[beside] for beside in POSES_BESIDE.get(name, ()) if beside in courses])
        },
        "share_of_oracles_gap": {
            name: _compared(
                lambda own, blind, best: (blind - own) / (blind - best),
                (courses[name], courses[RANDOM], courses[ORACLE]),
                pads,
            )
            for name in courses
            if {RANDOM, ORACLE} <= set(courses) and CONDITIONS[name] in COMPARED_POLICIES
        },
    }


def _course(found: dict[int, Episode]) -> dict[int, dict[int, float]]:
    """Chamfer distance (mm) after each reported number of touches: of every object."""
    counts = sorted({count for each in found.values() for count in each.scores})
    return {
        count: {number: each.scores[count]["chamfer_mm"] for number, each in found.items() if count in each.scores}
        for count in counts
    }


def _compared(
    statistic: Callable[..., Array], courses: Sequence[dict[int, dict[int, float]]], pads: int
) -> dict[str, list[float]]:
    """A statistic of the mean distances of some conditions on the same objects, after each number of touches."""
    compared = {}
    for count in sorted(count for count in set.intersection(*map(set, courses)) if count > 0):
        numbers = np.array(sorted(set.intersection(*(set(course[count]) for course in courses))))
        values = np.array([[course[count][number] for number in numbers] for course in courses])

        def of(weights: np.ndarray, values: np.ndarray = values) -> np.ndarray:
            return statistic(*(values @ weights))

        found = bootstrap_clusters(of, [numbers, numbers % pads], len(numbers))
        compared[str(count)] = [float(found.mean), float(found.low), float(found.high)]
    return compared


def _condition(found: dict[int, Episode], pads: int) -> dict[str, Any]:
    counts = sorted({count for each in found.values() for count in each.scores} - {START})
    hits = [touch.is_contact for each in found.values() for touch in touches_of(each)]
    return {
        "stopped": sum(each.stopped for each in found.values()),
        "hits": float(np.mean(hits)),
        "after": {str(count): _after(found, count, pads) for count in counts},
    }


def _after(found: dict[int, Episode], count: int, pads: int) -> dict[str, list[float]]:
    """Means with 95 % intervals over objects and pads; ratios of means are to the start, of the hidden surface to
    what a view left of it.
    """
    kept = {number: each for number, each in found.items() if count in each.scores}
    numbers = np.array(list(kept))
    clusters = [numbers, numbers % pads]

    def ratio(name: str, begun: int) -> Estimate:
        now, before = (np.array([each.scores[done][name] for each in kept.values()]) for done in (count, begun))
        return bootstrap_clusters(lambda weights: (weights @ now) / (weights @ before), clusters, len(numbers))

    values = {name: np.array([each.scores[count][name] for each in kept.values()]) for name in SCORES}
    means = {name: mean_interval(value, clusters) for name, value in values.items()}
    means |= {"ratio": ratio("chamfer_mm", START), "hidden_ratio": ratio("hidden_mm", 0)}
    return {name: list(map(float, found)) for name, found in means.items()}


def draw_errors(report: dict[str, Any]) -> Picture:
    """Distance to the true surface against touches, for each condition."""
    figure = Picture(figsize=(6.5, 4), layout="constrained")
    axes = figure.subplots()
    for colour, (name, found) in zip(COLOURS, report["conditions"].items(), strict=False):
        touches = sorted(map(int, found["after"]))
        rows = np.array([found["after"][str(count)]["chamfer_mm"] for count in touches])
        axes.plot(touches, rows[:, 0], "o-", color=colour, label=name, ms=4)
        axes.fill_between(touches, rows[:, 1], rows[:, 2], color=colour, alpha=0.12, lw=0)
    axes.axhline(report["grid_floor_mm"], color=Colour.GREY, ls=":", lw=1)
    axes.set(xlabel="touches", ylabel="Chamfer distance, mm", ylim=(0, None), xticks=touches)
    axes.legend(fontsize=8)
    figure.suptitle(titled("Distance to the true surface, 95 % intervals; dotted: the grid's floor", True), fontsize=11)
    return figure


def touches_of(episode: Episode) -> list[SurfaceEvidence]:
    """Evidence of the touches of an episode, without that of a view."""
    return [each for each in episode.state.evidence if isinstance(each.region, Sweep)]


def draw_episode(out: Path, episode: Episode, name: str, mesh: Mesh, seconds: float) -> None:
    """Draw the stages of one episode and the truth, and say what came out."""
    touches = touches_of(episode)
    shown = sorted((count, estimate) for count, estimate in episode.estimates.items() if count > START)
    stages = [shown_surface(estimate, touches[:count]) for count, estimate in shown]
    title = f"An unseen object ({name}) under touches"
    viz.save_figure(viz.plot_growing_surface(stages, (mesh.vertices, mesh.faces), title, True), out / "growing.png")
    first, last = (episode.scores[count]["chamfer_mm"] for count in (START, max(episode.scores)))
    print(
        f"{name}: {first:.1f} mm from the true surface before the first touch, {last:.1f} mm after {len(touches)} "
        f"(simulated; after {seconds:.0f} s); {out / 'growing.png'} shows it",
        flush=True,
    )


def shown_surface(estimate: SurfaceEstimate, touches: Sequence[SurfaceEvidence]) -> viz.ShownSurface:
    """A surface with its spread at its vertices, and the poses that met it."""
    mesh = estimate.mesh
    std = interpolate(estimate.grid, estimate.std, mesh.vertices)
    poses = np.array(
        [touch.region.T_o_t for touch in touches if touch.is_contact and isinstance(touch.region, Sweep)]
    ).reshape(-1, 4, 4)
    label = f"{len(touches)} touch" if len(touches) == 1 else f"{len(touches)} touches"
    return viz.ShownSurface(label, mesh.vertices, mesh.faces, std, poses)
