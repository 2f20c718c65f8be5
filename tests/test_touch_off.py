"""The skin's place in the tool from touches of a flat, against skins whose place is known."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from i2t import boards
from i2t.hardware import touch_off as touching
from i2t.hardware.limits import Limits
from i2t.hardware.protocols import DeviceError
from i2t.hardware.touch_off import CLEAR, SIDES, TILT, face, lowered, onset, touch_off
from i2t.stand_ins.scene import Flat
from i2t.stand_ins.simulated import Lab, SimulatedArm, Virtual
from i2t.types import PAD_WINDOW
from i2t.world import Errors

LIMITS = Limits((0.2, -0.3, 0.005), (0.6, 0.3, 0.5))
AT, HEIGHT, STIFFNESS = (0.4, 0.1), 0.03, 4000.0  # m, m, N/m of a corner
CORNERS = PAD_WINDOW / 2 * np.column_stack([np.array(SIDES, float), np.zeros(4)])


def skin(z, rx, ry):
    """A skin's true frame in the tool."""
    T = np.eye(4)
    T[:3, :3], T[2, 3] = Rotation.from_rotvec([rx, ry, 0.0]).as_matrix(), z
    return T


def corners(T_b_t, true):
    return CORNERS @ (T := T_b_t @ true)[:3, :3].T + T[:3, 3]


@given(st.floats(-3e-3, 3e-3), st.floats(-0.05, 0.05), st.floats(-0.05, 0.05))
@settings(max_examples=30, deadline=None)
def test_a_plane_through_four_corners_is_the_skin(z, rx, ry):
    true = skin(z, rx, ry)
    touches = []
    for i, side in enumerate(SIDES):
        T = np.diag([1.0, -1.0, -1.0, 1.0])
        T[:3, :3] = T[:3, :3] @ lowered(side)
        heights = corners(T, true)[:, 2]
        assert heights.argmin() == i  # its own corner touches first
        T[2, 3] = HEIGHT - heights.min()
        touches.append(T)
    found = face(touches, HEIGHT)
    # A tilted face's corners come closer to the axis by 1 - cos 0.07 = 0.25 % of 10 mm, on a slope of 0.07: 2 um; twice
    # for both tilts, and the tool's own 8 degrees let a corner that is 25 um aside stand 4 um higher.
    np.testing.assert_allclose(found.T_tool_skin[2, 3], z, atol=8e-6)
    np.testing.assert_allclose(found.T_tool_skin[:3, 2], true[:3, 2], atol=1e-3)
    assert found.miss < 4e-6


def test_where_a_press_began_is_found_in_noise():
    rng = np.random.default_rng(0)
    travel = np.linspace(0, 2e-3, 200)
    force = 1000 * np.maximum(0, travel - 1.2e-3)
    errors = [onset(travel, force + 0.05 * rng.standard_normal(200)) - 1.2e-3 for _ in range(50)]
    # 50 looks over 0.5 mm: the intercept of a line through 64 points scatters by about 0.05 N sqrt(4 / 64) / 1 N/mm.
    assert np.abs(errors).max() < 5 * 0.05 * math.sqrt(4 / 64) * 1e-3
    with pytest.raises(ValueError, match="three looks"):
        onset([0, 1e-3], [0, 1.0])
    with pytest.raises(ValueError, match="did not rise with"):
        onset(np.arange(5.0), np.array([5.0, 4, 3, 2, 1]))


class Fingered:
    """A flat that each corner of a skin meets like a spring."""

    def __init__(self, true, height):
        self.true, self.height, self.reading = true, height, np.zeros(15)

    def __call__(self, position, turned):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = turned, position
        at = corners(T, self.true)
        force = STIFFNESS * np.maximum(0, self.height - at[:, 2])[:, None] * [0.0, 0.0, 1.0]
        return np.concatenate([force.sum(0), np.cross(at - position, force).sum(0)])


def arm_with(true, height=HEIGHT):
    lab = Lab(Flat(0.0, 1.0, np.zeros(15), Errors.none(), boards.reskin()), Virtual(0.0))
    lab.robot.contact = Fingered(true, height)
    return SimulatedArm(lab, LIMITS)


def test_an_arm_finds_its_skin():
    true, told = skin(0.8e-3, 0.02, -0.03), []
    with arm_with(true) as arm:
        found = touch_off(arm, AT, HEIGHT, told.append)
        assert arm.state().T_b_t[2, 3] > HEIGHT + CLEAR
    np.testing.assert_allclose(found.T_tool_skin[2, 3], true[2, 3], atol=0.02e-3)
    np.testing.assert_allclose(found.T_tool_skin[:3, 2], true[:3, 2], atol=2e-3)
    assert found.miss < 0.02e-3
    assert len(told) == 4


def test_what_is_no_flat_is_said():
    with arm_with(skin(0, 0, 0), HEIGHT - 0.02) as arm, pytest.raises(DeviceError, match="met no flat within 11 mm"):
        touch_off(arm, AT, HEIGHT, str)
    with arm_with(skin(0, 0, 0)) as arm:
        with pytest.raises(ValueError, match="outside the box"):
            touch_off(arm, (0.7, 0.1), HEIGHT, str)
        with pytest.raises(ValueError, match="outside the box"):
            touch_off(arm, AT, 0.0, str)
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    tilted = [T @ np.block([[lowered(side), np.zeros((3, 1))], [np.zeros((1, 3)), np.ones((1, 1))]]) for side in SIDES]
    with pytest.raises(ValueError, match=r"the skin would be .* mm and .* degrees from where the rig has it"):
        face(tilted, HEIGHT)
    assert lowered((1, 1))[2, 0] != 0
    assert math.acos(lowered((1, -1))[2, 2]) == pytest.approx(TILT)


def test_the_command_says_what_is_missing(tmp_path, capsys):
    arguments = ["--host", "127.0.0.1", "--height", "0.01", "--at", "0.4", "0", "--rig", str(tmp_path / "lab.toml")]
    assert touching.main(arguments) == 2
    assert "no such file" in capsys.readouterr().err
