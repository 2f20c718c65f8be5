"""Each name and its home, read by type checkers and by lazy_loader."""

from .cluster_map import TouchViews as TouchViews
from .cluster_map import plot_clusters as plot_clusters
from .episode_report import EpisodeRecord as EpisodeRecord
from .episode_report import plot_episode as plot_episode
from .episode_report import write_episode_report as write_episode_report
from .patches import draw_map as draw_map
from .patches import draw_patch as draw_patch
from .patches import plot_patches as plot_patches
from .rates import plot_confusions as plot_confusions
from .rates import plot_intervals as plot_intervals
from .rates import plot_rates as plot_rates
from .scene import explain_no_scene as explain_no_scene
from .scene import object_image as object_image
from .scene import object_plotter as object_plotter
from .scene import plot_object as plot_object
from .skins import draw_reading as draw_reading
from .skins import draw_skin as draw_skin
from .skins import plot_press as plot_press
from .skins import plot_readings as plot_readings
from .skins import plot_skin_map as plot_skin_map
from .style import save_figure as save_figure
from .surfaces import ShownSurface as ShownSurface
from .surfaces import plot_growing_surface as plot_growing_surface
from .training import plot_predicted_touches as plot_predicted_touches
from .training import plot_predictions as plot_predictions
from .training import plot_training_curves as plot_training_curves
