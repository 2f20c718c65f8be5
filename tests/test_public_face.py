"""`import i2t`: what it gives, what it costs, how it shows itself, and what it refuses."""

import inspect
import json
import re
import subprocess
import sys
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

import i2t
from i2t import _HOME_OF
from i2t.skin.elasticity import GRID
from i2t.skin.pad import press_force
from i2t.types import one_line

ROOT = Path(__file__).parents[1]
FUNCTIONS = sorted(name for name in i2t.__all__ if inspect.isfunction(getattr(i2t, name)))


def test_all_names_are_there_and_only_these():
    assert sorted(i2t.__all__) == sorted(_HOME_OF)
    assert set(i2t.__all__) <= set(dir(i2t))
    with pytest.raises(AttributeError, match="no attribute 'render'"):
        _ = i2t.render


def _loaded_by(code: str) -> set[str]:
    """Top names of what a new process has loaded after some code."""
    words = [sys.executable, "-c", f"{code}\nimport sys; print(*sys.modules)"]
    loaded = subprocess.run(words, capture_output=True, text=True, check=True, cwd=ROOT).stdout.split()
    return {name.split(".")[0] for name in loaded}


def test_importing_it_loads_nothing_heavy():
    assert not {"jax", "numpy", "scipy", "trimesh", "tyro", "h5py", "matplotlib"} & _loaded_by("import i2t")


def test_types_data_sets_objects_and_the_hardware_side_import_no_jax():
    """So tools of devices start at once, and run where no JAX is."""
    modules = ["i2t.types", "i2t.errors", "i2t.skin.boards"]
    for package in ("dataset", "objects", "hardware"):
        paths = sorted((ROOT / "i2t" / package).rglob("*.py"))
        names = [".".join(path.relative_to(ROOT).with_suffix("").parts) for path in paths if path.stem != "__main__"]
        modules += [name.removesuffix(".__init__") for name in names]
    assert len(modules) > 20
    imported = _loaded_by(f"import importlib\nfor name in {modules!r}: importlib.import_module(name)")
    assert not {"jax", "jaxlib"} & imported


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


def test_after_the_data_arguments_are_named():
    given = {name: inspect.signature(getattr(i2t, name)).parameters.values() for name in FUNCTIONS}
    positional = {
        name: tuple(each.name for each in parameters if each.kind is each.POSITIONAL_OR_KEYWORD)
        for name, parameters in given.items()
    }
    assert positional == DATA


ERRORS = {"DataError", "DeviceError", "I2TError"}
CLASSES = sorted(name for name in i2t.__all__ if inspect.isclass(getattr(i2t, name)) and name not in ERRORS)


CUBE = i2t.prepare_surface(i2t.make_object("square").mesh)


def _dome() -> np.ndarray:
    x = GRID.centres
    return ((x[:, None] ** 2 + x[None] ** 2) / 8e-3).astype(np.float32)


def test_a_function_that_is_called_again_compiles_nothing(caplog):
    for call in (
        lambda: i2t.press(i2t.nominal_pad(), _dome(), 0.3e-3),
        lambda: press_force(i2t.nominal_pad(), _dome(), 0.5),
        lambda: i2t.render_patch(CUBE, np.eye(4, dtype=np.float32), pixels=8),
    ):
        call()
        with jax.log_compiles(), caplog.at_level("WARNING"):
            call()
        assert [record.message for record in caplog.records if record.message.startswith("Compiling")] == []
        caplog.clear()


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


def test_what_it_gives_is_shown_in_one_line_without_numbers_of_arrays():
    star, predictor, pad_model = i2t.make_object("star"), i2t.load_predictor("nominal"), i2t.load_pad_model("nominal")
    calibration = i2t.load_calibration("eflesh")
    for value in (
        star, star.mesh, CUBE, i2t.reskin_board(), i2t.nominal_pad(), pad_model, pad_model.model, predictor,
        predictor.model, predictor.predict(np.zeros((48, 48))), calibration, calibration.gp,
        i2t.sample_touch_sites(star.mesh, 2), i2t.press(i2t.nominal_pad(), _dome(), 0.3e-3),
        i2t.render_patch(CUBE, np.eye(4, dtype=np.float32), pixels=8), i2t.Camera(640, 360, 322.4, 322.1, 319.5, 179.5),
    ):  # fmt: skip
        text = repr(value)
        assert "\n" not in text
        assert "array(" not in text.lower()
        assert len(text) < 700
        assert text.startswith(type(value).__name__)


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
