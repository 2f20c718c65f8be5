"""The skin's place in the tool from touches of a flat, against skins whose place is known."""

import math

import numpy as np
import pytest
from helpers.closed_form import BOARD, QUIET
from helpers.spring_plane import SpringPlane

from i2t.emulators.in_process import SimulatedArm, SimulatedLab, VirtualClock
from i2t.errors import DeviceError
from i2t.geometry import transform
from i2t.hardware.contract import refuse
from i2t.hardware.limits import SAFETY
from i2t.hardware.motion_limits import MotionLimits
from i2t.hardware.poses import pose_from_vector
from i2t.hardware.touch_off import (
    CORNER_SIGNS,
    TouchOffConfig,
    contact_onset,
    corner_force,
    corner_rotation,
    fit_plane,
    touch_off,
)
from i2t.patches.dimensions import PAD_WINDOW

LIMITS = MotionLimits((0.2, -0.3, 0.005), (0.6, 0.3, 0.5))
AT, HEIGHT, STIFFNESS = (0.4, 0.1), 0.03, 4000.0  # m, m, N/m of a corner
CORNERS = PAD_WINDOW / 2 * np.column_stack([np.array(CORNER_SIGNS, float), np.zeros(4)])


def skin(z, rx, ry):
    """A skin's true frame in the tool."""
    return pose_from_vector([0.0, 0.0, z, rx, ry, 0.0])


def corners(T_b_t, true):
    return CORNERS @ (T := T_b_t @ true)[:3, :3].T + T[:3, 3]


LOOKS = np.arange(0.0, 8e-3, 2e-3 / 125)  # m: 125 looks a second at 2 mm/s


@pytest.mark.parametrize(("soft", "stiff"), [(0.9e-3, 1e4), (0.5e-3, 3e3), (1e-6, 4e3)], ids=["skin", "hard", "spring"])
def test_the_onset_of_a_press_is_found_within_the_limit_of_the_noise(soft, stiff):
    """The errors meet the Cramer-Rao bound, 0.07 and 0.1 mm at 0.1 N, within the scatter of 16 trials: three standard
    deviations of 18 %. A spring's first parameter is at the end of its range, where there is no bound.
    """
    force = corner_force(LOOKS - 5e-3, soft, stiff)
    np.testing.assert_allclose(soft * np.cbrt(force) + force / stiff, np.maximum(LOOKS - 5e-3, 0), atol=1e-9)
    travel = LOOKS[: np.argmax(force > 2) + 1]
    assert contact_onset(travel, force[: len(travel)]) == pytest.approx(5e-3, abs=2e-6)
    if soft < 1e-5:
        return
    rng, noise, true = np.random.default_rng(0), 0.1, np.array([5e-3, math.log(soft), math.log(stiff)])

    def model(x):
        return corner_force(travel - x[0], *np.exp(x[1:]))

    steps = np.diag([1e-7, 1e-4, 1e-4])
    slopes = np.stack([(model(true + step) - model(true - step)) / (2 * step.max()) for step in steps], 1)
    bound = noise * math.sqrt(np.linalg.inv(slopes.T @ slopes)[0, 0])
    errors = [contact_onset(travel, model(true) + noise * rng.standard_normal(len(travel))) - 5e-3 for _ in range(16)]
    assert np.sqrt(np.mean(np.square(errors))) < 1.54 * bound
    assert bound < 0.15e-3


class Fingered:
    """A flat that pushes back on each corner of a skin like a spring."""

    def __init__(self, true, height):
        self.true, self.height, self.reading = true, height, np.zeros(15)
        self.peak = 0.0  # N, the highest force of a corner

    def __call__(self, position, turned):
        at = corners(transform(turned, position), self.true)
        force = STIFFNESS * np.maximum(0, self.height - at[:, 2])[:, None] * [0.0, 0.0, 1.0]
        self.peak = max(self.peak, force.sum())
        return np.concatenate([force.sum(0), np.cross(at - position, force).sum(0)])


def arm_with(true, height=HEIGHT):
    lab = SimulatedLab(SpringPlane(0.0, 1.0, np.zeros(15), QUIET, BOARD), VirtualClock(0.0))
    lab.robot.contact = Fingered(true, height)
    return SimulatedArm(lab, LIMITS)


@pytest.mark.parametrize(("z", "rx", "ry"), [(0.8e-3, 0.04, -0.04), (-3e-3, -0.04, 0.01)])
def test_an_arm_finds_its_skin(z, rx, ry):
    true, messages = skin(z, rx, ry), []
    with arm_with(true) as arm:
        plane = touch_off(arm, LIMITS, AT, HEIGHT, messages.append)
        assert arm.state().T_b_t[2, 3] > HEIGHT + TouchOffConfig.clearance
    np.testing.assert_allclose(plane.T_tool_skin[2, 3], true[2, 3], atol=0.02e-3)
    np.testing.assert_allclose(plane.T_tool_skin[:3, 2], true[:3, 2], atol=2e-3)
    assert plane.flatness_error < 0.02e-3
    assert len(messages) == 4
    assert SAFETY.touch_off_force_n < arm.lab.robot.contact.peak < 1.5 * SAFETY.touch_off_force_n  # stopped 30 ms late


def test_presses_without_an_onset_and_a_missing_flat_are_reported():
    few, falling = (np.array([0, 1e-3]), np.array([0, 1.0])), (np.arange(6.0), 6 - np.arange(6.0))
    lost = np.arange(8.0), np.where(np.arange(8) == 5, np.nan, np.arange(8.0))
    calls = [(contact_onset, few, "in at least 5 samples"), (contact_onset, falling, "did not rise with")]
    refuse(ValueError, [*calls, (contact_onset, lost, "1 of 8 samples have no finite distance and force")])
    with arm_with(skin(0, 0, 0), HEIGHT - 0.02) as arm, pytest.raises(DeviceError, match="met no flat within 11 mm"):
        touch_off(arm, LIMITS, AT, HEIGHT, str)
    for at, height in (((0.7, 0.1), HEIGHT), (AT, 0.0)):
        with arm_with(skin(0, 0, 0)) as arm, pytest.raises(ValueError, match="outside the box"):
            touch_off(arm, LIMITS, at, height, str)
    tilted = np.tile(np.diag([1.0, -1.0, -1.0, 1.0]), (4, 1, 1))
    tilted[:, :3, :3] = [tilted[0, :3, :3] @ corner_rotation(side) for side in CORNER_SIGNS]
    with pytest.raises(ValueError, match=r"the skin would be .* mm and .* degrees from where the rig has it"):
        fit_plane(list(tilted), HEIGHT)
