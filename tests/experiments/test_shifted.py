"""Shifted and damaged variants of a recording: what they are, and that the command counts where a baseline is above."""

import json

import numpy as np
import pytest
from helpers.skin_presses import presses_of_a_skin

from experiments.calibrate.skins import PressedSkinOfKind
from experiments.shifted import run, variants
from experiments.shifted.arguments import ShiftedArgs

SKIN = presses_of_a_skin(150)


def made_skins(kind, seed, count, presses):
    rng = np.random.default_rng((seed, len(kind)))
    position, depth = rng.uniform(-8e-3, 8e-3, (60, 2)), rng.uniform(0.2e-3, 1e-3, 60)
    readings = rng.normal(size=(60, 15))
    return [PressedSkinOfKind(kind, position, depth, 1e3 * depth, readings, np.zeros((5, 2)))] * count


@pytest.fixture
def made(monkeypatch):
    """Variants of a made-up recording, and made-up skins in place of simulated ones."""
    monkeypatch.setattr(variants, "read_recordings", lambda path: [SKIN])
    monkeypatch.setattr(variants, "simulate_skins", made_skins)
    return variants.make_variants("nowhere", 5)


def test_each_variant_differs_in_what_its_name_says_and_in_nothing_else(made):
    sound = made["real"]
    np.testing.assert_array_equal(sound.readings, SKIN.readings)
    np.testing.assert_allclose(made["height zero 3 mm off"].load - sound.load, 3e-3)
    np.testing.assert_array_equal(made["labels two rows late"].position, sound.position[2:])
    np.testing.assert_array_equal(made["labels two rows late"].readings, sound.readings[:-2])
    assert len(np.unique(made["five heights"].load)) == 5
    np.testing.assert_allclose(made["gains of 0.3 to 3"].readings[:, 12:], 3 * sound.readings[:, 12:])
    assert np.ptp(made["x not known"].position[:, 0]) == 0
    changed = (made["5 % of the readings wrong"].readings != sound.readings).any(1)
    assert 0 < changed.mean() < 0.12
    assert made["no load"].load is None
    for name, one in made.items():
        assert len(one.position) == len(one.readings), name
        assert one.load is None or (one.load >= 0).all(), name


def test_what_is_held_out_is_never_known():
    position = SKIN.targets["position"]
    for known, test in run.held_out(position, np.random.default_rng(0)).values():
        assert len(known) > 0
        assert len(test) > 0
        assert not set(known) & set(test)
    known, test = run.held_out(position, np.random.default_rng(0))["whole blocks"]
    cell = np.floor((position - position.min(0)) / run.BLOCK_M + 1e-9).astype(int)
    assert not set(map(tuple, cell[known])) & set(map(tuple, cell[test]))


def test_losses_are_counted(capsys):
    def cell(gain):
        r2 = {"i2t.calibrate": 0.5, "mean reading": 0.5 - gain}
        return {"variant": "v", "held_out": "random presses", "presses": 5, "r2": r2, "gain": gain, "inside_90": 0.9,
                "best_baseline": "mean reading"}  # fmt: skip

    cells = [cell(gain) for gain in (0.3, -0.005, -0.02, -0.2)]
    found = run.summary(cells)
    assert found["lost_by_more_than"] == {"0.01": 2, "0.03": 1, "0.1": 1}
    assert found["mean_loss"] == pytest.approx(-0.225 / 4)
    run.print_table({"cells": cells, "summary": {"random presses": found}})
    assert capsys.readouterr().out.count("mean reading 0.700") == 1


@pytest.mark.full
def test_the_command_scores_every_method(made, tmp_path, monkeypatch):
    monkeypatch.setattr(run, "SHIFTED_COUNTS", (5, 20))
    metrics = run.run(ShiftedArgs(tmp_path, out=tmp_path / "out", draws=1, only=("noise",)))
    names = {one["variant"] for one in metrics["cells"]}
    assert names == {
        "depths with 0.5 mm of noise", "forces with a tenth of noise", "positions with 2 mm of noise",
        "nothing but noise",
    }  # fmt: skip
    for one in json.loads((tmp_path / "out" / "metrics.json").read_text())["cells"]:
        assert set(one["r2"]) == {*run.BASELINE_METHODS, run.LIKELIEST, run.CALIBRATED}
