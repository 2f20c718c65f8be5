"""Figures for people: readings, patches, skins, scenes in three dimensions, clusters, rates, and episode reports.

Functions take NumPy or JAX arrays and return a matplotlib figure, which `save_figure` writes and notebooks show as it
is; those called `draw_...` draw into axes that they are given. Lengths are drawn in millimetres, fields in microtesla,
and what was simulated says so in its title. Boards may have any number of chips.

Names are imported when they are first used: `i2t.viz.clusters` and `i2t.viz.agreement` need no matplotlib.
"""

from importlib import import_module
from typing import Any

_MODULES = {
    "cluster_map": ("TouchViews", "plot_clusters"),
    "episode_report": ("EpisodeRecord", "plot_episode", "write_episode_report"),
    "style": ("save_figure",),
    "patches": ("draw_map", "draw_patch", "plot_patches"),
    "rates": ("plot_confusions", "plot_intervals", "plot_rates"),
    "scene": ("object_image", "object_plotter", "plot_object", "why_no_scene"),
    "skins": ("draw_reading", "draw_skin", "plot_press", "plot_readings", "plot_skin_map"),
    "surfaces": ("ShownSurface", "plot_growing_surface"),
    "training": ("plot_predicted_touches", "plot_predictions", "plot_training_curves"),
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}
__all__ = sorted(_MODULE_OF)


def __getattr__(name: str) -> Any:
    if name in _MODULE_OF:
        return getattr(import_module(f"i2t.viz.{_MODULE_OF[name]}"), name)
    raise AttributeError(f"module 'i2t.viz' has no attribute {name!r}")
