"""`import i2t`: its names, its cost, its texts, and its refusals."""

import inspect
import json
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import is_dataclass
from itertools import chain
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

import jax
import numpy as np
import pytest

import i2t
from i2t.skin.elasticity import GRID

ROOT = Path(__file__).parents[1]
FUNCTIONS = sorted(name for name in i2t.__all__ if inspect.isfunction(getattr(i2t, name)))


def test_the_public_names_are_exactly_those_listed():
    assert [name for name in i2t.__all__ if not hasattr(i2t, name)] == []
    assert set(i2t.__all__) == set(dir(i2t))
    with pytest.raises(AttributeError, match="i2t attribute render"):
        _ = i2t.render


def _loaded_by(code: str) -> set[str]:
    """Top names of what a new process has loaded after some code."""
    words = [sys.executable, "-c", f"{code}\nimport sys; print(*sys.modules)"]
    loaded = subprocess.run(words, capture_output=True, text=True, check=True, cwd=ROOT).stdout.split()
    return {name.split(".")[0] for name in loaded}


def test_importing_it_loads_nothing_heavy():
    assert not {"jax", "numpy", "scipy", "trimesh", "tyro", "h5py", "matplotlib"} & _loaded_by("import i2t")


def test_types_data_sets_objects_and_the_hardware_side_import_no_jax_and_no_sdk():
    """Device tools therefore start at once, and run without JAX and without other devices' libraries."""
    sdks = {"cv2", "serial", "pyrealsense2", "rtde_control", "rtde_receive"}
    modules = [
        "i2t.emulators.reskin_board",
        "i2t.types",
        "i2t.errors",
        "i2t.skin.boards",
        "i2t.collect.procedure",
        "i2t.collect.recorder",
    ]
    for package in ("dataset", "objects", "hardware"):
        paths = sorted((ROOT / "i2t" / package).rglob("*.py"))
        names = [".".join(path.relative_to(ROOT).with_suffix("").parts) for path in paths if path.stem != "__main__"]
        modules += [name.removesuffix(".__init__") for name in names]
    assert len(modules) > 20
    imported = _loaded_by(f"import importlib\nfor name in {modules!r}: importlib.import_module(name)")
    assert not {"jax", "jaxlib", *sdks} & imported


# What may be given by position: the data. Everything else, how it is done, is named.
DATA = {
    "anyskin_board": ("depth",),
    "calibrate": ("positions", "loads", "readings"),
    "contact_pose": ("mesh", "point"),
    "fit_pad_model": ("dataset", "meshes"),
    "fit_predictor": ("dataset", "split"),
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
    "prepare_surfaces": ("meshes",),
    "press": ("pad", "height", "indentation"),
    "recognize": ("meshes", "dataset", "pad_model"),
    "register_by_depth": ("mesh", "T_w_o", "depth", "camera", "T_w_c"),
    "register_by_touch": ("key", "surface", "T_w_o", "T_w_contact", "weight"),
    "register_session": ("touches", "surface"),
    "render_patch": ("surface", "T_o_t"),
    "reskin_board": ("depth",),
    "run_paper_loop": ("keys", "predictors", "surfaces", "pad"),
    "sample_pad": ("key",),
    "sample_touch_sites": ("mesh", "n"),
    "save_dataset": ("path", "dataset"),
    "save_pad": ("path", "pad"),
    "simulate_touches": ("key", "objects", "pad", "errors", "n"),
    "use_compile_cache": (),
}


def test_arguments_after_the_data_are_keyword_only():
    given = {name: inspect.signature(getattr(i2t, name)).parameters.values() for name in FUNCTIONS}
    positional = {
        name: tuple(each.name for each in parameters if each.kind is each.POSITIONAL_OR_KEYWORD)
        for name, parameters in given.items()
    }
    assert positional == DATA


SECOND_TIER = ("hardware", "paper", "prediction", "recognition", "simulation", "skin_models", "viz")
BUILT_BY = {  # results that no user constructs
    "Calibration": i2t.calibrate,
    "KnownPad": i2t.fit_pad_model,
    "PadModel": i2t.load_pad_model,
    "PredictorScore": i2t.fit_predictor,
    "RecognizedSessions": i2t.recognize,
}


def _classes(hint: Any) -> Iterator[type]:
    """The classes of i2t in an annotation."""
    for part in (*get_args(hint), get_origin(hint)):
        yield from chain(*map(_classes, part)) if isinstance(part, list) else _classes(part) if part else ()
    if isinstance(hint, type) and hint.__module__.startswith("i2t."):
        yield hint


def _calls(name: str) -> list[Callable[..., Any]]:
    """What a user calls by a name of the face: a function, or a class and its other constructors."""
    value = getattr(i2t, name)
    if not inspect.isclass(value) or name in BUILT_BY or inspect.isabstract(value):
        return [value] if inspect.isfunction(value) else []
    others = [method for method in vars(value).values() if isinstance(method, classmethod)]
    construct = vars(value).get("__init__", value)
    with_fields = is_dataclass(value) or issubclass(value, tuple)
    return [value if with_fields else construct, *(inspect.unwrap(method.__func__) for method in others)]


def test_every_type_that_its_functions_take_is_on_it():
    face = {getattr(i2t, name) for name in i2t.__all__}
    missing = {
        f"{name}({parameter}: {kind.__module__}.{kind.__qualname__})"
        for name in i2t.__all__
        for call in _calls(name)
        for parameter, hint in get_type_hints(call).items()
        if parameter != "return"
        for kind in _classes(hint)
        if kind not in face
    }
    assert missing == set()


def test_packages_of_the_second_tier_give_what_they_list():
    for name in SECOND_TIER:
        package = getattr(i2t, name)
        assert inspect.ismodule(package)
        assert len(package.__all__) > 10
        assert [each for each in package.__all__ if inspect.ismodule(getattr(package, each))] == []


def test_the_paper_on_one_page_needs_the_face_alone():
    page = (ROOT / "examples" / "00_the_paper.py").read_text()
    assert re.findall(r"^ *(?:from|import) .*", page, re.M) == ["import jax", "import i2t"]
    used = set(re.findall(r"\bi2t\.(\w+)", page))
    assert used <= {*i2t.__all__} - {*SECOND_TIER}


CUBE = i2t.prepare_surface(i2t.make_object("square").mesh)


def _dome() -> np.ndarray:
    x = GRID.centres
    return ((x[:, None] ** 2 + x[None] ** 2) / 8e-3).astype(np.float32)


def test_a_function_that_is_called_again_compiles_nothing(caplog):
    for call in (
        lambda: i2t.press(i2t.nominal_pad(), _dome(), 0.3e-3),
        lambda: i2t.render_patch(CUBE, np.eye(4, dtype=np.float32), pixels=8),
    ):
        call()
        with jax.log_compiles(), caplog.at_level("WARNING"):
            call()
        assert [record.message for record in caplog.records if record.message.startswith("Compiling")] == []
        caplog.clear()


def test_values_print_in_one_line_without_array_contents():
    calibration, predictor = i2t.load_calibration("eflesh"), i2t.load_predictor("nominal")
    for value in (i2t.make_object("star"), CUBE, i2t.nominal_pad(), predictor, predictor.model, calibration,
                  i2t.press(i2t.nominal_pad(), _dome(), 0.3e-3)):  # fmt: skip
        text = repr(value)
        assert "\n" not in text
        assert "array(" not in text.lower()
        assert len(text) < 700
        assert text.startswith(type(value).__name__)


def test_values_print_in_a_few_lines():
    pad = i2t.nominal_pad()
    for value in (i2t.load_calibration("eflesh"), i2t.load_pad_model("nominal"), i2t.load_predictor("nominal"), pad,
                  i2t.load_dataset("nominal"), i2t.press(pad, _dome(), 0.3e-3)):  # fmt: skip
        lines = str(value).splitlines()
        assert 2 <= len(lines) <= 4
        assert all(len(line) < 120 for line in lines)
        assert "chips" in str(value) or "values" in str(value)


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
dataset = i2t.load_dataset("nominal")
patch, top, height = np.zeros((48, 48)), (0, 0, 30e-3), np.zeros((40, 40))
place, travel, reading = np.zeros((4, 2)), np.full(4, 1e-3), np.zeros((4, 15))
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
    ("seed", "i2t.sample_touch_sites(mesh, 2, seed=-1)"),
    ("key", "i2t.simulate_touches(0, [surface], pad, i2t.DataError, 4)"),
    ("n", "i2t.simulate_touches(key, [surface], pad, None, -4)"),
    ("objects", "i2t.simulate_touches(key, [], pad, None, 4)"),
    ("touches_per_session", "i2t.simulate_touches(key, [surface], pad, None, 4, touches_per_session=0)"),
    ("patch", "predictor.predict('patch')"),
    ("view", "predictor.predict(patch, view='all')"),
    ("T_o_t", "predictor.predict_touch(mesh, 'here')"),
    ("height", "i2t.press(pad, 'flat', 1e-3)"),
    ("indentation", "i2t.press(pad, height, float('nan'))"),
    ("strength", "i2t.nominal_pad(strength='strong')"),
    ("key", "i2t.sample_pad(0)"),
    ("spread", "i2t.sample_pad(key, spread=-1.0)"),
    ("depth", "i2t.reskin_board(-3.5e-3)"),
    ("depth", "i2t.anyskin_board(float('nan'))"),
    ("T_o_t", "i2t.render_patch(surface, 'here')"),
    ("pixels", "i2t.render_patch(surface, eye, pixels=-1)"),
    ("mesh", "i2t.prepare_surface('star')"),
    ("mesh", "i2t.prepare_surfaces(['star'])"),
    ("meshes", "i2t.prepare_surfaces([])"),
    ("dataset", "i2t.fit_predictor(key, split=None)"),
    ("split", "i2t.fit_predictor(dataset, 'object')"),
    ("key", "i2t.fit_predictor(dataset, key=0)"),
    ("method", "i2t.fit_predictor(dataset, method='perfect')"),
    ("method", "i2t.fit_predictor(dataset, method=None)"),
    ("dataset", "i2t.load_predictor('nominal').score(reading)"),
    ("dataset", "i2t.fit_pad_model({'star': mesh})"),
    ("meshes", "i2t.recognize([mesh, mesh], dataset, i2t.load_pad_model('nominal'))"),
    ("meshes", "i2t.recognize({'star': mesh}, dataset, i2t.load_pad_model('nominal'))"),
    ("pad_model", "i2t.recognize({'star': mesh, 'b': mesh}, dataset, i2t.load_pad_model('nominal').model)"),
    ("keys", "i2t.run_paper_loop(key, {}, {'star': surface}, pad, reading_std=reading, episodes=2)"),
    ("episodes_per_pool", "i2t.run_paper_loop(jax.random.split(key, 3), {}, {'star': surface}, pad, "
     "reading_std=reading, episodes=2, episodes_per_pool=0)"),
    ("reading_std", "i2t.run_paper_loop(jax.random.split(key, 3), {}, {'star': surface}, pad, "
     "reading_std=0 * reading, episodes=2)"),
    ("predictors", "i2t.run_paper_loop(jax.random.split(key, 3), {'proprioception': None}, {'star': surface}, pad, "
     "reading_std=reading, episodes=2)"),
    ("rule", "i2t.PaperEpisodes(np.zeros(1), np.zeros(1), np.zeros((1, 1, 2))).hits('vote')"),
    ("surfaces", "i2t.run_paper_loop(jax.random.split(key, 3), {}, {}, pad, reading_std=reading, episodes=2)"),
    ("point", "i2t.contact_pose(mesh, 'top')"),
    ("pixel", "i2t.pose_at_pixel(image, camera, eye, 'middle')"),
    ("camera", "i2t.patch_from_depth(image, 'D405', eye, eye)"),
    ("camera", "i2t.Camera(640, 360, 'fx', 1, 1, 1)"),
    ("translation_std", "i2t.register_by_depth(mesh, eye, image, camera, eye, translation_std=-1.0)"),
    ("contact_std", "i2t.register_by_touch(key, surface, eye, eye[None], np.ones(1), translation_std=1e-3, "
     "rotation_std=0.1, contact_std=0.0)"),
    ("touches", "i2t.register_session([eye], surface)"),
    ("readings", "i2t.calibrate(place, travel, 'readings', load_kind='travel')"),
    ("positions", "i2t.load_calibration('eflesh').predict('here', 1e-3)"),
    ("meshes", "i2t.ObjectRecognizer(key, i2t.load_pad_model('nominal').model, [mesh, mesh])"),
    ("T_w_o", "i2t.ObjectRecognizer(key, i2t.load_pad_model('nominal').model, {'a': mesh, 'b': mesh}, T_w_o=2 * eye)"),
    ("object", "i2t.make_object('mugg')"),
    ("name", "i2t.load_mesh('mug.stl', 'mm')"),
]  # fmt: skip


def test_misuse_is_refused_in_one_sentence_that_names_the_argument():
    code = MISUSE.replace("{CALLS}", repr(CALLS))
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    wrong = []
    for name, call, kind, message in json.loads(done.stdout):
        named = re.search(rf"(?<![a-z_]){name}", message) and len(message) < 500 and "\n" not in message
        if kind not in REFUSALS or not named or "; " not in message:
            wrong.append((call, kind, message[:300]))
    assert wrong == []
    asked = {name for name in FUNCTIONS for _, call in CALLS if f"i2t.{name}(" in call}
    of_files = {name for name in FUNCTIONS if name.startswith(("load_", "save_"))}  # tests/files/test_hostile_files.py
    assert set(FUNCTIONS) - asked <= {*of_files, "use_compile_cache"}  # which takes nothing
