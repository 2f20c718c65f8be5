"""Result of all converters."""

from dataclasses import replace
from typing import NamedTuple

from i2t.dataset import Dataset
from i2t.recordings.log import ReadingLog


class Converted(NamedTuple):
    """A data set converted from a recording, and sentences on assumptions and omissions of the conversion."""

    dataset: Dataset
    notes: tuple[str, ...]
    brief: tuple[str, ...]  # what was changed, left out or is doubtful, in a few lines


def converted(dataset: Dataset, log: ReadingLog) -> Converted:
    """Add the notes of a conversion to the data set's provenance (`Dataset.meta`).

    Args:
        dataset: The converted touches.
        log: Log that holds the notes.

    Returns:
        The data set with its notes, the notes, and the most important of them.
    """
    notes = log.sentences()
    meta = dict(dataset.meta) | {"notes": " | ".join(notes)}
    return Converted(replace(dataset, meta=meta), tuple(notes), tuple(log.brief()))
