"""Names that somebody else chose reach a terminal without their control characters."""

from dataclasses import replace

import pytest
from helpers.random_touches import make

from experiments.common.tables import text_table
from i2t.cli import exit_codes as cli
from i2t.cli.pipes import ExitCode
from i2t.convert.commands import main
from i2t.dataset import save_dataset
from i2t.dataset.card import card_of
from i2t.errors import DataError, printable

EVIL = "mug\x1b[2J\n\x07\x9b31m\u202e"
SHOWN = r"mug\x1b[2J\n\x07\x9b31m\u202e"


def controls(text):
    return [c for c in text if c in "\x1b\x07\x9b\u202e"]


@pytest.mark.parametrize("name", ["Tasse, größer", "磁気　皮膚", "كوب", "👩‍🔧 \u00a0", r"a\b"])
def test_letters_of_every_script_stay(name):
    assert printable(name) == name


def test_control_characters_are_escaped():
    assert printable(EVIL) == SHOWN
    assert printable("\ud800\x7f\r\u2029") == r"\ud800\x7f\r\u2029"


def test_names_of_a_data_set_are_printed_without_controls(tmp_path, capsys):
    names = (EVIL, "square", "größer")
    hostile = replace(make(9, pixels=4, objects=names), pads=(EVIL, "b"), meta={EVIL: EVIL, "notes": EVIL})
    path = save_dataset(tmp_path / "set.h5", hostile)
    assert main(["summary", str(path)]) == 0
    said = capsys.readouterr().out
    assert said.count(SHOWN) == 5  # once as an object and a pad, and in the meta three times
    assert "größer" in said
    assert not controls(said + card_of(hostile))
    assert not controls(text_table([EVIL], [[EVIL]]))


def test_an_error_that_quotes_a_file_is_one_line_without_controls(capsys):
    def refuse():
        raise ValueError(f"{EVIL}: cannot be read")

    assert cli.exit_code_of(refuse) == ExitCode.WRONG_USE
    assert capsys.readouterr().err == f"error: {SHOWN}: cannot be read\n"
    assert not controls(str(DataError(EVIL)))
