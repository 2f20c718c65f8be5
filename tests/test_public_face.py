"""`import i2t`: what it gives, what it costs, and that each name says what it takes and gives."""

import inspect
import re
import subprocess
import sys

import pytest

import i2t
from i2t import _HOME_OF

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


@pytest.mark.parametrize("name", FUNCTIONS)
def test_after_the_data_arguments_are_named(name):
    kinds = [parameter.kind for parameter in inspect.signature(getattr(i2t, name)).parameters.values()]
    assert kinds.count(inspect.Parameter.POSITIONAL_OR_KEYWORD) <= 5  # at most five of them are data
