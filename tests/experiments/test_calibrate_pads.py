"""Simulated skins of many kinds, the prior that is made of them, and the table of what it is worth."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from experiments.calibrate_pads import __main__ as command
from experiments.calibrate_pads import kinds, population, prior_search, simulate, skin_kinds
from i2t.calibration.population_gp.prior import prior_about

from i2t.calibration.population_gp import load_prior


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


def test_the_search_climbs_to_the_top():
    top = dict.fromkeys(population.SEARCHED, 3.0) | {"far_amplitude": 1.0}

    def hill(hyper):
        return -sum(
            float(np.log(getattr(hyper, name) / getattr(population.GUESS, name) / top[name]) ** 2)
            for name in population.SEARCHED
        )

    found = population.search(hill, population.GUESS)
    for name in population.SEARCHED:
        # 3 lies between powers of the factors; what is found is off by less than half of the smallest factor.
        far = getattr(found, name) / getattr(population.GUESS, name) / top[name]
        assert abs(np.log(far)) <= np.log(population.STEP_FACTORS[-1]) / 2 + 1e-9


def test_a_run_adds_the_faults_of_a_board_in_order():
    readings = jnp.full((2, 30, 15), 50.0)
    found = np.asarray(simulate.add_faults(jax.random.key(2), readings)) / 50
    # Warming by up to 11.2 K weakens magnets by 0.12 % a kelvin; softening adds a tenth, one chip keeps 0.3, creep 1 %.
    assert found.min() >= 1 - 1.2e-3 * 11.2
    assert found.max() <= 1.1 * 1.3 / (1 - 0.2 * 0.05)
    remembers = (found[:, -1] > 1.25).reshape(2, 5, 3)
    np.testing.assert_array_equal(remembers.all(2).sum(1), [1, 1])
    np.testing.assert_array_equal(remembers.any(2).sum(1), [1, 1])
    assert not np.array_equal(found[0], found[1])
