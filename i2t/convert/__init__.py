"""Other people's recordings, as data sets of ours: one module for each layout, each a function from a folder or file to
`Converted`; and `lerobot`, which writes a data set for others.

A converter states what it assumed and what it left out in its notes, which become part of the data set's provenance.
What it cannot read it refuses with one sentence; with `skip_bad` it leaves that out and says so in a note.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from i2t.convert.common import Converted as Converted

__all__ = ["Converted"]

# Assumptions of converters that their command shows, which need not import them for that.
CAMERA_OFFSET_M = 64e-3  # m, of Imagine2touch: the camera behind the tool's origin
TIP_RADIUS_M = 4e-3  # m, of eFlesh's tip
EFLESH_WINDOW_M = 40e-3  # m, holds the 31 x 31 mm grid of eFlesh's `spatial` sessions


def __getattr__(name: str) -> Any:
    if name != "Converted":
        raise AttributeError(f"module 'i2t.convert' has no attribute {name!r}")
    from i2t.convert.common import Converted

    return Converted
