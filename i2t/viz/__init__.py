"""Figures of readings, patches, skins, three-dimensional scenes, clusters, rates and episode reports.

Functions take NumPy or JAX arrays and return a matplotlib figure, which `save_figure` writes and notebooks display.
Functions called `draw_...` draw into given axes. Lengths are drawn in millimetres and fields in microtesla, and titles
mark simulated data. Boards may have any number of chips.

Names are imported on first use: `i2t.viz.clusters` and `i2t.viz.agreement` do not need matplotlib.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)  # names of __init__.pyi
