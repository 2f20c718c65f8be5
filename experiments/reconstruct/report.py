"""Numbers of a run with intervals over objects and pads, the table that the documents show, and figures."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from experiments.reconstruct.episodes import SCORES, Episode
from i2t import viz
from i2t.objects.solids import Object
from i2t.recognition.intervals import bootstrap_clusters, mean_interval
from i2t.reconstruction.signed_distances import interpolate
from i2t.reconstruction.surface import SurfaceEstimate, TouchEvidence
from i2t.viz.style import COLOURS, GREY, Picture, titled

POLICIES = ("random", "uncertainty", "reduction")
Episodes = dict[str, dict[int, Episode]]  # by condition, and by the number of the object


def summarize(episodes: Episodes, pads: int) -> dict[str, Any]:
    """Scores of every condition after some touches."""
    numbers = next(iter(episodes.values()))
    return {
        "episodes_of_each_condition": len(numbers),
        "test_objects": len(numbers),
        "pads": pads,
        "conditions": {name: _condition(found, pads) for name, found in episodes.items()},
    }


def _condition(found: dict[int, Episode], pads: int) -> dict[str, Any]:
    counts = sorted({count for each in found.values() for count in each.scores})
    return {
        "stopped": sum(each.stopped for each in found.values()),
        "hits": float(np.mean([np.mean([touch.hit for touch in each.state.touches]) for each in found.values()])),
        "after": {str(count): _after(found, count, pads) for count in counts},
    }


def _after(found: dict[int, Episode], count: int, pads: int) -> dict[str, list[float]]:
    """Means with 95 % intervals over objects and pads; the ratio to the start is one of means."""
    kept = {number: each for number, each in found.items() if count in each.scores}
    numbers = np.array(list(kept))
    clusters = [numbers, numbers % pads]
    values = {name: np.array([each.scores[count][name] for each in kept.values()]) for name in SCORES}
    start = np.array([each.scores[0]["chamfer_mm"] for each in kept.values()])

    def ratio(weights: np.ndarray) -> np.ndarray:
        return (weights @ values["chamfer_mm"]) / (weights @ start)

    means = {name: mean_interval(value, clusters) for name, value in values.items()}
    means["ratio"] = bootstrap_clusters(ratio, clusters, len(numbers))
    return {name: [float(found.mean), float(found.low), float(found.high)] for name, found in means.items()}


def draw_errors(report: dict[str, Any]) -> Picture:
    """Distance to the true surface against touches, for each condition."""
    figure = Picture(figsize=(9, 3.6), layout="constrained")
    policies, others = figure.subplots(1, 2, sharey=True)
    names = list(report["conditions"])
    panels = (
        (policies, [name for name in names if name in POLICIES], "where to touch"),
        (others, [name for name in names if name not in POLICIES or name == "reduction"], "what is known"),
    )
    for axes, chosen, title in panels:
        for colour, name in zip(COLOURS, chosen, strict=False):
            after = report["conditions"][name]["after"]
            touches = sorted(int(count) for count in after)
            rows = np.array([after[str(count)]["chamfer_mm"] for count in touches])
            axes.plot(touches, rows[:, 0], "o-", color=colour, label=name, ms=4)
            axes.fill_between(touches, rows[:, 1], rows[:, 2], color=colour, alpha=0.12, lw=0)
        axes.axhline(report["grid_floor_mm"], color=GREY, ls=":", lw=1)
        axes.set(xlabel="touches", title=title, ylim=(0, None))
        if chosen:
            axes.legend(fontsize=8)
    policies.set_ylabel("Chamfer distance, mm")
    figure.suptitle(titled("Distance to the true surface, 95 % intervals; dotted: the grid's floor", True), fontsize=11)
    return figure


def draw_growing(episode: Episode, item: Object) -> Picture:
    """The stages of one episode, and the truth."""
    stages = [
        shown_surface(estimate, episode.state.touches[:count]) for count, estimate in sorted(episode.estimates.items())
    ]
    title = f"An unseen object ({item.name}) under touches"
    return viz.plot_growing_surface(stages, (item.mesh.vertices, item.mesh.faces), title, True)


def shown_surface(estimate: SurfaceEstimate, touches: Sequence[TouchEvidence]) -> viz.ShownSurface:
    """A surface with its spread at its vertices, and the poses that met it."""
    mesh = estimate.mesh
    std = interpolate(estimate.grid, estimate.std, mesh.vertices)
    poses = np.array([touch.T_o_t for touch in touches if touch.hit]).reshape(-1, 4, 4)
    label = f"{len(touches)} touch" if len(touches) == 1 else f"{len(touches)} touches"
    return viz.ShownSurface(label, mesh.vertices, mesh.faces, std, poses)
