"""The command with its simulated defaults: it collects, resumes, makes dry runs, and refuses wrong options."""

import json
import os
import signal
import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace

import jax
import numpy as np
import pytest
import trimesh
from helpers import random_touches

from i2t import dataset
from i2t.cli.exit_codes import exit_code_of
from i2t.collect import command, folder_notes, recorder, session
from i2t.collect.arguments import CollectArgs, LabArgs
from i2t.collect.devices import Devices
from i2t.collect.out_folder import NOTES_FILE
from i2t.collect.site_plan import SiteSampler
from i2t.collect.start import begin
from i2t.collect.touch import SkinOnTool, UnreachableError
from i2t.depth.camera import Camera
from i2t.emulators.in_process import SimulatedSkin
from i2t.errors import DataError
from i2t.hardware.carried_skins import CarriedSkin
from i2t.hardware.contract import refuse
from i2t.hardware.rig import Rig
from i2t.hardware.world import WorldArgs
from i2t.objects.solids import Mesh, highest_point
from i2t.simulation.site_limits import SiteLimits
from i2t.skin.boards import grid_board
from i2t.skin.files import save_pad
from i2t.skin.pad import nominal_pad
from i2t.types import ReturnCode

BOX = Mesh(np.eye(3), np.array([[0, 1, 2]], np.int32))  # any mesh


def test_sites_keep_clear_of_a_piece_that_is_not_touched(tmp_path, capsys):
    plate, post = trimesh.creation.box((100, 60, 10)), trimesh.creation.cylinder(5, 150)
    plate.apply_translation((0, 0, 5))
    post.apply_translation((20, 0, 86))  # loose: 1 mm above the plate
    path = tmp_path / "plate.stl"
    trimesh.util.concatenate([plate, post]).export(path)
    world = WorldArgs(str(path), "mm", largest_piece=True)
    begun = begin(CollectArgs(out=tmp_path / "set", world=world))
    assert "moved by 0.00, 0.00, 0.00" not in capsys.readouterr().out
    T_w_o = np.eye(4)
    assert begun.target.mesh.vertices[:, 2].max() == pytest.approx(0.01)
    sampler = SiteSampler(begun.target, T_w_o, SiteLimits(), 0, "plate")
    assert sampler.top == pytest.approx(0.161)
    sites = np.stack([sampler.site(number).T_w_t for number in range(64)])
    assert np.abs(sites[:, 2, 3] - 0.01).max() < 1e-6  # none on the post, and none whose skin would meet it
    assert np.linalg.norm(sites[:, :2, 3] - (0.02, 0), axis=1).min() > SiteLimits().half_edge
    both = begin(CollectArgs(out=tmp_path / "set", world=replace(world, largest_piece=False))).target
    assert highest_point(both, T_w_o) == pytest.approx(0.161)
    low = replace(Rig(), limits=replace(Rig().limits, upper=(1.0, 1.0, 0.2)))
    low.write(tmp_path / "low.toml")
    with pytest.raises(UnreachableError, match="the box ends"):
        begin(CollectArgs(out=tmp_path / "set", world=world, lab=LabArgs(tmp_path / "low.toml")))


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    """The rig of the emulators with a smaller image."""
    path = tmp_path_factory.mktemp("rig") / "rig.toml"
    replace(Rig(), camera=Camera(160, 90, 161.2, 161.0, 79.5, 44.5)).write(path)
    return path


@pytest.mark.full
def test_a_collection_is_plausible_and_can_be_resumed(tmp_path, rig, capsys):
    """A hexagon is 30 mm high: the patch is where arm and rig report it, within their errors of a millimetre."""

    def run(*more, touches):
        words = ["--out", str(tmp_path / "set"), "--rig", str(rig), "--touches", str(touches), *more]
        code = command.main(words)
        return code, "".join(capsys.readouterr())

    code, output = run(touches=1)
    assert code == 0
    for sentence in ("SIMULATED: no real device takes part", "the simulated skin: at rest 400 Hz",
                     "top: met the object", "touch 1/1"):  # fmt: skip
        assert sentence in output
    first = dataset.load_dataset(tmp_path / "set")
    assert (len(first), first.source, first.objects) == (1, "simulated", ("hexagon",))
    assert json.loads(first.meta["settings"])["force"] == 8.0
    touches = first.touches
    assert np.isin(touches.code, [ReturnCode.SKIN, ReturnCode.WRENCH]).all()
    assert (np.linalg.norm(touches.reading, axis=1) > 15).all()
    assert ((touches.force > 0.05) & (touches.force < 10)).all()
    assert ((touches.travel > 0) & (touches.travel < 1.5e-3)).all()
    assert (np.abs(touches.nearest + touches.travel) < 4e-3).all()  # placement and camera 1 mm each, and 0.3 mm noise
    assert (touches.T_w_t[:, 2, 2] < -0.2).all()
    assert run(touches=2)[0] == 0
    data = dataset.load_dataset(tmp_path / "set")
    assert (len(data), len(data.sessions)) == (2, 1)
    np.testing.assert_array_equal(data.touches.reading[:1], touches.reading)
    assert [recorder.site_number_of(path) for path in recorder.list_touches(tmp_path / "set")] == [0, 1]
    code, output = run(touches=2)
    assert code == 0
    assert "there already" in output
    code, output = run("--object", "star", touches=2)
    assert code == 2
    assert "begun with another object" in output
    (tmp_path / "set" / NOTES_FILE).unlink()
    code, output = run(touches=2)
    assert code == 2
    assert "holds touches that this command did not collect" in output


def test_a_defective_skin_stops_sessions_and_dry_runs(tmp_path, rig, capsys, monkeypatch):
    read = SimulatedSkin.read

    def frozen(self, count, timeout=None):
        samples = read(self, count, timeout)
        samples.reading.reshape(count, -1, 3)[:, 2] = 12.3
        return samples

    monkeypatch.setattr(SimulatedSkin, "read", frozen)
    options = ["--out", str(tmp_path / "set"), "--rig", str(rig), "--touches", "1"]
    assert command.main(options) == 1
    assert "skins: the simulated skin: chip 2" in capsys.readouterr().err
    assert not (tmp_path / "set").exists() or not recorder.list_touches(tmp_path / "set")
    assert command.main([*options, "--dry-run"]) == 1
    assert "BAD       skins: the simulated skin: chip 2" in capsys.readouterr().out


def test_a_folder_is_not_resumed_with_other_settings_rig_or_skin(tmp_path):
    args = CollectArgs(out=tmp_path)
    _, begun = folder_notes.resume(args, "hexagon", Rig(), BOX)
    folder_notes.write_notes(tmp_path, begun)
    harder = replace(args, settings=replace(args.settings, press=0.004, force=9.0))
    heavier, larger = replace(Rig(), mass=Rig().mass + 0.1), BOX._replace(vertices=1.1 * BOX.vertices)
    fingers = replace(Rig(), skins=(CarriedSkin("right", "simulated", np.diag([1.0, -1, -1, 1])),))
    others = [
        ((harder, "hexagon", Rig(), BOX), r"settings\.force and settings\.press|settings\.press and settings\.force"),
        *(((args, "hexagon", other, BOX), "begun with another rig") for other in (heavier, fingers)),
        ((args, "hexagon", Rig(), larger), "begun with another mesh"),  # of the same name, in another folder
    ]
    refuse(DataError, [(folder_notes.resume, *other) for other in others])
    patient = replace(args, settings=replace(args.settings, retries=9, patience=60.0))
    _, begun = folder_notes.resume(patient, "hexagon", Rig(), BOX)
    for kind, name in (("skin", ""), ("camera", ""), ("arm", ""), ("skin", "right")):
        for serial in ("", "A1", "", "A1"):  # a number that is known only later counts from then on
            device = SimpleNamespace(serial_number=serial)
            folder_notes.require_same(begun, folder_notes.device_notes(kind, device, name), tmp_path)
        other = folder_notes.device_notes(kind, SimpleNamespace(serial_number="B2"), name)
        with pytest.raises(
            DataError, match=rf"begun with another {kind}_serial.*: A1, now B2\); use the earlier value"
        ):
            folder_notes.require_same(begun, other, tmp_path)
    for board in (grid_board(2, 2), grid_board(2, 2)):
        folder_notes.require_same(begun, folder_notes.board_notes(SkinOnTool("", None, board)), tmp_path)
    with pytest.raises(DataError, match="begun with another layout of chips"):
        folder_notes.require_same(begun, folder_notes.board_notes(SkinOnTool("", None, grid_board(2, 3))), tmp_path)
    assert folder_notes.rig_hash(Rig()) == "5fb9684045"  # as written when a key was still called travel


def test_a_dry_run_moves_nothing_and_writes_no_touch(tmp_path, rig, capsys):
    assert command.main(["--out", str(tmp_path / "dry"), "--rig", str(rig), "--touches", "5", "--dry-run"]) == 0
    output = capsys.readouterr().out
    for sentence in ("nothing was moved", "0 of 5 cannot be reached", "a collision at 10 N/mm ends at 30 N at most"):
        assert sentence in output
    assert "BAD" not in output
    assert (tmp_path / "dry-rig.png").stat().st_size > 10_000
    assert not (tmp_path / "dry").exists()


@pytest.mark.full
def test_sigterm_stops_a_collection_and_keeps_everything(tmp_path, rig, capsys):
    args = CollectArgs(out=tmp_path / "stopped", lab=LabArgs(rig), touches=5, skip_first_touch=True)

    def work() -> int:
        return session.collect(begin(args), on_outcome=lambda _: os.kill(os.getpid(), signal.SIGTERM))

    assert exit_code_of(work) == 128 + signal.SIGTERM
    assert len(dataset.load_dataset(tmp_path / "stopped")) == 1
    assert "the same command resumes the collection" in capsys.readouterr().out


def test_a_touch_without_contact_has_no_travel_and_no_force_in_its_line(capsys):
    recorder = SimpleNamespace(saved=[SimpleNamespace(name="touch-1.h5")], bytes=0)
    progress = session._Session(SimpleNamespace(touches=2), None, None, recorder, set())
    for code, force, travel in ((ReturnCode.SKIN, 0.7249, 0.1731e-3), (ReturnCode.AIR, np.nan, np.nan)):
        touch = SimpleNamespace(skins={"": SimpleNamespace(code=code, reading=np.array([3.0, np.nan, 4.0]))})
        touch.force, touch.travel = force, travel
        progress.report(SimpleNamespace(site=SimpleNamespace(number=code), code=code, touch=touch, reason=""))
    met, missed = capsys.readouterr().out.splitlines()
    assert "stopped by the skin  5.0 uT  0.72 N  0.17 mm  " in met
    assert "no contact  5.0 uT  " in missed
    assert not {"nan", "N", "mm"} & set(missed.split())


def test_wrong_options_are_refused_before_jax_is_imported(tmp_path):
    """They are speeds beyond what the rig can stop, another seed, another pad, and unknown devices."""
    args = CollectArgs(out=tmp_path)
    folder_notes.write_notes(tmp_path, begin(args).notes)
    wrong = {
        "--settings.press .05": "stopped at 8 N would end at 34 N",
        "--seed 1": "was begun with another seed (seed: 0, now 1); use the earlier value",
        "--pad-name red": "was begun with another pad-name (pad-name: simulated pad 0, now red); use the earlier value",
        "--arm nobody": "--arm nobody is not known",
        "--camera nobody": "--camera nobody is not known",
        "--trust-rig": "--trust-rig is called --accept-unusual-rig now",
        "--sites.half .01": "--sites.half is called --sites.half-edge now",
    }
    program = (
        "import sys; from i2t.collect.command import main; "
        "codes = [main(['--out', sys.argv[1], *words.split()]) for words in sys.argv[2:]]; "
        "print('jax' in sys.modules, *codes)"
    )
    words = [sys.executable, "-c", program, str(tmp_path), *wrong]
    run = subprocess.run(words, capture_output=True, text=True, check=True)
    assert run.stdout == "False 2 2 2 2 2 2 2\n"
    for line, sentence in zip(run.stderr.splitlines(), wrong.values(), strict=True):
        assert sentence in line


def test_a_folder_of_an_earlier_version_is_resumed_with_its_pad_and_site_limits(tmp_path):
    args = CollectArgs(out=tmp_path)
    begun = {key: value for key, value in begin(args).notes.items() if key != "pad-name"}
    begun["sites"] = {"half" if limit == "half_edge" else limit: value for limit, value in begun["sites"].items()}
    folder_notes.write_notes(tmp_path, begun)
    assert begin(replace(args, pad_name="red")).notes["pad-name"] == "red"  # nobody knows
    random = random_touches.make(1)
    touch = replace(random, pads=("blue",), touches=random.touches._replace(pad=np.zeros(1)))
    dataset.write_touch(tmp_path, dataset.Record(touch, counters={"site": 3}))
    with pytest.raises(DataError, match=r"begun with another pad-name \(pad-name: blue, now red\)"):
        begin(replace(args, pad_name="red"))
    assert begin(replace(args, pad_name="blue")).notes["pad-name"] == "blue"


@pytest.fixture(scope="module")
def four_chips(tmp_path_factory):
    """A folder with a rig, and a pad on another board."""
    folder = tmp_path_factory.mktemp("pad")
    Rig().write(folder / "lab.toml")
    save_pad(folder / "four_chips.npz", jax.jit(lambda: nominal_pad(board=grid_board(2, 2)))())
    return folder


UR, RESKIN = "--arm ur --host 10.0.0.2", "--skin reskin --port /dev/skin"


@pytest.mark.parametrize(("wrong", "sentence"), [
    (f"--arm ur {RESKIN} --camera realsense", "pass --host"),
    (f"{UR} --rig lab.toml --skin emulated", "--skin is emulated, which does not work with this arm"),
    ("--arm emulated --skin emulated --host 10.0.0.2", "give both, or neither"),
    ("--skin emulated", "pass --arm emulated"),
    (f"{UR} --skin somewhere:Skin", "--skin somewhere:Skin: somewhere cannot be imported"),
    ("--arm emulated --skin emulated --pad four_chips.npz",
     "four_chips.npz: is a pad on a board of 4 chips, which differs from reskin, of 5; pass the --board"),
    ("--arm emulated", "--skin is simulated, which does not work with this arm; pass --arm simulated"),
    ("--settings.press 0.25", "settings.press is 0.25; give 0.0001 to 0.05"),
    ("--state-timeout 60", "--state-timeout is 60; give 0.02 to 5"),
    ("--pose 30 0 0 0 0 0", "--pose is 30 0 0"),
    ("--pose 0 0 0.2 0 0 0", "above the table"),
])  # fmt: skip
def test_contradictory_options_are_refused_in_one_sentence_before_the_start(
    tmp_path, capsys, monkeypatch, four_chips, wrong, sentence
):
    monkeypatch.chdir(four_chips)
    with pytest.raises(SystemExit) as ended:
        sys.exit(command.main(["--out", str(tmp_path / "set"), *wrong.split()]))
    assert ended.value.code == 2
    assert sentence in "".join(capsys.readouterr())
    assert not (tmp_path / "set").exists()


@pytest.mark.parametrize(("sources", "source"), [
    (("real", "real", "real"), "real"),
    (("real", "emulated", "real"), "mixed"),
    (("emulated", "emulated", "simulated"), "simulated"),
])  # fmt: skip
def test_touches_are_real_only_if_every_device_is(sources, source):
    arm, skin, camera = (SimpleNamespace(features=SimpleNamespace(source=source)) for source in sources)
    assert Devices(arm, (SimpleNamespace(skin=skin),), camera, None).source == source
