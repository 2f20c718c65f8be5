"""Other people's recordings, as data sets of ours: one module for each layout, each a function from a folder or file to
`Converted`; and `lerobot`, which writes a data set for others.

A converter states what it assumed and what it left out in its notes, which become part of the data set's provenance.
What it cannot read it refuses with one sentence; with `skip_bad` it leaves that out and says so in a note.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(__name__, submod_attrs={"common": ["Converted"]})

# Assumptions of converters that their command shows, which need not import them for that.
CAMERA_OFFSET_M = 64e-3  # m, of Imagine2touch: the camera behind the tool's origin
TIP_RADIUS_M = 4e-3  # m, of eFlesh's tip
EFLESH_WINDOW_M = 40e-3  # m, holds the 31 x 31 mm grid of eFlesh's `spatial` sessions
