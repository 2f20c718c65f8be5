"""Parts that all converters share: their result, how damage is treated, and reading text and tables of numbers."""

import io
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from i2t import files
from i2t.dataset import Dataset
from i2t.errors import DataError


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
    silent_rows: int = 0  # left out, as a chip did not answer

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

    def sentences(self) -> list[str]:
        """All notes, with the number of damaged rows.

        Returns:
            The sentences.
        """
        counted = {
            f"left out: {self.damaged_rows} damaged rows; the first: {self.first_damage}": self.damaged_rows,
            f"left out: {self.silent_rows} rows in which a chip did not answer": self.silent_rows,
        }
        return [*self.lines, *(said for said, count in counted.items() if count)]

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


def data_error(path: Path, problem: str) -> DataError:
    """The error about a file that is not as its author wrote it.

    Args:
        path: Of the file.
        problem: What is wrong with it.

    Returns:
        The error, with one sentence.
    """
    return DataError(f"{path}: {problem}; restore it from the source")


def read_bytes(path: Path) -> bytes:
    """The contents of a file, unzipped where its name ends in .gz.

    Args:
        path: Of the file.

    Returns:
        The contents.

    Raises:
        DataError: It cannot be read.
    """
    try:
        raw = files.read_bytes(path)
    except OSError as error:
        raise data_error(path, f"cannot be read ({error.strerror or error})") from error
    return files.unpacked(path, raw) if path.suffix == ".gz" else raw


def read_text(path: Path) -> str:
    """The contents of a text file, unzipped as by `read_bytes`.

    Args:
        path: Of the file.

    Returns:
        The text.

    Raises:
        DataError: It cannot be read, or is no text.
    """
    try:
        return read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise data_error(path, f"is no text (byte {error.start} is not UTF-8)") from error


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
