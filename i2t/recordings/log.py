"""Log of a recording that is being read: what was assumed and left out, and how damage is handled."""

from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool

from i2t.errors import DataError

if TYPE_CHECKING:
    from i2t.recordings.diagnose.findings import Finding

ZERO_AMBIENT = "ambient is zero in every row: nothing is subtracted"  # note if a log's ambient field is zero


@dataclass
class ReadingLog:
    """Notes on a recording that is being read, each listed once, and counts of damaged rows and of chips that did not
    answer. Damage raises an error unless `skip_bad` is set.
    """

    skip_bad: bool
    lines: list[str] = field(default_factory=list)
    damaged_rows: int = 0
    first_damage: str = ""
    unit: str = "rows"  # noun for a reading in the notes, such as "touches"
    answered_rows: int = 0  # number of rows in which every chip answered
    silent_rows: int = 0  # number of rows that are left out because a chip did not answer
    silent_chips: Counter[int] = field(default_factory=Counter)  # number of rows in which each chip did not answer
    changes: dict[str, list[str]] = field(default_factory=dict)  # notes on what was changed or left out, by topic
    doubts: dict[str, list[str]] = field(default_factory=dict)  # notes on what is doubtful, by topic
    advice: dict[str, str] = field(default_factory=dict)  # clauses on what to do about doubts, by topic

    def info(self, line: str) -> None:
        """Add a sentence to the notes unless they contain it.

        Args:
            line: Sentence to note.
        """
        if line not in self.lines:
            self.lines.append(line)

    def change(self, topic: str, line: str) -> None:
        """Add a sentence on what was changed or left out.

        Args:
            topic: What was changed, in a few words.
            line: Sentence to note.
        """
        self._add(self.changes, topic, line)

    def doubt(self, topic: str, line: str) -> None:
        """Add a sentence on what is doubtful.

        Args:
            topic: What is doubtful, in a few words.
            line: Sentence to note.
        """
        self._add(self.doubts, topic, line)

    def finding(self, finding: "Finding", where: str = "", *, kept: bool = False) -> None:
        """Add the result of a test of the recording, as a change, a doubt or a mere note.

        Args:
            finding: The result. A test that could not be made is a mere note.
            where: The part of the recording that was tested, such as " in session 1"; empty if it is the whole.
            kept: Whether the recording is not corrected, although the finding contradicts it.
        """
        if finding.wrong and not kept:
            self.change(finding.name, f"corrected{where}: {finding.sentence}")
        elif finding.untested:
            self.info(f"not tested{where}: {finding.sentence}")
        elif finding.wrong or not finding.identifiable:
            sentence = (
                f"{finding.sentence.removesuffix('.')}; {finding.advice}." if finding.advice else finding.sentence
            )
            self.doubt(finding.name, f"{'contradicted' if finding.wrong else 'doubtful'}{where}: {sentence}")
            if finding.advice:
                self.advice[finding.name] = finding.advice
        else:
            self.info(f"found{where}: {finding.sentence}")

    def include(self, other: "ReadingLog") -> None:
        """Add the notes of another log.

        Args:
            other: Log of an earlier step of the same conversion.
        """
        changes = {topic: list(lines) for topic, lines in other.changes.items()}
        for sentence in other.sentences():
            self.info(sentence)
        for topic, lines in (changes | {sentence: [sentence] for sentence in other._counts()}).items():
            self.changes.setdefault(topic, []).extend(lines)
        for topic, lines in other.doubts.items():
            self.doubts.setdefault(topic, []).extend(lines)
        self.advice |= other.advice

    def _add(self, notes: dict[str, list[str]], topic: str, line: str) -> None:
        if line not in self.lines:
            notes.setdefault(topic, []).append(line)
        self.info(line)

    def skip(self, error: DataError) -> None:
        """Raise an error about damage, or note what is left out because of it.

        Args:
            error: Error about the source.

        Raises:
            DataError: The given error, unless `skip_bad` is set.
        """
        if not self.skip_bad:
            raise error
        self.change("damage", f"left out: {error}")

    def skip_row(self, error: DataError) -> None:
        """Raise an error, or count a row of a table that is left out because of it.

        Args:
            error: Error about the row.

        Raises:
            DataError: The given error, unless `skip_bad` is set.
        """
        if not self.skip_bad:
            raise error
        self.damaged_rows, self.first_damage = self.damaged_rows + 1, self.first_damage or str(error)

    def select_answered(self, silent: Bool[np.ndarray, "n chips"]) -> Bool[np.ndarray, " n"]:
        """Select and count the rows in which all chips answered.

        Args:
            silent: `(n, chips)` mask of chips that did not answer.

        Returns:
            `(n,)` mask of the rows in which all chips answered.
        """
        answered = np.asarray(~silent.any(1))
        self.answered_rows += int(answered.sum())
        self.silent_rows += int((~answered).sum())
        self.silent_chips.update(dict(enumerate(silent.sum(0).tolist())))
        return answered

    def require_answers(self, source: object, remedy: str = "check the board's cable, and record again") -> None:
        """Refuse a source in which every row was left out because some chip did not answer.

        Args:
            source: Name of the source, for the message.
            remedy: Advice at the end of the message.

        Raises:
            DataError: All rows were left out because a chip did not answer.
        """
        if self.silent_rows and not self.answered_rows:
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
        """Count the rows in which each chip did not answer, as a clause."""
        counts = {chip: count for chip, count in self.silent_chips.items() if count}
        if len(counts) == len(self.silent_chips) and set(counts.values()) == {self.silent_rows}:
            return "every chip in all of them"
        return ", ".join(f"chip {chip} in {count}" for chip, count in counts.items())

    def sentences(self) -> list[str]:
        """List all notes, including the numbers of damaged rows and of rows with silent chips.

        Returns:
            The sentences in the order in which they were noted, followed by the counts.
        """
        return [*self.lines, *self._counts()]

    def brief(self, *, max_changes: int = 3) -> list[str]:
        """List what was changed, left out or is doubtful, in a few lines.

        Args:
            max_changes: Maximum number of lines on changes.

        Returns:
            The first sentence on each change, with the number of further ones, and one line on all doubts.
        """
        changes = [_first_of(lines) for lines in self.changes.values()] + self._counts()
        if len(changes) > max_changes:
            topics = ", ".join([*self.changes, *self._counts()][max_changes - 1 :])
            changes = [*changes[: max_changes - 1], f"also changed or left out: {topics}"]
        if len(self.doubts) > 1:
            doubts = [f"{topic} ({self.advice[topic]})" if topic in self.advice else topic for topic in self.doubts]
            return [*changes, f"doubtful: {', '.join(doubts)}"]
        return [*changes, *map(_first_of, self.doubts.values())]

    def _counts(self) -> list[str]:
        """Word the numbers of damaged rows and of rows with silent chips that are not zero."""
        counted = {
            f"left out: {self.damaged_rows} damaged rows; the first: {self.first_damage}": self.damaged_rows,
            f"left out: {self.silent_rows} {self.unit} in which a chip did not answer": self.silent_rows,
            f"did not answer, but sent zeros or nothing: {self._chips()}": self.silent_rows,
        }
        return [sentence for sentence, count in counted.items() if count]


def _first_of(lines: list[str]) -> str:
    return lines[0] + (f" (and {len(lines) - 1} more of this kind)" if len(lines) > 1 else "")


def require_ambient(
    source: object, silent: Bool[np.ndarray, "n chips"], silent_ambient: Bool[np.ndarray, "n chips"], remedy: str
) -> None:
    """Refuse a source in which a chip has readings but no ambient field.

    Args:
        source: Name of the file, for the message.
        silent: `(n, chips)` mask of chips that did not answer.
        silent_ambient: `(n, chips)` mask of ambient fields that are zero.
        remedy: Advice at the end of the message.

    Raises:
        DataError: A chip that answered has no ambient field in any row.
    """
    missing = silent_ambient.all(0) & ~silent.all(0)
    if len(silent) and missing.any():
        chips = ", ".join(map(str, np.flatnonzero(missing)))
        raise DataError(f"{source}: the ambient field of chip {chips} is zero in every row; {remedy}")
