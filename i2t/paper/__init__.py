"""Imagine2touch as its authors wrote it: network, loss, ensemble rules, recognition loop and classifier of stamps.

Source: Ayad et al., "Imagine2touch: Predictive Tactile Sensing for Robotic Manipulation using Efficient Low-Dimensional
Signals", and its published code (github.com/ayadabdalla/imagine2touch) for details that the text omits.

Each name is loaded when it is first used.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)  # names of __init__.pyi
