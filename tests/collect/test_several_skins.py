"""Several skins on one tool: each is read in each touch, with its own board, and a set is of the one that is named."""

import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers.closed_form import GAIN, HEIGHT, QUIET, ROOM, make, names, site

from experiments.calibrate.config import CalibrateArgs
from experiments.recognize.arguments import SimulateArgs
from experiments.train.arguments import TrainArgs
from i2t import dataset
from i2t.collect import command, recorder, session
from i2t.collect.carried import SkinOnTool
from i2t.collect.devices import Devices
from i2t.collect.event_log import read_raw
from i2t.collect.recorder import CarriedSkinInfo, Recorder, touches_in
from i2t.collect.session_ambient import fitted_ambient
from i2t.collect.settings import AmbientSettings
from i2t.dataset import SKIN_NAME, SkinChoiceError
from i2t.depth.camera import Camera
from i2t.emulators import reskin_board
from i2t.emulators.in_process import CarriedSkinLab, SimulatedSkin
from i2t.emulators.scene import SpringPlane
from i2t.errors import DataError, DeviceError, DeviceTimeoutError
from i2t.hardware.carried_skins import CarriedSkin
from i2t.hardware.reskin.driver import ReSkin
from i2t.hardware.rig import Rig
from i2t.hardware.rig_checks import implausible
from i2t.skin.ambient import load_ambient
from i2t.skin.boards import make_board
from i2t.types import Board, ReturnCode
from i2t.view.contents import read_contents

pytestmark = pytest.mark.xdist_group("collect")

ROOT = Path(__file__).parents[2]
ASIDE_M = 0.02  # of the second skin, along the tool's x
SQUARE = make_board("grid-2x2")
SQUARE_GAIN = np.linspace(14, -11, 12)  # uT/N
STIFFNESS = 10e3


def beside(out_by: float) -> np.ndarray:
    """T_tool_skin of a skin that lies so far (m) before the one at the tool."""
    T = np.eye(4)
    T[:3, 3] = ASIDE_M, 0.0, out_by
    return T


def two(out_by: float, **options):
    """A procedure over a springy plane with a second skin of four chips on the tool."""
    procedure = make(**options)
    lab = procedure.arm.lab
    plane = SpringPlane(HEIGHT, STIFFNESS, SQUARE_GAIN, QUIET, SQUARE, room=ROOM)
    skin = SimulatedSkin(CarriedSkinLab(lab, plane, beside(out_by)))
    skin.connect()
    procedure.carried = (SkinOnTool("right", skin, SQUARE, beside(out_by), pad="right pad"),)
    procedure.rig = replace(procedure.rig, skin="left")
    return procedure


def info_of(procedure):
    about = {each.name: CarriedSkinInfo(each.pad, each.board, {"skin": "right's"}) for each in procedure.carried}
    return replace(names(procedure), skin=procedure.rig.skin, carried=about)


def touched(folder, procedure, count=1):
    """The last of some touches."""
    with Recorder(folder, info_of(procedure), procedure.clock) as recording:
        made = list(procedure.run(lambda history: site(len(history)) if len(history) < count else None, recording))
    return made[-1].touch


@pytest.mark.parametrize(("out_by", "own", "other"), [
    (-5e-3, ReturnCode.SKIN, ReturnCode.AIR),
    (+2e-3, ReturnCode.AIR, ReturnCode.SKIN),
])  # fmt: skip
def test_the_skin_that_is_further_out_feels_the_press_and_has_the_force_to_itself(tmp_path, out_by, own, other):
    touch = touched(tmp_path, two(out_by))
    right = touch.carried["right"]
    assert (touch.code, right.code) == (own, other)
    felt, gain, silent = (touch, GAIN, right) if own == ReturnCode.SKIN else (right, SQUARE_GAIN, touch)
    np.testing.assert_allclose(felt.reading, felt.force * gain, rtol=1e-3)
    np.testing.assert_allclose(felt.depth, felt.force / STIFFNESS, atol=5e-6)
    np.testing.assert_allclose(silent.reading, 0, atol=1e-6)
    assert np.isnan(silent.depth)
    assert np.isnan(silent.force) or silent.force == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_allclose(right.T_w_s, touch.T_w_t @ beside(out_by), atol=1e-12)
    np.testing.assert_allclose(right.seen.nearest, right.T_w_s[2, 3] - HEIGHT, atol=1e-9)


def test_two_skins_that_feel_a_press_share_its_force_which_is_then_unknown_for_each(tmp_path):
    """Two springs side by side: the arm measures their sum, and the torque of the one that lies aside."""
    procedure = two(0.0)
    touch = touched(tmp_path, procedure)
    right = touch.carried["right"]
    assert touch.code == right.code == ReturnCode.SKIN
    assert np.isnan(touch.force)
    assert np.isnan(right.force)
    sunk = HEIGHT - touch.T_w_t[2, 3]
    np.testing.assert_allclose(touch.reading, STIFFNESS * sunk * GAIN, rtol=1e-3)
    np.testing.assert_allclose(right.reading, STIFFNESS * sunk * SQUARE_GAIN, rtol=1e-3)
    wrench = dataset.read_touch(touches_in(tmp_path)[0]).series["wrench"].values
    deepest = wrench[np.argmin(wrench[:, 2])]
    np.testing.assert_allclose(deepest[2], -2 * STIFFNESS * sunk, rtol=0.02)
    np.testing.assert_allclose(deepest[4], ASIDE_M * STIFFNESS * sunk, rtol=0.02)  # r x F, x aside and F against z


@pytest.mark.full
def test_either_skin_stops_a_press_and_the_events_say_which(tmp_path):
    for number, (out_by, said) in enumerate(((2e-3, "stopped by skin right"), (-5e-3, "stopped by skin left"))):
        folder = tmp_path / str(number)
        touched(folder, two(out_by))
        events = [text for _, text in dataset.read_touch(touches_in(folder)[0]).events]
        assert said in events


def test_a_second_skin_that_falls_silent_ends_the_press():
    procedure = two(-5e-3)
    skin, since = procedure.carried[0].skin, procedure.carried[0].skin.since
    heard = []

    def fading(number):
        heard.append(number)
        skin.silent = len(heard) > 5
        return since(number)

    skin.since = fading
    with pytest.raises(DeviceTimeoutError, match="silent"):
        procedure.touch(site(0), Ignoring())
    assert procedure.arm.state().T_b_t[2, 3] > HEIGHT  # nothing was pressed


class Ignoring:
    """A log that keeps nothing."""

    def samples(self, samples, skin=""):
        pass

    def state(self, state):
        pass

    def event(self, text):
        pass


# Files


def test_a_touch_keeps_each_skin_with_its_own_board_and_series(tmp_path):
    touch = touched(tmp_path, two(2e-3))
    record = dataset.read_touch(touches_in(tmp_path)[0])
    assert record.skin_names == ("left", "right")
    right = record.skins["right"]
    assert right.board.num_chips == 4
    assert right.pads == ("right pad",)
    assert right.meta["skin"] == "right's"
    np.testing.assert_allclose(right.touches.reading[0], touch.carried["right"].reading, rtol=1e-6)
    np.testing.assert_allclose(right.touches.T_w_t[0], touch.carried["right"].T_w_s, atol=1e-7)
    assert record.series["tactile right"].values.shape[1] == 12
    assert record.series["tactile"].values.shape[1] == 15
    assert len(record.series["tactile right"].time) > 400
    assert record.counters["skin right samples"] > 400
    alone = record.of_skin("right")
    assert alone.touch is right
    assert alone.series["tactile"] is record.series["tactile right"]
    assert not any("right" in label for label in alone.series)
    assert record.of_skin("left").series["tactile"] is record.series["tactile"]


def test_a_set_is_of_the_skin_that_is_named_and_one_sentence_asks_for_it(tmp_path):
    touched(tmp_path, two(2e-3), 2)
    with pytest.raises(SkinChoiceError, match=r"touch-.*holds touches of 2 skins, left and right; name one with"):
        dataset.load_dataset(tmp_path)
    with pytest.raises(SkinChoiceError, match=r"has no skin 'thumb' but the skin left and right; name one of these"):
        dataset.load_dataset(tmp_path, skin="thumb", skip_bad=True)
    left, right = (dataset.load_dataset(tmp_path, skin=name) for name in ("left", "right"))
    assert (left.board.num_chips, right.board.num_chips) == (5, 4)
    assert len(left) == len(right) == 2
    dataset.save_dataset(tmp_path / "packed" / "right.h5", right)
    for again in (None, "right"):  # a set of one skin is named, and need not be
        packed = dataset.load_dataset(tmp_path / "packed", skin=again)
        np.testing.assert_array_equal(packed.touches.reading, right.touches.reading)
    with pytest.raises(SkinChoiceError, match="has no skin 'left' but the skin right"):
        dataset.load_dataset(tmp_path / "packed", skin="left")


def test_a_touch_of_one_skin_is_as_it_was_and_older_readers_find_the_skin_at_the_tool(tmp_path):
    """The place of the groups that every version reads: touches, names and board at the file's root."""
    procedure = make()
    with Recorder(tmp_path / "one", names(procedure), procedure.clock) as recording:
        list(procedure.run(lambda history: None if history else site(0), recording))
    touch = touched(tmp_path / "two", two(2e-3))
    (one,), (several,) = touches_in(tmp_path / "one"), touches_in(tmp_path / "two")
    with h5py.File(one) as file, h5py.File(several) as other:
        assert set(other) - set(file) == {"skins"}
        assert set(other["touches"]) == set(file["touches"])
        assert set(other["meta"]) - set(file["meta"]) == {SKIN_NAME}
        assert not [name for name in file["counters"] if "right" in name]
        np.testing.assert_allclose(other["touches/reading"][0], touch.reading, rtol=1e-6)
        assert other["board/chips"].shape == file["board/chips"].shape == (5, 3)
    with pytest.raises(SkinChoiceError, match="has no skin 'left' but one skin without a name; leave out --skin-name"):
        dataset.load_dataset(tmp_path / "one", skin="left")


@pytest.mark.full
def test_what_was_under_way_is_read_of_every_skin(tmp_path):
    procedure = two(-5e-3)
    approach = procedure.arm.approach

    def interrupted(*how, **named):
        approach(*how, **named)
        raise KeyboardInterrupt

    procedure.arm.approach = interrupted
    with pytest.raises(KeyboardInterrupt):
        touched(tmp_path, procedure)
    (raw,) = (tmp_path / recorder.INTERRUPTED).iterdir()
    rows = {kind: sum(len(part) for each, part in read_raw(raw) if each == kind) for kind in ("skin", "skin right")}
    assert rows["skin"] > 400
    assert rows["skin right"] > 400
    widths = {part.shape[1] for kind, part in read_raw(raw) if kind == "skin right"}
    assert widths == {2 + 4 * 4}


def test_what_is_looked_at_is_of_the_skin_that_is_named(tmp_path):
    touched(tmp_path, two(2e-3))
    with pytest.raises(SkinChoiceError, match="2 skins"):
        read_contents(tmp_path)
    contents = read_contents(tmp_path, skin="right")
    (record,) = contents.records()
    assert contents.dataset.board.num_chips == record.touch.board.num_chips == 4
    assert record.series["tactile"].values.shape[1] == 12


@pytest.mark.full
@pytest.mark.parametrize(("module", "next_refusal"), [
    ("experiments.train", "choose another --split"),
    ("experiments.calibrate", "no press has a known position and depth"),
    ("experiments.recognize", "has touches of plane"),
])  # fmt: skip
def test_commands_work_with_the_skin_that_is_named(tmp_path, module, next_refusal):
    """Two touches are too few for any of them, which they find out only once the touches are read."""
    touched(tmp_path / "set", two(2e-3), 2)
    words = [sys.executable, "-m", module, "--dataset", str(tmp_path / "set"), "--out", str(tmp_path / "out")]
    words += ["--pad", "nominal"] if module.endswith("recognize") else []
    for named, said in (([], "holds touches of 2 skins, left and right"), (["--skin-name", "left"], next_refusal)):
        run = subprocess.run([*words, *named], capture_output=True, text=True, cwd=ROOT)
        assert run.returncode == 2
        assert said in run.stderr


@pytest.mark.parametrize("module", ["train", "calibrate", "recognize"])
def test_a_skin_s_name_needs_a_data_set(module):
    arguments = {"train": TrainArgs, "calibrate": CalibrateArgs, "recognize": SimulateArgs}[module]
    given = {"calibration": Path("c.npz"), "save_pad": Path("p.npz")} if module == "calibrate" else {}
    with pytest.raises(ValueError, match="--skin-name has no effect without --dataset"):
        arguments(skin_name="left", **given).check()


# The ambient field


@pytest.mark.full
def test_each_skin_has_an_ambient_field_of_its_own_in_the_same_poses(tmp_path, capsys):
    from i2t.emulators.room import RoomField

    procedure = two(0.0)
    procedure.arm.lab.scene.room = RoomField()
    procedure.carried[0].skin.lab.scene.room = RoomField()
    field = fitted_ambient(procedure, AmbientSettings(poses=6, seconds=0.1), tmp_path)
    right = procedure.carried[0].ambient_field
    np.testing.assert_allclose(right.earth, field.earth, atol=0.5)  # of one room, in the base
    assert right.offset.shape == (4, 3)
    kept, _ = load_ambient(tmp_path / ".ambient-right.npz", SQUARE)
    np.testing.assert_allclose(kept.earth, right.earth)
    assert "ambient field of right" in capsys.readouterr().out
    procedure.carried[0].ambient_field = None
    fitted_ambient(procedure, AmbientSettings(), tmp_path)
    np.testing.assert_allclose(procedure.carried[0].ambient_field.earth, right.earth)


# The rig and the command


@pytest.fixture
def rig(tmp_path):
    def write(device, address="", **options):
        right = CarriedSkin("right", device, beside(0.0), "grid-2x2", address, pad="right pad", **options)
        lab = replace(Rig(), camera=Camera(160, 90, 161.2, 161.0, 79.5, 44.5), skin="left", skins=(right,))
        path = tmp_path / f"{device}.toml"
        lab.write(path)
        return path

    return write


def test_a_rig_with_skins_is_read_as_it_was_written_and_one_without_is_as_before(rig):
    path = rig("reskin", "/dev/ttyACM1")
    read = Rig.read(path)
    assert read.text() == path.read_text()
    (right,) = read.skins
    assert (read.skin, right.name, right.device, right.board, right.address, right.pad) == (
        "left", "right", "reskin", "grid-2x2", "/dev/ttyACM1", "right pad",
    )  # fmt: skip
    np.testing.assert_array_equal(right.T_tool_skin, beside(0.0))
    assert "skin" not in [line.split(" ")[0] for line in Rig().text().splitlines()]
    assert "[skins" not in Rig().text()


@pytest.mark.parametrize(("old", "new", "said"), [
    ('board = "grid-2x2"', 'board = "round"', "skins.right.board: Board 'round' is not known"),
    ("[skins.right]", "[skins.left]", "skins.left is also the name of the skin at the tool; give tool.skin another"),
    ("[skins.right]", '[skins."a b"]', "'a b' is no name of a skin"),
    ('address = "/dev/ttyACM1"', "", "skins.right names no board; add address, its port"),
    ('address = "/dev/ttyACM1"', "port = 3", "'port' is no key of [skins.right]"),
    ('address = "/dev/ttyACM1"', "address = 3", "skins.right.address is 3; give a word in quotes"),
    ('pad = "right pad"', 'serial_number = "E6"', "skins.right has an address and a serial_number; keep one"),
    ("T_tool_skin = [", "T_tool = [", "'T_tool' is no key of [skins.right]; is it T_tool_skin?"),
    ("  [1.0, 0.0, 0.0, 0.02]", "  [2.0, 0.0, 0.0, 0.02]", "skins.right.T_tool_skin holds no rotation"),
    ('skin = "left"', "skin = 5", "tool.skin is 5; give a word in quotes"),
])  # fmt: skip
def test_a_table_of_a_skin_that_cannot_be_is_refused_in_one_sentence(rig, old, new, said):
    path = rig("reskin", "/dev/ttyACM1")
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(ValueError, match=f"^{re.escape(str(path))}: .*{re.escape(said)}"):
        Rig.read(path)


@pytest.mark.parametrize(("device", "flags", "said"), [
    ("simulated", ["--arm", "ur", "--host", "127.0.0.1", "--skin", "reskin"], "skins.right.device is simulated"),
    ("emulated", ["--arm", "ur", "--host", "127.0.0.1", "--skin", "reskin"], "feels nothing on this arm"),
    ("nobody's", [], "skins.right.device is \"nobody's\"; give one of reskin"),
])  # fmt: skip
def test_devices_of_skins_that_do_not_go_with_the_arm_are_refused(rig, tmp_path, capsys, device, flags, said):
    words = ["--rig", str(rig(device)), "--out", str(tmp_path / "out"), "--object", "cylinder", *flags]
    assert command.main(words) == 2
    assert said in capsys.readouterr().err


@pytest.mark.parametrize(("where", "said"), [
    ((0.0, 0.0, 0.05), "puts it 50 mm before the skin that presses"),
    ((0.002, 0.0, 0.0), "puts it 2 mm from the skin at the tool, where that one is"),
])  # fmt: skip
def test_a_skin_that_meets_everything_first_or_lies_on_another_is_doubted(where, said):
    T = np.eye(4)
    T[:3, 3] = where
    (doubt,) = implausible(replace(Rig(), skins=(CarriedSkin("right", "simulated", T),)))
    assert said in doubt
    assert not implausible(replace(Rig(), skins=(CarriedSkin("right", "simulated", beside(0.0)),)))
    T[:3, :3] = np.diag([1.0, -1, -1])  # the other side of a finger, which presses nothing
    T[:3, 3] = 0.0, 0.0, -0.005
    assert not implausible(replace(Rig(), skins=(CarriedSkin("back", "simulated", T),)))


def test_a_board_that_is_named_for_two_skins_is_refused(rig, tmp_path, capsys):
    words = ["--rig", str(rig("reskin", "/dev/ttyACM1")), "--out", str(tmp_path / "out"), "--object", "cylinder"]
    assert command.main([*words, "--skin", "reskin", "--port", "/dev/ttyACM1"]) == 2
    assert "the board /dev/ttyACM1 is named for two skins; correct --port, or skins.right" in capsys.readouterr().err


@pytest.mark.full
def test_the_command_collects_two_simulated_skins_resumes_packs_and_refuses_another_rig(rig, tmp_path, capsys):
    from i2t.convert import commands

    path, out = rig("simulated"), tmp_path / "out"
    words = ["--rig", str(path), "--out", str(out), "--object", "cylinder"]
    assert command.main([*words, "--touches", "1"]) == 0
    assert "skin right at rest: 400 Hz" in capsys.readouterr().out
    assert command.main([*words, "--touches", "2"]) == 0
    sets = {name: dataset.load_dataset(out, skin=name) for name in ("left", "right")}
    assert [len(each) for each in sets.values()] == [2, 2]
    assert [each.board.num_chips for each in sets.values()] == [5, 4]
    assert sets["right"].pads == ("right pad",)
    assert "| skin name | left |" in (out / "README.md").read_text()
    assert commands.main(["pack", str(out), str(tmp_path / "packed")]) == 2
    assert "holds touches of 2 skins" in capsys.readouterr().err
    assert commands.main(["pack", str(out), str(tmp_path / "packed"), "--skin-name", "right"]) == 0
    assert len(dataset.load_dataset(tmp_path / "packed")) == 2
    path.write_text(path.read_text().replace("0.02]", "0.03]"))
    assert command.main([*words, "--touches", "3"]) == 2
    assert "was begun with another rig" in capsys.readouterr().err


def test_a_folder_begun_with_chips_that_are_turned_otherwise_is_refused(tmp_path):
    procedure = two(2e-3)
    touched(tmp_path, procedure)
    devices = Devices(procedure.arm, procedure.skin, procedure.camera, procedure.clock, board=procedure.board,
                      carried=tuple(procedure.carried))  # fmt: skip
    session._check_boards(tmp_path, devices, procedure.rig)
    aligned = devices._replace(board=Board(devices.board.chips, np.tile(np.eye(3), (5, 1, 1))))
    with pytest.raises(DataError, match="begun with a board of the skin left whose chips lie or turn otherwise"):
        session._check_boards(tmp_path, aligned, procedure.rig)
    moved = replace(devices.carried[0], board=Board(SQUARE.chips + 1e-3, SQUARE.rotations))
    with pytest.raises(DataError, match="of the skin right whose chips"):
        session._check_boards(tmp_path, devices._replace(carried=(moved,)), procedure.rig)


@pytest.mark.full
def test_a_second_skin_that_is_dead_passes_no_dry_run_and_starts_no_session(rig, tmp_path, capsys, monkeypatch):
    read = SimulatedSkin.read

    def dead(self, count, timeout=None):
        samples = read(self, count, timeout)
        return samples._replace(reading=0 * samples.reading) if self.board.num_chips == 4 else samples

    monkeypatch.setattr(SimulatedSkin, "read", dead)
    words = ["--rig", str(rig("simulated")), "--out", str(tmp_path / "out"), "--object", "cylinder", "--touches", "1"]
    assert command.main([*words, "--dry-run"]) == 1
    said = capsys.readouterr().out
    assert "BAD       the skin right, the simulated skin: " in said
    assert "BAD       the simulated skin: " not in said
    assert command.main(words) == 1
    assert "the skin right, the simulated skin cannot be used: " in capsys.readouterr().err


# Real drivers with emulated boards


def on_usb(monkeypatch, boards: dict[str, str]) -> None:
    """The serial ports of this machine become these, by their serial numbers."""
    from types import SimpleNamespace

    ports = [
        SimpleNamespace(device=os.path.realpath(port), vid=0x239A, pid=1, description="QT Py", serial_number=number)
        for number, port in boards.items()
    ]
    from serial.tools import list_ports

    monkeypatch.setattr(list_ports, "comports", lambda: ports)


def test_a_board_is_found_by_its_serial_number(monkeypatch):
    with reskin_board.started("--board", "grid-2x2") as (square, _), reskin_board.started() as (five, _):
        on_usb(monkeypatch, {"A1": five, "B2": square})
        with ReSkin(serial_number="B2", chips=4) as skin:
            assert skin.info.serial_number == "B2"
            assert skin.read(3).reading.shape == (3, 12)
        with pytest.raises(DeviceError, match=r"no board has the serial number C3 .*A1 on .*B2 on .*; plug it in"):
            ReSkin(serial_number="C3").connect()


@pytest.mark.full
def test_two_boards_on_serial_ports_are_read_in_each_touch_with_their_serial_numbers(
    rig, tmp_path, monkeypatch, capsys
):
    """The arm is simulated and the boards feel nothing: force stops the press, and neither skin has felt it."""
    with reskin_board.started("--board", "grid-2x2") as (square, _), reskin_board.started() as (five, _):
        on_usb(monkeypatch, {"A1": five, "B2": square})
        out, path = tmp_path / "out", rig("reskin", serial_number="B2")
        words = ["--rig", str(path), "--out", str(out), "--object", "cylinder", "--skip-first-touch", "--skin",
                 "reskin", "--skin-serial", "A1", "--settings.silence", "2", "--settings.approach", "0.04",
                 "--settings.press", "0.005"]  # fmt: skip
        assert command.main([*words, "--touches", "1"]) == 0
        capsys.readouterr()
        right = dataset.load_dataset(out, skin="right", missing_chips=True)
        assert right.meta["skin serial number"] == "B2"
        assert dataset.load_dataset(out, skin="left").meta["skin serial number"] == "A1"
        assert right.touches.reading.shape == (1, 12)
        notes = json.loads((out / recorder.NOTES).read_text())
        assert (notes["skin_serial"], notes["skin_serial right"]) == ("A1", "B2")
        on_usb(monkeypatch, {"A1": five, "D4": square})
        path.write_text(path.read_text().replace("B2", "D4"))
        monkeypatch.setattr(session, "_rig_hash", lambda rig: notes["rig"])  # as with a port in place of the number
        assert command.main([*words, "--touches", "2"]) == 2
        assert "was begun with the skin B2, and this one is D4" in capsys.readouterr().err


@pytest.mark.full
@pytest.mark.skipif(sys.platform != "linux", reason="needs the addresses 127.x.y.z")
def test_an_emulated_arm_with_two_emulated_boards_feels_with_both(rig, tmp_path):
    """The other skin is 20 mm aside: where one of them meets the cylinder's side or top, the other may meet air."""
    pytest.importorskip("rtde_control", reason="ur_rtde is not installed (there are wheels for Python 3.10 to 3.12)")
    out = tmp_path / "out"
    words = ["--rig", str(rig("emulated")), "--out", str(out), "--object", "cylinder", "--skip-first-touch", "--arm",
             "emulated", "--skin", "emulated", "--touches", "1", "--state-timeout", "3", "--watchdog-rate", "0.5",
             "--settings.silence", "2", "--settings.hold", "2"]  # fmt: skip
    assert any(command.main(words) == 0 for _ in range(3))  # a session that a starved device has ended goes on
    left, right = (dataset.load_dataset(out, skin=name).touches for name in ("left", "right"))
    felt = [bool(code[0] != ReturnCode.AIR) for code in (left.code, right.code)]
    assert any(felt)
    sizes = [float(np.linalg.norm(each.reading[0])) for each in (left, right)]
    assert max(sizes) > 20
    np.testing.assert_allclose(right.T_w_t[0], left.T_w_t[0] @ beside(0.0), atol=1e-6)
