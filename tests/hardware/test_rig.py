"""A lab's calibration file: written values are read back, and impossible ones are refused in one sentence."""

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from i2t.depth.camera import Camera
from i2t.hardware.contract import refuse
from i2t.hardware.motion_limits import MotionLimits
from i2t.hardware.poses import pose_from_vector
from i2t.hardware.rig import Rig
from i2t.hardware.rig import __main__ as rigs


def pose(rotvec, at):
    return pose_from_vector([*at, *rotvec])


small = st.lists(st.floats(-0.4, 0.4), min_size=3, max_size=3)


@given(small, small, small, st.floats(0, 20), st.floats(0.02, 2))
@settings(max_examples=30, deadline=None)
def test_a_written_rig_reads_back_unchanged(tmp_path_factory, turn, at, centre, mass, distance):
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
    for name, value in vars(Rig.read(path)).items():
        if isinstance(value, np.ndarray):  # a rotation is made orthonormal once more, which may move its last digit
            np.testing.assert_allclose(value, getattr(written, name), atol=4e-16, err_msg=name)
        else:
            assert value == getattr(written, name)
    assert [file.name for file in path.parent.iterdir()] == ["lab.toml"]


def test_the_example_is_the_default_and_frames_agree(tmp_path):
    path = tmp_path / "lab.toml"
    assert rigs.main([str(path), "--example"]) == 0
    rig = Rig.read(path)
    assert rig.text() == Rig().text()
    np.testing.assert_allclose(rig.T_base_world @ rig.T_world_base, np.eye(4), atol=1e-15)
    assert rig.limits.contains((rig.T_base_world @ rig.T_world_object)[:3, 3] + [0, 0, 0.03])  # the object's top
    # Standing 40 mm off a surface the paper's camera looks from its looking distance.
    assert 0.04 - rig.T_tool_camera[2, 3] == pytest.approx(rig.looking_distance)
    with pytest.raises(ValueError, match="read-only"):
        rig.T_tool_camera[0, 0] = 2
    left_out = r"(speed|acceleration|force|torque|approach|stiffness|model|coeff|object_from)"
    kept = [line for line in Rig().text().splitlines() if not re.match(left_out, line)]
    path.write_text("\n".join(kept))
    assert Rig.read(path).text() == Rig().text()


IDENTITY = "[1.0, 0.0, 0.0, 0.0],\n  [0.0, 1.0, 0.0, 0.0],\n  [0.0, 0.0, 1.0, "
TOOL, CAMERA = IDENTITY + "0.05]", IDENTITY + "-0.064]"


@pytest.mark.parametrize(
    ("old", "new", "why"),
    [
        (TOOL, TOOL.replace("0.05", "50.0"), r"tool.T_flange_tool: lies 50 m away, of at most 0.5; give metres"),
        ("[tool]", '[tool]\narm = "ur5e"', r"'arm' is not a key of \[tool\]; give one of T_flange_tool"),
        (TOOL, TOOL.replace("1.0", "1.1"), r"tool.T_flange_tool: is not a rigid motion .* orthonormal"),
        (TOOL, TOOL.replace("[1.0", "[-1.0"), r"tool.T_flange_tool: is not a rigid motion .it is mirrored"),
        (TOOL, TOOL.replace("0.05", "nan"), r"tool.T_flange_tool holds NaN or infinity"),
        (
            "[0.0, 0.0, 0.0, 1.0]",
            "[0.0, 0.0, 0.05, 1.0]",
            r"T_flange_tool: .*last row is 0, 0, 0.05, 1.; write 0, 0, 0, 1",
        ),
        (CAMERA, CAMERA.replace("1.0", "-1.0", 1).replace("1.0, -0", "-1.0, -0"), r"turns the camera's axis more than"),
        ("mass = 0.5", "mass = true", r"tool.mass is True; give one number"),
        ("mass = 0.5", "mas = 0.5", r"'mas' is not a key of \[tool\]; is it mass\?"),
        ("mass = 0.5\n", "", r"tool.mass is missing; add it to \[tool\]"),
        ('model = "none"', 'model = "fisheye"', r"camera: model 'fisheye' is a fisheye lens"),
        ("object_covariance = [\n  [1e-06", "object_covariance = [\n  [-1e-06", r"has a negative variance"),
        ("object_covariance = [\n  [1e-06, 0.0", "object_covariance = [\n  [1e-06, 1e-7", r"is not symmetric"),
        ("object_covariance = [\n  [1e-06", "object_covariance = [\n  [1.0", r"means 1 m; give variances in m"),
        ("[world]", "[globe]", r"'globe' is not a table; give one of tool, camera, world, limits"),
        ("speed = 0.25", "speed = nan", r"limits.speed holds NaN"),
        ("lower = [0.25", "lower = [0.75", r"limits.lower, .*, must lie below upper"),
        ("[tool]", "[tool", r"is not TOML"),
    ],
)
def test_impossible_rigs_are_refused_in_one_sentence(tmp_path, old, new, why):
    path = tmp_path / "lab.toml"
    text = Rig().text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(ValueError, match=why) as caught:
        Rig.read(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_missing_and_unreadable_rig_files_are_refused(tmp_path, capsys):
    file = tmp_path / "lab.toml"
    file.write_bytes(b"\xff\xfe\x00")
    nowhere = (tmp_path / "nowhere.toml",)
    refuse(FileNotFoundError, [(Rig.read, nowhere, "no such file; write one to start from with i2t rig ")])
    refuse(ValueError, [(Rig.read, (tmp_path,), "is a folder, not a regular file"), (Rig.read, (file,), "UTF-8")])
    assert rigs.main([str(file)]) == 2
    assert rigs.main([str(file), "--example"]) == 2
    assert "exists already" in capsys.readouterr().err


def test_an_object_outside_the_box_and_probable_mistakes_are_doubted(capsys, tmp_path):
    for rig, code, doubt in (
        (Rig(), 0, ""),
        (Rig(T_world_object=pose([0, 0, 0], [1, 0, 0])), 1, "OUTSIDE"),
        (Rig(T_flange_tool=np.eye(4)), 1, "DOUBT     tool.T_flange_tool puts the skin 0 mm from the flange"),
    ):
        rig.write(tmp_path / f"{len(doubt)}.toml")
        assert rigs.main([str(tmp_path / f"{len(doubt)}.toml")]) == code
        shown = capsys.readouterr().out
        assert doubt in shown
        assert bool(doubt) == ("OUTSIDE" in shown or "DOUBT" in shown)
