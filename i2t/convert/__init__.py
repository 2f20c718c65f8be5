"""Other people's recordings, as data sets of ours: one module for each layout, each a function from a folder or file to
`Converted`.

A converter states what it assumed and what it left out in its notes, which become part of the data set's provenance.
What it cannot read it refuses with one sentence; with `skip_bad` it leaves that out and says so in a note.
"""

from i2t.convert.common import Converted

__all__ = ["Converted"]
