"""Data sets of touches on disk, read and written with NumPy and h5py alone, without JAX.

A recorded touch is one immutable file, and a packed set holds many touches in one file; one reader serves both. `sets`
defines a data set, `files` makes files atomic and verifiable, `store` reads and writes them, and `splits` holds touches
out. docs/data.md describes the schema.
"""

from i2t.dataset.sets import Dataset, concatenate, holds_simulated, missing_views, source_phrase, validate
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
    "missing_views",
    "read_touch",
    "same_places",
    "save_dataset",
    "source_phrase",
    "spatial_blocks",
    "square_blocks",
    "validate",
    "write_touch",
]
