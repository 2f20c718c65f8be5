"""`import i2t`: what it gives, what it costs, and that each name says what it takes and gives."""

import ast
import inspect
import json
import re
import subprocess
import sys
import textwrap
import typing
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np
import pytest

import i2t
from i2t import _HOME_OF
from i2t.skin.elasticity import GRID
from i2t.skin.pad import press_force
from i2t.types import one_line

FUNCTIONS = sorted(name for name in i2t.__all__ if inspect.isfunction(getattr(i2t, name)))


def test_all_names_are_there_and_only_these():
    assert sorted(i2t.__all__) == sorted(_HOME_OF)
    assert set(i2t.__all__) <= set(dir(i2t))
    with pytest.raises(AttributeError, match="no attribute 'render'"):
        _ = i2t.render


def test_importing_it_loads_nothing_heavy():
    code = "import sys; before = set(sys.modules); import i2t; print(*sorted(set(sys.modules) - before))"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    heavy = {"jax", "numpy", "scipy", "trimesh", "tyro", "h5py", "matplotlib"}
    assert not heavy & {name.split(".")[0] for name in loaded}
    assert len(loaded) < 40


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_function_says_its_arguments_what_it_returns_and_an_example(name):
    function = getattr(i2t, name)
    text = inspect.getdoc(function) or ""
    for section in ("Args:", "Returns:", "Example:"):
        assert section in text or (section == "Returns:" and name.startswith("save_")), f"{name} has no {section}"
    stated = text[text.index("Args:") :]
    for parameter in inspect.signature(function).parameters:
        assert re.search(rf"^\s+\*{{0,2}}{parameter}(, \w+)*:", stated, re.M), f"{name}: {parameter} is not in Args"


def _public_code() -> list[tuple[str, Any]]:
    """Public functions and the public methods of public classes."""
    found = [(name, getattr(i2t, name)) for name in FUNCTIONS]
    for name in sorted(set(i2t.__all__) - set(FUNCTIONS)):
        methods = inspect.getmembers(getattr(i2t, name), inspect.isfunction)
        found += [(f"{name}.{each}", method) for each, method in methods if not each.startswith("_")]
    return found


def test_what_raises_says_so():
    raising = []
    for name, function in _public_code():
        body = ast.parse(textwrap.dedent(inspect.getsource(inspect.unwrap(function))))
        if any(isinstance(node, ast.Raise) for node in ast.walk(body)):
            raising.append(name)
            assert "Raises:" in (inspect.getdoc(function) or ""), f"{name} raises and does not say what"
    assert len(raising) > 8


# What may be given by position: the data. Everything else, how it is done, is named.
DATA = {
    "anyskin_board": ("depth",),
    "calibrate": ("positions", "loads", "readings"),
    "contact_pose": ("mesh", "point"),
    "load_calibration": ("path",),
    "load_dataset": ("path",),
    "load_mesh": ("path", "unit"),
    "load_pad": ("path",),
    "load_pad_model": ("path",),
    "load_predictor": ("directory",),
    "make_object": ("name",),
    "nominal_pad": ("pattern",),
    "patch_from_depth": ("depth", "camera", "T_w_c", "T_w_t"),
    "pose_at_pixel": ("depth", "camera", "T_w_c", "pixel"),
    "prepare_surface": ("mesh",),
    "press": ("pad", "height", "indentation"),
    "register_by_depth": ("mesh", "T_w_o", "depth", "camera", "T_w_c"),
    "register_by_touch": ("key", "surface", "T_w_o", "T_w_contact", "weight"),
    "render_patch": ("surface", "T_w_t"),
    "reskin_board": ("depth",),
    "sample_pad": ("key",),
    "sample_touch_sites": ("mesh", "n"),
    "save_dataset": ("path", "dataset"),
    "save_pad": ("path", "pad"),
    "simulate_touches": ("key", "objects", "pad", "errors", "n"),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_after_the_data_arguments_are_named(name):
    parameters = inspect.signature(getattr(i2t, name)).parameters
    positional = [each for each, parameter in parameters.items() if parameter.kind is parameter.POSITIONAL_OR_KEYWORD]
    assert tuple(positional) == DATA[name]


ERRORS = {"DataError", "DeviceError", "I2TError"}
CLASSES = sorted(name for name in i2t.__all__ if inspect.isclass(getattr(i2t, name)) and name not in ERRORS)


@pytest.mark.parametrize("name", [*FUNCTIONS, *CLASSES])
def test_an_example_is_python_that_names_the_public_face(name):
    text = inspect.getdoc(getattr(i2t, name)) or ""
    assert "Example:\n" in text, f"{name} has no example"
    code = textwrap.dedent(text.split("Example:\n", 1)[1])
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "i2t":
            assert node.attr in i2t.__all__, f"{name}: the example uses i2t.{node.attr}"
        called = ast.unparse(node.func).removeprefix("i2t.") if isinstance(node, ast.Call) else ""
        if called in i2t.__all__ and not _starred(node):
            keywords = {keyword.arg: None for keyword in node.keywords}
            inspect.signature(getattr(i2t, called)).bind(*node.args, **keywords)


def _starred(call: ast.Call) -> bool:
    return any(isinstance(each, ast.Starred) for each in call.args) or any(each.arg is None for each in call.keywords)


CUBE = i2t.prepare_surface(i2t.make_object("square").mesh)


def _dome() -> np.ndarray:
    x = GRID.centres
    return ((x[:, None] ** 2 + x[None] ** 2) / 8e-3).astype(np.float32)


@pytest.mark.parametrize(
    "call",
    [
        pytest.param(lambda: i2t.press(i2t.nominal_pad(), _dome(), 0.3e-3), id="press"),
        pytest.param(lambda: press_force(i2t.nominal_pad(), _dome(), 0.5), id="press_force"),
        pytest.param(lambda: i2t.render_patch(CUBE, np.eye(4, dtype=np.float32), pixels=8), id="render_patch"),
    ],
)
def test_a_function_that_is_called_again_compiles_nothing(call, caplog):
    call()
    with jax.log_compiles(), caplog.at_level("WARNING"):
        call()
    assert [record.message for record in caplog.records if record.message.startswith("Compiling")] == []


def _classes_in(hint: Any) -> Iterator[type]:
    if inspect.isclass(hint) and hint.__module__.startswith("i2t"):
        yield hint
    for part in typing.get_args(hint):
        yield from _classes_in(part)


def _returned(function: Any) -> Iterator[type]:
    yield from _classes_in(typing.get_type_hints(inspect.unwrap(function)).get("return"))


def _public_classes() -> set[type]:
    """All classes that somebody meets who starts at the public face: what it names, returns and holds."""
    found: set[type] = set()
    new = {getattr(i2t, name) for name in CLASSES} | {
        each for name in FUNCTIONS for each in _returned(getattr(i2t, name))
    }
    while new:
        kind = new.pop()
        found.add(kind)
        members = [getattr(each, "fget", each) for name, each in inspect.getmembers(kind) if not name.startswith("_")]
        held = [each for hint in typing.get_type_hints(kind).values() for each in _classes_in(hint)]
        held += [each for member in members if inspect.isfunction(member) for each in _returned(member)]
        new |= set(held) - found
    return found


def test_every_class_of_arrays_shows_itself_in_one_line():
    tuples = {kind for kind in _public_classes() if issubclass(kind, tuple)}
    assert len(tuples) > 30
    assert {kind.__name__ for kind in tuples if kind.__repr__ is not one_line} == set()


STAR = i2t.make_object("star")


@pytest.mark.parametrize(
    "make",
    [
        lambda: STAR,
        lambda: STAR.mesh,
        lambda: CUBE,
        lambda: i2t.reskin_board(),
        lambda: i2t.nominal_pad(),
        lambda: i2t.load_pad_model("nominal"),
        lambda: i2t.load_pad_model("nominal").model,
        lambda: i2t.load_predictor("nominal"),
        lambda: i2t.load_predictor("nominal").model,
        lambda: i2t.load_calibration("eflesh"),
        lambda: i2t.load_calibration("eflesh").gp,
        lambda: i2t.sample_touch_sites(STAR.mesh, 2),
        lambda: i2t.press(i2t.nominal_pad(), _dome(), 0.3e-3),
        lambda: i2t.Camera(640, 360, 322.4, 322.1, 319.5, 179.5),
    ],
    ids=lambda make: inspect.getsource(make).strip() if inspect.isfunction(make) else "",
)
def test_what_it_gives_is_shown_in_one_line_without_numbers_of_arrays(make):
    text = repr(make())
    assert "\n" not in text
    assert "array(" not in text.lower()
    assert len(text) < 700
    assert text.startswith(type(make()).__name__)


# Calls that nobody means, each with the argument that the message names. They run without the tests' type checks, which
# a user does not have.
MISUSE = """
import json
import warnings

import jax
import numpy as np

import i2t

warnings.simplefilter("ignore")
mesh, key, eye = i2t.make_object("star").mesh, jax.random.key(0), np.eye(4)
surface, pad, predictor = i2t.prepare_surface(mesh), i2t.nominal_pad(), i2t.load_predictor("nominal")
camera, image = i2t.Camera(8, 6, 10.0, 10.0, 3.5, 2.5), np.full((6, 8), 0.1, np.float32)
patch, top, height = np.zeros((48, 48)), (0, 0, 30e-3), np.zeros((40, 40))
place, depth, reading = np.zeros((4, 2)), np.full(4, 1e-3), np.zeros((4, 15))
calls = {CALLS}
said = []
for name, call in calls:
    try:
        eval(call)
    except Exception as error:
        said.append((name, call, type(error).__name__, str(error)))
    else:
        said.append((name, call, "nothing", ""))
print(json.dumps(said))
"""

REFUSALS = ("ValueError", "TypeError", "FileNotFoundError")
CALLS = [
    ("n", "i2t.sample_touch_sites(mesh, -1)"),
    ("n", "i2t.sample_touch_sites(mesh, 0)"),
    ("n", "i2t.sample_touch_sites(mesh, 2.5)"),
    ("n", "i2t.sample_touch_sites(mesh, True)"),
    ("seed", "i2t.sample_touch_sites(mesh, 2, seed=-1)"),
    ("key", "i2t.simulate_touches(0, [surface], pad, i2t.DataError, 4)"),
    ("n", "i2t.simulate_touches(key, [surface], pad, None, -4)"),
    ("n", "i2t.simulate_touches(key, [surface], pad, None, [1, 2])"),
    ("n", "i2t.simulate_touches(key, [surface], pad, None, '4')"),
    ("objects", "i2t.simulate_touches(key, [], pad, None, 4)"),
    ("touches_per_session", "i2t.simulate_touches(key, [surface], pad, None, 4, touches_per_session=0)"),
    ("force", "predictor.predict(patch, force='1')"),
    ("force", "predictor.predict(patch, force=[1.0, 2.0])"),
    ("force", "predictor.predict(patch, force=float('nan'))"),
    ("depth", "predictor.predict(patch, depth='deep')"),
    ("patch", "predictor.predict('patch')"),
    ("patch", "predictor.predict([[0.0], [0.0, 1.0]])"),
    ("wide", "predictor.predict(patch, wide='all')"),
    ("T_w_t", "predictor.predict_touch(mesh, 'here')"),
    ("height", "i2t.press(pad, 'flat', 1e-3)"),
    ("height", "i2t.press(pad, height[:9], 1e-3)"),
    ("height", "i2t.press(pad, height * np.nan, 1e-3)"),
    ("indentation", "i2t.press(pad, height, float('nan'))"),
    ("indentation", "i2t.press(pad, height, '1e-3')"),
    ("indentation", "i2t.press(pad, height, [1e-3, 2e-3])"),
    ("strength", "i2t.nominal_pad(strength='strong')"),
    ("key", "i2t.sample_pad(0)"),
    ("spread", "i2t.sample_pad(key, spread=-1.0)"),
    ("depth", "i2t.reskin_board('3.5')"),
    ("depth", "i2t.reskin_board(-3.5e-3)"),
    ("depth", "i2t.anyskin_board(float('nan'))"),
    ("T_w_t", "i2t.render_patch(surface, 'here')"),
    ("pixels", "i2t.render_patch(surface, eye, pixels=-1)"),
    ("pixels", "i2t.render_patch(surface, eye, pixels='48')"),
    ("window", "i2t.render_patch(surface, eye, window=float('nan'))"),
    ("reach", "i2t.render_patch(surface, eye, reach='4')"),
    ("mesh", "i2t.prepare_surface('star')"),
    ("point", "i2t.contact_pose(mesh, 'top')"),
    ("roll", "i2t.contact_pose(mesh, top, roll='quarter')"),
    ("normal", "i2t.contact_pose(mesh, top, normal='up')"),
    ("mesh", "i2t.contact_pose('star', top)"),
    ("pixel", "i2t.pose_at_pixel(image, camera, eye, 'middle')"),
    ("roll", "i2t.pose_at_pixel(image, camera, eye, (3, 3), roll='quarter')"),
    ("T_w_c", "i2t.pose_at_pixel(image, camera, 'here', (3, 3))"),
    ("depth", "i2t.pose_at_pixel('image', camera, eye, (3, 3))"),
    ("camera", "i2t.pose_at_pixel(image, 'D405', eye, (3, 3))"),
    ("depth", "i2t.patch_from_depth(1e3 * image, camera, eye, eye)"),
    ("depth", "i2t.patch_from_depth('image', camera, eye, eye)"),
    ("camera", "i2t.patch_from_depth(image, 'D405', eye, eye)"),
    ("T_w_t", "i2t.patch_from_depth(image, camera, eye, 2 * eye)"),
    ("pixels", "i2t.patch_from_depth(image, camera, eye, eye, pixels=0)"),
    ("camera", "i2t.Camera(640, 360, 'fx', 1, 1, 1)"),
    ("camera", "i2t.Camera(-640, 360, 1, 1, 1, 1)"),
    ("translation_std", "i2t.register_by_depth(mesh, eye, image, camera, eye, translation_std=-1.0)"),
    ("T_w_o", "i2t.register_by_depth(mesh, 'here', image, camera, eye)"),
    ("depth", "i2t.register_by_depth(mesh, eye, 1e3 * image, camera, eye)"),
    ("key", "i2t.register_by_touch(0, surface, eye, eye[None], [1.0], translation_std=1e-3, rotation_std=0.1)"),
    ("contact_std", "i2t.register_by_touch(key, surface, eye, eye[None], np.ones(1), translation_std=1e-3, "
     "rotation_std=0.1, contact_std=0.0)"),
    ("readings", "i2t.calibrate(place, depth, 'readings', load_kind='depth')"),
    ("positions", "i2t.calibrate('here', depth, reading, load_kind='depth')"),
    ("loads", "i2t.calibrate(place, ['a', 'b', 'c', 'd'], reading, load_kind='depth')"),
    ("positions", "i2t.load_calibration('eflesh').predict('here', 1e-3)"),
    ("key", "i2t.ObjectRecognizer(0, i2t.load_pad_model('nominal').model, {'a': mesh, 'b': mesh})"),
    ("pad_model", "i2t.ObjectRecognizer(key, i2t.load_pad_model('nominal'), {'a': mesh, 'b': mesh})"),
    ("meshes", "i2t.ObjectRecognizer(key, i2t.load_pad_model('nominal').model, [mesh, mesh])"),
    ("T_w_o", "i2t.ObjectRecognizer(key, i2t.load_pad_model('nominal').model, {'a': mesh, 'b': mesh}, T_w_o=2 * eye)"),
    ("object", "i2t.make_object('mugg')"),
    ("pattern", "i2t.nominal_pad('checkers')"),
    ("name", "i2t.load_mesh('mug.stl', 'mm')"),
]  # fmt: skip


def test_what_nobody_means_is_refused_in_one_sentence_that_names_it():
    code = MISUSE.replace("{CALLS}", repr(CALLS))
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    wrong = []
    for name, call, kind, message in json.loads(done.stdout):
        named = re.search(rf"(?<![a-z_]){name}", message) and len(message) < 500 and "\n" not in message
        if kind not in REFUSALS or not named or "; " not in message:
            wrong.append((call, kind, message[:300]))
    assert wrong == []
    asked = {name for name in FUNCTIONS for _, call in CALLS if f"i2t.{name}(" in call}
    of_files = {name for name in FUNCTIONS if name.startswith(("load_", "save_"))}  # tests/test_hostile_files.py
    assert set(FUNCTIONS) - asked <= of_files
