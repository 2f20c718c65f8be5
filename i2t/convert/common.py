"""Parts that all converters share: their result, how damage is treated, and reading text and tables of numbers."""

import io
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool

from i2t.dataset import Dataset
from i2t.errors import DataError
from i2t.files.archives import unpacked
from i2t.files.kinds import GZIP_MARK, decoded
from i2t.files.reading import read_bytes as read_file

ZERO_AMBIENT = "ambient is zero in every row: nothing is subtracted"


class Converted(NamedTuple):
    """A data set and, in sentences, what was assumed and what was left out on the way."""

    dataset: Dataset
    notes: tuple[str, ...]


@dataclass
class ConversionLog:
    """Collects what a person must know of a conversion, each sentence once; damage ends it unless it may be skipped."""

    skip_bad: bool
    lines: list[str] = field(default_factory=list)
    damaged_rows: int = 0
    first_damage: str = ""
    unit: str = "rows"  # what a reading stands for
    heard_rows: int = 0  # rows in which every chip answered
    silent_rows: int = 0  # rows that are left out because a chip did not answer
    silent_chips: Counter[int] = field(default_factory=Counter)  # rows in which each chip did not answer

    def info(self, line: str) -> None:
        """Note a sentence, once.

        Args:
            line: The sentence.
        """
        if line not in self.lines:
            self.lines.append(line)

    def skip(self, error: DataError) -> None:
        """Raise an error, or note what is left out for it.

        Args:
            error: What is wrong with the source.

        Raises:
            DataError: The error, unless `skip_bad`.
        """
        if not self.skip_bad:
            raise error
        self.info(f"left out: {error}")

    def skip_row(self, error: DataError) -> None:
        """Raise an error, or leave out a row of a table for it and count it.

        Args:
            error: What is wrong with the row.

        Raises:
            DataError: The error, unless `skip_bad`.
        """
        if not self.skip_bad:
            raise error
        self.damaged_rows, self.first_damage = self.damaged_rows + 1, self.first_damage or str(error)

    def keep_heard(self, silent: Bool[np.ndarray, "n chips"]) -> Bool[np.ndarray, " n"]:
        """Leave out rows in which a chip did not answer, and count them.

        Args:
            silent: (n, chips) mask of chips that did not answer.

        Returns:
            (n,) mask of the rows in which all chips answered.
        """
        heard = np.asarray(~silent.any(1))
        self.heard_rows, self.silent_rows = self.heard_rows + int(heard.sum()), self.silent_rows + int((~heard).sum())
        self.silent_chips.update(dict(enumerate(silent.sum(0).tolist())))
        return heard

    def require_heard(self, source: object, remedy: str = "check the board's cable, and record again") -> None:
        """Refuse a source in which a chip was silent in every row.

        Args:
            source: Name of the source, for the message.
            remedy: What the user is to do.

        Raises:
            DataError: Rows were left out because a chip did not answer, and no other row was read.
        """
        if self.silent_rows and not self.heard_rows:
            rows = f"in any of its {self.silent_rows} {self.unit}"
            never = [chip for chip, count in self.silent_chips.items() if count == self.silent_rows]
            if len(never) == len(self.silent_chips):
                problem = f"no chip answers {rows}, which hold zeros or nothing"
            elif never:
                problem = f"chip {', '.join(map(str, never))} does not answer {rows}, but sends zeros or nothing"
            else:
                problem = f"a chip does not answer in each of its {self.silent_rows} {self.unit} ({self._chips()})"
            raise DataError(f"{source}: {problem}; {remedy}")

    def _chips(self) -> str:
        """Half a sentence that counts the rows in which each chip did not answer."""
        counts = {chip: count for chip, count in self.silent_chips.items() if count}
        if len(counts) == len(self.silent_chips) and set(counts.values()) == {self.silent_rows}:
            return "every chip in all of them"
        return ", ".join(f"chip {chip} in {count}" for chip, count in counts.items())

    def sentences(self) -> list[str]:
        """All notes, with the numbers of damaged rows and of those in which a chip did not answer.

        Returns:
            The sentences.
        """
        counted = {
            f"left out: {self.damaged_rows} damaged rows; the first: {self.first_damage}": self.damaged_rows,
            f"left out: {self.silent_rows} {self.unit} in which a chip did not answer": self.silent_rows,
            f"did not answer, but sent zeros or nothing: {self._chips()}": self.silent_rows,
        }
        return [*self.lines, *(sentence for sentence, count in counted.items() if count)]

    def close(self, dataset: Dataset) -> Converted:
        """Put the notes into the data set's provenance.

        Args:
            dataset: What was converted.

        Returns:
            The data set with its notes, and the notes.
        """
        notes = self.sentences()
        meta = dict(dataset.meta) | {"notes": " | ".join(notes)}
        return Converted(replace(dataset, meta=meta), tuple(notes))


def require_ambient(
    source: object, silent: Bool[np.ndarray, "n chips"], silent_ambient: Bool[np.ndarray, "n chips"], remedy: str
) -> None:
    """Refuse a source without the ambient field of a chip that has readings.

    Args:
        source: Name of the file, for the message.
        silent: (n, chips) mask of chips that did not answer.
        silent_ambient: (n, chips) mask of ambient fields that are zero.
        remedy: What the user is to do.

    Raises:
        DataError: A chip that answered has no ambient field in any row.
    """
    missing = silent_ambient.all(0) & ~silent.all(0)
    if len(silent) and missing.any():
        chips = ", ".join(map(str, np.flatnonzero(missing)))
        raise DataError(f"{source}: the ambient field of chip {chips} is zero in every row; {remedy}")


def data_error(path: Path, problem: str) -> DataError:
    """The error about a file that is not as its author wrote it.

    Args:
        path: Of the file.
        problem: What is wrong with it.

    Returns:
        The error, with one sentence.
    """
    return DataError(f"{path}: {problem}; restore it from the source")


@contextmanager
def os_errors_as_data_errors(path: Path) -> Iterator[None]:
    """Turn errors of the system while a file is read into errors that name the file.

    Args:
        path: The file that is read in the block.

    Yields:
        Nothing.

    Raises:
        DataError: The block raised an OSError.
    """
    try:
        yield
    except OSError as error:
        raise data_error(path, f"cannot be read ({error.strerror or error})") from error


def read_bytes(path: Path) -> bytes:
    """The contents of a file, unzipped where it is a gzip archive.

    Args:
        path: Of the file.

    Returns:
        The contents.

    Raises:
        DataError: It cannot be read.
    """
    with os_errors_as_data_errors(path):
        raw = read_file(path)
    return unpacked(path, raw) if raw.startswith(GZIP_MARK) else raw


def read_text(path: Path) -> str:
    """The contents of a text file, unzipped as by `read_bytes`.

    Args:
        path: Of the file.

    Returns:
        The text.

    Raises:
        DataError: It cannot be read, is of another kind, or is not text.
    """
    return decoded(path, read_bytes(path))


def read_numbers(path: Path, columns: tuple[int, ...]) -> np.ndarray:
    """A comma-separated table of numbers without a header.

    Args:
        path: Of the file.
        columns: How many columns it may have.

    Returns:
        (rows, columns) float64.

    Raises:
        DataError: It cannot be read, or is no such table.
    """
    text = read_text(path)
    if not text.strip():
        raise data_error(path, "is empty")
    try:
        table = np.loadtxt(io.StringIO(text), delimiter=",", ndmin=2)
    except (ValueError, OverflowError) as error:
        raise data_error(path, f"is no table of numbers ({repr(str(error))[:200]})") from error
    if table.shape[1] not in columns:
        expected = " or ".join(map(str, columns))
        raise data_error(path, f"has {table.shape[1]} columns, not {expected}")
    return table
