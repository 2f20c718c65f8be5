"""Options of a command, read by tyro: one sentence where they are wrong, and help that fits a terminal.

tyro answers what it cannot read with a box in which names of classes stand, and prints a description as it is written,
however wide the terminal is. Here its answer becomes the sentence `error: ...` that other refusals are, and paragraphs
are wrapped; commands, which are indented, are cut after a backslash where they are too long. A default that says
nothing, None or an empty list, is left out: what happens without the option is said in its text.
"""

import contextlib
import io
import os
import re
import shutil
import sys
import textwrap
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

import tyro

from i2t.cli import WRONG_USE

LETTERS_FOR_LINES = str.maketrans("─│╭╮╰╯•", "-|++++*")
HELP_WORDS = {"-h", "--help"}
WIDEST = 80  # columns of a help, however wide the terminal is
ONE_LINE = "100000"  # columns in which every sentence of the parser is one line
SHELL_INDENT = "  "  # at least, before lines of a description that stand for themselves
NOTE_GOES_ON = " " * 12  # at least, before the second line of a note
NOTE_INDENT = 8  # of notes that come below what they are about

T = TypeVar("T")

_TIED = "\0"  # a space at which no line ends
_RULE = re.compile(r"^─{5,}$")
_BORDERS = "│╭╮╰╯"
_GAP = r"(?:[\s│]|\x1b\[[\d;]*m)"
_NO_DEFAULT = re.compile(rf"\(default:{_GAP}*(?:None)?{_GAP}*\)")
_SEQUENCE_LEFT = re.compile(r"\x1b\[[\d;]*m|[\s│]")


def read_options(
    kind: Callable[..., T],
    words: Sequence[str] | None,
    *,
    program: str,
    description: str = "",
    config: Sequence[Any] = (tyro.conf.FlagCreatePairsOff,),
) -> T:
    """Read a command line into a dataclass.

    Args:
        kind: The dataclass, or a union of those of sub-commands.
        words: The command line without the program's name; None takes the process's.
        program: What a user types to run the command.
        description: For the help; where it is empty the docstring of the dataclass.
        config: Of tyro.

    Returns:
        The options.

    Raises:
        SystemExit: After help, or after one sentence on stderr where a word makes no sense.
    """
    return answering(
        words, lambda given: tyro.cli(kind, args=given, prog=program, description=description or None, config=config)
    )


def answering(words: Sequence[str] | None, parse: Callable[[list[str]], T]) -> T:
    """Read a command line with tyro, with the answers of `read_options`.

    Args:
        words: The command line without the program's name; None takes the process's.
        parse: Calls tyro with them.

    Returns:
        What `parse` returns.

    Raises:
        SystemExit: After help, or after one sentence on stderr where a word makes no sense.
    """
    given = list(sys.argv[1:] if words is None else words)
    helping = bool(HELP_WORDS.intersection(given))
    columns = str(min(shutil.get_terminal_size().columns, WIDEST)) if helping else ONE_LINE
    said, shown = io.StringIO(), _Shown(sys.stdout)
    try:
        with _columns(columns), contextlib.redirect_stderr(said), contextlib.redirect_stdout(shown):
            return parse(given)
    except SystemExit as ended:
        if ended.code == WRONG_USE:
            print(f"error: {one_sentence(said.getvalue())}", file=sys.stderr)
        else:
            print(_for_terminal(_fitted(shown.text(), int(columns)), sys.stdout), end="")
        raise


def one_sentence(box: str) -> str:
    """Text of the parser's box, as a sentence that names options and no classes.

    Args:
        box: As tyro prints it where it is wide enough for each of its sentences.

    Returns:
        The sentence.
    """
    lines = [line.rstrip().strip(_BORDERS).rstrip()[1:] for line in _plain(box).splitlines()]
    lines = [line for line in lines[1:-1] if line.strip()]
    parts: list[list[str]] = [[]]
    for line in lines:
        if _RULE.match(line.strip()):
            parts.append([])
        else:
            parts[-1].append(line)
    first, said = parts[0], " ".join(" ".join(line.strip() for line in parts[0]).split())
    program = re.search(r"(?:run|see):? (.*?) --help", " ".join(line.strip() for line in parts[-1]))
    helps = f"; {' '.join(program[1].split())} --help lists them" if program else ""
    if found := re.match(r"Unrecognized options: (.*)", said):
        return _unknown(found[1].split(", "), parts[1:], helps)
    if found := re.match(r"Error parsing ([^:]*): (.*)", said):
        return _unreadable(found[1], found[2])
    if found := re.match(r"[Ii]nvalid choice '(.*)' for argument '(.*)'\. Expected one of \((.*?),?\)", said):
        choices = [choice for choice in re.findall(r"'([^']*)'", found[3]) if choice != "None"]
        return f"{found[2]} is {found[1]}; choose one of {', '.join(choices)}"
    if said.startswith("Missing from "):
        missing = [line.strip() for line in first if re.match(r" {4}\S", line)]
        return f"give {_listed([_name(each) for each in missing])}"
    if found := re.match(r"Expected one of \{(.*)\}", said):
        return f"say what to do: one of {found[1]}"
    if found := re.match(r"Missing value for argument '(.*)'\. Expected (\d+) values", said):
        return f"{found[1]} needs {'a value' if found[2] == '1' else f'{found[2]} values'}"
    return said or " ".join(_plain(box).split())


def _unknown(tokens: Sequence[str], parts: Sequence[Sequence[str]], helps: str) -> str:
    """Message on unknown words, with likely options."""
    flags = [token for token in tokens if token.startswith("-")]
    for part in parts:
        if found := re.match(r"Available subcommands: (.*)", " ".join(line.strip() for line in part)):
            return f"{tokens[0]} is none of {found[1]}"
    if not flags:
        return f"{' '.join(tokens)} is more than this command takes{helps}"
    near = [line.split()[0].split("/")[0].rstrip(",") for part in parts for line in part if re.match(r" {4}-", line)]
    meant = f"; perhaps {_listed(near[:2], 'or')}" if near else helps
    return f"there is no option {flags[0]}{meant}"


def _unreadable(name: str, why: str) -> str:
    """Message on an unreadable value."""
    if found := re.match(r"invalid literal for int\(\) with base 10: (.*)", why):
        why = f"{found[1]} is no whole number"
    elif found := re.match(r"could not convert string to float: (.*)", why):
        why = f"{found[1]} is no number"
    elif found := re.match(r"Could not parse arguments \[(.*)\] into", why):
        why = f"{found[1]} cannot be read; see --help"
    return f"{name}: {why}" if name.startswith("-") else why


def _name(missing: str) -> str:
    """Name of a missing option: its flag, or in capitals where it has none."""
    word = missing.split()[0].split("/")[0].rstrip(",")
    return f"one of {word.strip('{}').replace(',', ', ')}" if word.startswith("{") else word


def _listed(names: Sequence[str], last: str = "and") -> str:
    return f" {last} ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)


def _plain(text: str) -> str:
    return re.sub(r"\x1b\[[\d;]*m", "", text)


class _Shown(io.TextIOWrapper):
    """Buffer of printed text, drawn with lines, and in colours if it goes to a terminal."""

    def __init__(self, goes_to: Any) -> None:
        super().__init__(io.BytesIO(), encoding="utf-8")
        self._goes_to = goes_to

    def isatty(self) -> bool:
        """Test whether the text goes to a terminal."""
        return bool(self._goes_to is not None and self._goes_to.isatty())

    def text(self) -> str:
        """All that was printed."""
        self.flush()
        buffer: Any = self.buffer
        return buffer.getvalue().decode()


def _for_terminal(text: str, stream: Any) -> str:
    """The text, its lines drawn with letters where the stream has no others."""
    try:
        text.encode(getattr(stream, "encoding", None) or "utf-8")
    except UnicodeEncodeError:
        return text.translate(LETTERS_FOR_LINES)
    return text


@contextlib.contextmanager
def _columns(count: str) -> Iterator[None]:
    """Set the width of the terminal that programs see."""
    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = count
    try:
        yield
    finally:
        if before is None:
            del os.environ["COLUMNS"]
        else:
            os.environ["COLUMNS"] = before


def _fitted(text: str, columns: int) -> str:
    """Help text with a description that fits the columns, and boxes without empty defaults."""
    head, begins, boxes = text.partition("\n╭")
    boxes = begins + boxes
    boxes = re.sub(r"\{None\}\|(\S+)", lambda found: found[1] + " " * len("{None}|"), boxes)
    boxes = re.sub(r"\{None,(\S+\})", lambda found: "{" + found[1] + " " * len("None,"), boxes)
    touched = _NO_DEFAULT.sub(_blank, boxes)
    lines = [
        line
        for line, before in zip(touched.split("\n"), boxes.split("\n"), strict=True)
        if line == before or _plain(line).strip(_BORDERS + " ")
    ]
    head = _plain(head).replace("{None}|", "").replace("{None,", "{")
    head = re.sub(rf"\{{\S{{{columns},}}\}}", lambda found: found[0].replace(",", ", "), head)
    return wrapped(head, columns) + "\n".join(lines)


def _blank(found: re.Match[str]) -> str:
    """Replace text by spaces, between borders and colours."""
    kept, at = [], 0
    for part in _SEQUENCE_LEFT.finditer(found[0]):
        kept += [" " * (part.start() - at), part[0]]
        at = part.end()
    return "".join([*kept, " " * (len(found[0]) - at)])


def wrapped(text: str, columns: int = WIDEST) -> str:
    """A description for a terminal: paragraphs are wrapped, and indented lines cut where they are too long.

    Args:
        text: Paragraphs, and indented lines of commands or terms with a note behind them.
        columns: Of the terminal.

    Returns:
        The text, in which no line that has spaces is longer.
    """
    lines: list[str] = []
    for line in _joined(text.split("\n")):
        if len(line) <= columns:
            lines.append(line)
        elif line.startswith(SHELL_INDENT):
            lines += _cut(line, columns)
        else:
            lines += textwrap.wrap(line, columns, break_long_words=False, break_on_hyphens=False)
    return re.sub(r"\n{3,}", "\n\n", "\n".join(lines))


def _joined(lines: Sequence[str]) -> list[str]:
    """Each paragraph as one line, and each indented line with the rest of its note."""
    joined = [""]
    for line in lines:
        before = joined[-1]
        goes_on = before.startswith(SHELL_INDENT) if line.startswith(NOTE_GOES_ON) else not before.startswith(" ")
        if line and before and goes_on and (not line.startswith(SHELL_INDENT) or line.startswith(NOTE_GOES_ON)):
            gap = "  " if line.startswith(NOTE_GOES_ON) and not re.search(r"\S {2,}\S", before) else " "
            joined[-1] = before.rstrip() + gap + line.strip()
        else:
            joined.append(line)
    return joined[1:]


def _cut(line: str, columns: int) -> list[str]:
    """An indented line: what is behind two spaces goes to lines of its own, and a command goes on after a backslash."""
    indent = " " * (len(line) - len(line.lstrip()))
    command, *note = re.split(r" {2,}", line.strip(), maxsplit=1)
    shell = command.startswith(("python ", "--", "pip "))
    command = re.sub(r"(--\S+) (?=[^-\\\s])", rf"\1{_TIED}", command.removesuffix(" \\"))  # an option and its value
    inside = textwrap.wrap(command, columns - len(indent) - 2, break_long_words=False, break_on_hyphens=False)
    cut = [f"{indent}{'' if not i else '    '}{part}".replace(_TIED, " ") for i, part in enumerate(inside)]
    last = len(cut) - 1 if not line.endswith("\\") else len(cut)
    cut = [each + (" \\" if shell and i < last else "") for i, each in enumerate(cut)]
    notes = textwrap.wrap(note[0].strip(), columns - NOTE_INDENT, break_long_words=False) if note else []
    return cut + [" " * NOTE_INDENT + each for each in notes]
