"""The emulated controller's program: the outputs that its clients receive."""

import numpy as np
import pytest

from i2t.emulators.robot_motion import Robot, plane
from i2t.emulators.ur_program import Controller


def controller():
    return Controller(Robot(np.array([0.4, 0.0, 0.3, np.pi, 0.0, 0.0]), plane(0.0, 0.0), noise=0.1))


def test_all_clients_receive_the_same_outputs_at_a_tick_and_others_at_the_next():
    emulated = controller()
    force = emulated.output("actual_TCP_force")
    assert emulated.output("actual_TCP_force") == force  # one draw of the sensor's noise
    emulated.robot.line_to(np.array([0.4, 0.0, 0.2, np.pi, 0.0, 0.0]), 0.1, 1.0)
    for _ in range(100):
        emulated.step()
    emulated.observe()
    assert emulated.output("actual_TCP_force") != force
    assert emulated.output("timestamp") == pytest.approx(0.2)
    np.testing.assert_allclose(emulated.output("actual_TCP_pose"), emulated.robot.pose)
    assert emulated.output("actual_TCP_pose")[2] < 0.3


def test_forged_outputs_replace_true_ones_and_an_unknown_one_is_refused():
    emulated = controller()
    emulated.forged["actual_q"] = [1.0] * 6
    assert emulated.output("actual_q") == [1.0] * 6
    with pytest.raises(KeyError):
        emulated.output("actual_current")


def test_a_line_that_does_not_turn_keeps_the_rotation_exactly_and_one_that_turns_does_not():
    robot = controller().robot
    before = robot.rotation
    robot.line_to(np.array([0.4, 0.0, 0.2, np.pi, 0.0, 0.0]), 0.1, 1.0)
    robot.step(0.1)
    assert robot.rotation is before
    assert robot.position[2] < 0.3
    robot.line_to(np.array([0.4, 0.0, 0.2, np.pi, 0.0, 0.1]), 0.1, 1.0)
    robot.step(0.1)
    assert np.abs(robot.rotation - before).max() > 1e-4
