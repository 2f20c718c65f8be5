"""Tables of labelled readings of any tactile sensor: one row a touch, in the order in which they were made.

One column holds the label, others may be left out, and the remaining columns are the reading. Where a column numbers
the touches, the rows of a touch become their mean, because samples of one contact share its errors. Tables are split
within groups, in the order of the file or at random. Successive touches share errors, which a random split puts on both
sides, so its scores are better than those of a later session would be (Roberts et al., Ecography 40, 2017).
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
MAX_VALUE = 1e30  # of a reading: classifiers count in single precision
CLOSE = 0.25  # distance of successive rows of one touch, relative to that of a label's rows far apart in time
MIN_CLOSE_SHARE = 0.1  # share of close successive rows, above that by chance, from which a warning is given
MIN_RISES = 12  # rises of a column that never falls, from which it is taken for a counter
MIN_JUMP = 0.5  # relative distance between rows of different touches; a drift has no such jumps
MAX_ZERO_SHARE = 0.1  # share of zeros in other rows, above which a row of zeros is a reading
OUTLIERS = 0.01  # share of touches that any label may give, so that none rules a label out


class ReadingTable(NamedTuple):
    """Readings, the label of each, and the group within which it is compared with others."""

    reading: Float[np.ndarray, "n d"]
    label: Int[np.ndarray, " n"]  # index of `labels`
    labels: tuple[str, ...]  # numbers by size, else by the alphabet
    group: Int[np.ndarray, " n"]  # index of `groups`
    groups: tuple[str, ...]  # in the order of the files
    columns: tuple[str, ...]  # of the reading
    samples: int = 0  # rows of the files, where several rows are one touch; 0 where each row is a touch
    notes: tuple[str, ...] = ()  # sentences on what was changed in the files or left out


class _Part(NamedTuple):
    """The rows of one file."""

    labels: list[str]
    groups: list[str]
    touches: list[str]  # the touch of which a row is a sample; empty texts where each row is a touch
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
        paths: CSV files, plain or gzip-ed, of the same columns. Several files are as many groups at least.
        label: Column of the label: any text.
        group: Column of the group, if the rows of a file are of several.
        ignore: Columns that are no part of the reading.
        touch: Column that numbers or names the touches: rows that follow each other with the same label, group and
            value in it are samples of one touch.

    Returns:
        All touches, in the order of the files. A touch of several samples has their mean reading.

    Raises:
        DataError: A file cannot be read, lacks a column, or holds a value that is not a number or an empty label.
        ValueError: One column is named for two purposes, or one file is given twice.
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
                f"{path}: its reading has not the columns of {paths[0]} ({', '.join(other[:3])}); give tables of one "
                "sensor, or leave these columns out of both"
            )
    texts = [text for part in parts for text in part.labels]
    labels = _in_order(texts)
    if len(labels) < 2:
        raise DataError(f"{paths[0]}: column {label} holds {labels[0]} only; give at least two labels to tell apart")
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
            f"{paths[0]}: {repeats} of {len(reading)} rows repeat another exactly; if they are copies, remove them: a "
            "method that was taught one knows the other",
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
    """The means of successive rows with the same label, group and touch (number of the file, and name)."""
    names = np.unique(touches, axis=0, return_inverse=True)[1].reshape(-1)
    keys = np.column_stack([table.label, table.group, names])
    starts = first_samples((keys[1:] == keys[:-1]).all(1))
    means = mean_samples(table.reading, starts)
    return table._replace(reading=means, label=table.label[starts], group=table.group[starts], samples=len(keys))


def close_followers(table: ReadingTable) -> float:
    """Share of rows that may be samples of the same touch as the row before.

    Such a row is much closer to the row before of its label and group than rows of that label are to each other
    otherwise.

    Args:
        table: The readings, in the order in which they were made.

    Returns:
        The share; 0 where it is at most a tenth, where rows far apart in time are as close, and where readings drift
        without jumps.
    """
    spread = table.reading.std(0)
    scaled = (table.reading - table.reading.mean(0)) / np.where(spread > 0, spread, 1)
    following, others = [], []
    for rows in rows_of_labels(table):
        if len(rows) < 4:
            continue
        half = len(rows) // 2  # as far apart in time as all of them can be
        apart = np.linalg.norm(scaled[rows[half:]] - scaled[rows[: len(rows) - half]], axis=1)
        if typical := float(np.median(apart)):
            following.append(np.linalg.norm(np.diff(scaled[rows], axis=0), axis=1) / typical)
            others.append(apart / typical)
    if not following:
        return 0.0
    near, far = np.concatenate(following), np.concatenate(others)
    share, jumps = float(np.mean(near < CLOSE)), near[near >= CLOSE]
    drifts = len(jumps) > 0 and np.median(jumps) < MIN_JUMP
    return 0.0 if drifts or share < MIN_CLOSE_SHARE + 2 * np.mean(far < CLOSE) else share


def refuse_counters(table: ReadingTable, path: Path, *, may_number_touches: bool = True) -> None:
    """Refuse a reading with a column that never falls within any label, because it counts rows, touches or time.

    Args:
        table: The readings, in the order of the files.
        path: The file, or the first of several, for messages.
        may_number_touches: Whether the command has an option `--touch` for such a column.

    Raises:
        DataError: There is such a column.
    """
    steps = np.concatenate([np.diff(table.reading[rows], axis=0) for rows in rows_of_labels(table)])
    counts = (steps >= 0).all(0) & ((steps > 0).sum(0) >= MIN_RISES)
    if counts.any():
        name = table.columns[int(counts.argmax())]
        other = f", or, if it numbers touches of several rows each, pass --touch {name}" if may_number_touches else ""
        raise DataError(
            f"{path}: column {name} never falls from one row of a label to the next, so that it counts rows, touches "
            f"or time and is no reading; leave it out (--ignore {name}){other}"
        )


def _read(path: Path, label: str, group: str | None, ignore: Sequence[str], touch: str | None) -> _Part:
    special = [name for name in (label, group, touch, *ignore) if name is not None]
    header, rows, notes = open_text_table(path, as_named=True, texts=special)
    if missing := [name for name in special if name not in header]:
        remedy = did_you_mean(missing[0], header, "name one of its columns")
        raise DataError(f"{path}: there is no column {missing[0]} ({describe_header(header)}); {remedy}")
    kept = [i for i, name in enumerate(header) if name not in special]
    if twice := next((name for name in header if header.count(name) > 1 and name not in ignore), ""):
        raise DataError(f"{path}: column {twice} stands twice in the first line; rename one")
    if not kept:
        raise DataError(f"{path}: no column is left for the reading; leave out fewer")
    log, columns = ReadingLog(skip_bad=False), tuple(header[i] for i in kept)
    remedy = "correct or remove the row, or leave the column out (--ignore)"
    sound, reading = valid_rows(path, header, rows, columns, np.ones_like, log, bound=MAX_VALUE, remedy=remedy)
    if not sound:
        raise DataError(f"{path}: holds no row below the names of its columns; give one a touch")
    names = (label, group, touch)
    texts = [
        ["" if name is None else _name(path, line, name, cells[header.index(name)]) for name in names]
        for line, cells in sound
    ]
    log.lines += notes
    heard = log.select_answered(_silent(columns, reading))
    log.require_answers(path)
    labels, groups, touches = zip(*(row for row, keep in zip(texts, heard, strict=True) if keep), strict=True)
    return _Part(list(labels), list(groups), list(touches), columns, reading[heard], log.sentences())


def _silent(columns: Sequence[str], reading: np.ndarray) -> np.ndarray:
    """Mask (n, chips) of chips that sent zeros only; all columns are one chip where their names tell of none. Where
    other rows hold many zeros, as those of arrays of switches do, a row of zeros is a reading.
    """
    fields = [i for i, name in enumerate(columns) if FIELD_STEM.match(name.lower())]
    if fields and len(fields) % AXES_OF_CHIP == 0:
        return silent_chips(reading[:, fields], differences=True)
    zeros = (reading == 0).all(1, keepdims=True)
    others = reading[~zeros[:, 0]]
    plain = reading.shape[1] >= AXES_OF_CHIP and (not others.size or np.mean(others == 0) <= MAX_ZERO_SHARE)
    return zeros & plain


def _name(path: Path, line: int, column: str, text: str) -> str:
    if not text.strip():
        raise DataError(f"{path}: line {line} has nothing in column {column}; fill it in, or remove the row")
    return text.strip()


def _in_order(texts: Sequence[str]) -> tuple[str, ...]:
    """Different texts: numbers by size where all are numbers, else by the alphabet."""
    different = sorted(set(texts))
    numbers = [parse_number(text) for text in different]
    are_numbers = all(number is not None and np.isfinite(number) for number in numbers)
    return tuple(sorted(different, key=float) if are_numbers else different)


# --- splits ---


def training_rows(table: ReadingTable, share: float, seed: int) -> dict[str, Bool[np.ndarray, " n"]]:
    """Which rows are for training, by split: the first of each label in each group (`IN_ORDER`), or as many at random.

    Args:
        table: Of n rows.
        share: Of a label's rows that are for training; at least one is on either side where there are two.
        seed: Of the draw.

    Returns:
        Whether a row is for training.
    """
    rng = np.random.default_rng(seed)
    train = {IN_ORDER: np.zeros(len(table.label), bool), AT_RANDOM: np.zeros(len(table.label), bool)}
    for rows in rows_of_labels(table):
        count = count_for_training(len(rows), share)
        train[IN_ORDER][rows[:count]] = True
        train[AT_RANDOM][rng.permutation(rows)[:count]] = True
    return train


def rows_of_labels(table: ReadingTable) -> list[Int[np.ndarray, " k"]]:
    """Rows of each label in each group.

    Args:
        table: Of n rows.

    Returns:
        Row numbers in the order of the file, for each pair that occurs.
    """
    pair = table.group * len(table.labels) + table.label
    return [np.flatnonzero(pair == value) for value in np.unique(pair)]


def with_outliers(p: Float[np.ndarray, "n labels"]) -> Float[np.ndarray, "n labels"]:
    """Probabilities of which the share `OUTLIERS` is the same for all labels.

    Args:
        p: Of a classifier.

    Returns:
        The mixture.
    """
    return (1 - OUTLIERS) * p + OUTLIERS / p.shape[1]


def require_rows(table: ReadingTable, minimum: int, path: Path) -> None:
    """Refuse a table with too few rows of a label in a group, or with a group of one label.

    Args:
        table: Any.
        minimum: Minimum number of rows of a label in a group.
        path: Of the file, or the first one, for messages.

    Raises:
        DataError: There are fewer.
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
    """Rows for training, of so many: at least one, and one fewer than all.

    Args:
        rows: How many there are.
        share: That is wanted.

    Returns:
        How many.
    """
    return min(max(round(share * rows), 1), max(rows - 1, 1))
