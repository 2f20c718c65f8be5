"""The card of a data set describes its contents, and readers ignore it."""

import re
from dataclasses import replace

import numpy as np
import pytest
from helpers.random_touches import make

from i2t.dataset import load_dataset, save_dataset
from i2t.dataset.card import CARD, card_of, write_card
from i2t.errors import DataError
from i2t.skin.boards import make_board, name_of_board


def test_a_card_states_contents_count_board_and_source():
    dataset = replace(make(9, board="grid-1x2", pixels=4), meta={"rig": "a | b"})
    card = card_of(dataset)
    assert card.startswith("# 9 touches, simulated\n")
    for i, name in enumerate(dataset.objects):
        count = int(np.sum(dataset.touches.object == i))
        assert (f"{name} ({count})" in card) == bool(count)
    assert "| board | one without a name: 2 chips, at " in card
    assert "| board | grid-1x2: 2 chips, at " in card_of(dataset, board_name=name_of_board(dataset.board))
    assert "| rig | a / b |" in card
    assert "4 x 4 pixels over 17 mm" in card
    for name in ("reskin", "anyskin", "eflesh", "grid-2x3", "grid-3x2"):
        assert name_of_board(make_board(name)) == name


def test_notes_are_a_list_and_no_remark_breaks_a_table_or_has_no_end():
    notes = [f"Note {i} says what was left out, at some length, so that it is not cut." for i in range(42)]
    meta = {"rig": "word " * 1000, "notes": " | ".join(notes), "made by": "a\nb", "unknowns of hexagon 1": "[{}]"}
    card = card_of(replace(make(9, pixels=4), meta=meta))
    assert all(f"\n- {note}\n" in card for note in notes[:40])
    assert notes[40] not in card
    assert "- and 2 more, in the set's `meta`" in card
    assert "| made by | a b |" in card
    assert "unknowns of" not in card  # notes say what was found
    (rig,) = re.findall(r"^\| rig \| (.*) \|$", card, re.M)
    assert rig.endswith("word ...")
    assert len(rig) < 1100


def test_a_card_is_replaced_and_is_not_part_of_the_set(tmp_path):
    dataset = make(3, pixels=4)
    save_dataset(tmp_path / "set.h5", dataset)
    (tmp_path / CARD).write_text("old")
    write_card(tmp_path, dataset)
    assert (tmp_path / CARD).read_text() == card_of(dataset)
    assert len(load_dataset(tmp_path)) == 3
    assert sorted(path.name for path in tmp_path.iterdir()) == [CARD, "set.h5"]
    with pytest.raises(DataError, match="choose a folder"):
        write_card(tmp_path / "set.h5", dataset)
