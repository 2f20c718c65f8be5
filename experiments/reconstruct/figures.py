"""Pictures of a run: errors against touches, reliability of the bands, a surface that grows."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import norm

from experiments.reconstruct.episodes import Episode, Explorer
from experiments.reconstruct.report import Episodes
from i2t import viz
from i2t.reconstruction.signed_distances import interpolate
from i2t.reconstruction.surface import Z_90, SurfaceEstimate, TouchEvidence
from i2t.viz.style import COLOURS, GREY, Picture, titled

BAND_LEVELS = np.linspace(0.1, 0.95, 18)  # nominal coverages


def draw_all(out: Path, report: dict[str, Any], episodes: Episodes, explorer: Explorer) -> None:
    """Write the figures of a run; one that this machine cannot draw says why."""
    viz.save_figure(draw_errors(report), out / "errors.png")
    viz.save_figure(draw_reliability(episodes), out / "bands.png")
    name = "reduction" if "reduction" in episodes else next(iter(episodes))
    key = next(iter(episodes[name]))
    episode, mesh = episodes[name][key], explorer.reality.objects[key[0]].mesh
    stages = [shown(episode, count) for count in sorted(episode.estimates)]
    title = f"An unseen object ({explorer.reality.objects[key[0]].name}) under touches"
    figure = viz.plot_growing_surface(stages, (mesh.vertices, mesh.faces), title, True)
    viz.save_figure(figure, out / "growing.png")
    if reason := viz.write_surface_gltf(stages[-1], out / "surface.gltf"):
        print(reason)


def shown(episode: Episode, count: int) -> viz.ShownSurface:
    """A stage of an episode."""
    return shown_surface(episode.estimates[count], episode.state.touches[:count])


def shown_surface(estimate: SurfaceEstimate, touches: Sequence[TouchEvidence]) -> viz.ShownSurface:
    """A surface with its spread at its vertices, and the poses that met it."""
    mesh = estimate.mesh
    std = interpolate(estimate.grid, estimate.std, mesh.vertices)
    poses = np.array([touch.T_o_t for touch in touches if touch.hit]).reshape(-1, 4, 4)
    label = f"{len(touches)} touch" if len(touches) == 1 else f"{len(touches)} touches"
    return viz.ShownSurface(label, mesh.vertices, mesh.faces, std, poses)


def draw_errors(report: dict[str, Any]) -> Picture:
    """Distance to the true surface against touches, for each condition."""
    figure = Picture(figsize=(9, 3.6), layout="constrained")
    policies, others = figure.subplots(1, 2, sharey=True)
    names = list(report["conditions"])
    compared = ("random", "even", "uncertainty", "reduction", "oracle")
    panels = (
        (policies, [name for name in names if name in compared], "where to touch"),
        (others, [name for name in names if name not in compared or name == "reduction"], "what is known"),
    )
    for axes, chosen, title in panels:
        for colour, name in zip(COLOURS, chosen, strict=False):
            after = report["conditions"][name]["after"]
            rows = np.array([after[count]["chamfer_mm"] for count in sorted(after, key=int)])
            touches = sorted(int(count) for count in after)
            axes.plot(touches, rows[:, 0], "o-", color=colour, label=name, ms=4)
            axes.fill_between(touches, rows[:, 1], rows[:, 2], color=colour, alpha=0.12, lw=0)
        axes.axhline(report["grid_floor_mm"], color=GREY, ls=":", lw=1)
        axes.set(xlabel="touches", title=title, ylim=(0, None))
        if chosen:
            axes.legend(fontsize=8)
    policies.set_ylabel("Chamfer distance, mm")
    figure.suptitle(titled("Distance to the true surface, 95 % intervals; dotted: the grid's floor", True), fontsize=11)
    return figure


def draw_reliability(episodes: Episodes) -> Picture:
    """Share of the true surface in bands of each nominal coverage."""
    figure = Picture(figsize=(4.6, 4.2), layout="constrained")
    axes = figure.subplots()
    axes.plot([0, 1], [0, 1], color=GREY, lw=1, ls=":")
    for colour, name in zip(COLOURS, episodes, strict=False):
        parts = [
            found.standard for each in episodes[name].values() for count, found in each.errors.items() if count > 0
        ]
        if parts:
            misses = np.concatenate(parts)
            found = [(misses < norm.ppf(0.5 + level / 2)).mean() for level in BAND_LEVELS]
            axes.plot(BAND_LEVELS, found, color=colour, label=name)
    axes.axvline(2 * norm.cdf(Z_90) - 1, color=GREY, lw=0.6)
    axes.set(xlabel="nominal coverage of the band", ylabel="share of the true surface in it", xlim=(0, 1), ylim=(0, 1))
    axes.legend(fontsize=8)
    figure.suptitle(titled("Reliability of the bands", True), fontsize=11)
    return figure
