"""Presets are chosen by name."""

from dataclasses import dataclass

import pytest

from experiments.common.presets import choose_preset


@dataclass(frozen=True)
class Config:
    touches: int = 1000
    seeds: int = 1


def test_given_options_change_a_preset_and_an_unknown_preset_is_refused():
    presets = {"paper": Config(), "debug": Config(10)}
    assert choose_preset(presets, "debug", seeds=3, touches=None) == Config(10, 3)
    with pytest.raises(ValueError, match="--preset nonsense is none of paper, debug"):
        choose_preset(presets, "nonsense")
