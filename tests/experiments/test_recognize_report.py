"""Tables of recognition: intervals over dependent episodes, scores of each object, and the paper's rows only."""

import re

import numpy as np
import pytest

from experiments.common.runs import load_part, save_part
from experiments.recognize import report
from experiments.recognize.report import COMPARED_PAIRS, IMAGINE2TOUCH, RULES_GP, SAME_INPUT_PAIRS, EpisodeResults
from i2t.recognition.paper_rules import PROPRIOCEPTION
from tools.reproduce.recognition_tables import paper_differences

NAMES = ("star", "cylinder")
MASK, DEPTH = IMAGINE2TOUCH
METHODS = (f"{MASK}, votes", f"{RULES_GP}, votes", f"{PROPRIOCEPTION}, votes", "fused")


def results(pad: str, run: str, hit: np.ndarray) -> EpisodeResults:
    """Episodes (e, t) of the two objects in turn, correct where `hit`; each two share a pool of their own."""
    truth = np.arange(len(hit)) % 2
    decided = np.where(hit, truth[:, None], 1 - truth[:, None])
    p = np.where(decided[..., None] == np.arange(2), 0.9, 0.1).astype(np.float32)
    pool = np.array([f"{run}, pool {i // 2}" for i in range(len(hit))])
    return EpisodeResults(NAMES, truth, dict.fromkeys(METHODS, p), None, pad, pool)


# The star is never recognised at the last touch by the first run, and always by the others; the cylinder always.
FIRST = np.array([[True, False], [False, True]] * 3)
OTHER = np.ones((6, 2), bool)
PARTS = [
    {"primitives": results("pad 0", "a", FIRST)},
    {"primitives": results("pad 0", "b", OTHER)},
    {"primitives": results("pad 1", "c", OTHER)},
]


@pytest.fixture(scope="module")
def scores() -> dict:
    return report.score_set(report.pool_set(PARTS, "primitives"))


def test_episodes_are_alike_by_pad_and_by_pool():
    episodes = report.pool_set(PARTS, "primitives")
    pad, pool = episodes.clusters()
    assert len(pad) == len(pool) == 18
    assert pad.tolist() == [0] * 12 + [1] * 6  # two runs with one pad are one pad
    assert len(np.unique(pool)) == 9  # but their pools are not the same
    assert (pool[:2] == pool[0]).all()
    *_, objects = episodes.clusters(episodes.truth)
    assert objects.tolist() == [0, 1] * 9


def test_each_object_is_scored_by_itself(scores):
    found = scores["methods"]["fused"]["by_object"]
    assert found["star"]["last"]["mean"] == pytest.approx(6 / 9)
    assert found["star"]["mean"]["mean"] == pytest.approx(7.5 / 9)
    assert found["cylinder"]["last"]["mean"] == 1


def test_intervals_are_over_pads_and_wider_than_over_independent_episodes(scores):
    accuracy = scores["methods"]["fused"]["accuracy"]
    hit = np.concatenate([FIRST, OTHER, OTHER])[:, -1]
    independent = 1.96 * hit.std() / np.sqrt(len(hit))
    assert accuracy["mean"][-1] == pytest.approx(hit.mean())
    assert accuracy["high"][-1] - accuracy["low"][-1] > 2 * independent


def test_saved_files_equal_the_results(tmp_path):
    save_part(tmp_path / "part.npz", report.to_part(PARTS[0]))
    back = report.from_part(load_part(tmp_path / "part.npz"))["primitives"]
    assert (back.names, back.pad, back.episodes) == (NAMES, "pad 0", None)
    np.testing.assert_array_equal(back.pool, PARTS[0]["primitives"].pool)
    np.testing.assert_array_equal(back.truth, PARTS[0]["primitives"].truth)
    np.testing.assert_array_equal(back.beliefs["fused"], PARTS[0]["primitives"].beliefs["fused"])


def test_only_the_papers_methods_are_next_to_its_figures(scores, capsys):
    summary = {
        "source": "simulated",
        **report.pads_of(PARTS),
        "sets": {"primitives": scores},
    }
    report.print_tables(summary)
    lines = capsys.readouterr().out.splitlines()
    assert "2 pads" in lines[1]
    assert "9 pools of sites" in lines[1]
    assert "for these pads and these objects" in lines[1]
    published = {re.split("  +", line)[0]: line.rpartition("paper: ")[2] for line in lines if "paper: " in line}
    assert published == {f"{MASK}, votes": "0.50", f"{PROPRIOCEPTION}, votes": "0.23"}
    assert not [line for line in lines if "I2T" in line]


def test_the_papers_last_column_weighs_every_object_alike():
    """Three primitives at .5 and two tools at .7 are .58, as in the paper, however many episodes there are of each."""
    rng = np.random.default_rng(0)
    sets = {}
    for name, objects, episodes, share in (("primitives", 3, 60, 0.5), ("tools", 2, 200, 0.7)):
        truth = np.arange(episodes) % objects
        hit = np.zeros(episodes, bool)
        for i in range(objects):
            rows = np.flatnonzero(truth == i)
            hit[rng.permutation(rows)[: round(share * len(rows))]] = True
        decided = np.where(hit, truth, (truth + 1) % objects)
        p = np.eye(objects)[decided][:, None]
        pool = np.array([f"{name} {i}" for i in range(episodes)])
        beliefs = {f"{MASK}, votes": p, f"{PROPRIOCEPTION}, votes": np.eye(objects)[truth][:, None]}
        sets[name] = EpisodeResults(tuple("abc"[:objects]), truth, beliefs, None, "pad 0", pool)
    made = report.mean_over_objects([sets])
    found = made["mean of the sets"][f"{MASK}, votes"]
    lost = made["differences of these means"][f"{MASK}, votes - {PROPRIOCEPTION}, votes"]
    assert found["mean"] == pytest.approx(0.58)
    assert found["low"] < 0.58 < found["high"]
    assert lost["mean"] == pytest.approx(-0.42)  # to one that is always right
    assert found["high"] - found["low"] == pytest.approx(lost["high"] - lost["low"])


def test_a_mean_that_all_pools_share_by_chance_is_as_uncertain_as_of_independent_episodes():
    truth = np.zeros(12, int)
    decided = np.tile([0, 1], 6)  # half of the episodes of each pool are right
    pool = np.repeat([f"pool {i}" for i in range(6)], 2)
    beliefs = {"fused": np.eye(2)[decided][:, None]}
    part = {
        name: EpisodeResults(NAMES, truth, beliefs, None, "pad 0", np.char.add(f"{name} ", pool))
        for name in report.PAPER_SETS
    }
    found = report.mean_over_objects([part])["mean of the sets"]["fused"]
    assert found["mean"] == pytest.approx(0.5)
    assert found["high"] - found["low"] > 2 * 1.96 * np.sqrt(0.25 / 24)


def test_fair_rows_are_compared_by_votes_and_product_under_short_names_of_their_own():
    """In the documents' table, a name that is shortened too far would match two rows."""
    last = {"mean": 0.1, "low": 0.0, "high": 0.2}
    pairs = [f"{one} - {other}" for one, other in COMPARED_PAIRS if ", " in one and ", " in other]
    paired = {pair: {"last": last, "pads_needed": 3} for pair in pairs}
    sets = {name: {"paired": paired} for name in report.PAPER_SETS}
    measured = {"pads": list("012345"), "sets": sets, "differences of these means": dict.fromkeys(pairs, last)}
    table = paper_differences(measured)
    names = [line.split(" | ")[0].strip("| ") for line in table.splitlines()[2:]]
    assert len(set(names)) == len(names) == len(pairs)
    network_with, gp_without = "mask and force - mask", "Gaussian process at the median force - depth"
    gp_with = ["Gaussian process - Gaussian process at the median force", "Gaussian process - depth and force"]
    for rule in ("votes", "product"):
        found = {name.removesuffix(f" ({rule})") for name in names if name.endswith(f"({rule})")}
        assert found >= {network_with, gp_without, *gp_with}
    assert len([pair for pair in SAME_INPUT_PAIRS if pair[0] == RULES_GP]) == 3
    # A p value of 0.05 alone stands with no other beside it. Clear differences do, and the primary one bears no mark.
    assert "†" not in table
    clear = {"mean": 0.1, "low": 0.09, "high": 0.11}
    measured["differences of these means"] = dict.fromkeys(pairs, clear)
    marked = [line.count("†") for line in paper_differences(measured).splitlines()[2:]]
    assert marked == [0] + [1] * (len(pairs) - 1)
