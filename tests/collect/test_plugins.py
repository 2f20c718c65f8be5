"""Devices of third parties: a complete package is collected with, and what is missing or wrong is one sentence."""

import os
import subprocess
import sys
import types
from contextlib import ExitStack
from dataclasses import replace
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path

import numpy as np
import pytest

from i2t import dataset
from i2t.collect import command, place
from i2t.collect.devices import DeviceConfig, make_devices
from i2t.depth.camera import Camera
from i2t.emulators.world import WorldConfig
from i2t.hardware import hand_eye, plugins
from i2t.hardware import touch_off as touching
from i2t.hardware.kinematics import arms
from i2t.hardware.plugins import DeviceSetup, PluginConfig, is_plugin, load_plugin
from i2t.hardware.rig import Rig
from i2t.skin.boards import reskin_board

ACME = Path(__file__).parents[2] / "examples" / "acme_devices"
QUICK = ["--settings.approach", "0.04", "--settings.press", "0.005", "--settings.settle", "0.02"]

pytestmark = pytest.mark.xdist_group("collect")


@pytest.fixture
def acme(monkeypatch):
    """The example's folder on the path, and its names as an installed package would register them."""
    monkeypatch.syspath_prepend(str(ACME))
    for module in ("acme_devices", "franka_arm"):
        monkeypatch.delitem(sys.modules, module, raising=False)
    registered = EntryPoints(
        EntryPoint("acme", f"acme_devices:Acme{kind.capitalize()}", group) for kind, group in plugins.GROUPS.items()
    )
    monkeypatch.setattr(plugins, "entry_points", lambda **wanted: registered.select(**wanted))


@pytest.mark.full
def test_the_example_is_collected_with_by_its_classes_and_then_by_its_names(acme, tmp_path, capsys):
    """Four chips: twelve values from the device to the data set. The second command resumes the first's folder only
    under the first's names, so it has a folder of its own.
    """
    rig = tmp_path / "rig.toml"
    replace(Rig(), camera=Camera(160, 90, 161.2, 161.0, 79.5, 44.5)).write(rig)
    classes = [f"--{kind}=acme_devices:Acme{kind.capitalize()}" for kind in plugins.GROUPS]
    shared = ["--rig", str(rig), "--no-pose-error", *QUICK]
    assert command.main(["--out", str(tmp_path / "set"), "--touches", "2", *classes, *shared]) == 0
    assert "SIMULATED" in capsys.readouterr().out
    made = dataset.load_dataset(tmp_path / "set")
    assert made.touches.reading.shape == (2, 12)
    assert made.source == "simulated"
    assert made.board.num_chips == 4
    assert (np.linalg.norm(made.touches.reading, axis=1) > 15).all()
    names = [f"--{kind}=acme" for kind in plugins.GROUPS]
    assert command.main(["--out", str(tmp_path / "dry"), "--touches", "2", "--dry-run", *names, *shared]) == 0
    said = capsys.readouterr().out
    assert all(f"ok        Acme's {kind}" in said for kind in plugins.GROUPS)


@pytest.mark.full
def test_an_arm_of_seven_joints_plans_its_touches_and_keeps_its_joints(acme, tmp_path, capsys):
    """The table stands 0.4 m before the arm; 0.5 m further on nothing is within its reach, and nothing is touched."""
    camera = Camera(160, 90, 161.2, 161.0, 79.5, 44.5)
    replace(Rig(), camera=camera).write(tmp_path / "rig.toml")
    devices = ["--arm=franka_arm:FrankaArm", "--skin=acme", "--camera=acme", "--no-pose-error", *QUICK]
    made = ["--out", str(tmp_path / "set"), "--touches", "1", "--rig", str(tmp_path / "rig.toml"), *devices]
    assert command.main(made) == 0
    (file,) = (tmp_path / "set").glob("touch-*.h5")
    joints = dataset.read_touch(file).series["joints"]
    assert joints.values.shape[1] == 7
    assert np.ptp(joints.values, axis=0).max() > 1e-3
    low, high = arms()["panda"].low, arms()["panda"].high
    assert ((joints.values > low) & (joints.values < high)).all()

    setup = DeviceSetup(Rig())
    arm = load_plugin("arm", PluginConfig("franka_arm:FrankaArm"), setup)
    down = np.diag([1.0, -1.0, -1.0, 1.0])
    near, far = down.copy(), down.copy()
    near[:3, 3], far[:3, 3] = (0.4, 0.0, 0.1), (0.95, 0.0, 0.1)
    assert arm.why_unreachable([near]) == ""
    assert "panda cannot reach it" in arm.why_unreachable([far])


def test_a_name_means_what_a_package_registers(acme):
    assert is_plugin("arm", "acme")
    assert is_plugin("arm", "somewhere:Arm")
    assert not is_plugin("arm", "other")


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("nowhere_at_all:Arm", "nowhere_at_all cannot be imported (No module named"),
        ("acme_devices:Nothing", "acme_devices has no Nothing; give package.module:Class"),
        ("acme_devices:", "acme_devices has no ; give package.module:Class"),
        (":Arm", "cannot be imported"),
        ("broken_devices:NoArguments", "cannot be built"),
        ("broken_devices:NoMethods", "lacks approach, close, connect, features, go, move, state, stop, zero_wrench"),
        ("other", "there is no such arm (registered under i2t.arms: acme)"),
    ],
)
def test_what_is_missing_or_wrong_is_one_sentence(acme, monkeypatch, name, said):
    broken = types.ModuleType("broken_devices")
    broken.NoArguments = type("NoArguments", (), {})
    broken.NoMethods = type("NoMethods", (), {"__init__": lambda self, setup: None})
    monkeypatch.setitem(sys.modules, "broken_devices", broken)
    with pytest.raises(ValueError, match=r"^--arm ") as error:
        load_plugin("arm", PluginConfig(name), DeviceSetup(Rig()))
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_a_real_arm_of_another_package_needs_a_rig(acme, monkeypatch, tmp_path, capsys):
    import acme_devices

    features = acme_devices.AcmeArm.features.fget
    real = property(lambda arm: features(arm)._replace(source="real"))
    monkeypatch.setattr(acme_devices.AcmeArm, "features", real)
    monkeypatch.setattr(acme_devices.AcmeArm, "connect", lambda arm: pytest.fail("the arm was connected"))
    classes = [f"--{kind}=acme_devices:Acme{kind.capitalize()}" for kind in plugins.GROUPS]
    assert command.main(["--out", str(tmp_path / "set"), *classes]) == 2
    assert "a real arm needs to know its lab" in capsys.readouterr().err


def test_a_name_that_two_packages_register_is_refused(monkeypatch):
    both = EntryPoints(EntryPoint("acme", f"{package}:Arm", "i2t.arms") for package in ("one", "two"))
    monkeypatch.setattr(plugins, "entry_points", lambda **wanted: both.select(**wanted))
    with pytest.raises(ValueError, match=r"several packages register it \(one:Arm, two:Arm\)"):
        load_plugin("arm", PluginConfig("acme"), DeviceSetup(Rig()))


def test_an_unknown_name_on_the_command_line_is_one_sentence(tmp_path, capsys):
    assert command.main(["--out", str(tmp_path / "set"), "--arm", "robot"]) == 2
    assert "--arm robot is not known; give one of ur, simulated, emulated" in capsys.readouterr().err


@pytest.mark.full
def test_the_example_passes_its_own_tests():
    """Those of every arm, every skin and every camera."""
    path = os.pathsep.join([str(ACME), os.environ.get("PYTHONPATH", "")])
    words = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", str(ACME / "test_acme_devices.py")]
    done = subprocess.run(
        words, env={**os.environ, "PYTHONPATH": path}, cwd=ACME.parents[1], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout


@pytest.mark.parametrize("kind", ["skin", "camera"])
def test_the_example_keeps_to_the_contract(acme, kind):
    """Its own tests say so; here those that take no time show that they run."""
    sys.modules.pop("test_acme_devices", None)
    import test_acme_devices

    contract = {"skin": test_acme_devices.TestAcmeSkin, "camera": test_acme_devices.TestAcmeCamera}[kind]()
    contract.test_features_are_known_before_connecting(contract.make_device)
    if kind == "skin":
        contract.test_samples_are_whole_plausible_and_in_order(contract.make_device)


@pytest.fixture
def lab_file(tmp_path):
    """A rig whose camera has few pixels."""
    replace(Rig(), camera=Camera(160, 90, 161.2, 161.0, 79.5, 44.5)).write(tmp_path / "lab.toml")
    return tmp_path / "lab.toml"


def test_views_of_a_board_are_taken_with_another_package_s_arm_and_camera(
    acme, lab_file, tmp_path, monkeypatch, capsys
):
    """The arm is let go between views, so that a person can move it."""
    import acme_devices

    monkeypatch.setattr(hand_eye.CharucoBoard, "find", lambda board, image: (np.zeros((0, 3)), np.zeros((0, 2))))
    held, connect, close = [], acme_devices.AcmeArm.connect, acme_devices.AcmeArm.close
    monkeypatch.setattr(acme_devices.AcmeArm, "connect", lambda arm: held.append(True) or connect(arm))
    monkeypatch.setattr(acme_devices.AcmeArm, "close", lambda arm: held.append(False) or close(arm))
    answers = iter(["", "", "q"])
    seen_held = []
    monkeypatch.setattr("builtins.input", lambda said: seen_held.append(held[-1]) or next(answers))
    words = ["--arm", "acme", "--camera", "acme_devices:AcmeCamera", "--rig", str(lab_file)]
    assert hand_eye.main(["capture", str(tmp_path / "views"), *words]) == 0, capsys.readouterr().err
    assert "2 views" in capsys.readouterr().out
    assert not any(seen_held)
    poses = np.loadtxt(tmp_path / "views" / "poses.csv", delimiter=",", usecols=range(1, 7))
    arm = acme_devices.AcmeArm(DeviceSetup(Rig.read(lab_file)))
    with arm:
        np.testing.assert_allclose(poses[0, :3], arm.state().T_b_t[:3, 3], atol=1e-6)
    lens, T_camera_image = hand_eye._lens(tmp_path / "views" / "camera.toml")
    assert (lens.width, lens.height) == (160, 90)
    np.testing.assert_array_equal(T_camera_image, np.eye(4))


def test_a_skin_is_touched_off_with_another_package_s_arm(acme, lab_file, monkeypatch, capsys):
    """It comes to the arm; how the touches go is said in tests/hardware."""
    arms = []
    found = touching.FittedPlane(np.eye(4), 0.0)
    monkeypatch.setattr(touching, "touch_off", lambda arm, *_: arms.append((arm, arm.state().safe)) or found)
    words = ["--arm", "acme", "--rig", str(lab_file), "--height", "0.01", "--at", "0.4", "0"]
    assert touching.main(words) == 0
    ((arm, safe),) = arms
    assert type(arm).__name__ == "AcmeArm"
    assert safe
    assert touching.main([*words, "--watchdog-rate", "5"]) == 2
    assert "--watchdog-rate: of a UR arm, and --arm is acme; leave it out" in capsys.readouterr().err


@pytest.mark.full
def test_an_object_is_placed_with_another_package_s_arm_and_camera(acme, lab_file, monkeypatch, capsys):
    """Acme's lab renders what its arm looks at: the catalogue's hexagon, seen obliquely."""
    import acme_devices

    rig = Rig.read(lab_file)
    looking = np.eye(4)  # T_w_c, from 40 degrees off the vertical
    tilt = np.pi - 0.7
    looking[:3, :3] = [[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]]
    looking[:3, 3] = np.array([0, 0, 0.015]) - 0.15 * looking[:3, 2]
    goal = rig.T_base_world @ looking @ np.linalg.inv(rig.T_tool_camera)
    connect = acme_devices.AcmeArm.connect

    def connect_there(arm):
        connect(arm)
        arm.lab.robot.position, arm.lab.robot.rotation = goal[:3, 3], goal[:3, :3]

    monkeypatch.setattr(acme_devices.AcmeArm, "connect", connect_there)
    words = [str(lab_file), "--object", "hexagon", "--arm", "acme", "--camera", "acme", "--write"]
    assert place.main(words) == 0, capsys.readouterr().err
    assert Rig.read(lab_file).object_from == "registration"


@pytest.mark.parametrize(
    ("main", "words", "said"),
    [
        (hand_eye.main, ["capture", "DIR", "--arm", "acme"], "--arm acme needs the lab's calibration"),
        (hand_eye.main, ["capture", "DIR", "--host", "h", "--camera", "acme"], "--camera acme needs the lab's calib"),
        (hand_eye.main, ["capture", "DIR", "--rig", "RIG", "--camera", "acme", "--size", "9", "9"], "--size"),
        (hand_eye.main, ["capture", "DIR"], "a UR arm needs the address of its controller; pass --host"),
        (touching.main, ["--arm", "robot", "--rig", "RIG", "--height", "0", "--at", "0", "0"], "robot is not known"),
        (place.main, ["RIG", "--object", "star", "--camera", "eye", "--host", "h"], "--camera eye is not known; give"),
        (place.main, ["RIG", "--object", "star", "--camera", "acme", "--views", "FOLDER", "--host", "h"], "--views"),
        (place.main, ["RIG", "--object", "star", "--arm", "acme", "--tool", *"000000"], "the pose of the tool is need"),
    ],
)  # fmt: skip
def test_a_lab_is_measured_with_devices_that_are_known(acme, lab_file, capsys, main, words, said):
    named = {"RIG": str(lab_file), "FOLDER": str(lab_file.parent)}
    assert main([named.get(word, word) for word in words]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1


@pytest.mark.parametrize(
    ("board", "said"),
    [
        (None, "--skin acme: does not say where its chips are; give it an attribute board"),
        (reskin_board(), "Acme's skin sends 12 values, and a board of 5 chips"),
    ],
)
def test_a_skin_that_does_not_know_its_board_is_refused(acme, monkeypatch, board, said):
    """Its chips are not taken for ReSkin's five."""
    import acme_devices

    monkeypatch.setattr(acme_devices.AcmeSkin, "board", board)
    config = DeviceConfig(PluginConfig("acme"), PluginConfig("acme"), PluginConfig("acme"), WorldConfig("hexagon"))
    with ExitStack() as stack, pytest.raises(ValueError, match=said):
        make_devices(config, Rig(), stack)
