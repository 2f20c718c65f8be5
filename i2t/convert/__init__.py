"""Converters of recordings by other people to data sets: one module for each layout, with a function from a folder or
file to `Converted`. Only `lerobot` goes the other way and writes a data set for other software.

A converter lists its assumptions and omissions in its notes, which become part of the data set's provenance. It refuses
unreadable parts with one sentence; with `skip_bad`, it leaves them out and adds a note.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(__name__, submod_attrs={"common": ["Converted"]})

# Assumptions of converters. They are here because the command line shows them without importing the converters.
PAPER_CAMERA_OFFSET_M = 64e-3  # m, distance of Imagine2touch's camera behind the tool's origin
EFLESH_TIP_RADIUS_M = 4e-3  # m, assumed radius of the spherical tip that presses eFlesh
EFLESH_WINDOW_M = 40e-3  # m, edge of a square around the 31 x 31 mm grid of eFlesh's `spatial` sessions
