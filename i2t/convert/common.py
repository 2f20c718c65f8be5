"""The result that all converters share."""

from dataclasses import replace
from typing import NamedTuple

from i2t.dataset import Dataset
from i2t.recordings.log import ReadingLog


class Converted(NamedTuple):
    """A data set and, in sentences, what was assumed and what was left out on the way."""

    dataset: Dataset
    notes: tuple[str, ...]


def converted(dataset: Dataset, log: ReadingLog) -> Converted:
    """Put the notes of a conversion into the data set's provenance.

    Args:
        dataset: What was converted.
        log: What is to be known of it.

    Returns:
        The data set with its notes, and the notes.
    """
    notes = log.sentences()
    meta = dict(dataset.meta) | {"notes": " | ".join(notes)}
    return Converted(replace(dataset, meta=meta), tuple(notes))
