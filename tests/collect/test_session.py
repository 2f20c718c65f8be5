"""The command on its simulated defaults: it collects, resumes, checks dry, and says what is wrong."""

import json
import os
import signal
import subprocess
import sys
from contextlib import ExitStack, nullcontext
from dataclasses import replace

import jax
import numpy as np
import pytest

from i2t import dataset
from i2t.collect import command, recorder, session
from i2t.collect.arguments import CollectArgs
from i2t.collect.devices import DeviceConfig, DeviceContext, make_devices, make_skin
from i2t.emulators import lab, reskin_board
from i2t.emulators.in_process import SimulatedSkin
from i2t.emulators.world import (
    EmulatedArmConfig,
    EmulatedSkinConfig,
    SimulatedArmConfig,
    SimulatedCameraConfig,
    WorldConfig,
    read_pad,
)
from i2t.errors import DataError
from i2t.hardware.camera_folder import CameraFolderConfig
from i2t.hardware.plugins import PluginConfig
from i2t.hardware.realsense import RealSenseConfig
from i2t.hardware.reskin.config import ReSkinConfig
from i2t.hardware.rig import Rig
from i2t.hardware.ur.config import UrConfig
from i2t.objects.solids import Mesh
from i2t.skin.boards import grid_board
from i2t.skin.files import save_pad
from i2t.skin.pad import nominal_pad
from i2t.types import ReturnCode

pytestmark = pytest.mark.xdist_group("collect")

# The emulated board and the thread that hears it may wait for a core longer than a lab's devices may be silent.
PATIENT = ["--settings.silence", "2", "--settings.approach", "0.04", "--settings.press", "0.005"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("collect")


@pytest.fixture(scope="module")
def rig(folder):
    """The rig of the emulators with a smaller image."""
    from i2t.depth.camera import Camera

    path = folder / "rig.toml"
    replace(Rig(), camera=Camera(160, 90, 161.2, 161.0, 79.5, 44.5)).write(path)
    return path


def run(folder, rig, *more, touches=2):
    return command.main(["--out", str(folder / "set"), "--rig", str(rig), "--touches", str(touches), *more])


@pytest.mark.full
def test_it_collects_a_set_says_so_and_goes_on_where_it_stopped(folder, rig, capsys):
    assert run(folder, rig) == 0
    said = capsys.readouterr().out
    assert "SIMULATED: no real device takes part" in said
    assert "touch 2/2" in said
    first = dataset.load_dataset(folder / "set")
    assert len(first) == 2
    assert first.source == "simulated"
    assert first.objects == ("hexagon",)
    assert run(folder, rig, touches=3) == 0
    data = dataset.load_dataset(folder / "set")
    assert len(data) == 3
    assert len(data.sessions) == 1
    np.testing.assert_array_equal(data.touches.reading[:2], first.touches.reading)
    assert [recorder.site_number_of(path) for path in recorder.touches_in(folder / "set")] == [0, 1, 2]
    capsys.readouterr()
    assert run(folder, rig, touches=3) == 0
    assert "there already" in capsys.readouterr().out


@pytest.mark.full
def test_what_was_collected_makes_sense(folder, rig):
    """A hexagon 30 mm high: the patch lies where the arm and the rig say, within their errors of a millimetre."""
    touches = dataset.load_dataset(folder / "set").touches
    pressed = np.isin(touches.code, [ReturnCode.SKIN, ReturnCode.WRENCH])
    assert pressed.all()
    assert (np.linalg.norm(touches.reading, axis=1) > 15).all()
    assert ((touches.force > 0.05) & (touches.force < 10)).all()
    assert ((touches.depth > 0) & (touches.depth < 1.5e-3)).all()
    assert (np.abs(touches.nearest + touches.depth) < 4e-3).all()  # placement and camera 1 mm each, and 0.3 mm noise
    assert (touches.T_w_t[:, 2, 2] < -0.2).all()


@pytest.mark.full
def test_the_first_touch_of_a_session_is_slow_and_agrees_with_the_rig(folder, rig, capsys):
    assert command.main(["--out", str(folder / "first"), "--rig", str(rig), "--touches", "1"]) == 0
    said = capsys.readouterr().out
    assert "skin at rest: 400 Hz" in said
    assert "first touch: met the object" in said
    wrong = replace(Rig.read(rig), T_world_object=_lifted(0.01))
    wrong.write(folder / "wrong.toml")
    host = ["--out", str(folder / "wrong"), "--rig", str(folder / "wrong.toml"), "--trust-rig"]
    assert command.main([*host, "--touches", "1"]) == 0  # simulated, the object is where the rig has it


def _lifted(height):
    T = np.eye(4)
    T[2, 3] = height
    return T


@pytest.mark.parametrize("harm", ["dead", "frozen", "saturated"])
def test_no_session_starts_and_no_dry_run_passes_on_a_skin_that_lies(folder, rig, capsys, monkeypatch, harm):
    read = SimulatedSkin.read

    def lie(self, count, timeout=None):
        samples = read(self, count, timeout)
        by_chip = samples.reading.reshape(count, -1, 3)
        by_chip[:, 2] = {"dead": 0.0, "frozen": 12.3, "saturated": 7930.0}[harm]
        return samples

    monkeypatch.setattr(SimulatedSkin, "read", lie)
    options = ["--out", str(folder / harm), "--rig", str(rig), "--touches", "1"]
    assert command.main(options) == 1
    assert "the simulated skin cannot be used: chip 2" in capsys.readouterr().err
    assert not recorder.touches_in(folder / harm) if (folder / harm).exists() else True
    assert command.main([*options, "--dry-run"]) == 1
    assert "BAD       the simulated skin: chip 2" in capsys.readouterr().out


@pytest.mark.full
def test_another_collection_is_not_mixed_in(folder, rig, capsys):
    assert run(folder, rig, "--object", "star") == 2
    assert "begun with another object" in capsys.readouterr().err
    assert run(folder, rig, "--seed", "1") == 2
    assert "another seed" in capsys.readouterr().err
    (folder / "other").mkdir(exist_ok=True)
    (folder / "other" / recorder.touches_in(folder / "set")[0].name).write_bytes(b"")
    assert command.main(["--out", str(folder / "other")]) == 2
    assert "another making" in capsys.readouterr().err


BOX = Mesh(np.eye(3), np.array([[0, 1, 2]], np.int32))  # any mesh


def test_other_settings_another_rig_and_another_skin_are_not_mixed_in(tmp_path):
    args = CollectArgs(out=tmp_path)
    _, notes = session._resume(args, "hexagon", Rig(), BOX)
    recorder.write_notes(tmp_path, notes)
    harder = replace(args.settings, press=0.004, force=9.0)
    with pytest.raises(DataError, match=r"settings\.force and settings\.press|settings\.press and settings\.force"):
        session._resume(replace(args, settings=harder), "hexagon", Rig(), BOX)
    with pytest.raises(DataError, match="begun with another rig"):
        session._resume(args, "hexagon", replace(Rig(), mass=Rig().mass + 0.1), BOX)
    with pytest.raises(DataError, match="begun with another mesh"):  # of the same name, in another folder
        session._resume(args, "hexagon", Rig(), BOX._replace(vertices=1.1 * BOX.vertices))
    patient = replace(args, settings=replace(args.settings, retries=9, patience=60.0))
    _, notes = session._resume(patient, "hexagon", Rig(), BOX)
    for device in ("skin", "camera", "arm", "skin right"):
        for serial in ("A1", "", "A1"):
            session._keep_serial(notes, device, serial, tmp_path)
        with pytest.raises(DataError, match=f"begun with the {device.split()[0]} A1, and this one is B2"):
            session._keep_serial(notes, device, "B2", tmp_path)
    assert notes["skin_serial"] == notes["camera_serial"] == notes["arm_serial"] == notes["skin_serial right"] == "A1"
    unknown = {}  # a number that is known only later counts from then on
    session._keep_serial(unknown, "camera", "", tmp_path)
    session._keep_serial(unknown, "camera", "A1", tmp_path)
    with pytest.raises(DataError, match="camera A1"):
        session._keep_serial(unknown, "camera", "B2", tmp_path)


def test_a_rig_of_an_earlier_version_counts_as_the_same():
    assert session._rig_hash(Rig()) == "5fb9684045"  # as written when a key was still called travel


@pytest.mark.full
def test_a_touch_says_how_it_was_made_and_where(folder, rig):
    meta = dataset.load_dataset(folder / "set").meta
    assert json.loads(meta["settings"])["force"] == 8.0
    assert meta["rig"] == session._rig_hash(Rig.read(rig))


def test_a_dry_run_moves_nothing_and_writes_no_touch(folder, rig, capsys):
    assert command.main(["--out", str(folder / "dry"), "--rig", str(rig), "--touches", "5", "--dry-run"]) == 0
    said = capsys.readouterr().out
    assert "nothing was moved" in said
    assert "0 of 5 cannot be reached" in said
    assert (folder / "dry-plan.png").stat().st_size > 1000
    assert (folder / "dry-rig.png").stat().st_size > 10_000
    assert "a collision at 10 N/mm ends at 30 N at the most" in said
    assert "BAD" not in said
    assert not (folder / "dry").exists()


@pytest.mark.full
def test_sigterm_stops_it_and_keeps_everything(folder, rig, capsys):
    def stop(outcome):
        os.kill(os.getpid(), signal.SIGTERM)

    args = CollectArgs(out=folder / "stopped", rig=rig, touches=5, skip_first_touch=True)
    before = signal.signal(signal.SIGTERM, command.end_by_signal)
    try:
        with pytest.raises(SystemExit) as ended:
            session.collect(args, on_outcome=stop)
    finally:
        signal.signal(signal.SIGTERM, before)
    assert ended.value.code == 128 + signal.SIGTERM
    assert len(dataset.load_dataset(folder / "stopped")) == 1
    assert "the same command goes on" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (["--arm", "ur"], "pass --rig"),
        (["--skin", "replay"], "pass --replay"),
        (["--camera", "folder"], "pass --views"),
        (["--arm", "emulated"], "a simulated skin feels only"),
        (["--object", "no such thing"], "no such"),
        (["--camera-serial", "123"], "--camera-serial says which camera it is, and --camera is simulated"),
        (["--settings.press", "0"], "press is 0"),
        (["--settings.press", "0.25"], "press is 0.25; give 0.0001 to 0.05 m/s"),
        (["--settings.force", "1000"], "force is 1000; give 0.2 to 150 N"),
        (["--touches", "-5"], "touches is -5"),
        (["--stiffness", "-1"], "stiffness is -1"),
        (["--seed", "-1"], "seed is -1"),
        (["--watchdog-rate", "0.01"], "watchdog rate 0.01 Hz is outside"),
        (["--state-timeout", "60"], "state timeout 60 s is outside"),
        (["--sites.min-cos", "7"], "sites.min_cos is 7"),
        (["--ambient.seconds", "1e9"], "ambient.seconds is 1e+09"),
        (["--pose", "30", "0", "0", "0", "0", "0"], "--pose is 30 0 0"),
        (["--pose", "0", "0", "0.2", "0", "0", "0"], "on nothing"),
    ],
)
def test_what_does_not_go_together_is_said_in_a_sentence(tmp_path, capsys, wrong, said):
    try:
        code = command.main(["--out", str(tmp_path / "set"), *wrong])
    except SystemExit as error:
        code = error.code
    assert code == 2
    caught = capsys.readouterr()
    assert said in caught.err + caught.out
    assert not (tmp_path / "set").exists()


@pytest.mark.parametrize(("old", "new"), command.RENAMED_COLLECT_FLAGS.items())
def test_a_flag_of_an_earlier_version_is_answered_with_its_new_name(capsys, old, new):
    with pytest.raises(SystemExit) as ended:
        command.main([old, "1"])
    assert ended.value.code == 2
    assert f"{old} is called {new} now" in capsys.readouterr().err


def test_help_needs_neither_jax_nor_numpy_mathematics():
    """So that it comes at once."""
    code = "import sys, i2t.collect.command\nassert not {'jax', 'scipy', 'h5py', 'matplotlib'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_each_name_on_the_command_line_is_a_configuration(tmp_path):
    args = CollectArgs(arm="ur", host="10.0.0.2", skin="reskin", port="/dev/skin", board="grid-4x4", camera="folder",
                       views=tmp_path, watchdog_rate=5.0)  # fmt: skip
    config = session.device_config(args)
    assert config.arm == UrConfig("10.0.0.2", watchdog_rate=5.0)
    assert config.skin == ReSkinConfig("/dev/skin", "grid-4x4")
    assert config.camera == CameraFolderConfig(tmp_path)
    emulated = session.device_config(replace(args, arm="emulated", skin="emulated"))
    assert emulated.arm == EmulatedArmConfig("10.0.0.2", watchdog_rate=5.0)
    assert emulated.skin == EmulatedSkinConfig("/dev/skin", "grid-4x4")
    assert emulated.world.board == "grid-4x4"
    real, played = UrConfig("10.0.0.2"), EmulatedArmConfig()
    assert (real.state_timeout, real.watchdog_rate) == (played.state_timeout, played.watchdog_rate)
    eyes = session.device_config(replace(args, camera="realsense", views=None, camera_serial="123"))
    assert eyes.camera == RealSenseConfig("123")  # of two that are plugged in
    foreign = session.device_config(replace(args, camera="acme:Camera", views=None, camera_serial="10.0.0.3"))
    assert foreign.camera == PluginConfig("acme:Camera", "10.0.0.3")
    hands = session.device_config(replace(args, port=None, skin_serial="A1"))
    assert hands.skin == ReSkinConfig(None, "grid-4x4", "A1")
    assert config.world.board is None  # a real skin says nothing of the pad that a simulated arm would wear
    for wrong, said in (
        ({"arm": "ur", "host": None}, "pass --host"),
        ({"arm": "ur", "skin": "emulated", "port": None}, "feels nothing"),
        ({"arm": "emulated", "skin": "emulated", "port": None}, "pass both, or neither"),
        ({"arm": "simulated", "skin": "emulated"}, "leave out --port"),
        ({"skin": "somewhere:Skin"}, "--board grid-4x4 means nothing to --skin somewhere:Skin"),
    ):
        with pytest.raises(ValueError, match=said):
            session.device_config(replace(args, **wrong))
    with pytest.raises(ValueError, match="touches is 0"):
        CollectArgs(touches=0)


def test_a_skin_of_another_board_has_as_many_channels(tmp_path):
    """Its own port is kept, also where an emulated arm brings a skin with it."""
    config = session.device_config(CollectArgs(arm="emulated", skin="reskin", port="/dev/skin", board="grid-4x4"))
    with ExitStack() as stack:
        skin = make_skin(config.skin, DeviceContext(config, Rig(), stack))
    assert len(skin.features.channels) == 48
    assert "/dev/skin" in skin.features.name


@pytest.fixture(scope="module")
def four_chips(folder):
    """A pad of four chips on disk."""
    path = folder / "four_chips.npz"
    save_pad(path, jax.jit(lambda: nominal_pad(board=grid_board(2, 2)))())
    return path


def test_an_emulated_board_has_the_chips_that_were_named(monkeypatch, four_chips):
    started = {}

    def record(name):
        def start(*options):
            started[name] = list(options)
            return nullcontext((name, None))

        return start

    monkeypatch.setattr(reskin_board, "started", record("board"))
    monkeypatch.setattr(lab, "started", record("lab"))
    for arm, part in ((SimulatedArmConfig(), "board"), (EmulatedArmConfig(), "lab")):
        world = WorldConfig("hexagon", pad=four_chips)
        config = DeviceConfig(arm, EmulatedSkinConfig(board="grid-2x2"), SimulatedCameraConfig(), world)
        with ExitStack() as stack:
            context = DeviceContext(config, Rig(), stack)
            _ = context.emulated_board if part == "board" else context.emulated_lab
        options = started[part]
        assert options[-2:] == ["--board", "grid-2x2"]
        if part == "lab":
            assert options[-3] == "--board"  # the first begins the board's own options
            assert str(four_chips) in options


def test_a_pad_of_another_board_is_refused_before_anything_starts(monkeypatch, four_chips):
    assert read_pad(four_chips).board.num_chips == read_pad(four_chips, "grid-2x2").board.num_chips == 4
    for module in (reskin_board, lab):
        monkeypatch.setattr(module, "started", lambda *_: pytest.fail("it was started"))
    said = r"four_chips\.npz: is a pad on another board, of 4 chips, than reskin, of 5; pass the --board"
    for arm in (SimulatedArmConfig(), EmulatedArmConfig()):
        world = WorldConfig("hexagon", pad=four_chips)
        config = DeviceConfig(arm, EmulatedSkinConfig(), SimulatedCameraConfig(), world)
        with ExitStack() as stack, pytest.raises(ValueError, match=said):
            make_devices(config, Rig(), stack)
    with pytest.raises(ValueError, match="the pad is on the board grid-2x2 and the emulated skin on reskin"):
        DeviceConfig(
            SimulatedArmConfig(),
            EmulatedSkinConfig(),
            SimulatedCameraConfig(),
            WorldConfig("hexagon", board="grid-2x2"),
        )


@pytest.mark.full
@pytest.mark.parametrize(("skin", "name", "chips"), [("simulated", "grid-4x4", 16), ("emulated", "grid-2x2", 4)])
def test_a_skin_of_any_number_of_chips_is_collected_with(tmp_path, rig, skin, name, chips):
    """What the arm presses is felt: a skin of other chips than its board's would show nothing."""
    options = ["--rig", str(rig), "--touches", "1", "--skin", skin, "--board", name, "--no-pose-error", *PATIENT]
    words = ["--out", str(tmp_path / "set"), *options, *(["--settings.hold", "2"] if skin == "emulated" else [])]
    assert any(command.main(words) == 0 for _ in range(3 if skin == "emulated" else 1))
    made = dataset.load_dataset(tmp_path / "set")
    assert made.board.num_chips == chips
    assert made.touches.reading.shape == (1, 3 * chips)
    assert np.linalg.norm(made.touches.reading[0]) > 15


@pytest.mark.full
@pytest.mark.skipif(sys.platform != "linux", reason="needs the addresses 127.x.y.z")
def test_an_emulated_arm_wears_a_pad_of_four_chips(tmp_path, rig, four_chips):
    pytest.importorskip("rtde_control", reason="ur_rtde is not installed (there are wheels for Python 3.10 to 3.12)")
    options = ["--rig", str(rig), "--touches", "1", "--arm", "emulated", "--skin", "emulated", "--pad", str(four_chips)]
    patient = ["--state-timeout", "3", "--watchdog-rate", "0.5", "--settings.hold", "2", *PATIENT]
    assert command.main(["--out", str(tmp_path / "other"), *options, *patient]) == 2  # of a board of five
    assert not (tmp_path / "other").exists()
    words = ["--out", str(tmp_path / "set"), *options, *patient, "--board", "grid-2x2"]
    # Three processes share the machine with the other tests; a session that a starved one has ended goes on.
    assert any(command.main(words) == 0 for _ in range(3))
    made = dataset.load_dataset(tmp_path / "set")
    assert made.touches.reading.shape == (1, 12)
    assert np.linalg.norm(made.touches.reading[0]) > 15
