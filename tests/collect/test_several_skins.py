"""Several skins on one tool: each is read in each touch with its own board, and a set is loaded for one of them."""

import re
from dataclasses import replace
from functools import partial
from itertools import count

import numpy as np
import pytest
from helpers.closed_form import GAIN, HEIGHT, QUIET, listed, make, names, site
from helpers.spring_plane import SpringPlane

from i2t import dataset
from i2t.collect import command, recorder
from i2t.collect.recorder import Recorder, list_touches, read_raw
from i2t.collect.touch import SkinOnTool
from i2t.convert import commands
from i2t.dataset import SkinChoiceError
from i2t.depth.camera import Camera
from i2t.emulators.in_process import SimulatedSkin, SkinInLab
from i2t.errors import DeviceTimeoutError
from i2t.hardware.carried_skins import CarriedSkin
from i2t.hardware.contract import refuse
from i2t.hardware.poses import pose_from_vector
from i2t.hardware.rig import Rig
from i2t.hardware.rig_checks import implausible_values
from i2t.skin.boards import make_board
from i2t.types import ReturnCode

ASIDE_M = 0.02  # of the second skin, along the tool's x
SQUARE = make_board("grid-2x2")
SQUARE_GAIN = np.linspace(14, -11, 12)  # uT/N
STIFFNESS = 10e3


def beside(out_by: float) -> np.ndarray:
    """T_tool_skin of a skin that protrudes by this distance (m) in front of the one at the tool."""
    return pose_from_vector([ASIDE_M, 0.0, out_by, 0.0, 0.0, 0.0])


def two(out_by: float):
    """A procedure over a springy plane with a second skin of four chips on the tool."""
    procedure = make()
    plane = SpringPlane(HEIGHT, STIFFNESS, SQUARE_GAIN, QUIET, SQUARE)
    lab = procedure.arm.lab
    skin = SimulatedSkin(lab, lab.carry(SkinInLab(plane, beside(out_by), seed=1)))
    skin.connect()
    procedure.skins.append(SkinOnTool("right", skin, SQUARE, beside(out_by), pad="right pad"))
    procedure.rig = replace(procedure.rig, skin="left")
    return procedure


def info_of(procedure):
    info = names(procedure)
    about = {
        name: replace(info_of_skin, meta={"skin": f"{name or 'left'}'s", dataset.SKIN_NAME: name or procedure.rig.skin})
        for name, info_of_skin in info.skins.items()
    }
    return replace(info, skins=about)


def touched(folder, procedure, touches=1):
    """The last of several touches."""
    with Recorder(folder, info_of(procedure), procedure.clock) as recording:
        outcomes = list(procedure.run(listed(*map(site, range(touches))), recording))
    return outcomes[-1].touch


@pytest.mark.parametrize("out_by", [-5e-3, 2e-3])
def test_the_skin_that_protrudes_stops_the_press_and_has_its_force(tmp_path, out_by):
    touch = touched(tmp_path, two(out_by))
    right = touch.skins["right"]
    pair = ((touch.skins[""], GAIN), (right, SQUARE_GAIN))
    (felt, gain), (silent, _) = pair if out_by < 0 else pair[::-1]
    assert (felt.code, silent.code) == (ReturnCode.SKIN, ReturnCode.AIR)
    np.testing.assert_allclose(felt.reading, felt.force * gain, rtol=1e-3)
    np.testing.assert_allclose(felt.travel, felt.force / STIFFNESS, atol=5e-6)
    np.testing.assert_allclose(silent.reading, 0, atol=1e-6)
    assert np.isnan(silent.travel)
    assert np.isnan(silent.force) or silent.force == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_allclose(right.T_w_s, touch.T_w_t @ beside(out_by), atol=1e-12)
    np.testing.assert_allclose(right.seen.nearest, right.T_w_s[2, 3] - HEIGHT, atol=1e-9)
    record = dataset.read_touch(list_touches(tmp_path)[0])
    assert f"stopped by skin {'left' if out_by < 0 else 'right'}" in [text for _, text in record.events]
    assert [name for name in record.counters if "seen" in name] == ["skin right seen percent"]


def test_the_force_of_a_press_that_two_skins_feel_is_unknown(tmp_path):
    """For two springs in parallel, the arm measures their sum, and the torque of the one that is off the axis."""
    touch = touched(tmp_path, two(0.0))
    right = touch.skins["right"]
    assert touch.code == right.code == ReturnCode.SKIN
    assert np.isnan([touch.force, right.force]).all()
    sunk = HEIGHT - touch.T_w_t[2, 3]
    np.testing.assert_allclose(touch.reading, STIFFNESS * sunk * GAIN, rtol=1e-3)
    np.testing.assert_allclose(right.reading, STIFFNESS * sunk * SQUARE_GAIN, rtol=1e-3)
    wrench = dataset.read_touch(list_touches(tmp_path)[0]).series["wrench"].values
    deepest = wrench[np.argmin(wrench[:, 2])]
    np.testing.assert_allclose(deepest[2], -2 * STIFFNESS * sunk, rtol=0.02)
    np.testing.assert_allclose(deepest[4], ASIDE_M * STIFFNESS * sunk, rtol=0.02)  # r x F, x aside and F against z


def test_a_second_skin_that_falls_silent_ends_the_press_and_its_samples_are_kept(tmp_path):
    procedure = two(-5e-3)
    skin, since, looks = procedure.skins[1].skin, procedure.skins[1].skin.since, count()

    def fading(number):
        skin.silent = next(looks) >= 60
        return since(number)

    skin.since = fading
    with Recorder(tmp_path, info_of(procedure), procedure.clock) as recording:
        with pytest.raises(DeviceTimeoutError, match="silent"):
            procedure.touch(site(0), recording.begin(site(0), 0))
        assert procedure.arm.state().T_b_t[2, 3] > HEIGHT  # nothing was pressed
    (raw,) = (tmp_path / recorder.INTERRUPTED).iterdir()
    rows = [part for kind, part in read_raw(raw) if kind == "skin right"]
    assert sum(map(len, rows)) > 100
    assert {part.shape[1] for part in rows} == {2 + 4 * 4}


def test_a_set_keeps_each_skin_with_its_board_and_is_loaded_by_its_name(tmp_path):
    """The skin at the tool is where every version reads it; a set without a skin's name has no further skins."""
    both = tmp_path / "both"
    touch = touched(both, two(2e-3), 2)
    record = dataset.read_touch(list_touches(both)[-1])
    right = record.skins["right"]
    assert right.pads == ("right pad",)
    assert right.meta["skin"] == "right's"
    np.testing.assert_allclose(right.touches.reading[0], touch.skins["right"].reading, rtol=1e-6)
    np.testing.assert_allclose(right.touches.T_w_t[0], touch.skins["right"].T_w_s, atol=1e-7)
    np.testing.assert_allclose(record.touch.touches.reading[0], touch.reading, rtol=1e-6)
    assert [record.series[name].values.shape[1] for name in ("tactile", "tactile right")] == [15, 12]
    assert len(record.series["tactile right"].time) > 400
    alone = record.of_skin("right")
    assert alone.touch is right
    assert alone.series["tactile"] is record.series["tactile right"]
    sets = [dataset.load_dataset(both, skin=name) for name in ("left", "right")]
    assert [(touches.board.num_chips, len(touches)) for touches in sets] == [(5, 2), (4, 2)]
    dataset.save_dataset(tmp_path / "packed" / "right.h5", sets[1])
    for again in (None, "right"):  # a set of one skin is named, and need not be
        packed = dataset.load_dataset(tmp_path / "packed", skin=again)
        np.testing.assert_array_equal(packed.touches.reading, sets[1].touches.reading)
    procedure, load = make(), dataset.load_dataset
    with Recorder(tmp_path / "one", names(procedure), procedure.clock) as recording:
        list(procedure.run(listed(site(0)), recording))
    choices = [
        (load, (both,), r"touch-.*holds touches of 2 skins, left and right; name one with"),
        (partial(load, skin="thumb", skip_bad=True), (both,), "'thumb' but the skin left and right; name one of"),
        (partial(load, skin="left"), (tmp_path / "one",), "'left' but one skin without a name; leave out --skin-name"),
    ]
    refuse(SkinChoiceError, choices)


@pytest.fixture
def rig(tmp_path):
    """Writes the rig of a lab with a second skin."""

    def write(device, address="", **options):
        right = CarriedSkin("right", device, beside(0.0), "grid-2x2", address, pad="right pad", **options)
        lab = replace(Rig(), camera=Camera(160, 90, 161.2, 161.0, 79.5, 44.5), skin="left", skins=(right,))
        path = tmp_path / f"{device}.toml"
        lab.write(path)
        return path

    return write


@pytest.mark.parametrize(("old", "new", "sentence"), [
    ('address = "/dev/ttyACM1"', "", "skins.right identifies no board; add its address or its serial_number"),
    ('pad = "right pad"', 'serial_number = "E6"', "skins.right has an address and a serial_number; keep one"),
    ("  [1.0, 0.0, 0.0, 0.02]", "  [2.0, 0.0, 0.0, 0.02]", "skins.right.T_tool_skin: is not a rigid motion"),
])  # fmt: skip
def test_a_rig_with_skins_is_read_back_and_an_impossible_one_refused(rig, old, new, sentence):
    path = rig("reskin", "/dev/ttyACM1")
    text = path.read_text()
    assert Rig.read(path).text() == text
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(ValueError, match=f"^{re.escape(str(path))}: .*{re.escape(sentence)}"):
        Rig.read(path)


@pytest.mark.parametrize(("device", "flags", "sentence"), [
    ("simulated", ["--arm", "ur", "--host", "127.0.0.1", "--skin", "reskin"], "skins.right.device is simulated"),
    ("emulated", ["--arm", "ur", "--host", "127.0.0.1", "--skin", "reskin"], "emulated, which does not work with this"),
    ("nobody's", [], "skins.right.device nobody's is not known; give a name that"),
])  # fmt: skip
def test_skins_that_do_not_work_with_the_arm_are_refused(rig, tmp_path, capsys, device, flags, sentence):
    path = rig(device, "/dev/ttyACM1" if device == "reskin" else "")
    assert command.main(["--rig", str(path), "--out", str(tmp_path / "out"), "--object", "cylinder", *flags]) == 2
    assert sentence in capsys.readouterr().err


def test_a_skin_that_protrudes_too_far_or_overlaps_another_is_doubted():
    turned = (np.pi, 0.0, 0.0)  # on the other side of a finger, where it presses nothing
    for rotation, where, sentence in (
        (np.zeros(3), (0.0, 0.0, 0.05), "puts it 50 mm in front of the skin that presses"),
        (np.zeros(3), (0.002, 0.0, 0.0), "puts it 2 mm from the skin at the tool, in its place"),
        (np.zeros(3), (ASIDE_M, 0.0, 0.0), None),
        (turned, (0.0, 0.0, -0.005), None),
    ):
        T = pose_from_vector([*where, *rotation])
        doubts = implausible_values(replace(Rig(), skins=(CarriedSkin("right", "simulated", T),)))
        assert [sentence in doubt for doubt in doubts] == ([True] if sentence else [])


@pytest.mark.full
def test_two_simulated_skins_are_collected_and_packed_unless_one_is_dead(rig, tmp_path, capsys, monkeypatch):
    path, out = rig("simulated"), tmp_path / "out"
    words = ["--rig", str(path), "--out", str(out), "--object", "cylinder", "--skip-first-touch",
             "--board", "grid-4x4"]  # fmt: skip
    assert command.main([*words, "--touches", "1"]) == 0
    assert "the skin right, the simulated skin: at rest 400 Hz" in capsys.readouterr().out
    felt = [dataset.load_dataset(out, skin=name).touches.reading for name in ("left", "right")]
    assert [reading.shape for reading in felt] == [(1, 48), (1, 12)]
    assert max(map(np.linalg.norm, felt)) > 15
    assert commands.main(["pack", str(out), str(tmp_path / "packed"), "--skin-name", "right"]) == 0
    assert dataset.load_dataset(tmp_path / "packed").board.num_chips == 4
    read = SimulatedSkin.read

    def dead(self, count, timeout=None):
        samples = read(self, count, timeout)
        return samples._replace(reading=0 * samples.reading) if self.board.num_chips == 4 else samples

    monkeypatch.setattr(SimulatedSkin, "read", dead)
    assert command.main([*words, "--touches", "2"]) == 1
    assert "skins: the skin right, the simulated skin: every chip" in capsys.readouterr().err
