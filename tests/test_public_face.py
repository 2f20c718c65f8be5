"""`import i2t`: what it gives, what it costs, and that each name says what it takes and gives."""

import ast
import inspect
import re
import subprocess
import sys
import textwrap
from typing import Any

import jax
import numpy as np
import pytest

import i2t
from i2t import _HOME_OF
from i2t.skin.elasticity import GRID
from i2t.skin.pad import press_force

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
