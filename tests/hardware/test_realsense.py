"""The RealSense driver with the SDK itself, which plays recordings of its software device. No camera was used."""

import re
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest

from i2t.depth.camera import Camera
from i2t.errors import DeviceError, DeviceTimeoutError, NotConnectedError
from i2t.hardware import realsense
from i2t.hardware.poses import pose_from_vector
from i2t.hardware.protocols import View
from i2t.hardware.realsense import RealSense, check_distance, nearest

pytest.importorskip(
    "pyrealsense2", reason="pyrealsense2, or its system package libusb-1.0-0, is not installed", exc_type=ImportError
)

from helpers import realsense_file

ROOT = Path(__file__).parents[2]
CAMERA = Camera(64, 48, 60.0, 61.0, 31.0, 24.0, "brown_conrady", (0.1, -0.02, 1e-3, 2e-3, 0.01))
UNIT = 1e-4
PATIENCE = 20.0  # s that a loaded machine may need
rows, columns = np.mgrid[:48, :64]
DEPTH = np.where((rows == 5) & (columns < 3), np.nan, 0.1 + 1e-3 * rows + 1e-4 * columns)
COLOUR = np.stack([rows, columns, 0 * rows + 7], -1).astype(np.uint8)


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("realsense") / "views.db3"
    realsense_file.write(path, CAMERA, [View(0.0, DEPTH, COLOUR)] * 15, "D405", UNIT)
    return path


def test_the_camera_gives_metres_lens_and_aligned_colour_of_new_views(file):
    camera = RealSense(file=file, size=(64, 48))
    assert camera.serial_number == ""
    with camera:
        assert camera.features.nearest == 0.04
        assert camera.serial_number == realsense_file.SERIAL  # which every file of a session states
        reported = camera.camera
        np.testing.assert_allclose(reported.coefficients, CAMERA.coefficients, rtol=1e-6)  # the SDK has float32
        assert replace(reported, coefficients=CAMERA.coefficients) == CAMERA
        view = camera.capture(PATIENCE)
        # Depth is stored in units; the unit itself is a float32.
        np.testing.assert_allclose(view.depth, DEPTH, atol=UNIT / 2, rtol=1e-6)
        seen = np.isfinite(DEPTH)
        # Same lens, same place: a pixel's colour is its own, but where distortion's inverse is rounded to a neighbour.
        assert np.abs(view.colour[seen][:, :2].astype(int) - COLOUR[seen][:, :2]).max() <= 1
        assert (view.colour[seen][:, 2] == 7).mean() > 0.97
        assert (view.colour[~seen] == 0).all()
        with pytest.raises(DeviceTimeoutError, match=r"sent no view in 0\.001 s"):
            camera.capture(0.001)


def test_colour_keeps_its_own_frame(tmp_path):
    T = pose_from_vector([0.015, 0.001, -0.002, 0.0, 0.0, np.pi / 2])
    realsense_file.write(tmp_path / "views.db3", CAMERA, [View(0.0, DEPTH, COLOUR)] * 4, T_depth_colour=T)
    with RealSense(file=tmp_path / "views.db3", size=(64, 48)) as camera:
        colour = camera.colour(PATIENCE)
    np.testing.assert_array_equal(colour.image, COLOUR)
    np.testing.assert_allclose(colour.T_c_colour, T, atol=1e-7)
    assert colour.camera.fx == 60.0


def test_exposures_are_dated_where_the_clock_is_the_computers(file):
    import pyrealsense2 as rs

    camera = RealSense(file=file)

    def exposed(domain, ago):
        milliseconds = 1e3 * (time.time() - ago)
        frames = SimpleNamespace(get_frame_timestamp_domain=lambda: domain, get_timestamp=lambda: milliseconds)
        return camera._exposed(frames)

    for domain in (rs.timestamp_domain.global_time, rs.timestamp_domain.system_time):
        when = exposed(domain, 0.05)
        assert 0.05 <= time.monotonic() - when < 0.05 + PATIENCE
        for jump in (-3600.0, 3600.0):  # somebody set the clock
            assert exposed(domain, jump) is None
    assert exposed(rs.timestamp_domain.hardware_clock, 0.0) is None


def test_an_unplugged_camera_is_noticed_before_the_timeout(file):
    """The SDK then gives neither frames nor an error, and its pipeline cannot be stopped."""
    camera = RealSense(file=file, size=(64, 48))
    camera.connect()
    camera._pipe.stop()
    camera._file, camera._pipe = None, Mock()
    camera._pipe.try_wait_for_frames = lambda milliseconds: time.sleep(1e-3 * milliseconds) or (False, None)
    camera._pipe.stop.side_effect = RuntimeError("stop() cannot be called before start()")
    with pytest.raises(DeviceError, match=r"is gone; plug it in"):
        camera.capture(PATIENCE)
    with pytest.raises(NotConnectedError):
        camera.capture()


REFUSED = """
import sys
from pathlib import Path
from i2t.errors import DeviceError
from i2t.hardware.realsense import RealSense

file, torn, nowhere = map(Path, sys.argv[1:])
for camera in (
    RealSense("123"), RealSense(file=nowhere), RealSense(file=torn), RealSense(file=file),
    RealSense(file=file, size=(64, 48), distance=0.03),
):
    try:
        camera.connect()
    except DeviceError as error:
        print(error, flush=True)
"""


def test_a_failed_connection_states_its_reason(file, tmp_path):
    """The test runs in its own process, because the SDK sometimes crashes one in which it could not play a file."""
    torn = tmp_path / "torn.db3"
    torn.write_bytes(file.read_bytes()[:5000])
    words = [sys.executable, "-c", REFUSED, str(file), str(torn), str(tmp_path / "nowhere.db3")]
    for _ in range(10):
        tried = subprocess.run(words, capture_output=True, text=True, cwd=ROOT, check=False)
        if tried.returncode >= 0:
            break
    whys = (
        r"was not found \(RealSense cameras here: none\)",
        "the file does not exist",
        "cannot be played",
        "cannot be played at 640 x 360",
        r"D405 measures nothing nearer than 40 mm",  # as the file's own device tells
    )
    for why, line in zip(whys, tried.stdout.splitlines(), strict=True):
        assert re.search(why, line)


def test_only_listed_models_measure_at_the_paper_s_distance():
    assert nearest("Intel RealSense D435I", 640, 360) == 0.150
    assert [name for name in realsense.NEAREST_MM if nearest(name, 640, 360) <= 0.104] == ["D405"]
    check_distance("D405", 1280, 720, 0.104)
    check_distance("D999", 640, 360, 0.01)  # of which nothing is known
    with pytest.raises(DeviceError, match=r"look from 280 mm, or take 424 x 240 pixels, or mount a D405$"):
        check_distance("D435", 1280, 720, 0.11)


def test_the_command_shows_and_keeps_views(file, tmp_path, capsys):
    shown = ["--file", str(file), "--size", "64", "48"]
    assert realsense.main([*shown, "--count", "2", "--save", str(tmp_path / "views")]) == 0
    out = capsys.readouterr().out
    assert "D405" in out
    assert "view 1: 100% measured, 126.7 mm" in out
    assert sorted(path.name for path in (tmp_path / "views" / "colour").iterdir()) == ["000000.png", "000001.png"]
    assert realsense.main([*shown, "--save", str(tmp_path / "views")]) == 2  # nothing is overwritten
    assert realsense.main([*shown, "--distance", "0.01"]) == 2
