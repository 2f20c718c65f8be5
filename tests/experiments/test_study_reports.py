"""Every study's report of made-up beliefs gives the tables that the documents ask for, whatever was believed."""

import json

import numpy as np
import pytest

from experiments.reproduce.tables import STUDY_TABLES, TABLES, study_table
from experiments.studies import constants, object_count, planar, policy, pose_error, registered, sites
from experiments.studies.lab import pool_parts
from experiments.studies.run import STUDIES
from i2t.recognition.episodes import EVIDENCE

EPISODES = 50
RNG = np.random.default_rng(0)
PLAN = {"truth": np.arange(EPISODES) % 5, "pool": np.arange(EPISODES) // 5}
PLACES = {"position_error": RNG.random(EPISODES), "rotation_error": RNG.random(EPISODES)}
RULES = ("same rules, Gaussian process, votes", "same rules, Gaussian process, product", "proprioception, votes",
         "proprioception, product")  # fmt: skip


def beliefs(touches: int, objects: int = 5) -> np.ndarray:
    """Beliefs of all episodes that know nothing."""
    drawn = RNG.random((EPISODES, touches, objects))
    return drawn / drawn.sum(-1, keepdims=True)


def part(study: str) -> dict:
    """What a study made of one pad."""
    if study == "sites":  # of an earlier version, without a row that there is now
        kinds = {kind: beliefs(1) for kind in EVIDENCE if kind != "readings and position"}
        return PLAN | {"share": RNG.random(EPISODES), "contact": RNG.random(EPISODES) > 0.3} | kinds
    if study == "planar":
        return {"truth": PLAN["truth"], "unknown pose": beliefs(20), "known pose": beliefs(20)} | PLACES
    if study == "policy":
        return {"truth": PLAN["truth"]} | {name: beliefs(10) for name in policy.POLICIES}
    if study == "object_count":
        return {f"{n} objects": PLAN | {"truth": np.arange(EPISODES) % n, "p": beliefs(20, n)} for n in (10, 25)}
    if study == "registered":
        refused = {"refused": RNG.random(EPISODES) > 0.9, "others_refused": RNG.integers(0, 2, EPISODES)}
        settings = "known to 1 mm", registered.FOUND_BY_VIEW
        return PLAN | PLACES | refused | {f"{kind}, {x}": beliefs(10) for x in settings for kind in registered.KINDS}
    if study == "pose_error":
        worlds = [{"objects": "primitives", "pose_error": size, "view_noise": 0.0} for size in (0.0, 1.0)]
        return {str(i): world | PLAN | {rule: beliefs(10) for rule in RULES} for i, world in enumerate(worlds)}
    values = {constants.IN_USE: beliefs(10), "dof = 4": beliefs(10)}
    return PLAN | {"planar truth": PLAN["truth"]} | dict.fromkeys(constants.CONSTANT_KINDS, values)


def test_every_study_names_the_tables_that_the_documents_may_ask_for():
    assert set(STUDY_TABLES) == set(STUDIES)
    assert all(TABLES[study].keys() == set(names) for study, names in STUDY_TABLES.items())


@pytest.mark.full
@pytest.mark.parametrize(
    "study", [sites, planar, policy, object_count, registered, pose_error, constants], ids=lambda study: study.__name__
)
def test_a_report_has_the_tables_of_its_study(study, tmp_path):
    name = study.__name__.rpartition(".")[2]
    found = json.loads(json.dumps(study.report([part(name) for _ in range(3)], tmp_path, ["0", "1", "2"])))
    assert set(found["tables"]) == set(STUDY_TABLES[name])
    for table in STUDY_TABLES[name]:
        lines = study_table(table)(found).splitlines()
        assert len(lines) > 2
        assert len({line.count(" | ") for line in lines}) == 1


def test_parts_of_two_versions_of_a_study_are_refused():
    with pytest.raises(ValueError, match="'stated' is in some of them only"):
        pool_parts([{"in use": np.zeros(2)}, {"in use": np.zeros(2), "stated": np.zeros(2)}])
