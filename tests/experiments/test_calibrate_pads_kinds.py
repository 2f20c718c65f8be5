"""Simulated skins of many kinds, the prior that is made of them, and the table of what it is worth."""

import numpy as np
import pytest

from experiments.calibrate_pads import __main__ as command
from experiments.calibrate_pads import kinds, prior_search, skin_kinds
from i2t.calibration.population_gp import load_prior
from i2t.calibration.population_gp.prior import prior_about


def test_the_prior_of_the_package_is_what_the_search_makes_of_its_constants():
    about, cfg = prior_about(), prior_search.PRESETS["paper"]
    assert about["source"] == "simulated"
    assert about["seed"] == prior_search.POPULATION_SEED != skin_kinds.KINDS_SEED
    assert tuple(about["kinds"]) == kinds.SKIN_KINDS
    assert about["skins_of_each"] == cfg.skins
    assert about["candidates"] == cfg.wide + len(prior_search.ANCHORS) * cfg.anchored + cfg.second
    assert len(load_prior().kernels.load_power) == cfg.kept
    named = {f"{case.kind}, {'force' if case.load == 'both' else case.load}" for case in skin_kinds.CASES}
    assert named <= set(about["best_of_kind"])


def test_candidates_lie_in_their_ranges_and_the_known_ones_are_among_those_about_them():
    rng = np.random.default_rng(0)
    drawn = prior_search.draw_wide(rng, 400)
    for name, (low, high, _) in prior_search.RANGES.items():
        values = getattr(drawn, name)
        off = {"far_amplitude": 1.0, "static_variance": 0.0}.get(name)
        assert ((values >= low) & (values <= high) | (values == off)).all(), name
    for known in prior_search.ANCHORS.values():
        about = prior_search.near(rng, known, 10)
        for name, values in known._asdict().items():
            np.testing.assert_array_equal(getattr(about, name)[: len(values)], values)
        assert (about.far_amplitude[known.far_amplitude[np.arange(10) % len(known.load_power)] == 1] == 1).all()


def test_shares_go_to_what_predicts_best_and_some_to_what_was_known():
    error = np.full((4, 3, 6), 0.5)
    error[:2, :, 1] = 0.1  # of skins of one load
    error[2:, :, 4] = 0.1  # of the other
    own = np.array([True, True, False, False])
    share = prior_search._shares(error, own, np.array([3]))
    assert share.sum() == pytest.approx(1)
    assert share.argmax() == 1
    assert prior_search.ANCHOR_SHARE <= share[3] < 0.3
    assert share[4] > share[0]  # a tenth is of all skins


def test_a_plain_process_fits_its_hyperparameters():
    rng = np.random.default_rng(1)
    x = np.column_stack([rng.uniform(-8e-3, 8e-3, (140, 2)), rng.uniform(0.2, 1.0, 140)])
    waves = rng.normal(size=(3, 30)) / np.array([[6e-3], [6e-3], [1.0]])
    y = 50 + 20 * np.cos(x @ waves + rng.uniform(0, 6, 30)) @ rng.normal(size=(30, 6)) + rng.normal(size=(140, 6))
    mean = skin_kinds.plain(x[:100], y[:100], x[100:])
    truth = y[100:]
    assert 1 - ((truth - mean) ** 2).sum() / ((truth - truth.mean(0)) ** 2).sum() > 0.9
    one = skin_kinds.plain(x[:2], y[:2], x[2:4])
    assert np.isfinite(one).all()


def test_blocks_held_out_share_no_position_with_training_presses():
    rng = np.random.default_rng(2)
    skin = kinds.PressedSkinOfKind(
        "bonded", rng.uniform(-8e-3, 8e-3, (250, 2)), np.ones(250), np.ones(250), np.zeros((250, 15)), np.zeros((5, 2))
    )
    cfg = skin_kinds.PRESETS["paper"]
    known, test = skin_kinds.held_out(skin_kinds.Case("bonded", "force", blocks=True), cfg, skin, rng)
    assert len(known) >= max(cfg.counts)
    assert len(test) > 20
    assert not set(known) & set(test)
    edge = 16e-3 / 3
    cells = [set(map(tuple, np.floor(skin.position[rows] / edge + 1.5).astype(int))) for rows in (known, test)]
    assert not cells[0] & cells[1]
    known, test = skin_kinds.held_out(skin_kinds.Case("bonded", "force"), cfg, skin, rng)
    assert not set(known) & set(test)


@pytest.mark.full
def test_every_kind_is_pressed_as_it_says():
    found = {kind: kinds.simulate_skins(kind, 5, 8, 40) for kind in kinds.SKIN_KINDS}
    for kind, skins in found.items():
        for skin in skins:
            assert skin.kind == kind
            assert all(np.isfinite(part).all() for part in skin[1:])
            assert (skin.depth >= 0).all()
            assert (skin.force >= 0).all()
            np.testing.assert_array_equal(skin.previous_readings[1:], skin.readings[:-1])
            assert np.corrcoef(skin.depth, skin.force)[0, 1] > 0.5
    again = kinds.simulate_skins("lattice", 5, 8, 40)
    np.testing.assert_array_equal(again[1].readings, found["lattice"][1].readings)
    size = {kind: np.median([np.std(skin.readings) for skin in skins]) for kind, skins in found.items()}
    assert size["weak"] < 0.6 * size["bonded"]
    assert size["lattice"] > size["bonded"]


@pytest.mark.full
@pytest.mark.parametrize("what", ["prior", "kinds"])
def test_a_debug_run_ends_with_its_results(what, tmp_path):
    assert command.main([f"--{what}", "--preset", "debug", "--out", str(tmp_path)]) == 0
    assert (tmp_path / "metrics.json").is_file()
    if what == "prior":
        assert (tmp_path / "prior.npz").stat().st_size < 100_000
    else:
        table = (tmp_path / "table.md").read_text()
        assert "GP of a population" in table
        assert table.count("\n") == 2 + 4 + 2  # head, methods, gain and coverage of one case
