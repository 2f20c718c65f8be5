"""How command lines are read: errors are one sentence, and descriptions are wrapped."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import pytest
import tyro

from i2t.options import one_sentence, read_options, wrapped


@dataclass(frozen=True)
class Asked:
    """Options of no command."""

    place: tyro.conf.Positional[Path]
    """Where."""
    count: int = 3
    """How many."""
    unit: Literal["m", "mm"] | None = None
    """Of a file."""
    at: Annotated[tuple[float, float], tyro.conf.arg(metavar="X Y")] = (0.0, 0.0)
    """Position."""
    names: tuple[str, ...] = ()
    """By default all."""

    def __post_init__(self) -> None:
        if self.count < 0:
            raise ValueError(f"--count is {self.count}; give 0 or more")


ANSWERS = {
    "": "give PATH",
    "here --cuont 3": "there is no option --cuont; perhaps --count",
    "here there": "there is more than this command takes; python -m it --help lists them",
    "here --count many": "--count: 'many' is no whole number",
    "here --at 0 up": "--at: '0', 'up' cannot be read",
    "here --count -1": "--count is -1; give 0 or more",
    "here --unit ell": "--unit is ell; choose one of",
}


@pytest.mark.parametrize(("words", "said"), ANSWERS.items(), ids=ANSWERS)
def test_a_wrong_word_is_answered_in_one_sentence(words, said, capsys):
    with pytest.raises(SystemExit, match="2"):
        read_options(Asked, words.split(), program="python -m it")
    out, printed = capsys.readouterr()
    assert out == ""
    assert printed.startswith(f"error: {said}")
    assert printed.count("\n") == 1
    assert "Asked" not in printed
    assert "None" not in printed


def test_what_is_right_is_read(monkeypatch):
    monkeypatch.setenv("COLUMNS", "50")
    assert read_options(Asked, ["here", "--names", "a", "b"], program="it") == Asked(Path("here"), names=("a", "b"))
    monkeypatch.setattr("sys.argv", ["it", "there", "--unit", "mm"])
    assert read_options(Asked, None, program="it") == Asked(Path("there"), unit="mm")


def test_a_sentence_is_found_in_ascii_and_in_colours_too():
    box = "+- Missing argument ----+\n| \x1b[1mMissing value for argument '--seed'. Expected 1 values.\x1b[0m |\n+--+\n"
    assert one_sentence(box) == "--seed needs a value"


def test_a_description_is_wrapped_and_its_commands_are_cut_where_a_shell_takes_them():
    command = "    python -m it --out " + "x" * 40
    text = "A " + "long " * 30 + f"paragraph\nin two lines.\n\n{command} --other-name yy    a note\n"
    lines = wrapped(text, 80).split("\n")
    assert max(map(len, lines)) <= 80
    assert f"{command} \\" in lines
    assert "        --other-name yy" in lines
    assert "        a note" in lines
    assert not any(line.startswith("in two") for line in lines)
