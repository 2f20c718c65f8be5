"""Devices of third parties: a complete package collects touches; a missing or wrong device is one sentence."""

import ast
import inspect
import os
import subprocess
import sys
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.refusals import refused

from i2t import dataset
from i2t.collect import command
from i2t.hardware import camera_folder, hand_eye, plugins
from i2t.hardware.plugins import DeviceSetup, load_device
from i2t.hardware.rig import Rig
from i2t.skin.boards import reskin_board

ACME = Path(__file__).parents[2] / "examples" / "acme_devices"

CLASSES = [f"--{kind}=acme_devices:Acme{kind.capitalize()}" for kind in plugins.KINDS]


@pytest.fixture
def acme(monkeypatch):
    """The example's folder on the path, and its names as an installed package would register them."""
    monkeypatch.syspath_prepend(str(ACME))
    for module in ("acme_devices", "acme_sdk"):
        monkeypatch.delitem(sys.modules, module, raising=False)
    registered = EntryPoints(
        EntryPoint("acme", f"acme_devices:Acme{kind.capitalize()}", group)
        for kind, (group, *_) in plugins.KINDS.items()
    )
    ours = plugins.entry_points
    monkeypatch.setattr(plugins, "entry_points", lambda **wanted: [*ours(**wanted), *registered.select(**wanted)])


def code_lines(function):
    """Lines of a class without docstrings and blank lines."""
    tree = ast.parse(inspect.getsource(function))
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node):
            node.body = node.body[1:]
    return len(ast.unparse(tree).replace("\n\n", "\n").splitlines())


def test_an_arm_is_written_in_25_lines_and_a_skin_in_15(acme):
    import acme_devices

    assert code_lines(acme_devices.AcmeArm) <= 25
    assert code_lines(acme_devices.AcmeSkin) <= 15


@pytest.mark.full
def test_a_set_is_collected_with_the_example_devices(acme, monkeypatch, tmp_path, capsys):
    """A board of four chips gives twelve values from the device to the data set."""
    import acme_devices

    monkeypatch.setattr(acme_devices.AcmeArm, "state_timeout", 3.0)  # s; other tests may keep the processor busy
    Rig().write(tmp_path / "lab.toml")
    shared = ["--skip-first-touch", "--touches", "1", "--rig", str(tmp_path / "lab.toml"), "--no-pose-error",
              "--settings.approach", "0.04", "--settings.press", "0.005", "--settings.settle", "0.02"]  # fmt: skip
    devices = ["--arm=acme_devices:AcmeArm", "--skin=acme_devices:AcmeSkin", "--camera=acme"]
    assert command.main(["--out", str(tmp_path / "set"), *devices, *shared]) == 0
    assert "SIMULATED" in capsys.readouterr().out
    collected = dataset.load_dataset(tmp_path / "set")
    assert collected.touches.reading.shape == (1, 12)
    assert (collected.source, collected.board.num_chips) == ("simulated", 4)
    assert np.linalg.norm(collected.touches.reading) > 15
    names = [f"--{kind}=acme" for kind in plugins.KINDS]
    assert command.main(["--out", str(tmp_path / "dry"), "--dry-run", *names, *shared]) == 0
    output = capsys.readouterr().out
    assert "BAD" not in output
    assert all(f"Acme's {kind}: " in output for kind in plugins.KINDS)


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("nowhere_at_all:Arm", "nowhere_at_all cannot be imported (No module named"),
        ("acme_devices:Nothing", "acme_devices has no Nothing; give package.module:Class"),
        ("broken_devices:NoArguments", "cannot be built"),
        ("broken_devices:NoMethods", "lacks approach, close, connect, features, go, move, state, stop, zero_wrench"),
        ("other", "is not known; give a name that an installed package registers (acme, emulated, simulated, ur)"),
    ],
)
def test_a_missing_or_wrong_device_is_refused_in_one_sentence(acme, monkeypatch, name, sentence):
    no_methods = type("NoMethods", (), {"__init__": lambda self, setup: None})
    broken = SimpleNamespace(NoArguments=type("NoArguments", (), {}), NoMethods=no_methods)
    monkeypatch.setitem(sys.modules, "broken_devices", broken)
    with pytest.raises(ValueError, match=r"^--arm ") as error:
        load_device("arm", name, DeviceSetup(Rig()))
    assert sentence in str(error.value)
    assert "\n" not in str(error.value)


def test_a_real_arm_of_another_package_needs_a_rig(acme, monkeypatch, tmp_path, capsys):
    import acme_devices

    features = acme_devices.AcmeArm.features.fget
    real = property(lambda arm: features(arm)._replace(source="real"))
    monkeypatch.setattr(acme_devices.AcmeArm, "features", real)
    monkeypatch.setattr(acme_devices.AcmeArm, "connect", lambda arm: pytest.fail("the arm was connected"))
    refused(
        capsys, command.main, "--out", tmp_path / "set", *CLASSES, why="a real arm needs the calibration of its lab"
    )


@pytest.mark.full
def test_the_example_passes_its_own_tests():
    """They include the tests of every arm, every skin and every camera."""
    path = os.pathsep.join([str(ACME), os.environ.get("PYTHONPATH", "")])
    words = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", str(ACME / "test_acme_devices.py")]
    done = subprocess.run(
        words, env={**os.environ, "PYTHONPATH": path}, cwd=ACME.parents[1], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout


def test_views_of_a_board_are_taken_with_devices_of_another_package(acme, tmp_path, monkeypatch, capsys):
    """The arm is released between views, so that a person can move it."""
    import acme_devices

    monkeypatch.setattr(hand_eye.CharucoBoard, "find", lambda board, image: (np.zeros((0, 3)), np.zeros((0, 2))))
    held, connect, close = [], acme_devices.AcmeArm.connect, acme_devices.AcmeArm.close
    monkeypatch.setattr(acme_devices.AcmeArm, "connect", lambda arm: held.append(True) or connect(arm))
    monkeypatch.setattr(acme_devices.AcmeArm, "close", lambda arm: held.append(False) or close(arm))
    answers, seen_held = iter(["", "", "q"]), []
    monkeypatch.setattr("builtins.input", lambda prompt: seen_held.append(held[-1]) or next(answers))
    Rig().write(tmp_path / "lab.toml")
    words = ["--arm", "acme", "--camera", "acme_devices:AcmeCamera", "--rig", str(tmp_path / "lab.toml")]
    assert hand_eye.main(["capture", str(tmp_path / "views"), *words]) == 0, capsys.readouterr().err
    assert "2 views" in capsys.readouterr().out
    assert not any(seen_held)
    poses = np.loadtxt(tmp_path / "views" / "poses.csv", delimiter=",", usecols=range(1, 7))
    with acme_devices.AcmeArm(DeviceSetup(Rig())) as arm:
        np.testing.assert_allclose(poses[0, :3], arm.state().T_b_t[:3, 3], atol=1e-6)
    lens, given = camera_folder.read_lens(tmp_path / "views", {"T_camera_image": None})
    assert (lens.width, lens.height) == (640, 360)
    np.testing.assert_array_equal(given["T_camera_image"], np.eye(4))


@pytest.mark.parametrize(
    ("board", "sentence"),
    [
        (None, "AcmeSkin: has no positions of its chips; give it an attribute board"),
        (reskin_board(), "Acme's skin sends 12 values, but a board of 5 chips"),
    ],
)
def test_a_skin_without_a_board_is_refused(acme, monkeypatch, tmp_path, capsys, board, sentence):
    """Its chips are not assumed to be ReSkin's five."""
    import acme_devices

    initialise = acme_devices.AcmeSkin.__init__
    monkeypatch.setattr(
        acme_devices.AcmeSkin, "__init__", lambda skin, setup: initialise(skin, setup) or setattr(skin, "board", board)
    )
    refused(capsys, command.main, "--out", tmp_path / "set", *CLASSES, why=sentence)
