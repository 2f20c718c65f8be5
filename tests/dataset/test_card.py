"""The card of a data set says what it holds, and no reader minds it."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.random_touches import make

from i2t.dataset import load_dataset, save_dataset
from i2t.dataset.card import CARD, card_of, write_card
from i2t.errors import DataError


def test_a_card_says_what_how_many_which_board_and_whether_simulated():
    dataset = replace(make(9, board="grid-1x2", pixels=4), meta={"rig": "a | b", "notes": "x" * 500})
    card = card_of(dataset)
    assert card.startswith("# 9 touches, simulated\n")
    for i, name in enumerate(dataset.objects):
        count = int(np.sum(dataset.touches.object == i))
        assert (f"{name} ({count})" in card) == bool(count)
    assert "| board | 2 chips at " in card
    assert "| rig | a / b |" in card
    assert "4 x 4 pixels over 17 mm" in card
    assert "x" * 301 not in card


def test_a_card_is_replaced_and_no_part_of_the_set(tmp_path):
    dataset = make(3, pixels=4)
    save_dataset(tmp_path / "set.h5", dataset)
    (tmp_path / CARD).write_text("old")
    write_card(tmp_path, dataset)
    assert (tmp_path / CARD).read_text() == card_of(dataset)
    assert len(load_dataset(tmp_path)) == 3
    assert sorted(path.name for path in tmp_path.iterdir()) == [CARD, "set.h5"]
    with pytest.raises(DataError, match="choose a folder"):
        write_card(tmp_path / "set.h5", dataset)
