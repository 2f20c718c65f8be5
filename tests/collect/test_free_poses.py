"""Free poses before a session: where they may be, how the tool gets there, and what comes of them."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from helpers.closed_form import NOISY, ROOM, make, names, site

from i2t.collect.free_poses import (
    AMBIENT_FILE,
    contradiction,
    fitted_ambient,
    gather_free_poses,
    plan_free_poses,
)
from i2t.collect.recorder import Recorder
from i2t.collect.settings import AmbientSettings
from i2t.collect.touch import UnreachableError
from i2t.dataset import load_dataset
from i2t.skin.ambient import load_ambient, predict_ambient

SETTINGS = AmbientSettings(poses=8, seconds=0.1)


def tilt_of(T_b_t):
    """Degrees from pointing down, in a world whose z axis is the base's."""
    return np.degrees(np.arccos(np.clip(-T_b_t[2, 2], -1.0, 1.0)))


def limited(procedure, lower, upper):
    rig = replace(procedure.rig, limits=replace(procedure.rig.limits, lower=lower, upper=upper))
    return replace(procedure, rig=rig)


def test_every_pose_is_in_the_box_above_the_way_across_and_tilts_no_further_than_asked():
    procedure = make()
    poses = plan_free_poses(procedure.path, procedure.arm.state().T_b_t, SETTINGS)
    assert len(poses) == 8
    lowest = procedure.path.transfer_height() + SETTINGS.clearance
    for pose in poses:
        for part in pose:
            assert procedure.rig.limits.contains(part[:3, 3])
            assert part[2, 3] >= lowest
        assert tilt_of(pose.upright) < 1e-6
        assert tilt_of(pose.tilted) <= SETTINGS.tilt + 1e-6
        np.testing.assert_array_equal(pose.upright[:3, 3], pose.tilted[:3, 3])
    assert max(tilt_of(pose.tilted) for pose in poses) > 0.8 * SETTINGS.tilt  # they tell most at the rim


def test_where_the_box_leaves_no_room_or_is_not_that_of_the_plan_nothing_moves():
    procedure = make()
    before = procedure.arm.state().T_b_t
    poses = plan_free_poses(procedure.path, before, SETTINGS)
    lower, upper = procedure.rig.limits.box
    low = limited(procedure, tuple(lower), (*upper[:2], procedure.path.transfer_height() + 0.02))
    with pytest.raises(UnreachableError, match="raise the box, or leave out the free poses"):
        plan_free_poses(low.path, before, SETTINGS)
    small = limited(procedure, tuple(lower), (*upper[:2], poses[0].tilted[2, 3] - 1e-3))
    asked = replace(SETTINGS, clearance=0.02)
    with pytest.raises(UnreachableError, match="outside the box"):
        gather_free_poses(small, poses, asked)
    np.testing.assert_array_equal(procedure.arm.state().T_b_t, before)


@pytest.mark.full
def test_on_the_way_the_tool_is_never_lower_nor_tilted_further():
    procedure = make()
    arm, settings = procedure.arm, AmbientSettings(poses=4, seconds=0.05, spread=0.03)
    goals, go = [], arm.go
    arm.go = lambda goal, *how: goals.append(np.array(goal)) or go(goal, *how)
    poses = plan_free_poses(procedure.path, arm.state().T_b_t, settings)
    free = gather_free_poses(procedure, poses, settings)[""]
    lowest = procedure.path.transfer_height()
    for before, after in pairwise(goals):
        assert min(before[2, 3], after[2, 3]) >= lowest
        if np.linalg.norm(before[:3, 3] - after[:3, 3]) > 1e-6:  # it goes across upright
            assert max(tilt_of(before), tilt_of(after)) < 1e-6
        else:  # and is tilted and put upright where it stands
            assert min(tilt_of(before), tilt_of(after)) < 1e-6
    np.testing.assert_allclose(free.T_b_t, [pose.tilted for pose in poses], atol=1e-9)
    assert free.samples.shape[::2] == (4, 15)
    assert 20 <= free.samples.shape[1] <= 40  # 0.05 s at 400 Hz, in bursts of ten
    assert tilt_of(arm.state().T_b_t) < 1e-6


@pytest.mark.full
def test_a_session_fits_keeps_and_compares_its_field_and_notices_a_room_that_changed(tmp_path, capsys):
    procedure = make(errors=NOISY)
    assert fitted_ambient(procedure, AmbientSettings(), tmp_path) == {}
    fields = fitted_ambient(procedure, replace(SETTINGS, poses=12), tmp_path)
    first = fields[""]
    np.testing.assert_allclose(first.earth, ROOM.earth, atol=3.0)  # iron on the tool is in the response
    assert "once subtracted" in capsys.readouterr().out
    kept, about = load_ambient(tmp_path / AMBIENT_FILE, procedure.skins[0].board)
    np.testing.assert_array_equal(kept.earth, first.earth)
    assert about["source"] == "simulated"
    with Recorder(tmp_path, names(procedure)) as file:
        touched = procedure.touch(site(0), file.begin(site(0), 0))
        file.save(touched)
    assert contradiction(fields, procedure, touched) == ""
    T_b_t = procedure.rig.T_base_world @ touched.T_w_t
    expected = predict_ambient(first, procedure.skins[0].board, T_b_t)[0]
    assert np.sqrt(np.mean((touched.skins[""].ambient - expected) ** 2)) < 8
    away = procedure.skins[0].board.to_board(np.repeat((T_b_t[:3, :3].T @ [0.0, 40.0, 0.0])[None], 5, axis=0))
    elsewhere = touched.skins[""]._replace(ambient=touched.skins[""].ambient + np.asarray(away))
    assert "ambient field" in contradiction(fields, procedure, touched._replace(skins={"": elsewhere}))
    assert len(load_dataset(tmp_path)) == 1  # the field is no touch
    again = fitted_ambient(procedure, AmbientSettings(), tmp_path)
    np.testing.assert_array_equal(again[""].earth, first.earth)


def test_settings_that_make_no_sense_or_pass_the_limits_are_refused(tmp_path):
    for wrong, why in (({"poses": 3}, "at least 4"), ({"tilt": 80.0}, "tilt"), ({"clearance": 0.0}, "clearance")):
        with pytest.raises(ValueError, match=why):
            AmbientSettings(**{"poses": 12, **wrong})
    procedure = make()
    procedure.rig = replace(procedure.rig, limits=replace(procedure.rig.limits, speed=0.01))
    with pytest.raises(ValueError, match="above the rig's limit"):
        fitted_ambient(procedure, SETTINGS, tmp_path)
