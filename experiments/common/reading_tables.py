"""Tables of labelled readings of any tactile sensor, with one row per touch in chronological order.

One column holds the label, others may be ignored, and the remaining columns are the reading. If a column numbers the
touches, the rows of a touch are averaged, because samples of one contact share its errors. Tables are split within
groups, in file order or at random. Successive touches share errors, and a random split puts such touches on both sides,
so its scores are better than those of a later session would be (Roberts et al., Ecography 40, 2017).
"""

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from i2t.errors import DataError, did_you_mean
from i2t.recordings.cells import parse_number
from i2t.recordings.columns import FIELD_STEM, describe_header
from i2t.recordings.log import ReadingLog
from i2t.recordings.samples import first_samples, mean_samples
from i2t.recordings.tables import open_text_table, valid_rows
from i2t.skin.boards import AXES_OF_CHIP, silent_chips

SPLITS = IN_ORDER, AT_RANDOM = "in file order", "at random"


class ReadingTable(NamedTuple):
    """Readings, the label of each, and the group within which it is compared with others."""

    reading: Float[np.ndarray, "n d"]
    label: Int[np.ndarray, " n"]  # index of `labels`
    labels: tuple[str, ...]  # in numerical order if all are numbers, otherwise in alphabetical order
    group: Int[np.ndarray, " n"]  # index of `groups`
    groups: tuple[str, ...]  # in the order of the files
    columns: tuple[str, ...]  # names of the reading's components
    samples: int = 0  # number of rows in the files if rows were averaged per touch; 0 if each row is a touch
    notes: tuple[str, ...] = ()  # sentences about rows that were changed or left out


class _Part(NamedTuple):
    """The rows of one file."""

    labels: list[str]
    groups: list[str]
    touches: list[str]  # name of the touch that a row samples; empty texts if each row is a touch
    columns: tuple[str, ...]
    reading: np.ndarray
    notes: list[str]


def read_reading_table(
    paths: Sequence[Path],
    *,
    label: str,
    group: str | None = None,
    ignore: Sequence[str] = (),
    touch: str | None = None,
) -> ReadingTable:
    """Read tables of readings.

    Args:
        paths: CSV files, plain or compressed with gzip, with the same columns. Each file is at least one group.
        label: Column of the label, which may be any text.
        group: Column of the group, if a file has rows of several groups.
        ignore: Columns that are not part of the reading.
        touch: Column that numbers or names the touches. Successive rows with the same label, group and value in this
            column are samples of one touch.

    Returns:
        All touches, in the order of the files. The samples of a touch are averaged.

    Raises:
        DataError: A file cannot be read, lacks a column, or holds a value that is not a number or an empty label.
        ValueError: A column is named for two purposes, or a file is given twice.
    """
    files = [path.resolve() for path in paths]
    if repeated := [path for i, path in enumerate(paths) if files[i] in files[:i]]:
        raise ValueError(f"{repeated[0]} is given twice; give each table once")
    special = [label, *(name for name in (group, touch) if name is not None), *ignore]
    if twice := sorted({name for name in special if special.count(name) > 1}):
        raise ValueError(f"column {twice[0]} is named twice among label, group, touch and ignored ones; name it once")
    parts = [_read(path, label, group, ignore, touch) for path in paths]
    for path, part in zip(paths, parts, strict=True):
        if part.columns != parts[0].columns:
            other = sorted(set(part.columns) ^ set(parts[0].columns)) or ["in another order"]
            raise DataError(
                f"{path}: its readings and those of {paths[0]} have different columns ({', '.join(other[:3])}); give "
                "tables of one sensor, or leave these columns out of both"
            )
    texts = [text for part in parts for text in part.labels]
    labels = _in_order(texts)
    if len(labels) < 2:
        raise DataError(f"{paths[0]}: column {label} holds {labels[0]} only; give at least two labels")
    names = [path.name.removesuffix(".gz").removesuffix(".csv") for path in paths]
    names = names if len(set(names)) == len(paths) else [str(path) for path in paths]
    grouped = [
        f"{name}, {text}" if len(paths) > 1 and text else text or name
        for name, part in zip(names, parts, strict=True)
        for text in part.groups
    ]
    groups = tuple(dict.fromkeys(grouped))
    reading = np.concatenate([part.reading for part in parts])
    label_of = np.array([labels.index(text) for text in texts])
    if repeats := len(reading) - len(np.unique(np.column_stack([reading, label_of]), axis=0)):
        warnings.warn(
            f"{paths[0]}: {repeats} of {len(reading)} rows repeat another exactly; if they are copies, remove them, "
            "because a method may be tested on a row that it was trained on",
            stacklevel=2,
        )
    table = ReadingTable(
        reading=reading,
        label=label_of,
        labels=labels,
        group=np.array([groups.index(text) for text in grouped]),
        groups=groups,
        columns=parts[0].columns,
        notes=tuple(f"{path}: {note}" for path, part in zip(paths, parts, strict=True) for note in part.notes),
    )
    if touch is None:
        return table
    return _merge_samples(table, [(i, text) for i, part in enumerate(parts) for text in part.touches])


def _merge_samples(table: ReadingTable, touches: Sequence[tuple[int, str]]) -> ReadingTable:
    """Average successive rows with the same label, group and touch (number of the file, and name)."""
    names = np.unique(touches, axis=0, return_inverse=True)[1].reshape(-1)
    keys = np.column_stack([table.label, table.group, names])
    starts = first_samples((keys[1:] == keys[:-1]).all(1))
    means = mean_samples(table.reading, starts)
    return table._replace(reading=means, label=table.label[starts], group=table.group[starts], samples=len(keys))


def close_followers(
    table: ReadingTable, *, close: float = 0.25, min_share: float = 0.1, min_jump: float = 0.5
) -> float:
    """Estimate the share of rows that may be samples of the same touch as the previous row.

    Distances are relative to the typical distance between rows of one label and group that are far apart in time.

    Args:
        table: The readings, in chronological order.
        close: Distance below which successive rows of a label and group may sample one touch.
        min_share: Minimum share of such rows, in excess of twice the share by chance, for a result above 0.
        min_jump: Minimum median distance between rows of different touches. A steady drift has smaller steps.

    Returns:
        The share, or 0 if it is below the minimum, if rows far apart in time are as close, or if readings drift without
        jumps.
    """
    spread = table.reading.std(0)
    scaled = (table.reading - table.reading.mean(0)) / np.where(spread > 0, spread, 1)
    following, others = [], []
    for rows in rows_of_labels(table):
        if len(rows) < 4:
            continue
        half = len(rows) // 2  # the longest time apart that is possible for all rows
        apart = np.linalg.norm(scaled[rows[half:]] - scaled[rows[: len(rows) - half]], axis=1)
        if typical := float(np.median(apart)):
            following.append(np.linalg.norm(np.diff(scaled[rows], axis=0), axis=1) / typical)
            others.append(apart / typical)
    if not following:
        return 0.0
    near, far = np.concatenate(following), np.concatenate(others)
    share, jumps = float(np.mean(near < close)), near[near >= close]
    drifts = len(jumps) > 0 and np.median(jumps) < min_jump
    return 0.0 if drifts or share < min_share + 2 * np.mean(far < close) else share


def refuse_counters(table: ReadingTable, path: Path, *, may_number_touches: bool = True, min_rises: int = 12) -> None:
    """Refuse a reading with a column that never falls within any label, because it counts rows, touches or time.

    Args:
        table: The readings, in the order of the files.
        path: The file, or the first of several, for messages.
        may_number_touches: Whether the command has an option `--touch` for such a column.
        min_rises: Minimum number of rises of such a column.

    Raises:
        DataError: There is such a column.
    """
    steps = np.concatenate([np.diff(table.reading[rows], axis=0) for rows in rows_of_labels(table)])
    counts = (steps >= 0).all(0) & ((steps > 0).sum(0) >= min_rises)
    if counts.any():
        name = table.columns[int(counts.argmax())]
        other = f", or, if it numbers touches of several rows each, pass --touch {name}" if may_number_touches else ""
        raise DataError(
            f"{path}: column {name} never falls from one row of a label to the next, so that it counts rows, touches "
            f"or time and is no reading; leave it out (--ignore {name}){other}"
        )


def _read(path: Path, label: str, group: str | None, ignore: Sequence[str], touch: str | None) -> _Part:
    special = [name for name in (label, group, touch, *ignore) if name is not None]
    header, rows, notes, _ = open_text_table(path, as_named=True, texts=special)
    if missing := [name for name in special if name not in header]:
        remedy = did_you_mean(missing[0], header, "name one of its columns")
        raise DataError(f"{path}: there is no column {missing[0]} ({describe_header(header)}); {remedy}")
    kept = [i for i, name in enumerate(header) if name not in special]
    if twice := next((name for name in header if header.count(name) > 1 and name not in ignore), ""):
        raise DataError(f"{path}: the first line has two columns called {twice}; rename one")
    if not kept:
        raise DataError(f"{path}: no column is left for the reading; leave out fewer")
    log, columns = ReadingLog(skip_bad=False), tuple(header[i] for i in kept)
    remedy = "correct or remove the row, or leave the column out (--ignore)"
    # Classifiers compute in single precision, hence the bound.
    sound, reading = valid_rows(path, header, rows, columns, np.ones_like, log, bound=1e30, remedy=remedy)
    if not sound:
        raise DataError(f"{path}: holds no row below the names of its columns; give one row per touch")
    names = (label, group, touch)
    texts = [
        ["" if name is None else _name(path, line, name, cells[header.index(name)]) for name in names]
        for line, cells in sound
    ]
    log.lines += notes
    answered = log.select_answered(_silent(columns, reading))
    log.require_answers(path)
    labels, groups, touches = zip(*(row for row, keep in zip(texts, answered, strict=True) if keep), strict=True)
    return _Part(list(labels), list(groups), list(touches), columns, reading[answered], log.sentences())


def _silent(columns: Sequence[str], reading: np.ndarray) -> np.ndarray:
    """Mark the chips that sent only zeros, as a mask (n, chips). All columns count as one chip if their names are not
    those of chips. A row of zeros is a valid reading if over a tenth of the other values are zero, as in arrays of
    switches.
    """
    fields = [i for i, name in enumerate(columns) if FIELD_STEM.match(name.lower())]
    if fields and len(fields) % AXES_OF_CHIP == 0:
        return silent_chips(reading[:, fields], differences=True)
    zeros = (reading == 0).all(1, keepdims=True)
    others = reading[~zeros[:, 0]]
    plain = reading.shape[1] >= AXES_OF_CHIP and (not others.size or np.mean(others == 0) <= 0.1)
    return zeros & plain


def _name(path: Path, line: int, column: str, text: str) -> str:
    if not text.strip():
        raise DataError(f"{path}: line {line} has nothing in column {column}; fill it in, or remove the row")
    return text.strip()


def _in_order(texts: Sequence[str]) -> tuple[str, ...]:
    """List the different texts in numerical order if all are numbers, otherwise in alphabetical order."""
    different = sorted(set(texts))
    numbers = [parse_number(text) for text in different]
    are_numbers = all(number is not None and np.isfinite(number) for number in numbers)
    return tuple(sorted(different, key=float) if are_numbers else different)


# --- splits ---


def training_rows(table: ReadingTable, share: float, seed: int) -> dict[str, Bool[np.ndarray, " n"]]:
    """Select the training rows of each split: the first rows of each label in each group (`IN_ORDER`), or as many rows
    at random (`AT_RANDOM`).

    Args:
        table: The table of n rows.
        share: Share of a label's rows that are for training. Either side has at least one of two or more rows.
        seed: Seed of the random split.

    Returns:
        Masks (n,) of the training rows by the split's name.
    """
    rng = np.random.default_rng(seed)
    train = {IN_ORDER: np.zeros(len(table.label), bool), AT_RANDOM: np.zeros(len(table.label), bool)}
    for rows in rows_of_labels(table):
        count = count_for_training(len(rows), share)
        train[IN_ORDER][rows[:count]] = True
        train[AT_RANDOM][rng.permutation(rows)[:count]] = True
    return train


def rows_of_labels(table: ReadingTable) -> list[Int[np.ndarray, " k"]]:
    """List the rows of each label in each group.

    Args:
        table: The table of n rows.

    Returns:
        Row numbers in file order, for each pair of label and group that occurs.
    """
    pair = table.group * len(table.labels) + table.label
    return [np.flatnonzero(pair == value) for value in np.unique(pair)]


def with_outliers(p: Float[np.ndarray, "n labels"], share: float = 0.01) -> Float[np.ndarray, "n labels"]:
    """Mix probabilities with a uniform distribution, so that no touch rules a label out.

    Args:
        p: Probabilities of the labels by a classifier.
        share: Weight of the uniform distribution.

    Returns:
        The mixed probabilities, `(n, labels)`.
    """
    return (1 - share) * p + share / p.shape[1]


def require_rows(table: ReadingTable, minimum: int, path: Path) -> None:
    """Refuse a table with too few rows of a label in a group, or with a group of one label.

    Args:
        table: The table.
        minimum: Minimum number of rows.
        path: The file, or the first of several, for messages.

    Raises:
        DataError: There are too few rows, or a group has one label only.
    """
    for rows in rows_of_labels(table):
        if len(rows) < minimum:
            label, group = table.labels[table.label[rows[0]]], table.groups[table.group[rows[0]]]
            raise DataError(
                f"{path}: label {label} has {len(rows)} of the {minimum} rows that are needed in group {group}; add "
                "some, remove the label, or take larger groups"
            )
    for i, name in enumerate(table.groups):
        if len(np.unique(table.label[table.group == i])) < 2:
            raise DataError(f"{path}: group {name} holds one label only; remove its rows, or take larger groups")


def count_for_training(rows: int, share: float) -> int:
    """Compute the number of training rows of a label: at least one, and at least one fewer than all if there are two.

    Args:
        rows: Number of rows of the label.
        share: Wanted share of training rows.

    Returns:
        The number of training rows.
    """
    return min(max(round(share * rows), 1), max(rows - 1, 1))
