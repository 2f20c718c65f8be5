"""Arms against their makers' figures, finite differences, and poses that can and cannot be reached."""

from dataclasses import replace

import numpy as np
import pytest

from i2t.collect.path import TouchPath
from i2t.collect.settings import TouchSettings
from i2t.collect.touch import Site, UnreachableError
from i2t.hardware import kinematics
from i2t.hardware.kinematics import JointPath, arms, follow, forward, plan, solve
from i2t.hardware.rig import Rig

DOWN = np.diag([1.0, -1.0, -1.0])


def pose(x, y, z):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = DOWN, (x, y, z)
    return T


@pytest.mark.parametrize(
    ("name", "at"),
    [("ur5e", (-0.8172, -0.2329, 0.0628)), ("ur3e", (-0.45675, -0.22315, 0.0665)), ("panda", (0.088, 0.0, 0.926))],
)
def test_the_stretched_arm_stands_where_its_maker_says(name, at):
    """Sums and differences of the lengths in the makers' drawings."""
    arm = arms()[name]
    np.testing.assert_allclose(forward(arm, np.zeros(len(arm.low)))[:3, 3], at, atol=1e-6)


@pytest.mark.parametrize("name", ["ur10e", "panda"])
def test_the_jacobian_is_the_derivative_and_poses_that_an_arm_takes_are_found_again(name):
    arm, rng, step = arms()[name], np.random.default_rng(0), 1e-6
    q = rng.uniform(arm.low, arm.high)
    T, J = kinematics._chain(arm, q)
    for i, e in enumerate(step * np.eye(len(q))):
        change = (forward(arm, q + e) - forward(arm, q - e)) / (2 * step)
        np.testing.assert_allclose(change[:3, 3], J[:3, i], atol=1e-7)
        turn = change[:3, :3] @ T[:3, :3].T
        np.testing.assert_allclose([turn[2, 1], turn[0, 2], turn[1, 0]], J[3:, i], atol=1e-7)
    for _ in range(3):
        T = forward(arm, rng.uniform(np.clip(arm.low, -3, None), np.clip(arm.high, None, 3)))
        found = solve(arm, T)
        assert len(found)
        np.testing.assert_allclose(forward(arm, found), np.broadcast_to(T, (len(found), 4, 4)), atol=2e-4)
        assert ((found >= arm.low) & (found <= arm.high)).all()
        dexterous = kinematics._dexterity(arm, found).tolist()
        assert dexterous == sorted(dexterous, reverse=True)


def test_a_line_is_followed_within_the_limits_or_not_at_all():
    arm = arms()["ur5e"]
    way = plan(arm, [pose(0.4, 0.1, 0.3), pose(0.4, 0.1, 0.1), pose(0.45, -0.1, 0.1)])
    assert isinstance(way, JointPath)
    ends = forward(arm, way.joints)
    np.testing.assert_allclose(ends[-1][:3, 3], (0.45, -0.1, 0.1), atol=1e-4)
    assert np.abs(np.diff(way.joints, axis=0)).max() < kinematics.JUMP_RAD
    assert "cannot reach it: 1.20 m" in plan(arm, [pose(1.2, 0.0, 0.1)])
    start = solve(arm, pose(0.7, 0.0, 0.2))[0]
    assert "on the line to pose 2" in follow(arm, [pose(0.7, 0.0, 0.2), pose(1.1, 0.0, 0.2)], start)


def test_a_straight_elbow_and_a_turned_wrist_are_refused():
    """With the arm all but stretched the tool can go no further; near a joint's limit a correction has no room."""
    arm = arms()["ur5e"]
    said = plan(arm, [forward(arm, np.array([0.3, -0.6, 0.04, -1.0, -1.57, 0.0]))])
    assert "singularity" in said or "limit" in said
    tight = replace(arm, low=arm.low * 0 - 1e-3, high=arm.high * 0 + 1e-3)
    assert "degrees from a joint's limit" in plan(tight, [forward(arm, np.zeros(6))])


def test_a_rig_that_names_its_arm_plans_with_its_reach(tmp_path):
    """The default rig stands 0.4 m before a UR5e, and 1.4 m before it the same box is out of reach."""
    site = Site(3, pose(0.0, 0.0, 0.03))
    near = replace(Rig(), arm="ur5e")
    TouchPath(near, TouchSettings(), 0.03).check(site)
    base, box = near.T_world_base.copy(), near.limits
    base[0, 3] -= 1.0
    far = replace(near, T_world_base=base, limits=replace(box, lower=(1.25, -0.15, 0.005), upper=(1.55, 0.15, 0.45)))
    with pytest.raises(UnreachableError, match="site 3: ur5e cannot reach it"):
        TouchPath(far, TouchSettings(), 0.03).check(site)
    near.write(tmp_path / "rig.toml")
    assert Rig.read(tmp_path / "rig.toml").arm == "ur5e"
    assert "\narm = " not in Rig().text()
    with pytest.raises(ValueError, match=r"tool.arm is 'ur7'; give one of ur3, "):
        replace(near, arm="ur7")
