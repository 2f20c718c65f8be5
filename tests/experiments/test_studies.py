"""The formulas of the studies of recognition, their settings, and the tables that their reports give."""

import json
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from experiments.recognize.config import PRESETS
from experiments.studies import mismatch, open_set, physics, priors, report, stopping
from experiments.studies.lab import StudySize
from experiments.studies.run import STUDIES, _with_new_labels
from experiments.studies.tables import study_table
from i2t.intervals import Estimate
from i2t.skin_models.pressure_gp import GPHyperparameters
from i2t.skin_models.reading_model import LAYERS
from tools.reproduce.recognition_tables import STUDY_TABLES, TABLES

EPISODES = 50
RNG = np.random.default_rng(0)
PLAN = {"truth": np.arange(EPISODES) % 5, "pool": np.arange(EPISODES) // 5}
PADS = ["0", "1", "2"]


def beliefs(touches: int, objects: int = 5) -> np.ndarray:
    """Uniform beliefs of all episodes."""
    drawn = RNG.random((EPISODES, touches, objects))
    return drawn / drawn.sum(-1, keepdims=True)


def open_set_part(episodes: int = 8) -> dict:
    """Each unknown object is always or never recognised, so that episodes are as informative as their eight objects."""
    part = {}
    for name in ("validation", "test"):
        there = open_set.draw_objects(5, 8, episodes, seed=0)
        unknown = there >= 5
        hidden = unknown & (there % 2 == 0)  # half of the unknown objects look like known ones
        p_unknown = np.where(unknown & ~hidden, 0.9, 0.1) + 1e-3 * np.random.default_rng(0).random(len(there))
        p = np.repeat(((1 - p_unknown) / 5)[:, None, None], 5, 2)
        part[name] = open_set.OpenSetEpisodes(
            np.where(unknown, -1, there), p, p_unknown[:, None], there, np.arange(len(there)) // 5
        )._asdict()
    return part


def part(study: str) -> dict:
    """The results of a study for one pad."""
    if study == "open_set":
        return open_set_part()
    if study == "stopping":
        some = {f"{kind}, {name}": beliefs(10) for name in stopping.PLACEMENTS for kind in stopping.KINDS}
        some |= {f"{constant}={value:g}": beliefs(10) for constant, value in stopping.tried()}
        return dict.fromkeys(physics.SETS, PLAN | some)
    if study == "physics":
        cases = [(name, count) for name in (physics.MATCHED, "other") for count in ("20", physics.ALL)]
        cases += [(name, physics.ELSEWHERE) for name in (physics.MATCHED, "other")]
        factors = [(f"{factor:g}", kind) for factor in physics.INFLATIONS for kind in physics.KINDS]
        factors.append(("1", physics.WITHOUT))
        some = {f"{name}; {count}; {factor}; {kind}": beliefs(10) for name, count in cases for factor, kind in factors}
        return {"layers": np.zeros((4, 2)), "calls": np.zeros((2, 9))} | dict.fromkeys(physics.SETS, PLAN | some)
    return PLAN | {"fused, first": beliefs(10), "fused, other": beliefs(10), "position and presence": beliefs(10)}


def test_every_study_lists_the_tables_that_the_documents_use():
    assert set(STUDY_TABLES) == set(STUDIES)
    assert all(TABLES[study].keys() >= set(names) for study, names in STUDY_TABLES.items())


@pytest.mark.full
@pytest.mark.parametrize("name", STUDIES)
def test_a_report_has_the_tables_of_its_study(name):
    found = json.loads(json.dumps(STUDIES[name].report([part(name) for _ in range(3)], PADS)))
    assert set(found["tables"]) == set(STUDY_TABLES[name])
    for table in STUDY_TABLES[name]:
        lines = study_table(table)(found).splitlines()
        assert len(lines) > 2
        assert len({line.count(" | ") for line in lines}) == 1


def test_settings_are_compared_with_the_first_and_counted_as_by_hand():
    right = np.eye(5)[PLAN["truth"]][:, None].repeat(2, 1)
    wrong = np.eye(5)[(PLAN["truth"] + 1) % 5][:, None].repeat(2, 1)
    one = PLAN | {"fused, usual": right, "fused, broken": np.concatenate([right[:25], wrong[25:]])}
    table = report.report_settings([one] * 3, PADS)["tables"]["methods"]
    usual, broken = table["rows"]
    assert (usual[0], usual[1], usual[2]["mean"], usual[3]["mean"]) == ("usual", "fused", 1.0, 0.0)
    assert (broken[0], broken[2]["mean"], broken[3]["mean"], broken[5]["mean"]) == ("broken", 0.5, -0.5, -0.5)
    assert table["columns"][3] == {"name": "difference from usual", "decimals": 3, "signed": True, "percent": False}
    with pytest.raises(ValueError, match="'fused, usual' is missing in some"):
        report.report_settings([one, {name: one[name] for name in one if name != "fused, usual"}], ["0", "1"])


def test_each_world_differs_in_the_property_of_its_name():
    lab = SimpleNamespace(size=StudySize(1, debug=False), cfg=PRESETS["paper"])
    made = mismatch.worlds(lab)
    assert next(iter(made)) == "matched"
    assert made["arm twice as stiff"].limits.stiffness == 2 * lab.cfg.limits.stiffness
    assert made["twice the hysteresis"].errors.faults.hysteresis == 2 * lab.cfg.errors.faults.hysteresis
    lab.size = StudySize(1, debug=True)
    assert set(mismatch.worlds(lab)) == set(mismatch.DEBUG_WORLDS)


def test_a_physics_left_out_is_scaled_by_the_others_alone():
    """For the others, errors of factor 2 fit best; for the one left out, those of 0.7 would."""
    names, best = ("bonded layer", "soft", "left out"), {"bonded layer": 2.0, "soft": 2.0, "left out": 0.7}
    truth = PLAN["truth"]
    knowing, guessing = (np.full((EPISODES, 2, 5), (1 - p) / 4) for p in (0.9, 0.3))
    for p, right in ((knowing, 0.9), (guessing, 0.3)):
        p[np.arange(EPISODES), :, truth] = right
        p[:5] = np.roll(p[:5], 1, axis=2)  # some are wrong, so that a temperature cannot sharpen both alike
    part = {
        name: PLAN
        | {
            f"{which}; 20; {factor:g}; fused": knowing if factor == best[which] else guessing
            for which in names
            for factor in physics.INFLATIONS
        }
        for name in physics.SETS
    }
    assert physics.leave_out([part], "left out", "20", "fused").inflation == 2.0
    assert physics.names_of([part]) == list(names)


def fit_of(weights: list[float], bend: float) -> GPHyperparameters:
    return GPHyperparameters(jnp.float32(weights), jnp.float32(bend), jnp.float32(1), jnp.float32(0.2))


def test_a_prior_is_of_the_worlds_that_are_not_left_out():
    """It contains each layer that any of them selects once, and medians without noise."""
    calls = {
        "first": priors.WorldCall(1, fit_of([0.2, 0.8], 0.1)),
        "second": priors.WorldCall(1, fit_of([0.4, 0.6], 0.3)),
        "third": priors.WorldCall(0, fit_of([0.5, 0.5], 0.2)),
        "left out": priors.WorldCall(6, fit_of([1.0, 0.0], 0.9)),
    }
    prior = priors.prior_without(calls, "left out")
    assert prior.layers == LAYERS[:2]
    np.testing.assert_allclose(prior.discrepancy.weights, [0.4, 0.6], rtol=1e-6)
    assert float(prior.discrepancy.bend) == pytest.approx(0.2)
    assert float(prior.discrepancy.noise) == 0
    assert priors.prior_from([calls["left out"]]).layers == LAYERS[6:]


def test_episodes_of_studies_are_alike_by_pad_by_sites_and_by_object():
    part = {"truth": np.zeros(6, int), "pool": np.arange(6) // 2, "there": np.array([0, 1, 5, 0, 1, 6])}
    parts, one = [part] * 3, {"truth": part["truth"]}
    pad, pool, there = report.clusters_of(parts, ["0", "0", "1"], objects="there")
    assert pad.tolist() == [0] * 12 + [1] * 6
    assert pool.tolist() == [i // 2 for i in range(18)]  # each run's sites are its own
    assert there.tolist() == [0, 1, 2, 0, 1, 3] * 3
    assert len(report.clusters_of([one] * 3, PADS)) == 1
    assert report.clusters_of([one] * 2, ["0", "1"]) == []  # nothing tells the episodes of two pads apart


def test_detecting_unknown_objects_is_as_uncertain_as_the_objects_are_few():
    found = open_set.report([open_set_part()] * 3, PADS)["tables"]
    area = found["auroc"]["rows"][0][1]
    assert area["mean"] == pytest.approx(0.75, abs=0.06)
    assert area["high"] - area["low"] > 0.25  # independent episodes would give .1
    half = found["accuracy"]["rows"][-1]
    assert (half[0], half[2]["mean"]) == ("50%", 1.0)


def test_tables_of_studies_are_written_from_one_form():
    columns = ["a", report.Column("b", 2), report.Column("c", 1, signed=True), report.Column("d", 0, percent=True)]
    half = Estimate(np.float64(0.5), np.float64(0.25), np.float64(0.75))
    nothing = {"mean": None, "low": None, "high": None}
    cells = [["x", 0.123, half, half], [half, "-", nothing, {"mean": 0.5, "low": 0, "high": 1}]]
    made = report.make_table(columns, cells)
    lines = study_table("some")({"tables": {"some": json.loads(json.dumps(made))}}).splitlines()
    assert lines[0] == "| a | b | c | d |"
    assert lines[2] == "| x | 0.12 | +0.5 [+0.2, +0.8] | 50 % [25, 75] |"
    assert lines[3] == "| 0.500 [0.250, 0.750] | - | - | 50 % [0, 100] |"


def test_parts_of_an_earlier_version_have_the_labels_of_today():
    part = {"truth": 0, "test": {"matched; as many as the run; 1; fused": 1}, "fused, half as far": 2}
    expected = {"truth": 0, "test": {"matched; all; 1; fused": 1}, "fused, half as large": 2}
    assert _with_new_labels(part) == expected
