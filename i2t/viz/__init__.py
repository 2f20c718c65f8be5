"""Figures for people: readings, patches, skins, scenes in three dimensions, clusters, rates, and episode reports.

Functions take NumPy or JAX arrays and return a matplotlib figure, which `save_figure` writes and notebooks show as it
is; those called `draw_...` draw into axes that they are given. Lengths are drawn in millimetres, fields in microtesla,
and what was simulated says so in its title. Boards may have any number of chips.

Names are imported when they are first used: `i2t.viz.clusters` and `i2t.viz.agreement` need no matplotlib.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from i2t.viz.cluster_map import TouchViews as TouchViews
    from i2t.viz.cluster_map import plot_clusters as plot_clusters
    from i2t.viz.episode_report import EpisodeRecord as EpisodeRecord
    from i2t.viz.episode_report import plot_episode as plot_episode
    from i2t.viz.episode_report import write_episode_report as write_episode_report
    from i2t.viz.patches import draw_map as draw_map
    from i2t.viz.patches import draw_patch as draw_patch
    from i2t.viz.patches import plot_patches as plot_patches
    from i2t.viz.rates import plot_confusions as plot_confusions
    from i2t.viz.rates import plot_intervals as plot_intervals
    from i2t.viz.rates import plot_rates as plot_rates
    from i2t.viz.scene import interactive as interactive
    from i2t.viz.scene import map_plotter as map_plotter
    from i2t.viz.scene import object_image as object_image
    from i2t.viz.scene import object_plotter as object_plotter
    from i2t.viz.scene import plot_object as plot_object
    from i2t.viz.scene import plot_skin_surface as plot_skin_surface
    from i2t.viz.scene import skin_plotter as skin_plotter
    from i2t.viz.scene import why_no_scene as why_no_scene
    from i2t.viz.skins import draw_field as draw_field
    from i2t.viz.skins import draw_reading as draw_reading
    from i2t.viz.skins import draw_skin as draw_skin
    from i2t.viz.skins import plot_press as plot_press
    from i2t.viz.skins import plot_readings as plot_readings
    from i2t.viz.skins import plot_skin_map as plot_skin_map
    from i2t.viz.style import save_figure as save_figure
    from i2t.viz.surfaces import ShownSurface as ShownSurface
    from i2t.viz.surfaces import plot_growing_surface as plot_growing_surface
    from i2t.viz.surfaces import write_surface_gltf as write_surface_gltf
    from i2t.viz.training import plot_channel_errors as plot_channel_errors
    from i2t.viz.training import plot_predicted_touches as plot_predicted_touches
    from i2t.viz.training import plot_predictions as plot_predictions
    from i2t.viz.training import plot_training_curves as plot_training_curves

_MODULES = {
    "cluster_map": ("TouchViews", "plot_clusters"),
    "episode_report": ("EpisodeRecord", "plot_episode", "write_episode_report"),
    "style": ("save_figure",),
    "patches": ("draw_map", "draw_patch", "plot_patches"),
    "rates": ("plot_confusions", "plot_intervals", "plot_rates"),
    "scene": (
        "interactive",
        "map_plotter",
        "object_image",
        "why_no_scene",
        "object_plotter",
        "plot_object",
        "plot_skin_surface",
        "skin_plotter",
    ),
    "skins": ("draw_field", "draw_reading", "draw_skin", "plot_press", "plot_readings", "plot_skin_map"),
    "surfaces": ("ShownSurface", "plot_growing_surface", "write_surface_gltf"),
    "training": ("plot_channel_errors", "plot_predicted_touches", "plot_predictions", "plot_training_curves"),
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}
__all__ = sorted(_MODULE_OF)


def __getattr__(name: str) -> Any:
    if name in _MODULE_OF:
        return getattr(import_module(f"i2t.viz.{_MODULE_OF[name]}"), name)
    raise AttributeError(f"module 'i2t.viz' has no attribute {name!r}")
