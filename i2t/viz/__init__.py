"""Figures for people: readings, patches, skins, scenes in three dimensions, clusters, rates, and episode reports.

Functions take NumPy or JAX arrays and return a matplotlib figure, which `save_figure` writes and notebooks show as it
is; those called `draw_...` draw into axes that they are given. Lengths are drawn in millimetres, fields in microtesla,
and what was simulated says so in its title. Boards may have any number of chips.

Names are imported when they are first used: `i2t.viz.clusters` and `i2t.viz.agreement` need no matplotlib.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)  # names of __init__.pyi
