"""Touches on disk: recorded ones, one immutable file each, and packed sets, behind one reader. NumPy and h5py only;
importing it imports no JAX.

`sets` says what a data set is, `files` how a file survives a power cut and proves its contents, `store` writes and
reads, `splits` holds touches out. The schema is described in docs/data.md.
"""

from i2t.dataset.sets import Dataset, concatenate, holds_simulated, missing_context, source_words, validate
from i2t.dataset.splits import (
    Split,
    by_group,
    holdout_blocks,
    holdout_last,
    holdout_names,
    same_places,
    spatial_blocks,
    square_blocks,
)
from i2t.dataset.store import (
    SKIN_NAME,
    BadFileWarning,
    Image,
    Record,
    Series,
    SkinChoiceError,
    load_dataset,
    read_touch,
    save_dataset,
    write_touch,
)

__all__ = [
    "SKIN_NAME",
    "BadFileWarning",
    "Dataset",
    "Image",
    "Record",
    "Series",
    "SkinChoiceError",
    "Split",
    "by_group",
    "concatenate",
    "holdout_blocks",
    "holdout_last",
    "holdout_names",
    "holds_simulated",
    "load_dataset",
    "missing_context",
    "read_touch",
    "same_places",
    "save_dataset",
    "source_words",
    "spatial_blocks",
    "square_blocks",
    "validate",
    "write_touch",
]
