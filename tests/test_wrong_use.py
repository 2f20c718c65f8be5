"""What a newcomer does wrong with commands and functions is answered in one sentence, at once, and leaves nothing.

`COMMANDS` and `PATCHES` are the list. One process tries all commands, one after another, in a folder of their own.
"""

import json
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import trimesh

import i2t
from i2t import geometry
from i2t.collect.touch import SeenPatch
from i2t.convert.commands import main as convert
from i2t.depth.camera import Camera
from i2t.depth.patches import DepthPatch, DepthView
from i2t.patches.dimensions import REACH, VIEW_PIXELS
from i2t.patches.views import PatchView, centre
from i2t.prediction import user_input
from i2t.prediction.baselines import MeanReading
from i2t.prediction.predictor import Predictor, Reading
from i2t.runtime.batching import size_classes
from i2t.types import Patch, Surface

ROOT = Path(__file__).parents[1]
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT)}
# What is typed after `python -m`, and a word of the answer. Files that exist: mesh.stl (mm), other/mesh.stl, table.csv,
# text.txt, empty/ (a folder), one/ (presses of one shape).
COMMANDS = [
    ("i2t nonsense", "is not a command"),
    ("i2t colect", "did you mean collect?"),
    ("i2t.collect --object hamer", "did you mean hammer?"),
    ("i2t.collect --rig mesh.stl", "is the mesh of an object, not a text file"),
    ("i2t.collect --arm emulatd", "--arm emulatd is not known; did you mean emulated?"),
    ("i2t imagine --force 1N", "'1N' is not a number; give one, without a unit"),
    ("i2t fit nodir", "DATASET nodir: there is no such"),
    ("experiments.recognize lve", "lve is no part of python -m experiments.recognize; did you mean live?"),
    ("i2t.convert presses table.csv DATA --indenter sphere:4 --board reskn", "did you mean reskin?"),
    ("experiments.recognize --pad-model text.txt", "is a file and holds no finished run"),
    ("i2t.collect --touches -5", "--touches"),
    ("i2t.collect --settings.force 1000", "force"),
    ("i2t.collect --object nothing.stl", "neither a mesh file nor an object"),
    ("i2t.collect --object mesh.stl", "unit"),
    ("i2t.collect --out text.txt", "is a file"),
    ("i2t.hardware.reskin --seconds -1", "--seconds"),
    ("i2t.convert summary nowhere", "no such file or folder"),
    ("i2t.convert presses table.csv DATA --indenter ball:4", "give sphere:RADIUS"),
    ("i2t.convert presses table.csv . --indenter sphere:4", "which no conversion wrote"),
    ("experiments.train --seeds 0", "--seeds is 0"),
    ("experiments.train --dataset nowhere", "no such data set"),
    ("experiments.train --skin-name left", "no effect without --dataset"),
    ("experiments.recognize --pad-model nowhere", "holds no finished run"),
    ("experiments.recognize --objects mesh.stl other/mesh.stl --unit mm", "both called mesh"),
    ("experiments.calibrate --dataset table.csv --targets weight", "is no target"),
    ("experiments.fidelity --dataset nowhere", "nowhere"),
    ("experiments.calibrate --prior --simulated", "pass one of"),
    ("experiments.registration frames --data empty", "is missing"),
    ("experiments.benchmark --sections speed", "speed"),
    ("tools.reproduce --only nothing", "there is no step nothing"),
    ("tools.snippets READNE", "there is no page READNE; did you mean README?"),
    ("i2t.imagine --board grid-2x2", "name the board that it was trained on"),
    ("i2t.imagine --board anyskin", "differs from the board of the predictor of nominal, reskin"),
    ("i2t.imagine --model nowhere", "there is no such folder"),
    ("i2t.imagine --model empty", "holds no predictor"),
    ("i2t.imagine --at 0 0 30 --sites 2", "--at names the only touch; leave --sites out"),
    ("i2t.imagine --model nominall", "did you mean nominal"),
    ("i2t.view empty", "is an empty folder"),
    ("i2t.place text.txt --object hammer --host h", "text.txt"),
    ("i2t.hardware.hand_eye board b.png --dictionary nothing", "nothing"),
    ("i2t.hardware.touch_off", "--height"),
    ("i2t.hardware.realsense --file nothing.bag", "nothing.bag"),
    ("i2t.emulators.lab --link text.txt", "exists and is not a link"),
    ("tools.gallery --only nothing", "nothing"),
    ("tools.ready_models --eflesh nowhere", "no such folder"),
    ("experiments.reconstruct --dataset mesh.stl", "is the mesh of an object"),
    ("experiments.tsne --dataset table.csv", "is a table"),
    ("experiments.shapes --dataset one", "shape"),
]  # fmt: skip

# Those that have to read data, a model or a mesh before they can refuse.
MAY_IMPORT_JAX = ("i2t.imagine --board grid-2x2", "i2t.imagine --board anyskin", "experiments.shapes --dataset one")


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A working folder with the files that the list names."""
    here = tmp_path_factory.mktemp("here")
    box = trimesh.creation.box((30, 30, 30))
    (here / "other").mkdir()
    (here / "empty").mkdir()
    box.export(here / "mesh.stl")
    box.export(here / "other" / "mesh.stl")
    names = "x_mm,y_mm,travel_mm," + ",".join(f"b{chip}{axis}_uT" for chip in range(5) for axis in "xyz")
    rows = [f"{x},{-x},0.{x + 3}," + ",".join(str(10 * x + i) for i in range(15)) for x in range(-2, 3)]
    (here / "table.csv").write_text("\n".join([names, *rows]) + "\n")
    (here / "text.txt").write_text("no data at all\n")
    assert (
        convert(["presses", str(here / "table.csv"), str(here / "one"), "--indenter", "sphere:4", "--as-stated"]) == 0
    )
    return here


# Runs commands in one process, and says of each how it ended, what it printed, and what is loaded by then.
IN_ONE = """
import contextlib, io, json, sys
from importlib import import_module
from importlib.util import find_spec

said = []
for words in json.load(sys.stdin):
    module, *args = words.split()
    out, err = io.TextIOWrapper(io.BytesIO(), encoding="utf-8"), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            package = find_spec(module).submodule_search_locations
            code = import_module(f"{module}.__main__" if package else module).main(args)
        except SystemExit as ended:
            code = ended.code
    loaded = [name for name in ("jax", "numpy", "scipy", "trimesh") if name in sys.modules]
    said.append((words, code, err.getvalue(), loaded))
json.dump(said, sys.stdout)
"""


def in_one_process(commands: list[str], cwd: Path) -> list[tuple[str, int | None, str, list[str]]]:
    """Words of each command, with its exit code, printed errors, and the heavy libraries that were loaded."""
    done = subprocess.run(
        [sys.executable, "-c", IN_ONE],
        input=json.dumps(commands), cwd=cwd, env=ENVIRONMENT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def judged(code: int | None, printed: str, said: str) -> bool:
    """Whether the output is a refusal in one sentence."""
    if printed.startswith(("╭", "+")):  # tyro's, of words that it cannot read
        return code == 2 and said in " ".join(re.sub(r"[│|]", " ", printed).split())
    sentence = printed.startswith("error: ") and printed.count("\n") == 1 and said in printed
    return code == 2 and sentence and "[Errno" not in printed


def contents(here: Path) -> set[str]:
    return {str(path.relative_to(here)) for path in here.rglob("*")}


@pytest.mark.full
def test_wrong_commands_are_answered_in_one_sentence_before_jax_is_imported_and_leave_nothing(folder):
    before = contents(folder)
    answers = dict(COMMANDS)
    assert len(answers) == len(COMMANDS)
    wrong = []
    for words, code, printed, loaded in in_one_process(sorted(answers, key=MAY_IMPORT_JAX.__contains__), folder):
        late = "jax" in loaded and words not in MAY_IMPORT_JAX
        if late or not judged(code, printed, answers[words]):
            wrong.append((words, code, printed[-300:], loaded))
    assert wrong == []
    words, said = COMMANDS[0]  # in a process of its own
    typed = [sys.executable, "-m", *words.split()]
    ended = subprocess.run(typed, cwd=folder, env=ENVIRONMENT, capture_output=True, text=True, check=False)
    assert judged(ended.returncode, ended.stderr, said), ended.stderr
    assert contents(folder) == before


HELPED = ("i2t", "i2t collect", "i2t convert", "experiments.train", "experiments.recognize", "experiments.studies",
          "experiments.calibrate", "experiments.fidelity", "experiments.tsne")  # fmt: skip


def test_help_imports_neither_jax_nor_numpy():
    """The help therefore appears at once."""
    for words, code, printed, loaded in in_one_process([f"{module} --help" for module in HELPED], ROOT):
        assert (words, code or 0, printed, loaded) == (words, 0, "", [])


FULL_DISK = """
import resource, signal, sys
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
sys.dont_write_bytecode = True  # Python would cut modules that it compiles, and others would read them
resource.setrlimit(resource.RLIMIT_FSIZE, (512, 512))
from i2t.convert.commands import main
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.full
def test_a_conversion_to_a_full_disk_ends_in_one_sentence(folder, tmp_path):
    """No file may grow past 512 bytes here."""
    words = ["presses", str(folder / "table.csv"), str(tmp_path / "out"), "--indenter", "sphere:4"]
    command = [sys.executable, "-c", FULL_DISK, *words]
    ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert "Traceback" not in ended.stderr
    assert ended.returncode == 1, ended.stderr
    assert ended.stderr.count("\n") == 1
    assert not [path for path in (tmp_path / "out").rglob("*") if path.is_file()]
    assert convert(words) == 0  # the next attempt is not in its way


# Whoever starts the tests in the background of a script has told them, and their children, to ignore Ctrl-C.
HEARS_CTRL_C = """
import runpy, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
runpy.run_module("experiments.train", run_name="__main__", alter_sys=True)
"""


@pytest.mark.full
@pytest.mark.skipif(not Path("/proc").is_dir(), reason="looks at the process through /proc")
def test_ctrl_c_ends_a_run_in_one_sentence(tmp_path):
    """This holds at any time after the command has begun; here, while it imports JAX."""
    command = [sys.executable, "-c", HEARS_CTRL_C, "--preset", "debug", "--out", str(tmp_path / "run")]
    with subprocess.Popen(command, cwd=tmp_path, env=ENVIRONMENT, stderr=subprocess.PIPE, text=True) as process:
        while process.poll() is None and "jaxlib" not in Path(f"/proc/{process.pid}/maps").read_text():
            time.sleep(0.02)
        process.send_signal(signal.SIGINT)
        _, printed = process.communicate(timeout=300)
    assert process.returncode == 130, printed
    assert "Traceback" not in printed
    assert "interrupted" in printed.splitlines()[-1]


# --- functions ---


VIEW = np.zeros((72, 72), np.float32)
FLAT = np.zeros((48, 48), np.float32)
WHOLE = np.ones((48, 48), bool)


@pytest.fixture(scope="module")
def predictor() -> Predictor:
    """The simplest predictor; refusals do not depend on the model."""
    baseline = MeanReading(np.arange(15.0), np.ones(15))
    return Predictor(baseline, 17e-3, REACH, default_force=1.0, default_travel=0.3e-3)


@pytest.fixture(scope="module")
def box() -> i2t.Mesh:
    """60 mm in each direction, standing on z = 0."""
    solid = trimesh.creation.box((60e-3, 60e-3, 60e-3))
    return i2t.Mesh(np.asarray(solid.vertices) + np.array([0, 0, 30e-3]), np.asarray(solid.faces, np.int32))


def on_top(height: float = 0.0, up: bool = False) -> np.ndarray:
    """The tool above the middle of the box's top at this height, facing down or up."""
    at = np.array([0.0, 0, 60e-3 + height])
    return np.asarray(geometry.contact_frame(at, np.array([0.0, 0, -1.0 if up else 1.0])), np.float32)


def sized(**sizes: float) -> DepthPatch:
    """A flat patch from a depth image that states its size."""
    patch = DepthPatch(Patch(FLAT, np.float32(0)), WHOLE, ~WHOLE)
    for name, size in sizes.items():
        setattr(patch, name, size)
    return patch


PATCHES: list[tuple[dict[str, Any], str]] = [
    ({"patch": np.full((48, 48), REACH)}, "shows no surface"),
    ({"patch": np.linspace(0, 4, 48 * 48).reshape(48, 48)}, "divide millimetres by 1000"),
    ({"patch": -np.linspace(0, 4e-3, 48 * 48).reshape(48, 48)}, "negative"),
    ({"patch": np.linspace(2e-3, 4e-3, 48 * 48).reshape(48, 48)}, "counts from that point"),
    ({"patch": np.full((48, 48), np.nan)}, "NaN"),
    ({"patch": FLAT, "force": 1e6}, "bears at most"),
    ({"patch": FLAT, "force": [1.0, 2.0]}, "one for each of 1"),
    ({"patch": FLAT, "force": 0.0}, "force is 0 N; a skin is pressed"),
    ({"patch": FLAT, "force": -1.0}, "force is -1 N; a skin is pressed"),
    ({"patch": FLAT, "force": np.nan}, "force is not finite"),
    ({"patch": FLAT, "force": 60.0}, "give at most 40 N"),
    ({"patch": FLAT, "nearest": -0.3}, "give metres"),
    ({"patch": FLAT, "nearest": 0.936}, "begins 936 mm in front of the skin"),
    ({"patch": Patch(FLAT, np.float32(0.936))}, "begins 936 mm in front of the skin"),
    ({"patch": Patch(FLAT, np.float32(-0.02))}, "begins 20 mm behind the skin"),
    ({"patch": Patch(FLAT[None].repeat(3, 0), np.float32([0, 0.5, 0]))}, "skin at this pose (touch 1)"),
    ({"patch": DepthPatch(Patch(FLAT, np.float32(0.2)), WHOLE, ~WHOLE)}, "begins 200 mm in front of the skin"),
    ({"patch": PatchView(Patch(FLAT, np.float32(0.2)), VIEW)}, "begins 200 mm in front of the skin"),
    ({"patch": DepthView(PatchView(Patch(FLAT, np.float32(0.2)), VIEW), VIEW == 0)}, "begins 200 mm in front"),
    ({"patch": SeenPatch(FLAT, VIEW, 0.2, 1.0)}, "begins 200 mm in front of the skin"),
    ({"patch": [Patch(FLAT, 0.0), SeenPatch(FLAT, VIEW, 0.0, 1.0)]}, "lists of one kind"),
    ({"patch": DepthPatch(Patch(FLAT + REACH, np.float32(np.inf)), ~WHOLE, ~WHOLE)}, "no pixel of the patch was seen"),
    ({"patch": sized(window=34e-3)}, "its window is 34 mm, and the model was trained on patches of 17 mm"),
    ({"patch": sized(reach=2e-3)}, "its reach is 2 mm, and the model was trained on patches of 4 mm"),
    ({"patch": [sized(window=17e-3), sized(window=34e-3)]}, "its window is 34 mm"),
    ({"patch": DepthPatch(Patch(FLAT, np.float32(0)), WHOLE & (np.arange(48) < 3), ~WHOLE)}, "only 6 % of the patch"),
    ({"patch": FLAT, "view": np.full((72, 72), np.nan)}, "NaN or infinite where the patch is"),
    ({"patch": FLAT, "view": np.zeros((72, 71))}, "view has shape"),
    ({"patch": FLAT, "view": VIEW + 2e-3}, "differs from the patch in its middle"),
    ({"patch": FLAT, "valid": np.zeros((48, 48), bool)}, "no pixel of the patch was seen"),
]  # fmt: skip


@pytest.mark.parametrize(("given", "said"), PATCHES, ids=[said for _, said in PATCHES])
def test_an_invalid_patch_is_refused_in_one_sentence(predictor, given, said):
    with pytest.raises(ValueError, match=re.escape(said)) as refused:
        predictor.predict(**given)
    assert "\n" not in str(refused.value)


def test_a_force_far_beyond_training_is_warned_of(predictor):
    with pytest.warns(UserWarning, match="only a guess"):
        predictor.predict(FLAT, force=30.0)


def test_a_force_beyond_the_largest_of_training_is_warned_of_and_four_times_that_refused(predictor):
    trained = replace(predictor, metadata={"force_range": [0.2, 2.0]})
    trained.predict(FLAT, force=2.0)
    with pytest.warns(UserWarning, match="at most 2 N: its prediction .* only a guess"):
        trained.predict(FLAT, force=2.5)
    with pytest.raises(ValueError, match="give at most 8 N, or train on harder presses"):
        trained.predict(FLAT[None].repeat(2, 0), force=[1.0, 10.5])
    with pytest.raises(ValueError, match="force is -1 N; a skin is pressed, not pulled; give a pressing force"):
        trained.predict(FLAT, force=-1.0)


def test_a_patch_given_whole_predicts_the_same_as_its_parts(predictor):
    """The patch may be one, many, or a list; an unknown distance counts as none."""
    depth = np.linspace(0, 3e-3, 48 * 48, dtype=np.float32).reshape(48, 48)
    mask, view = np.arange(48 * 48).reshape(48, 48) < 2000, VIEW.copy()
    centre(view, 48)[:] = depth
    seen = VIEW == 0
    seen[12:-12, 12:-12] = mask
    patch, nearest = Patch(depth, np.float32(-2e-4)), -2e-4
    for whole, parts in (
        (patch, {"nearest": nearest}),
        (Patch(depth, np.nan), {}),
        (DepthPatch(patch, mask, ~mask), {"nearest": nearest, "valid": mask}),
        (PatchView(patch, view), {"nearest": nearest, "view": view}),
        (DepthView(PatchView(patch, view), seen), {"nearest": nearest, "view": view, "valid": mask}),
        (SeenPatch(depth, view, nearest, 1.0), {"nearest": nearest, "view": view}),
    ):
        expected, single = predictor.predict(depth, force=1.0, **parts), predictor.predict(whole, force=1.0)
        many = predictor.predict([whole, whole], force=[1.0, 1.0])
        np.testing.assert_array_equal(single, expected)
        assert single.mean.shape == (15,)
        np.testing.assert_array_equal(many.mean, np.stack([single.mean] * 2))
    with pytest.warns(UserWarning, match="begins 3 mm in front of the skin"):
        predictor.predict(Patch(depth, 3e-3), force=1.0)
    predictor.predict(Patch(depth, 3e-3), force=1.0, nearest=0.0)  # as a user says


@pytest.mark.parametrize("unit", [1e-4, 1e-3])
def test_a_depth_image_in_another_unit_is_refused(predictor, unit):
    """The surface is where the skin is; the image is ten times as far, and the message states it with the unit."""
    camera, stored = Camera(424, 240, 215.0, 215.0, 211.5, 119.5), np.full((240, 424), 1040, np.uint16)
    T_w_c, T_w_t = np.eye(4), np.eye(4)
    T_w_t[2, 3] = 0.104
    seen = i2t.patch_from_depth((stored * unit).astype(np.float32), camera, T_w_c, T_w_t)
    if unit == 1e-4:
        assert predictor.predict(seen, force=1.0).mean.shape == (15,)
    else:
        with pytest.raises(ValueError, match=r"begins 936 mm in front .* correct the unit of the depth image"):
            predictor.predict(seen, force=1.0)


def seen(height: float) -> PatchView:
    """A flat at a height above the tool's origin (m, along tool z)."""
    return PatchView(Patch(FLAT, np.float32(height)), np.zeros((VIEW_PIXELS, VIEW_PIXELS), np.float32))


def test_the_position_of_the_skin_is_judged_by_the_faces_before_and_behind_it(box):
    corners = Surface(np.asarray(box.vertices)[box.faces])
    for pose, height in ((on_top(), 0.0), (on_top(0.9e-3), 0.9e-3), (on_top(-3e-3), -3e-3)):
        user_input.check_in_front(corners, pose, seen(height), 17e-3)
    with pytest.warns(UserWarning, match="begins 6 mm in front of the skin .* meets nothing and reads zero"):
        user_input.check_in_front(corners, on_top(6e-3), seen(6e-3), 17e-3)
    inverted = Surface(corners.triangles[:, ::-1])
    user_input.check_in_front(inverted, on_top(), seen(0.0), 17e-3)  # of a mesh turned inside out nobody knows
    half = Surface(corners.triangles[:6])
    user_input.check_in_front(half, on_top(up=True), seen(0.0), 17e-3)


@pytest.mark.parametrize("overlap", [0.0, 2e-3])
def test_what_stands_out_next_to_a_point_is_named(box, overlap):
    """A wall of 15 or 100 mm on the box, 6 mm from the tool; the bodies touch or overlap."""
    corners = np.asarray(box.vertices)[box.faces]
    for height in (15e-3, 100e-3):
        wall = trimesh.creation.box((10e-3, 60e-3, height + overlap))
        wall.apply_translation([11e-3, 0, 60e-3 + (height - overlap) / 2])
        both = np.concatenate([corners, wall.triangles])
        depth = np.full((48, 48), REACH, np.float32)
        depth[:, 41:] = 0  # the top of the lower wall
        view = PatchView(Patch(depth, np.float32(-min(height, 40e-3))), VIEW.astype(np.float32))
        said = rf"within the skin's 20 mm stands out by {1e3 * height:g} mm at this pose.*; choose a point farther"
        with pytest.raises(ValueError, match=said):
            user_input.check_in_front(Surface(both), on_top(), view, 17e-3)
    with pytest.raises(ValueError, match=r"table=False keeps its file's frame"):
        user_input.check_in_front(Surface(corners), on_top(30e-3), seen(30e-3), 17e-3)
    at_wall = on_top()
    at_wall[0, 3] = 11e-3
    with pytest.raises(ValueError, match="from inside the object"):  # at the bottom of the wall, within both bodies
        user_input.check_in_front(Surface(both), at_wall, seen(0.0), 17e-3)


@pytest.mark.full
def test_a_pose_on_the_surface_is_taken_and_one_without_contact_refused_in_one_sentence(predictor, box):
    """The poses are one or many, a little in the air or in the object."""
    assert predictor.predict_touch(box, on_top(-3e-3)).mean.shape == (15,)
    with pytest.warns(UserWarning, match="begins 3 mm in front of the skin"):
        assert predictor.predict_touch(box, on_top(3e-3)).mean.shape == (15,)
    many = predictor.predict_touch(box, np.stack([on_top(), on_top(0.5e-3), on_top()]), force=[1.0, 2.0, 3.0])
    assert many.mean.shape == many.std.shape == (3, 15)
    for pose, said in (
        (on_top(0.5), "500 mm in front"),
        (on_top(-20e-3), "20 mm behind"),
        (on_top(up=True), "from inside the object"),
        (on_top(-60e-3), "from inside the object"),
        (np.diag([2.0, 2, 2, 1]), "not a rigid motion"),
        (on_top().T, "perhaps it is transposed"),
        (on_top() * [1, 1, 1, 1e3] + np.diag([0, 0, 0, -999.0]), "divide millimetres by 1000"),
        (np.full((4, 4), np.nan), "not a rigid motion"),
        (np.eye(3), "shape"),
        (on_top() + np.array([[0, 0, 0, 1.0], *np.zeros((3, 4))]), "nothing lies in front"),
    ):
        with pytest.raises(ValueError, match=said) as refused:
            predictor.predict_touch(box, pose, force=1.0)
        assert "\n" not in str(refused.value)


@pytest.mark.full
def test_meshes_and_files_are_accepted_in_the_frame_of_load_mesh(predictor, box, tmp_path):
    solid = trimesh.Trimesh(1e3 * (box.vertices + np.array([0.5, 0.2, 0.1])), box.faces)
    solid.export(tmp_path / "box.stl")
    loaded = i2t.load_mesh(tmp_path / "box.stl", "mm")
    np.testing.assert_allclose(np.ptp(loaded.vertices, axis=0), 60e-3, rtol=1e-6)
    open3d = SimpleNamespace(vertices=list(box.vertices), triangles=list(box.faces))  # as its meshes look
    for mesh in (loaded, trimesh.Trimesh(box.vertices, box.faces), open3d, tmp_path / "box.stl"):
        unit = "mm" if isinstance(mesh, Path) else None
        assert predictor.predict_touch(mesh, on_top(), unit=unit).mean.shape == (15,)
    with pytest.raises(ValueError, match="metres"):
        predictor.predict_touch(trimesh.Trimesh(1e3 * box.vertices, box.faces), on_top())
    with pytest.raises(ValueError, match="unit is that of a file"):
        predictor.predict_touch(box, on_top(), unit="mm")
    with pytest.raises(ValueError, match="its unit is missing"):
        predictor.predict_touch(tmp_path / "box.stl", on_top())
    bodies = [trimesh.creation.box((30, 30, 30)), trimesh.creation.box((30, 30, 29))]
    bodies[1].apply_translation((60, 0, 0))
    trimesh.util.concatenate(bodies).export(tmp_path / "two.stl")
    both = i2t.load_mesh(tmp_path / "two.stl", "mm")  # no body is left out
    top = i2t.contact_pose(both, both.vertices[both.vertices[:, 2].argmax()])
    assert (predictor.predict_touch(tmp_path / "two.stl", top, unit="mm").std > 0).all()


def test_a_new_number_of_touches_asks_the_model_for_one_of_three_sizes(predictor, monkeypatch):
    asked = []
    ask = Predictor.predict_batch
    monkeypatch.setattr(
        Predictor, "predict_batch", lambda self, batch: asked.append(len(batch.patch)) or ask(self, batch)
    )
    force = np.linspace(0.5, 1.5, 100)
    for n in (1, 5, 9, 100):
        seen = predictor.predict(np.repeat(FLAT[None], n, 0), force=force[:n])
        assert seen.mean.shape == seen.std.shape == (n, 15)
    assert set(asked) == {1, 8, 64}
    for n in (*range(1, 20), 63, 64, 65, 149):  # each touch is asked for once, in its place
        rows = np.concatenate(list(size_classes(n)))
        np.testing.assert_array_equal(rows, np.minimum(np.arange(len(rows)), n - 1))


def test_unmeasured_pixels_widen_the_predicted_spread(monkeypatch, predictor):
    """The spread grows with the effect that an object there would have."""
    patch = np.linspace(0, 3e-3, 48 * 48, dtype=np.float32).reshape(48, 48)
    mask = np.ones((48, 48), bool)
    mask[30:] = False

    def by_mean_depth(self, batch):
        mean = np.tile(1e4 * batch.patch.mean((1, 2))[:, None], (1, 15))
        return Reading(mean, np.ones_like(mean))

    monkeypatch.setattr(Predictor, "predict_batch", by_mean_depth)
    whole, part = predictor.predict(patch), predictor.predict(patch, valid=mask)
    empty, continued = (1e4 * one.mean() for one in user_input.fill_unseen(patch[None], mask, REACH))
    assert empty > continued > 0
    np.testing.assert_allclose(whole.std, 1.0)
    np.testing.assert_allclose(part.std, np.hypot(1.0, (empty - continued) / 2), rtol=1e-5)
    np.testing.assert_allclose(part.mean, (empty + continued) / 2, rtol=1e-5)
    np.testing.assert_array_equal(predictor.predict(patch, valid=np.ones((48, 48), bool)).mean, whole.mean)
    mask[8:] = False
    with pytest.warns(UserWarning, match="only 17 % of the patch was seen"):
        predictor.predict(patch, valid=mask)
