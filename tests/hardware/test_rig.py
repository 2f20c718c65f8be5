"""A lab's calibration file: what is written is read, and what cannot be is refused in one sentence."""

import dataclasses
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from i2t.depth.camera import Camera
from i2t.hardware import rig as rigs
from i2t.hardware.limits import MotionLimits
from i2t.hardware.rig import Rig


def pose(rotvec, at):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec(rotvec).as_matrix(), at
    return T


def same(one, other):
    for each in dataclasses.fields(Rig):
        np.testing.assert_array_equal(getattr(one, each.name), getattr(other, each.name), err_msg=each.name)


small = st.lists(st.floats(-0.4, 0.4), min_size=3, max_size=3)


@given(small, small, small, st.floats(0, 20), st.floats(0.02, 2))
@settings(max_examples=30, deadline=None)
def test_what_is_written_is_read(tmp_path_factory, turn, at, centre, mass, distance):
    path = tmp_path_factory.mktemp("rig") / "lab.toml"
    written = Rig(
        pose(turn, at),
        mass,
        tuple(centre),
        pose(turn, at),
        distance,
        Camera(848, 480, 421.7, 421.1, 423.9, 240.2, "brown_conrady", (0.1, -0.02, 1e-4)),
        pose(3 * np.array(turn), at),
        pose(turn, centre),
        "registration",
        MotionLimits((0.1, -0.2, 0.0), (0.5, 0.2, 0.4), speed=0.1, approach_distance=0.05),
    )
    written.write(path)
    read = Rig.read(path)
    # The rotation is made exactly orthonormal once more, which may move its last digit.
    for name in ("T_flange_tool", "T_tool_camera", "T_world_base", "T_world_object"):
        np.testing.assert_allclose(getattr(read, name), getattr(written, name), atol=4e-16)
    for name in ("mass", "centre", "looking_distance", "camera", "object_from", "limits"):
        assert getattr(read, name) == getattr(written, name)
    assert [file.name for file in path.parent.iterdir()] == ["lab.toml"]


def test_the_example_is_the_default_and_frames_agree(tmp_path):
    assert rigs.main([str(tmp_path / "lab.toml"), "--example"]) == 0
    rig = Rig.read(tmp_path / "lab.toml")
    same(rig, Rig())
    np.testing.assert_allclose(rig.T_base_world @ rig.T_world_base, np.eye(4), atol=1e-15)
    assert rig.limits.contains((rig.T_base_world @ rig.T_world_object)[:3, 3] + [0, 0, 0.03])  # the object's top
    # Standing 40 mm off a surface the paper's camera looks from its looking distance.
    assert 0.04 - rig.T_tool_camera[2, 3] == pytest.approx(rig.looking_distance)
    with pytest.raises(ValueError, match="read-only"):
        rig.T_tool_camera[0, 0] = 2


def test_what_may_be_left_out_is(tmp_path):
    path = tmp_path / "lab.toml"
    kept = [
        line
        for line in Rig().text().splitlines()
        if not line.startswith(
            ("speed", "acceleration", "force", "torque", "approach", "stiffness", "model", "coeff", "object_from")
        )
    ]
    path.write_text("\n".join(kept))
    same(Rig.read(path), Rig())


def test_a_file_of_an_earlier_version_is_read_and_two_names_of_one_key_are_refused(tmp_path):
    path = tmp_path / "lab.toml"
    text = dataclasses.replace(Rig(), limits=dataclasses.replace(Rig().limits, approach_distance=0.07)).text()
    path.write_text(text.replace("approach_distance = ", "travel = "))
    assert Rig.read(path).limits.approach_distance == 0.07
    path.write_text(text.replace("approach_distance = 0.07", "travel = 70"))
    with pytest.raises(ValueError, match=r"limits.approach_distance is 70; give m"):
        Rig.read(path)
    path.write_text(f"{text}travel = 0.07\n")
    with pytest.raises(ValueError, match=r"has approach_distance and travel, its earlier name; keep approach_distance"):
        Rig.read(path)


IDENTITY = "[1.0, 0.0, 0.0, 0.0],\n  [0.0, 1.0, 0.0, 0.0],\n  [0.0, 0.0, 1.0, "
TOOL, CAMERA = IDENTITY + "0.05]", IDENTITY + "-0.064]"


@pytest.mark.parametrize(
    ("old", "new", "why"),
    [
        (TOOL, TOOL.replace("0.05", "50.0"), r"tool.T_flange_tool lies 50 m away; give metres, each within 0.5 m"),
        (TOOL, TOOL.replace("1.0", "1.1"), r"tool.T_flange_tool holds no rotation: .* orthonormal"),
        (TOOL, TOOL.replace("[1.0", "[-1.0"), r"tool.T_flange_tool holds a reflection"),
        (TOOL, TOOL.replace("0.05", "nan"), r"tool.T_flange_tool holds NaN or infinity"),
        (TOOL, TOOL.replace(", 0.05]", "]"), r"tool.T_flange_tool is \[\[.*; give 4 x 4 numbers"),
        (TOOL, TOOL.replace("0.05", "'up'"), r"tool.T_flange_tool is .*; give 4 x 4 numbers"),
        ("[0.0, 0.0, 0.0, 1.0]", "[0.0, 0.0, 0.05, 1.0]", r"T_flange_tool has the last row .*; write \[0, 0, 0, 1\]"),
        (CAMERA, CAMERA.replace("1.0", "-1.0", 1).replace("1.0, -0", "-1.0, -0"), r"turns the camera's axis more than"),
        ("mass = 0.5", "mass = 500", r"tool.mass is 500; give kg, from 0 to 20"),
        ("mass = 0.5", "mass = true", r"tool.mass is True; give one number"),
        ("mass = 0.5", "mas = 0.5", r"'mas' is no key of \[tool\]; is it mass\?"),
        ("mass = 0.5\n", "", r"tool.mass is missing; add it to \[tool\]"),
        ("centre = [0.0, 0.0, 0.03]", "centre = [0.0, 0.0, 30]", r"tool.centre is .*; give x, y, z in m"),
        ("looking_distance = 0.104", "looking_distance = 104", r"looking_distance is 104; give m, from 0.02 to 2"),
        ("width = 640", "width = 640.5", r"camera.width is 640.5; give whole pixels"),
        ("fx = 322.4", "fx = '322'", r"camera.fx is '322'; give one number"),
        ('model = "none"', 'model = "fisheye"', r"camera: model 'fisheye' is not known"),
        ("coefficients = [", "coefficients = ['k1', ", r"camera.coefficients is .*; give .* numbers"),
        ('object_from = "given"', 'object_from = "guess"', r"object_from is 'guess'; give one of given, registration"),
        ("object_covariance = [\n", "object_covariance = [[0], ", r"object_covariance is .*; give 6 x 6 numbers"),
        ("object_covariance = [\n  [1e-06", "object_covariance = [\n  [-1e-06", r"has a negative variance"),
        ("object_covariance = [\n  [1e-06, 0.0", "object_covariance = [\n  [1e-06, 1e-7", r"is not symmetric"),
        ("object_covariance = [\n  [1e-06", "object_covariance = [\n  [1.0", r"says 1 m; give variances in m"),
        ("[world]", "[globe]", r"'globe' is no table; known are tool, camera, world, limits"),
        ("speed = 0.25", "speed = 250", r"limits.speed is 250; give m/s, from 0.0001 to 1"),
        ("speed = 0.25", "speed = nan", r"limits.speed holds NaN"),
        ("lower = [0.25", "lower = [0.75", r"limits.lower, .*, must lie below upper"),
        ("lower = [0.25, ", "lower = [", r"limits.lower is 2; give 3 numbers"),
        ("[tool]", "[tool", r"is not TOML"),
    ],
)
def test_what_cannot_be_is_refused_in_one_sentence(tmp_path, old, new, why):
    path = tmp_path / "lab.toml"
    text = Rig().text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(ValueError, match=why) as caught:
        Rig.read(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_files_that_are_none(tmp_path, capsys):
    with pytest.raises(FileNotFoundError, match=r"no such file; write one to start from with python -m i2t.hardware"):
        Rig.read(tmp_path / "nowhere.toml")
    with pytest.raises(ValueError, match="cannot be read"):
        Rig.read(tmp_path)
    (tmp_path / "lab.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ValueError, match="UTF-8"):
        Rig.read(tmp_path / "lab.toml")
    assert rigs.main([str(tmp_path / "lab.toml")]) == 2
    assert rigs.main([str(tmp_path / "lab.toml"), "--example"]) == 2
    assert "exists already" in capsys.readouterr().err


def test_the_summary_warns_of_an_object_outside_the_box(capsys, tmp_path):
    Rig().write(tmp_path / "lab.toml")
    assert rigs.main([str(tmp_path / "lab.toml")]) == 0
    shown = capsys.readouterr().out
    assert "looks from 104 mm" in shown
    assert "(given), within 1.0 mm and 1.0 degrees" in shown
    assert "OUTSIDE" not in shown
    assert "free motion at 40 mm/s at the most" in shown
    assert "DOUBT" not in shown
    assert "OUTSIDE" in rigs.summary(Rig(T_world_object=pose([0, 0, 0], [1, 0, 0])))


def test_what_is_nearly_always_a_mistake_is_doubted(capsys, tmp_path):
    dataclasses.replace(Rig(), T_flange_tool=np.eye(4)).write(tmp_path / "lab.toml")
    assert rigs.main([str(tmp_path / "lab.toml")]) == 1
    assert "DOUBT     tool.T_flange_tool puts the skin 0 mm from the flange" in capsys.readouterr().out


@pytest.mark.full
def test_the_hardware_layer_needs_no_jax_and_no_sdk():
    names = sorted(path.stem for path in Path(rigs.__file__).parent.glob("*.py") if path.stem != "__init__")
    code = "import sys, " + ", ".join(f"i2t.hardware.{name}" for name in names) + "\n"
    code += "there = {'jax', 'cv2', 'serial', 'pyrealsense2', 'rtde_control', 'rtde_receive'} & set(sys.modules)\n"
    code += "assert not there, there"
    subprocess.run([sys.executable, "-c", code], check=True)
