"""Camera in tool from views of a board, against cameras whose place is known. Views are drawn without OpenCV."""

import math
import re
import shutil
import sys
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from helpers.refusals import refused
from PIL import Image

from i2t.depth.camera import Camera
from i2t.depth.distortion import deproject
from i2t.emulators import ur_controller
from i2t.errors import DeviceError
from i2t.hardware import hand_eye
from i2t.hardware.contract import refuse
from i2t.hardware.hand_eye import CharucoBoard
from i2t.hardware.hand_eye_fit import BoardView, HandEyeConfig, board_pose, fit, pixel_rays
from i2t.hardware.plugins import colour_view
from i2t.hardware.poses import pose_difference, pose_from_vector
from i2t.hardware.protocols import ColourImage
from i2t.hardware.rig import Rig
from i2t.hardware.ur.access import tool_pose

pytest.importorskip("cv2", reason="OpenCV is not installed")

CAMERA = Camera(640, 360, 322.4, 322.1, 319.5, 179.5)
BOARD = CharucoBoard()
ARM = (0.1e-3, math.radians(0.05))  # m, rad: errors of the arm's pose, per axis


def pose(turn, at):
    return pose_from_vector([*at, *turn])


TRUE = pose([0.03, -0.05, 1.2], [0.02, -0.03, -0.064])  # T_t_c
LAID = pose([math.pi, 0.02, 0.4], [0.45, 0.1, 0.01])  # T_b_o; the board's z points away from who reads it
MIDDLE = np.array([BOARD.columns, BOARD.rows, 0]) * BOARD.square / 2


def tools(count, rng, tilt=0.45, distance=0.2):
    """Poses T_b_t from which the camera looks at the board's middle, tilted about both axes."""
    for _ in range(count):
        turn = [*rng.uniform(-tilt, tilt, 2), rng.uniform(-0.5, 0.5)]
        T_o_c = pose([0, 0, 0], MIDDLE) @ pose(turn, [0, 0, 0]) @ pose([0, 0, 0], [*rng.normal(0, 0.01, 2), -distance])
        yield LAID @ T_o_c @ np.linalg.inv(TRUE)


def reported(T, rng):
    """The pose that the arm reports."""
    return T @ pose(ARM[1] * rng.standard_normal(3), ARM[0] * rng.standard_normal(3))


def board_view(T_b_t, rng, noise, told=None):
    """All corners of a board as a perfect detector with `noise` pixels sees them."""
    grid = np.stack(np.meshgrid(np.arange(1, BOARD.columns), np.arange(1, BOARD.rows)), -1).reshape(-1, 2)
    corners = np.column_stack([BOARD.square * grid, np.zeros(len(grid))])
    seen = corners @ (T := np.linalg.inv(T_b_t @ TRUE) @ LAID)[:3, :3].T + T[:3, 3]
    rays = seen[:, :2] / seen[:, 2:] + noise / CAMERA.fx * rng.standard_normal((len(grid), 2))
    return BoardView(T_b_t if told is None else told, corners, rays)


def test_hand_eye_calibration_without_noise_is_exact():
    rng = np.random.default_rng(0)
    board_views = [board_view(T, rng, 0.0) for T in tools(6, rng)]
    for seen in board_views:
        np.testing.assert_allclose(board_pose(seen), np.linalg.inv(seen.T_b_t @ TRUE) @ LAID, atol=1e-9)
    result = fit(board_views, CAMERA.fx)
    np.testing.assert_allclose(result.T_t_c, TRUE, atol=1e-7)
    np.testing.assert_allclose(result.T_b_o, LAID, atol=1e-7)
    assert result.rms < 1e-4


@pytest.mark.full
def test_the_stated_error_agrees_with_the_actual_error():
    """Over 8 calibrations: the stated standard error is a root mean square, so are the errors made. A mean of 8
    squares of three independent parts each scatters by sqrt(2 / 24) = 29 %, by 50 % where one part rules, so its root
    by 15 to 25 %, and the jackknife of 12 views by some 20 % of its own: within a factor of two they must agree.
    """
    errors, stated = [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        result = fit([board_view(T, rng, 0.1, reported(T, rng)) for T in tools(12, rng)], CAMERA.fx)
        errors.append(pose_difference(result.T_t_c, TRUE))
        stated.append((result.position_error, result.rotation_error))
    errors, stated = (np.sqrt(np.mean(np.square(values), 0)) for values in (errors, stated))
    assert ((errors > 0.5 * stated) & (errors < 2 * stated)).all()
    # Smaller than what the simulated world takes for usual: 1 mm and 0.5 degrees per axis.
    assert (errors < [1e-3, math.radians(0.5)]).all()


def test_wrong_corners_are_outvoted_and_uninformative_views_refused():
    rng = np.random.default_rng(1)
    board_views = [board_view(T, rng, 0.1) for T in tools(10, rng)]
    clean = pose_difference(fit(board_views, CAMERA.fx).T_t_c, TRUE)[0]
    for seen in board_views[::2]:
        seen.rays[rng.integers(len(seen.rays))] += 3 / CAMERA.fx
    assert pose_difference(fit(board_views, CAMERA.fx).T_t_c, TRUE)[0] < max(3 * clean, 0.1e-3)
    upright = [board_view(T, rng, 0.1, reported(T, rng)) for T in tools(8, rng, tilt=0.0)]
    sparse = BoardView(upright[0].T_b_t, upright[0].corners[:5], upright[0].rays[:5])
    lost = [*board_views[:8], board_views[8]._replace(T_b_t=np.full((4, 4), np.nan))]
    calls = [
        (fit, (lost, CAMERA.fx), "view 9 has a pose or corners that are not finite"),
        (fit, (board_views[:5], CAMERA.fx), "found in 5 views; take at least 6"),
        (fit, (upright, CAMERA.fx), "tilt it by 15 degrees or more about two axes"),
        (board_pose, (sparse,), "shows 5 corners"),
    ]
    refuse(ValueError, calls)
    impatient = partial(fit, config=HandEyeConfig(max_steps=1))
    refuse(ValueError, [(impatient, (board_views, CAMERA.fx), "does not converge within 1 steps")])


def test_lines_of_sight_are_those_of_the_core():
    pixels = np.random.default_rng(3).uniform([0, 0], [639, 359], (50, 2))
    for model in ("none", "brown_conrady", "modified_brown_conrady", "inverse_brown_conrady"):
        coefficients = (0.08, -0.03, 1e-3, -2e-3, 0.01) if model != "none" else ()
        camera = replace(CAMERA, model=model, coefficients=coefficients)
        expected = deproject(camera, jnp.asarray(pixels, jnp.float32), jnp.ones(50))[:, :2]
        np.testing.assert_allclose(pixel_rays(camera, pixels), expected, atol=2e-6)  # float32


# With images


EDGE, FINER = 60, 3  # pixels of a square's edge in the drawing; pixels that are averaged, along each side


def view(T_b_t, drawing, rng):
    """An image (h, w, 3) uint8 of the drawn board on a grey table, by its homography; noise of two grey levels."""
    lens = np.array([[CAMERA.fx, 0, CAMERA.cx + 0.5], [0, CAMERA.fy, CAMERA.cy + 0.5], [0, 0, 1 / FINER]])
    to_metres = np.array([[1, 0, -EDGE], [0, 1, -EDGE], [0, 0, EDGE / BOARD.square]])  # behind a margin of a square
    to_drawing = np.linalg.inv(lens @ (np.linalg.inv(T_b_t @ TRUE) @ LAID)[:3, [0, 1, 3]] @ to_metres)
    rows, size = (to_drawing / to_drawing[2, 2]).ravel()[:8], (FINER * CAMERA.width, FINER * CAMERA.height)
    seen = drawing.transform(size, Image.Transform.PERSPECTIVE, rows, Image.Resampling.BILINEAR, fillcolor=120)
    grey = np.asarray(seen.reduce(FINER)) + 2 * rng.standard_normal((CAMERA.height, CAMERA.width))
    return np.repeat(np.clip(np.round(grey), 0, 255).astype(np.uint8)[..., None], 3, -1)


@pytest.fixture(scope="module")
def taken(tmp_path_factory):
    """A folder that `capture` made of nine views, from a camera and an arm that report their true poses."""
    rng = np.random.default_rng(4)
    drawing = Image.fromarray(BOARD.image(EDGE / (1e3 * BOARD.square)))
    T_c_colour = pose([0.0, 0.01, 0.0], [0.015, 0.0, 0.0])
    poses = list(tools(8, rng))
    poses.insert(4, poses[0] @ pose([1.5, 0, 0], [0, 0, 0]))  # looks away: no board
    now = []
    camera = SimpleNamespace(colour=lambda: ColourImage(0.0, view(now[-1], drawing, rng), CAMERA, T_c_colour))

    def arm():
        now.append(poses[len(now)])
        return reported(now[-1], rng)

    path = tmp_path_factory.mktemp("hand_eye") / "views"
    assert hand_eye.capture(path, lambda: (arm(), colour_view(camera)), lambda number: number < len(poses), BOARD) == 9
    return path, T_c_colour


def test_the_command_writes_the_camera_into_the_rig(taken, tmp_path, capsys):
    path, T_c_colour = taken
    Rig().write(tmp_path / "lab.toml")
    # The estimate is the colour camera; the rig has the depth camera.
    wanted = TRUE @ np.linalg.inv(T_c_colour)
    assert hand_eye.main(["estimate", str(path), "--rig", str(tmp_path / "lab.toml"), "--write"]) == 0
    out = capsys.readouterr().out
    assert out.startswith("8 views, 0.")
    distance, angle = map(float, re.search(r"standard error (\S+) mm, (\S+) degrees", out).groups())
    written = Rig.read(tmp_path / "lab.toml")
    metres, radians = pose_difference(wanted, written.T_tool_camera)
    # Three standard errors, which of eight views are themselves known to a quarter.
    assert 1e3 * metres < 4 * distance < 8
    assert math.degrees(radians) < 4 * angle < 4
    assert written.mass == Rig().mass
    assert hand_eye.main(["estimate", str(path), "--write"]) == 2


def test_missing_input_is_reported(taken, tmp_path, capsys):
    shutil.copytree(taken[0], copy := tmp_path / "views")
    for file, text, why in (
        ("images/000.png", "no image", "000.png: cannot be read"),
        ("poses.csv", "000.png,1,2,3\n", "is not a pose; write NAME.png"),
        ("camera.toml", "fx = 1\n", "'cx' is missing"),
    ):
        (copy / file).write_text(text)
        refused(capsys, hand_eye.main, "estimate", copy, why=why)


def test_drawn_boards_are_detected(tmp_path):
    file = tmp_path / "board.png"
    assert hand_eye.main(["board", str(file), "--dictionary", "APRILTAG_36h11"]) == 0
    with Image.open(file) as image:
        assert image.size == (10 * 177, 8 * 177)  # 15 mm at 300 dpi
        corners, _ = CharucoBoard(dictionary="APRILTAG_36h11").find(np.asarray(image.convert("RGB").resize((885, 708))))
    assert len(corners) == 35
    assert hand_eye.main(["board", str(file), "--square", "15"]) == 2  # in metres


@pytest.mark.skipif(sys.platform != "linux", reason="needs the addresses 127.x.y.z, which only Linux gives")
def test_the_arm_s_pose_is_read_without_controlling_the_arm():
    pytest.importorskip("rtde_receive", reason="ur_rtde is not installed (there are wheels for Python 3.10 to 3.12)")
    host = ur_controller.loopback(209)
    with pytest.raises(DeviceError, match="does not answer"):
        tool_pose(host)
    with ur_controller.process(host, "--pose", "0.4", "0.1", "0.2", "3", "0.1", "0"):
        np.testing.assert_allclose(tool_pose(host), pose([3, 0.1, 0], [0.4, 0.1, 0.2]), atol=1e-12)
