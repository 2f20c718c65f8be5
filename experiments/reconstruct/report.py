"""Scores of a run with intervals over objects and pads, and figures."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.reconstruct.arguments import CONDITIONS, ORACLE, POSE_BASELINES, RANDOM, READING
from experiments.reconstruct.episodes import SCORES, START, Episode
from i2t import viz
from i2t.intervals import Estimate, bootstrap_clusters, mean_interval
from i2t.objects.solids import Mesh
from i2t.reconstruction.evidence import SurfaceEvidence, Sweep
from i2t.reconstruction.signed_distances import interpolate
from i2t.reconstruction.surface import SurfaceEstimate
from i2t.types import Array
from i2t.viz.style import CURVE_COLOURS, Colour, Picture, titled

Episodes = dict[str, dict[int, Episode]]  # by condition, then by object number


def summarize(episodes: Episodes, pads: int) -> dict[str, Any]:
    """Score every condition by number of touches, and compare conditions on the objects that they share."""
    numbers = next(iter(episodes.values()))
    courses = {name: _course(by_number) for name, by_number in episodes.items()}
    return {
        "episodes_of_each_condition": len(numbers),
        "test_objects": len(numbers),
        "pads": pads,
        "conditions": {name: _condition(by_number, pads) for name, by_number in episodes.items()},
        "less_than_pose": {
            name: _compared(lambda own, *poses: 1 - own / min(poses), (courses[name], *poses), pads)
            for name in courses
            if (poses := [courses[baseline] for baseline in POSE_BASELINES.get(name, ()) if baseline in courses])
        },
        "share_of_oracles_gap": {
            name: _compared(
                lambda own, blind, best: (blind - own) / (blind - best),
                (courses[name], courses[RANDOM], courses[ORACLE]),
                pads,
            )
            for name in courses
            if {RANDOM, ORACLE} <= set(courses) and CONDITIONS[name] in (CONDITIONS[READING], CONDITIONS["uncertainty"])
        },
    }


def _course(episodes: dict[int, Episode]) -> dict[int, dict[int, float]]:
    """Chamfer distance (mm) by number of touches, then by object number."""
    counts = sorted({count for episode in episodes.values() for count in episode.scores})
    return {
        count: {
            number: episode.scores[count]["chamfer_mm"]
            for number, episode in episodes.items()
            if count in episode.scores
        }
        for count in counts
    }


def _compared(
    statistic: Callable[..., Array], courses: Sequence[dict[int, dict[int, float]]], pads: int
) -> dict[str, list[float]]:
    """Statistic of the conditions' mean distances on the same objects, with its interval, by number of touches."""
    compared = {}
    for count in sorted(count for count in set.intersection(*map(set, courses)) if count > 0):
        numbers = np.array(sorted(set.intersection(*(set(course[count]) for course in courses))))
        values = np.array([[course[count][number] for number in numbers] for course in courses])

        def statistic_of_means(weights: np.ndarray, values: np.ndarray = values) -> np.ndarray:
            return statistic(*(values @ weights))

        estimate = bootstrap_clusters(statistic_of_means, [numbers, numbers % pads], len(numbers))
        compared[str(count)] = [float(estimate.mean), float(estimate.low), float(estimate.high)]
    return compared


def _condition(episodes: dict[int, Episode], pads: int) -> dict[str, Any]:
    counts = sorted({count for episode in episodes.values() for count in episode.scores} - {START})
    hits = [touch.is_contact for episode in episodes.values() for touch in touches_of(episode)]
    return {
        "stopped": sum(episode.stopped for episode in episodes.values()),
        "hits": float(np.mean(hits)),
        "after": {str(count): _after(episodes, count, pads) for count in counts},
    }


def _after(episodes: dict[int, Episode], count: int, pads: int) -> dict[str, list[float]]:
    """Means with 95 % intervals over objects and pads. Ratios of means are relative to the start; for the hidden
    surface, to its distance after the view.
    """
    kept = {number: episode for number, episode in episodes.items() if count in episode.scores}
    numbers = np.array(list(kept))
    clusters = [numbers, numbers % pads]

    def ratio(name: str, start: int) -> Estimate:
        now, before = (np.array([episode.scores[done][name] for episode in kept.values()]) for done in (count, start))
        return bootstrap_clusters(lambda weights: (weights @ now) / (weights @ before), clusters, len(numbers))

    values = {name: np.array([episode.scores[count][name] for episode in kept.values()]) for name in SCORES}
    means = {name: mean_interval(value, clusters) for name, value in values.items()}
    means |= {"ratio": ratio("chamfer_mm", START), "hidden_ratio": ratio("hidden_mm", 0)}
    return {name: list(map(float, episodes)) for name, episodes in means.items()}


def draw_errors(report: dict[str, Any]) -> Picture:
    """Plot the distance to the true surface against touches, for each condition."""
    figure = Picture(figsize=(6.5, 4), layout="constrained")
    axes = figure.subplots()
    for colour, (name, scores) in zip(CURVE_COLOURS, report["conditions"].items(), strict=False):
        touches = sorted(map(int, scores["after"]))
        rows = np.array([scores["after"][str(count)]["chamfer_mm"] for count in touches])
        axes.plot(touches, rows[:, 0], "o-", color=colour, label=name, ms=4)
        axes.fill_between(touches, rows[:, 1], rows[:, 2], color=colour, alpha=0.12, lw=0)
    axes.axhline(report["grid_floor_mm"], color=Colour.GREY, ls=":", lw=1)
    axes.set(xlabel="touches", ylabel="Chamfer distance, mm", ylim=(0, None), xticks=touches)
    axes.legend(fontsize=8)
    figure.suptitle(titled("Distance to the true surface, 95 % intervals; dotted: the grid's floor", True), fontsize=11)
    return figure


def touches_of(episode: Episode) -> list[SurfaceEvidence]:
    """Evidence of an episode's touches, without its view."""
    return [evidence for evidence in episode.state.evidence if isinstance(evidence.region, Sweep)]


def draw_episode(out: Path, episode: Episode, name: str, mesh: Mesh, seconds: float) -> None:
    """Draw the stages of one episode next to the truth, and print its distances."""
    touches = touches_of(episode)
    shown = sorted((count, estimate) for count, estimate in episode.estimates.items() if count > START)
    stages = [shown_surface(estimate, touches[:count]) for count, estimate in shown]
    title = f"Unknown object ({name}), reconstructed touch by touch"
    viz.save_figure(viz.plot_growing_surface(stages, (mesh.vertices, mesh.faces), title, True), out / "growing.png")
    first, last = (episode.scores[count]["chamfer_mm"] for count in (START, max(episode.scores)))
    print(
        f"{name}: {first:.1f} mm from the true surface before the first touch, {last:.1f} mm after {len(touches)} "
        f"(simulated; after {seconds:.0f} s); figure: {out / 'growing.png'}",
        flush=True,
    )


def shown_surface(estimate: SurfaceEstimate, touches: Sequence[SurfaceEvidence]) -> viz.ShownSurface:
    """Surface with its standard deviation at the vertices, and the poses in contact."""
    mesh = estimate.mesh
    std = interpolate(estimate.grid, estimate.std, mesh.vertices)
    poses = np.array(
        [touch.region.T_o_t for touch in touches if touch.is_contact and isinstance(touch.region, Sweep)]
    ).reshape(-1, 4, 4)
    label = f"{len(touches)} touch" if len(touches) == 1 else f"{len(touches)} touches"
    return viz.ShownSurface(label, mesh.vertices, mesh.faces, std, poses)
