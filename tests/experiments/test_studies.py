"""The small formulas of the studies of recognition and of their reports."""

import json
from dataclasses import replace

import numpy as np
import pytest

from experiments.reproduce.tables import study_table
from experiments.studies import lab, open_set, planar, pose_error, sites
from i2t.recognition.intervals import Estimate
from i2t.recognition.planar import pose_cells
from i2t.simulation.touches import SimulationErrors
from i2t.types import TWIST_LEVER_M


def test_episodes_of_studies_are_alike_by_pad_by_sites_and_by_object():
    part = {"truth": np.zeros(6, int), "pool": np.arange(6) // 2, "there": np.array([0, 1, 5, 0, 1, 6])}
    parts, one = [part] * 3, {"truth": part["truth"]}
    pad, pool, there = lab.clusters_of(parts, ["0", "0", "1"], objects="there")
    assert pad.tolist() == [0] * 12 + [1] * 6
    assert pool.tolist() == [i // 2 for i in range(18)]  # each run's sites are its own
    assert there.tolist() == [0, 1, 2, 0, 1, 3] * 3
    assert len(lab.clusters_of([one] * 3, ["0", "1", "2"])) == 1
    assert lab.clusters_of([one] * 2, ["0", "1"]) == []  # nothing tells the episodes of two pads apart


def test_unknown_objects_come_about_equally_often():
    there = open_set.draw_objects(5, 8, 10, seed=0)
    assert np.bincount(there[:50]).tolist() == [10] * 5
    assert set(np.bincount(there[50:])[5:]) <= {6, 7}


def test_detecting_unknown_objects_is_as_uncertain_as_the_objects_are_few(tmp_path):
    """Each unknown object is always told or never: episodes say as little as their eight objects."""
    part = {}
    for name in ("validation", "test"):
        there = open_set.draw_objects(5, 8, 8, seed=0)
        unknown = there >= 5
        hidden = unknown & (there % 2 == 0)  # half of the unknown objects look like known ones
        p_unknown = np.where(unknown & ~hidden, 0.9, 0.1) + 1e-3 * np.random.default_rng(0).random(len(there))
        p = np.repeat(((1 - p_unknown) / 5)[:, None, None], 5, 2)
        part[name] = open_set.OpenSetEpisodes(
            np.where(unknown, -1, there), p, p_unknown[:, None], there, np.arange(80) // 5
        )._asdict()
    area = open_set.report([part] * 3, tmp_path, ["0", "1", "2"])["auroc"]
    assert area["mean"][0] == pytest.approx(0.75, abs=0.06)
    assert area["high"][0] - area["low"][0] > 0.25  # independent episodes would give .1


def test_tables_of_studies_are_written_from_one_form():
    columns = ["a", lab.Column("b", 2), lab.Column("c", 1, signed=True), lab.Column("d", 0, percent=True)]
    half = Estimate(np.float64(0.5), np.float64(0.25), np.float64(0.75))
    nothing = {"mean": None, "low": None, "high": None}
    made = lab.make_table(columns, [["x", 0.123, half, half], [half, "-", nothing, {"mean": 0.5, "low": 0, "high": 1}]])
    lines = study_table("some")({"tables": {"some": json.loads(json.dumps(made))}}).splitlines()
    assert lines[0] == "| a | b | c | d |"
    assert lines[2] == "| x | 0.12 | +0.5 [+0.2, +0.8] | 50 % [25, 75] |"
    assert lines[3] == "| 0.500 [0.250, 0.750] | - | - | 50 % [0, 100] |"


def test_a_rotation_of_a_symmetric_object_is_wrong_up_to_half_its_period_only():
    angle = np.radians([100.0, 100.0, 100.0, -350.0])
    found = planar.rotation_error(angle, np.array([4, 0, 1, 1]))
    np.testing.assert_allclose(np.degrees(found), [10, 0, 100, 10])


def test_a_table_that_is_higher_or_tilted_is_met_elsewhere():
    """In the object's frame the tool starts lower by the height, and lower where the table rises."""
    up, tilted = np.zeros((2, 6))
    up[2], tilted[3] = 1e-3, 0.01 * TWIST_LEVER_M  # about x: the table rises along y
    grid = planar.PlanarGrid(half=10e-3, reach=10e-3, step=5e-3, turns=4)
    site = np.array([[3e-3, 20e-3], [-5e-3, 0.0]])
    presses = [
        planar.TablePresses(np.zeros(1, int), np.zeros((1, 3)), site[None], t[None]) for t in (0 * up, up, tilted)
    ]
    level, higher, sloped = (planar._object_frame_sites(each, grid) for each in presses)
    np.testing.assert_allclose(higher[:, :3, 3] - level[:, :3, 3], [[0, 0, -1e-3]] * 2, atol=1e-8)
    np.testing.assert_allclose(sloped[:, 2, 3] - level[:, 2, 3], -0.01 * site[:, 1], atol=2e-6)  # of an angle's square
    np.testing.assert_allclose(np.linalg.norm(sloped[:, :3, 2] - level[:, :3, 2], axis=1), 0.01, rtol=1e-3)


def test_the_belief_allows_for_a_table_that_is_higher_and_tilted():
    std = planar.table_std(replace(SimulationErrors.none(), placement=2e-3, placement_angle=0.1))
    np.testing.assert_allclose(std, [0, 0, 2e-3, 0.1 * TWIST_LEVER_M, 0.1 * TWIST_LEVER_M, 0])
    _, cells = pose_cells(planar.PlanarGrid(half=5e-3, reach=5e-3, step=5e-3, turns=4))
    added = planar.add_table_errors(cells, std).covariance - cells.covariance
    np.testing.assert_allclose(added, np.broadcast_to(np.diag(std**2), added.shape), atol=1e-9)


def test_lines_change_sign_where_they_meet_zero():
    assert pose_error.sign_changes([0, 1, 3], [1.0, -1.0, 3.0]) == [0.5, 1.5]
    assert pose_error.sign_changes([0, 1], [1.0, 2.0]) == []


def test_information_is_counted_from_guessing():
    p = np.array([[0.25, 0.25, 0.25, 0.25], [1.0, 0.0, 0.0, 0.0], [0.5, 0.5, 0.0, 0.0]])
    np.testing.assert_allclose(sites.information_bits(p, np.array([3, 0, 1])), [0, 2, 1])
